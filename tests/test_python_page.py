"""The Python of docs/python.md runs as printed, in the project that the first commands of the README make."""

from pathlib import Path

import pytest

from tests.conftest import run_python, tacpipe
from tests.test_docs import PYTHON, ROOT, fenced_blocks, printed_commands, section

FIRST_COMMANDS = "From data to a report"  # section of the README
CHECKS = """
import html
import pyarrow.compute as pc

predicted = tacpipe.open("data/predicted").table()
assert everything.equals(predicted), "the whole dataset"
table = predicted.filter(pc.equal(predicted["recording"], "trial-003"))
assert forecast.num_rows and forecast.drop_columns("recording").equals(table.drop_columns("recording")), "one recording"
assert len(d) == len(d.labels) == 12
text = repr(d)
assert all(word in text for word in ("synchronize", "12", " Hz", "xela1", "bottle")), text
assert "<table" in d._repr_html_() and html.escape("bottle") in d._repr_html_()
roles = tacpipe.open("data/split").to_pandas()
assert set(train.recordings) == set(roles.recording[roles.role == "train"]) == set(frame["recording"])
assert (frame["object"] == frame["recording"].map(d.labels["object"]).astype(frame["object"].dtype)).all()
assert train.to_polars().shape == train.to_arrow().shape == train.to_pandas().shape
assert set(peaks.df()["object"]) == set(train.labels["object"])
assert set(bottles.labels["object_class"]) == {"bottle"}
names = [name for name in raw.table("xela1").column_names if name.startswith("taxel")]
assert len(names) == 48 and set(names) < set(recording.table("xela1").column_names)
batch = next(iter(loader))
assert batch["past"].shape == (64, 10, 99) and batch["future"].shape == (64, 10, 96) and batch["t_ns"].shape == (64, 20)
whole = torch.cat([window["past"] for window in windows])
assert whole.mean(dim=0).abs().max() < 0.5 and (whole.std(dim=0) - 1).abs().max() < 0.5
bare = test.windows(10, 10, inputs=windows.inputs, targets=windows.targets, rest_s=0.5)
assert torch.allclose(counts, bare[0]["future"], atol=0.1)
assert report.name == "report.html" and report.read_text().startswith("<!doctype html>") and len(segments) == 12
"""


@pytest.mark.long
def test_the_python_of_the_page_runs_as_printed_and_predicts_what_the_command_writes(tmp_path: Path) -> None:
    (tmp_path / ".tacpipe").mkdir()
    (block, *_) = (block for block in fenced_blocks(section((ROOT / "README.md").read_text(), FIRST_COMMANDS)))
    commands = [command.removeprefix("tacpipe ") for command, _ in printed_commands(block.text)]
    for command in [*commands, "predict models/forward data/synced -o data/predicted"]:
        process = tacpipe(tmp_path, command, OMP_NUM_THREADS="1")
        assert process.returncode == 0, f"{command}: {process.stderr}"
    code = "\n".join([*(block.text for block in fenced_blocks(PYTHON.read_text()) if not block.mark), CHECKS])
    ran = run_python(tmp_path, "-W", "error", "-c", code)
    assert ran.returncode == 0, ran.stderr
