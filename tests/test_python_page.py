"""The Python of docs/python.md runs as printed, in a project in which the commands of the tutorial ran."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import tacpipe
from tests.test_docs import blocks

PAGE = Path(__file__).parents[1] / "docs" / "python.md"
COMMANDS = (
    "simulate forward --trials 12 --duration-s 5 -o data/recordings",
    "label data/recordings * --set object=cup",
    "synchronize data/recordings -o data/synced --rate-hz 25",
    "segment contacts data/synced -o data/segments",
    "split data/segments -o data/split",
    "train forward data/segments --split data/split -o models/forward --epochs 1 --hidden 8 --stride 2",
    "evaluate models/forward data/segments --split data/split -o results/forward",
    "predict models/forward data/synced -o data/predicted",
)
CHECKS = """
import html
import pyarrow.compute as pc
wanted = tacpipe.open("data/predicted")
assert m.predict(d).equals(wanted.table()), "the whole dataset"
table = wanted.table().filter(pc.equal(wanted.table()["recording"], "trial-003"))
one = m.predict(d["trial-003"])
assert one.num_rows and one.drop_columns("recording").equals(table.drop_columns("recording")), "one recording"
assert len(d) == len(d.labels) == 12 and (d.labels["object"] == "cup").all()
text = repr(d)
assert all(word in text for word in ("synchronize", "12", "25 Hz", "xela1", "cup")), text
assert "<table" in d._repr_html_() and html.escape("cup") in d._repr_html_()
train = d.select(split="data/split", role="train", object="cup")
roles = tacpipe.open("data/split").to_pandas()
assert set(train.recordings) == set(roles.recording[roles.role == "train"])
assert set(train.to_pandas()["recording"]) == set(train.recordings)
assert (train.to_pandas(labels=["object"])["object"] == "cup").all()
assert train.to_polars().shape == train.to_arrow().shape == train.to_pandas().shape
rows = train.duckdb().sql("select count(*) from data join labels using (recording) where object = 'cup'").fetchall()
assert rows == [(len(train.to_pandas()),)]
counts = sum(len(batch["recording"]) for batch in loader)
assert counts == len(d.windows(10, 10)) > 100
batch = next(iter(loader))
assert batch["past"].shape == batch["future"].shape == (64, 10, len(loader.dataset.columns))
assert batch["t_ns"].shape == (64, 20)
assert report.name == "report.html" and report.read_text().startswith("<!doctype html>") and len(segments) == 12
"""


@pytest.mark.long
def test_the_python_of_the_page_runs_as_printed_and_predicts_what_the_command_writes(tmp_path: Path) -> None:
    (tmp_path / ".tacpipe").mkdir()
    for command in COMMANDS:
        done = tacpipe(tmp_path, command, OMP_NUM_THREADS="1")
        assert done.returncode == 0, f"{command}: {done.stderr}"
    code = "\n".join([*blocks(PAGE.read_text(), "python"), CHECKS])
    ran = subprocess.run([sys.executable, "-W", "error", "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
