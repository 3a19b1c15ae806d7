"""`tacpipe try` guesses what a folder is, and runs the pipeline on it with commands that it prints."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.cli import first_try
from tests.conftest import Lab
from tests.conftest import tacpipe as run_tacpipe
from tests.test_api import publish


def write_lab(folder: Path, objects: tuple[str, ...] = ("cup", "can", "box"), trials: int = 4) -> None:
    """Write grasps of objects, each harder than the last, by a skin at 100 Hz and a robot at 50 Hz."""
    rng = np.random.default_rng(0)
    for force_n, name in enumerate(objects, 1):
        for trial in range(trials):
            place = folder / f"{name}_{trial}"
            place.mkdir(parents=True)
            load = np.clip(np.sin(np.arange(200) / 80), 0, None) * force_n
            taxels = 1000 + 300 * load[:, None] + rng.normal(0, 3, (200, 4))
            rows = [",".join(map(str, [row / 100, *taxels[row].round()])) for row in range(200)]
            (place / "skin.csv").write_text("\n".join(["time,taxel1,taxel2,taxel3,taxel4", *rows]) + "\n")
            rows = [f"{row / 50},{load[2 * row]:.3f}" for row in range(100)]
            (place / "robot.csv").write_text("\n".join(["time,force", *rows]) + "\n")


@pytest.mark.long
def test_a_folder_of_tables_ends_in_a_report_and_a_changed_guess_is_used(tmp_path: Path) -> None:
    write_lab(tmp_path / "lab")
    ran = run_tacpipe(tmp_path, "try lab -o first")
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.strip() == "first/report.html" and (tmp_path / "first/report.html").exists()
    commands = [line.split()[2] for line in ran.stderr.splitlines() if line.startswith("$ ")]
    assert commands == ["ingest", "ingest", "check", "synchronize", "split", "train", "evaluate", "report"]
    assert "on 6 recordings" in ran.stderr and "--label folder1" in ran.stderr

    layout = tmp_path / "first/layout.toml"
    layout.write_text(layout.read_text().replace("{folder1}", "{object}"))
    ran = run_tacpipe(tmp_path, "try lab -o first")
    assert ran.returncode == 0 and "--label object" in ran.stderr and "--guess" not in ran.stderr


@pytest.mark.parametrize(
    ("files", "kind"),
    [
        (["a/skin.csv", "a/robot.csv"], "table"),
        (["a.mcap", "b.mcap", "c.db3"], "mcap"),
        (["a.bag"], "rosbag"),
        (["demo.hdf5", "notes.txt"], "hdf5"),
        (["a.xdf"], "xdf"),
        (["set/meta/info.json", "set/data/0.parquet"], "lerobot"),
        (["replay.zarr/.zgroup"], "zarr"),
        (["images/1.png", "images/2.png", "targets.csv"], "table"),
    ],
)
def test_the_format_is_that_of_most_files(files: list[str], kind: str, tmp_path: Path) -> None:
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    assert first_try.format_of(tmp_path) == kind


def stream(**quantities: str) -> pa.Table:
    """A stream of two rows with a column of each quantity."""
    fields = [pa.field(name, pa.float32(), metadata={"quantity": value}) for name, value in quantities.items()]
    schema = pa.schema([pa.field("t_ns", pa.int64()), *fields])
    return pa.table([[0, 10**7], *[[0.0, 1.0]] * len(fields)], schema=schema)


SKIN, ROBOT, ARM = stream(taxel1="tactile"), stream(fz="force"), stream(x="position")


@pytest.mark.parametrize(
    ("streams", "labels", "expected"),
    [
        ({"": SKIN}, ["cup", "can"], ["split", "train classify", "evaluate", "report"]),
        ({"": SKIN}, ["cup", "cup"], []),
        ({"skin": SKIN, "ft": ROBOT}, ["cup", "can"], ["synchronize", "split", "train classify", "evaluate", "report"]),
        ({"skin": SKIN, "ft": ROBOT}, ["", ""], ["synchronize", "split", "train regress", "evaluate", "report"]),
        ({"skin": SKIN, "arm": ARM}, ["", ""], ["synchronize"]),
        ({"arm": ARM}, ["cup", "can"], []),
    ],
)
def test_what_is_learned_follows_from_labels_and_quantities(
    streams: dict[str, pa.Table], labels: list[str], expected: list[str], lab: Lab
) -> None:
    names = [f"trial-{number}" for number in range(8)]
    stated = {"object": labels * 4} if any(labels) else {}
    commands = first_try.commands_after(publish(lab, "r", dict.fromkeys(names, streams), **stated), Path("out"))
    assert [" ".join(words[: 2 if words[0] == "train" else 1]) for words in commands] == expected


def test_open_shows_the_page_in_a_browser_and_no_folder(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    page = lab.folder / "report.html"
    page.touch()
    for shown in (page, lab.folder):
        monkeypatch.setattr("tacpipe.cli.first_try.run", lambda folder, output, shown=shown: shown)
        assert lab.run("try lab --open").out.strip() == str(shown)
    assert opened == [page.as_uri()]
