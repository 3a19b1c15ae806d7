import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pytest

import tacpipe
from tacpipe.formats.table import text
from tests.conftest import Lab, Ran
from tests.formats.table import labs

LAYOUT = """
[streams.skin]
files = "trial_{trial}/skin.csv"
time = { column = "time" }
columns = [
    { match = "taxel{taxel}", quantity = "tactile", unit = "count", type = "uint16" },
    { match = "fx", name = "force_x_n", quantity = "force", unit = "N" },
]

[[labels]]
file = "labels.csv"
key = "trial"
"""
INGEST = "ingest table own --layout layout.toml -o data/rec"


@pytest.fixture
def trial_lab(lab: Lab) -> Lab:
    """A project with a lab's own folder of three trials, their labels and a layout."""
    labs.write(lab.folder / "own")
    _label(lab, ["cork", "felt", "cork"])
    (lab.folder / "layout.toml").write_text(LAYOUT)
    return lab


def _label(lab: Lab, materials: list[str]) -> None:
    frame = pd.DataFrame({"trial": range(3), "material": materials})
    frame.to_csv(lab.folder / "own" / "labels.csv", index=False)


def counts(ran: Ran) -> tuple[int, int]:
    """Return how many recordings were read, and how many were in the store."""
    content = json.loads(ran.out)
    return content["ran"], content["reused"]


def test_a_labs_own_tables_become_recordings_with_labels(trial_lab: Lab) -> None:
    trial_lab.run(INGEST)
    result = tacpipe.open("data/rec")
    assert [entry.name for entry in result] == ["trial_0", "trial_1", "trial_2"]
    assert [entry.attributes["material"] for entry in result] == ["cork", "felt", "cork"]
    frame = labs.frame(seed=1)
    assert result["trial_1"].table("skin").column("taxel4").to_pylist() == frame["taxel4"].tolist()


def test_what_did_not_change_is_not_read_again(trial_lab: Lab) -> None:
    assert counts(trial_lab.run(f"{INGEST} --json")) == (3, 0)
    (trial_lab.folder / "layout.toml").write_text("# a comment\n" + LAYOUT)
    assert counts(trial_lab.run(f"{INGEST} --json")) == (0, 3)


def test_one_changed_line_of_a_shared_table_of_labels_costs_one_recording(trial_lab: Lab) -> None:
    trial_lab.run(INGEST)
    _label(trial_lab, ["cork", "foam", "cork"])
    assert counts(trial_lab.run(f"{INGEST} --json")) == (1, 2)
    assert [entry.attributes["material"] for entry in tacpipe.open("data/rec")] == ["cork", "foam", "cork"]


def test_one_changed_file_costs_one_recording_and_is_not_taken_for_the_same(trial_lab: Lab) -> None:
    trial_lab.run(INGEST)
    labs.frame(seed=7).to_csv(trial_lab.folder / "own" / "trial_2" / "skin.csv", index=False)
    refused = trial_lab.call(INGEST)
    assert refused.code == 2 and "trial_2" in refused.err
    assert counts(trial_lab.run(f"{INGEST} --replace --json")) == (1, 2)


def test_a_dry_run_describes_and_writes_nothing(trial_lab: Lab) -> None:
    printed = trial_lab.run("ingest table own --layout layout.toml --dry-run").out
    for part in ("3 recordings", "100 Hz", "tactile, count, uint16", "label material: cork, felt"):
        assert part in printed
    assert not (trial_lab.folder / "data").exists()


def test_a_guess_needs_no_layout(trial_lab: Lab) -> None:
    printed = trial_lab.run("ingest table own --guess").out
    assert 'files = "trial_{trial}/skin.csv"' in printed and 'file = "labels.csv"' in printed


def test_many_recordings_in_one_file_are_recordings_each(lab: Lab) -> None:
    all_items = pd.concat([labs.frame(seed=trial).assign(trial=f"t{trial}") for trial in range(3)])
    (lab.folder / "own").mkdir()
    all_items.to_csv(lab.folder / "own" / "all.csv", index=False)
    text = LAYOUT.partition("[[labels]]")[0].replace('"trial_{trial}/skin.csv"', '"all.csv"\nrecording = "trial"')
    (lab.folder / "layout.toml").write_text(text)
    lab.run(INGEST)
    result = tacpipe.open("data/rec")
    assert [entry.name for entry in result] == ["t0", "t1", "t2"]
    assert result["t2"].table("skin").column("taxel1").to_pylist() == labs.frame(seed=2)["taxel1"].tolist()


MANY = """
[streams.skin]
files = "all.csv"
recording = "trial"
time = { column = "time" }
columns = [{ match = "fx" }, { match = "taxel{taxel}", type = "uint16" }]
"""


def write_shared_file(lab: Lab, recordings: int, *, mixed: bool) -> dict[str, pd.DataFrame]:
    """Write one file of many recordings, one after another or with their rows mixed; return these by name."""
    frames = {f"t{number:02d}": labs.frame(20 + number, seed=number) for number in range(recordings)}
    full = pd.concat([frame.assign(trial=name) for name, frame in frames.items()], ignore_index=True)
    (lab.folder / "own").mkdir()
    full = full.sort_values("time", kind="stable") if mixed else full
    full.to_csv(lab.folder / "own" / "all.csv", index=False)
    (lab.folder / "layout.toml").write_text(MANY)
    return frames


