"""Results that other code computed are named on a hit, recomputed by --rerun, and code that breaks is shown itself."""

import json
import os
import shutil
import sys
from pathlib import Path

import pytest

from tests.conftest import Lab, make_once, tacpipe, write_plugin, write_source

STAGES = '''
"""Stages of a lab."""

from __future__ import annotations
from dataclasses import dataclass
from tacpipe import RecordingOutput, stage


@dataclass(frozen=True)
class Params:
    trials: int = 3
    factor: int = 2


@stage(version=1)
def made(params: Params, trial: Trial) -> RecordingOutput:
    """Return three numbers."""
    import pyarrow as pa

    return RecordingOutput({"left": pa.table({"x": [trial, 2, 3]})})


@stage(version=1)
def times(params: Params, recording: Recording) -> RecordingOutput:
    """Return the numbers, multiplied."""
    import pyarrow as pa
    import pyarrow.compute as pc

    table = recording.table("left")
    return RecordingOutput(pa.table({"x": pc.multiply(table["x"], params.factor)}), notes=NOTES)


@stage(version=1)
def sums(params: Params, recordings: Dataset) -> dict:
    """Return the sum of all numbers."""
    import lab_helper  # noqa: F401  (what is imported this late is code of the package too)

    total = sum(sum(shard.table()["x"].to_pylist()) for shard in recordings.recordings.values())
    return {"sum.txt": str(total).encode()}


@stage(version=1)
def fits(params: Params, recordings: Dataset, workspace: Workspace) -> dict:
    """Return the weights that a training writes, which is killed after its first epoch."""
    import lab_helper, os

    checkpoint = workspace / "checkpoint"
    if not checkpoint.exists():
        checkpoint.write_text(lab_helper.WEIGHTS)
        os._exit(9)
    return {"model.txt": checkpoint.read_bytes()}


NOTES = ()
'''
POINTS = "[tacpipe.stages]\nsimulate.numbers = lab_stages:made\ntimes = lab_stages:times\nsums = lab_stages:sums\n"
POINTS += "train.numbers = lab_stages:fits\n"
ESTIMATOR = '''
"""An estimator of a lab."""

from dataclasses import dataclass
from typing import Any, Literal
from tacpipe.tasks.regress.params import RegressParams


@dataclass(frozen=True)
class Nearest(RegressParams):
    """A regression."""

    architecture: Literal["nearest"] = "nearest"  # nearest: a regression

    def candidates(self, workspace: Any) -> Any:
        """Return the regression."""
        import lab_helper

        return {"nearest": lab_helper.fit}
'''
HELPER = """
def fit(examples, outputs, part):
    from tacpipe.tasks.learning.estimators import FittedLinear
    return FittedLinear.fit(examples, outputs, "quantity", features="last")
"""


def prepare_project(folder: Path) -> None:
    """Make a project with a plug-in of its own, whose recordings are made, multiplied and added up."""
    (folder / ".tacpipe").mkdir()
    package = folder / "package"
    write_plugin(package, "lab", POINTS, lab_stages=STAGES, lab_helper='WEIGHTS = "of ReLU"\n')
    (package / "lab.egg-info/top_level.txt").write_text("lab_stages\nlab_helper\n")
    run_printed(folder, "simulate numbers -o data/r")
    run_printed(folder, "times data/r -o data/t")
    run_printed(folder, "sums data/t -o data/s")


