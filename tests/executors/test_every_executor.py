"""Test that every executor gives the same datasets, errors and exit codes."""

import shutil
from pathlib import Path

import pytest

from tests.conftest import Lab

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
TRIALS = 12  # more than this process would compute by itself


@pytest.fixture(
    params=["local", *(pytest.param(name, marks=pytest.mark.long) for name in ("dask", "slurm"))],
)
def executor(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """An executor as `--executor` takes it."""
    fixtures = {"dask": "scheduler", "slurm": "slurm"}
    address: str = "local" if request.param == "local" else request.getfixturevalue(fixtures[request.param])
    return address


def simulate_recordings(lab: Lab, trials: int = TRIALS) -> None:
    lab.run(f"simulate toy -o data/rec --trials {trials} --jobs 1")


def test_every_recording_gives_the_bytes_that_one_process_gives(lab: Lab, executor: str) -> None:
    simulate_recordings(lab)
    lab.run("scale data/rec -o data/one --jobs 1")
    expected = lab.manifest("data/one")
    shutil.rmtree(lab.folder / ".tacpipe/records")
    ran = lab.run(f"scale data/rec -o data/other --jobs 2 --executor {executor}")
    assert f"{TRIALS} ran, 0 reused" in ran.err
    assert lab.manifest("data/other").content == expected.content


def test_a_stage_over_a_whole_dataset_and_a_fit_give_the_bytes_that_this_process_gives(lab: Lab, executor: str) -> None:
    simulate_recordings(lab, 4)
    for command in ("total data/one", "halves data/one", "centre data/one --split data/halves"):
        name = command.split()[0]
        lab.run("scale data/rec -o data/one --jobs 1")
        lab.run(f"{command} -o data/{name} --jobs 1")
        expected = lab.manifest(f"data/{name}").content
        shutil.rmtree(lab.folder / ".tacpipe/records")
        shutil.rmtree(lab.folder / f"data/{name}")
        lab.run(f"{command} -o data/{name} --executor {executor}")
        assert lab.manifest(f"data/{name}").content == expected


def test_files_named_from_this_folder_are_found(lab: Lab, executor: str) -> None:
    (lab.folder / "raw").mkdir()
    for number in range(TRIALS):
        (lab.folder / f"raw/{number:02}.txt").write_text(f"{number} 7")
    lab.run(f"ingest numbers raw -o data/rec --jobs 2 --executor {executor}")
    assert len(lab.manifest("data/rec").recordings) == TRIALS


def test_a_bad_recording_is_refused_or_left_out(lab: Lab, executor: str) -> None:
    (lab.folder / "raw").mkdir()
    for number in range(TRIALS):
        (lab.folder / f"raw/{number:02}.txt").write_text("x" if number == 5 else "1")
    refused = lab.call(f"ingest numbers raw -o data/rec --jobs 2 --executor {executor}")
    assert refused.code == 1
    assert "05.txt" in refused.err
    assert not (lab.folder / "data/rec").exists()
    left_out = lab.run(f"ingest numbers raw -o data/rec --jobs 2 --skip-bad --executor {executor}")
    assert "11 reused" in left_out.err
    assert set(lab.manifest("data/rec").skipped) == {"05"}


def test_a_mistake_in_a_stage_shows_its_own_line(lab: Lab, executor: str, plugin: Path) -> None:
    simulate_recordings(lab)
    ran = lab.call(f"scale data/rec -o data/out --pause-s=-1 --jobs 2 --executor {executor}")
    assert ran.code == 1
    assert "toy_stages.py" in ran.err
    assert "ValueError" in ran.err


def test_what_is_stored_is_compared(lab: Lab, executor: str) -> None:
    simulate_recordings(lab)
    lab.run("scale data/rec -o data/out --jobs 1")
    ran = lab.run(f"scale data/rec -o data/out --recompute-and-compare --jobs 2 --executor {executor}")
    assert f"{TRIALS} ran" in ran.err


def test_the_environment_names_an_executor_and_the_command_another(
    lab: Lab, executor: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulate_recordings(lab, 2)
    monkeypatch.setenv("TACPIPE_EXECUTOR", "none-such")
    assert lab.call("scale data/rec -o data/out").code == 2
    lab.run(f"scale data/rec -o data/out --executor {executor}")


def test_a_hit_needs_no_worker(lab: Lab) -> None:
    simulate_recordings(lab, 2)
    lab.run("scale data/rec -o data/out")
    assert "0 ran" in lab.run("scale data/rec -o data/out --executor dask://localhost:1").err
