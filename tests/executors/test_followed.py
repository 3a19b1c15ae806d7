"""A training in a worker, as the command's trackers and its terminal see it."""

import json
import shutil
from pathlib import Path

import pytest

from tests.chain import TRAIN
from tests.conftest import Lab, tacpipe
from tests.trackers.conftest import tracked as tracked  # a fixture

pytestmark = [pytest.mark.long, pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")]


def test_trackers_and_the_terminal_follow_a_training_in_a_worker(
    tracked: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed", reason="the extra dask is not installed")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    shutil.rmtree(tracked.folder / "models" / "forward", ignore_errors=True)
    words = f"{TRAIN} -o models/forward --epochs 2 --seed 3 --rerun"
    for name, executor in (("there", "dask"), ("here", "local")):
        ran = tacpipe(tracked.folder, f"{words} --track keeping:{name}.jsonl --executor {executor}")
        assert ran.returncode == 0, ran.stderr
        assert "epoch 1/" in ran.stderr
        assert "trained " in ran.stderr

    in_worker, in_process = (
        [json.loads(line) for line in (tracked.folder / f"{name}.jsonl").read_text().splitlines()]
        for name in ("there", "here")
    )
    assert [call[0] for call in in_worker] == ["start", *["line"] * (len(in_worker) - 2), "end"]
    assert in_worker == in_process