@pytest.fixture
def project(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Copy the project that `prepare_project` makes."""
    folder = tmp_path / "own"
    return shutil.copytree(make_once(tmp_path_factory, "own", prepare_project), folder, symlinks=True)


def call(folder: Path, command: str) -> tuple[int, str, str]:
    path = os.pathsep.join([str(folder / "package"), os.environ.get("PYTHONPATH", "")])
    process = tacpipe(folder, command, PYTHONPATH=path, PYTHONDONTWRITEBYTECODE="1")
    return process.returncode, process.stdout, process.stderr


def run_printed(folder: Path, command: str) -> str:
    code, out, err = call(folder, f"{command} --json")
    assert code == 0, out + err
    return out


def edit(folder: Path, before: str, after: str, module: str = "lab_stages") -> None:
    path = folder / f"package/{module}.py"
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))


def test_a_hit_on_results_of_edited_code_says_so_and_rerun_computes_them_again(project: Path) -> None:
    assert json.loads(run_printed(project, "times data/r -o data/t"))["notes"] == []
    edit(project, "params.factor)", "params.factor + 1)")
    first = json.loads(run_printed(project, "times data/r -o data/t"))
    assert (first["ran"], first["reused"]) == (0, 3)
    (note,) = first["notes"]
    assert note.startswith("3 of these results were computed by other code of times than there is now in lab_stages")
    assert "version 1" in note and "--rerun" in note
    (note,) = json.loads(run_printed(project, "sums data/t -o data/s"))["notes"]
    assert note.startswith("1 of these results were computed by other code of sums")
    rerun = json.loads(run_printed(project, "times data/r -o data/t --rerun"))
    assert (rerun["ran"], rerun["reused"], rerun["notes"]) == (3, 0, [])
    assert json.loads(run_printed(project, "times data/r -o data/t"))["notes"] == []
    run_printed(project, "sums data/t -o data/s --rerun")
    assert (project / "data/s/sum.txt").read_text() == str(3 * ((0 + 2 + 3) + (1 + 2 + 3) + (2 + 2 + 3)))


def test_new_recordings_do_not_hide_that_others_are_of_older_code(project: Path) -> None:
    edit(project, "params.factor)", "params.factor + 1)")
    run_printed(project, "simulate numbers -o data/r --trials 5 --rerun")
    for _ in range(2):  # The first run computes, the second is a hit.
        outcome = json.loads(run_printed(project, "times data/r -o data/t"))
        (note,) = outcome["notes"]
        assert note.startswith("3 of these results were computed by other code of times")
    assert outcome["reused"] == 5


def test_a_hit_names_the_package_of_which_a_module_was_edited_that_the_stage_imports_late(project: Path) -> None:
    assert json.loads(run_printed(project, "sums data/t -o data/s2"))["notes"] == []
    edit(project, "ReLU", "Tanh", "lab_helper")
    for command, count in (("sums data/t -o data/s2", 1), ("times data/r -o data/t", 3)):
        for _ in range(2):
            outcome = json.loads(run_printed(project, command))
            (note,) = outcome["notes"]
            assert outcome["ran"] == 0 and note.startswith(
                f"{count} of these results were computed by other code of the package lab than is installed now."
            )
    run_printed(project, "sums data/t -o data/s2 --rerun")
    assert json.loads(run_printed(project, "sums data/t -o data/s2"))["notes"] == []


@pytest.mark.long
def test_a_model_and_its_evaluation_name_the_edited_package_of_their_architecture(project: Path) -> None:
    package = project / "package"
    (package / "lab_estimator.py").write_text(ESTIMATOR)
    (package / "lab_helper.py").write_text(HELPER)
    (package / "lab.egg-info/top_level.txt").write_text("lab_estimator\nlab_helper\n")
    (package / "lab.egg-info/entry_points.txt").write_text(
        "[tacpipe.models]\nregress.nearest = lab_estimator:Nearest\n"
    )
    run_printed(project, "simulate forward --trials 4 --duration-s 4 -o data/f")
    run_printed(project, "synchronize data/f -o data/synced")
    run_printed(project, "split data/synced -o data/split --scheme random --val 0 --test 0.25")
    train = "train regress data/synced --split data/split -o models/m --architecture nearest --context-s 0"
    train += " --target gt_finger1_normal_n"
    evaluate = "evaluate models/m data/synced --split data/split -o results/m"
    assert json.loads(run_printed(project, train))["notes"] == json.loads(run_printed(project, evaluate))["notes"] == []
    edit(project, '"last"', '"statistics"', "lab_helper")
    for command in (train, evaluate):
        assert any(
            "other code of the package lab " in note for note in json.loads(run_printed(project, command))["notes"]
        ), command
    run_printed(project, f"{train} --rerun")
    assert not any("other code" in note for note in json.loads(run_printed(project, train))["notes"])


def test_a_training_never_resumes_a_checkpoint_that_other_code_wrote(project: Path) -> None:
    train = "train numbers data/r -o models/m"
    assert call(project, train)[0] == 9
    assert (
        run_printed(project, train) and (project / "models/m/model.txt").read_text() == "of ReLU"
    )  # The same code resumes it.
    assert call(project, f"{train}2 --factor 3")[0] == 9
    edit(project, "ReLU", "Tanh", "lab_helper")
    code, _, err = call(project, f"{train}2 --factor 3")
    assert code == 9 and "was written by other code; training starts over" in err
    run_printed(project, f"{train}2 --factor 3")
    assert (project / "models/m2/model.txt").read_text() == "of Tanh"
    assert not list((project / ".tacpipe/checkpoints").iterdir())


def test_a_change_of_a_built_in_stage_is_not_named_where_it_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    from tacpipe.engine import provenance
    from tacpipe.plugins import registry

    stage = registry.load("split")
    assert provenance.code(stage) is not None  # A checkout has a digest of its code.
    installed = "/usr/lib/python3/dist-packages/tacpipe_stages/split.py"
    monkeypatch.setattr(sys.modules[stage.function.__module__], "__file__", installed)
    assert provenance.code(stage) is None


@pytest.mark.parametrize(
    ("after", "words"),
    [
        ("import pyarrow.compute as pc; 1 / 0", "raised ZeroDivisionError on recording trial-000:"),
        ("import pyarrow.compute as pc; int('x')", "raised ValueError on recording trial-000:"),
    ],
)
def test_code_that_breaks_shows_its_own_frames_alone(project: Path, after: str, words: str) -> None:
    edit(project, "import pyarrow.compute as pc\n", f"{after}\n")
    code, out, err = call(project, "times data/r -o data/other --factor 5 --json")
    lines = err.splitlines()
    assert code == 1 and lines[0] == f"tacpipe: The code of stage times {words}"
    assert err.count('  File "') == 1 and f'File "{project}/package/lab_stages.py", line' in err and len(lines) <= 8
    failed = json.loads(out)
    assert failed["exit_code"] == 1 and words in failed["error"]
    path = os.pathsep.join([str(project / "package"), os.environ.get("PYTHONPATH", "")])
    full = tacpipe(project, "times data/r -o data/other --factor 5", PYTHONPATH=path, TACPIPE_TRACEBACK="1")
    assert full.returncode == 1 and full.stderr.count('  File "') > 5


@pytest.mark.parametrize(
    ("after", "words"),
    [("NOTES = (", "SyntaxError: '(' was never closed"), ("NOTES = 1 / 0", "ZeroDivisionError: division by zero")],
)
def test_a_module_that_cannot_be_loaded_is_one_sentence_though_its_results_are_stored(
    project: Path, after: str, words: str
) -> None:
    edit(project, "NOTES = ()", after)
    code, _, err = call(project, "times data/r -o data/t")
    assert (
        code == 1
        and err.count("\n") == 1
        and err.startswith("tacpipe: The module lab_stages of times cannot be loaded.")
    )
    line = 1 + STAGES.splitlines().index("NOTES = ()")
    assert words in err and f"lab_stages.py, line {line}" in err


def test_notes_of_a_stage_are_printed_once_for_all_recordings_and_on_a_hit_too(project: Path) -> None:
    edit(project, "NOTES = ()", 'NOTES = ("no number is above 100.",)')
    for ran_anew in (True, False):
        outcome = json.loads(run_printed(project, "times data/r -o data/n --factor 3"))
        assert outcome["notes"] == ["all 3 recordings: no number is above 100."] and (outcome["ran"] == 3) == ran_anew
    run_printed(project, "simulate numbers -o data/r --trials 5")
    edit(project, "notes=NOTES", "notes=NOTES if table['x'][0].as_py() < 2 else ()")
    code, _, err = call(project, "times data/r -o data/m --factor 4")
    assert code == 0 and "tacpipe: 2 recordings (trial-000, trial-001): no number is above 100.\n" in err


def test_a_run_of_which_no_recording_is_left_is_an_error_and_publishes_nothing(lab: Lab) -> None:
    write_source("src", a="one", b="two")
    ran = lab.call("ingest numbers src -o data/r --skip-bad")
    assert ran.code == 1 and "could not read any of the 2 recordings" in ran.err and not Path("data/r").exists()


def test_rerun_does_not_go_with_check(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    for option in ("--check", "--recompute-and-compare"):
        assert lab.call(f"simulate toy -o data/r --rerun {option}").code == 2


@pytest.mark.parametrize(
    ("command", "code"),
    [
        ("scale data/none -o data/s --json", 2),
        ("scale data/r -o data/s --factor x --json", 2),
        ("scale data/r -o data/s --refuse 0 --json", 1),
        ("scale data/r -o data/new --check --json", 3),
        ("label data/r nobody --set a=b --json", 2),
        ("show data/none --json", 2),
        ("explain data/none --json", 2),
        ("store checkout 000000 -o x --json", 2),
        ("store push s3://key:word@bucket/x data/r --json", 2),
        ("store nothing --json", 2),
    ],
)
def test_json_prints_one_object_on_errors_too(lab: Lab, command: str, code: int) -> None:
    lab.run("simulate toy -o data/r")
    failed = lab.call(command)
    value = json.loads(failed.out)
    assert failed.code == code == value["exit_code"] and set(value) == {"schema_version", "error", "exit_code"}
    assert value["error"] in failed.err


def test_a_recording_that_lost_a_stream_is_one_object_with_the_error_in_it(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("rig.toml").write_text('[[stream]]\nname = "f"\nsensor = "pulse"\ntransport = "serial:/dev/ttyACM0"\n')
    monkeypatch.setattr("tacpipe_stages.acquire.record", lambda *arguments, **options: ([], ["f was lost."]))
    failed = lab.call("acquire rig.toml -o rec --json")
    value = json.loads(failed.out)
    assert failed.code == value["exit_code"] == 5 and value["error"].endswith("f was lost.")
    assert (value["output"], value["recordings"]) == ("rec", []) and value["error"] in failed.err


def test_label_prints_what_it_changed_as_json(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    value = lab.run_json("label data/r trial-00[12] --set material=foam")
    assert value == {
        "schema_version": 1,
        "output": "data/r",
        "recordings": ["trial-001", "trial-002"],
        "labels": {"material": "foam"},
    }


@pytest.mark.parametrize(
    "command",
    [
        "store push ftp://bucket/x data/r",
        "store pull http://bucket/x data/r",
        "scale s3://bucket/r -o data/s",
        "scale data/r -o gs://bucket/s",
        "ingest numbers https://host/src -o data/i",
        "label s3://bucket/r trial-000 --set a=b",
        "show s3://bucket/r",
        "store checkout data/r -o s3://bucket/r",
        "acquire rig.toml -o s3://bucket/r",
        "demo -o s3://bucket/demo",
    ],
)
def test_an_address_is_refused_wherever_a_path_is_wanted_and_no_folder_is_made(lab: Lab, command: str) -> None:
    lab.run("simulate toy -o data/r")
    before = sorted(path.name for path in lab.folder.iterdir())
    failed = lab.call(command)
    assert failed.code == 2 and "address" in failed.err and failed.err.count("\n") == 1, failed
    assert sorted(path.name for path in lab.folder.iterdir()) == before


def test_an_address_is_refused_as_the_store_and_from_python(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    import tacpipe as library
    from tacpipe.errors import UsageError
    from tacpipe.maintenance import transfer

    lab.run("simulate toy -o data/r")
    with pytest.raises(UsageError, match="s3://bucket/r is an address"):
        library.open("s3://bucket/r")
    with pytest.raises(UsageError, match="s3://bucket/x is an address"):
        transfer.push(Path("s3://bucket/x"), [Path("data/r")])
    monkeypatch.setenv("TACPIPE_STORE", "ftp://bucket/store")
    refused = lab.call("store status")
    assert refused.code == 2 and "ftp://" in refused.err and refused.err.count("\n") == 1
    assert not Path("s3:").exists() and not Path("ftp:").exists()