@pytest.mark.parametrize("mixed", [False, True])
def test_a_file_of_many_recordings_is_read_as_often_for_many_as_for_one(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, mixed: bool
) -> None:
    times: list[Path] = []
    read = text.TextTable.batches

    def counted(file: text.TextTable, types: Mapping[str, pa.DataType]) -> Iterator[pa.Table]:
        times.append(file.path)
        return read(file, types)

    monkeypatch.setattr(text.TextTable, "batches", counted)
    monkeypatch.setattr(text, "BLOCK_BYTES", 1000)
    frames = write_shared_file(lab, 5, mixed=mixed)
    lab.run(INGEST)
    assert len(times) == 2  # one pass reads the names of the recordings, one their rows
    result = tacpipe.open("data/rec")
    assert {entry.name: entry.table("skin").column("fx").to_pylist() for entry in result} == {
        name: frame["fx"].tolist() for name, frame in frames.items()
    }
    assert not list((lab.store.root / "tmp").iterdir())


def test_workers_share_one_cut_of_a_file_and_leave_nothing(lab: Lab) -> None:
    frames = write_shared_file(lab, 9, mixed=True)
    assert counts(lab.run(f"{INGEST} --json --jobs 2")) == (9, 0)
    result = tacpipe.open("data/rec")
    assert {entry.name: entry.table("skin").column("taxel2").to_pylist() for entry in result} == {
        name: frame["taxel2"].tolist() for name, frame in frames.items()
    }
    assert not list((lab.store.root / "tmp").iterdir())


def test_a_wrong_cell_of_one_recording_of_many_is_named_by_its_line(lab: Lab) -> None:
    write_shared_file(lab, 3, mixed=False)
    path = lab.folder / "own" / "all.csv"
    lines = path.read_text().splitlines()
    cells = lines[30].split(",")
    lines[30] = ",".join(["oops", *cells[1:]])
    path.write_text("\n".join(lines))
    assert "line 31, column time holds 'oops'" in lab.call(INGEST).err
    lines[30] = ",".join([str(labs.START_S - 5), *cells[1:]])
    path.write_text("\n".join(lines))
    ran = lab.call(INGEST)
    assert "t01: own/all.csv, line 31: the stamp is" in ran.err and "t00: read, 20 rows" in ran.err
    assert not list((lab.store.root / "tmp").iterdir())


@pytest.mark.parametrize(
    ("change", "code", "parts"),
    [
        (lambda folder: (folder / "layout.toml").unlink(), 2, ("layout.toml",)),
        (lambda folder: (folder / "layout.toml").write_text("x = ["), 2, ("layout.toml", "TOML")),
        (
            lambda folder: (folder / "own/trial_1/skin.csv").write_text("time,fx\n0,1\n"),
            1,
            ("trial_1/skin.csv", "taxel"),
        ),
        (
            lambda folder: (folder / "own/labels.csv").write_text("trial,material\n0,cork\n"),
            1,
            ("labels.csv", "trial_1"),
        ),
    ],
)
def test_a_mistake_is_one_sentence_with_its_place(
    trial_lab: Lab, change: Callable[[Path], object], code: int, parts: tuple[str, ...]
) -> None:
    change(trial_lab.folder)
    ran = trial_lab.call(INGEST)
    assert ran.code == code and all(part in ran.err for part in parts), ran.err
    assert not (trial_lab.folder / "data/rec").exists()


def test_files_that_no_recording_is_read_from_are_named_at_each_run(trial_lab: Lab) -> None:
    (trial_lab.folder / "own" / "trial_0" / "camera.mp4").write_bytes(b"video")
    (trial_lab.folder / "own" / "trial_1" / "tactile.npz").write_bytes(b"array")
    (trial_lab.folder / "own" / "notes" / "later").mkdir(parents=True)
    labs.frame().to_csv(trial_lab.folder / "own" / "notes" / "later" / "skin.csv", index=False)
    (trial_lab.folder / "own" / ".DS_Store").write_bytes(b"")
    for _ in range(2):  # the second run has nothing to compute
        printed = trial_lab.run(INGEST).err
        notes = [line for line in printed.splitlines() if "not read" in line]
        assert [line.split(" file")[0] for line in notes] == ["tacpipe: 1 .csv", "tacpipe: 1 .mp4", "tacpipe: 1 .npz"]
        assert "notes/later/skin.csv" in notes[0] and "no `files` of the layout matches" in notes[0]
    assert "camera.mp4" in trial_lab.run("ingest table own --layout layout.toml --dry-run").out
    assert "labels.csv" not in printed  # labels are read


@pytest.mark.parametrize(("unit", "rate"), [("ms", "100,000 Hz"), ("us", "1e+08 Hz")])
def test_stamps_in_a_wrong_unit_are_a_warning_with_the_rate_that_they_give(
    trial_lab: Lab, unit: str, rate: str
) -> None:
    assert "Hz" not in trial_lab.run(INGEST).err
    (trial_lab.folder / "layout.toml").write_text(
        LAYOUT.replace('column = "time"', f'column = "time", unit = "{unit}"')
    )
    printed = trial_lab.run(f"{INGEST} --replace").err
    assert rate in printed and "unit" in printed and "all 3 recordings" in printed
    assert rate in trial_lab.run("ingest table own --layout layout.toml --dry-run").out
