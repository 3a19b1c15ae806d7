"""Test that LeRobot's own loader, `datasets` and `mlcroissant` open exports offline and return values and names.

They need a separate environment: `make test-exports` creates it and runs these tests.
"""

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tacpipe
from tests.conftest import Lab
from tests.exports import recordings
from tests.fake_recordings import write_dataset
from tests.stages.test_extract import frames_of
from tests.video import videos

PYTHON = os.environ.get("TACPIPE_EXPORTS_PYTHON", "")
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not PYTHON, reason="needs LeRobot in an environment of its own: make test-exports"),
]


def read(tool: str, given: str) -> Any:
    """Return what a function of `tests.exports.reading` gives in the other environment."""
    ran = subprocess.run(
        [PYTHON, str(Path(__file__).with_name("reading.py")), tool, given],
        env={**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": str(Path("hub").absolute()), "PYTHONPATH": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)


def test_lerobot_s_loader_gives_values_names_tasks_and_windows_back(rig: Lab) -> None:
    rig.run("export lerobot rec -o lr --rate-hz 100 --actions arm --task 'press the {object}'")
    rig.run("synchronize rec -o sync --rate-hz 100")
    tables = [entry.table() for entry in tacpipe.open("sync")]
    result = read("lerobot", "lr")
    assert (result["frames"], result["episodes"], result["fps"]) == (sum(map(len, tables)), 2, 100)
    assert result["tasks"] == ["press the box", "press the cup"]
    assert result["recordings"] == ["trial-00", "trial-01"]
    for feature, stream, name, place in (
        ("observation.state", "arm", "position_y_m", 1),
        ("observation.tactile.skin", "skin", "taxel02_x", 3),
    ):
        values = np.concatenate([table[f"{stream}_{name}"].to_numpy() for table in tables]).astype(np.float32)
        np.testing.assert_array_equal(np.array(result["values"][feature], np.float32)[:, place], values)
    assert result["names"][1] == "position_y_m"
    assert result["values"]["tacpipe.t_ns"] == [value for table in tables for value in table["t_ns"].to_pylist()]
    assert result["policy"] == {
        "observation.state": "STATE",
        "observation.tactile.skin": "STATE",
        "observation.odd": "STATE",
        "action": "ACTION",
    }
    first = len(tables[0])
    state = np.array(result["values"]["observation.state"])
    np.testing.assert_array_equal(np.array(result["window"]), state[[first, first, first + 1]])
    assert result["padded"] == [True, False, False]
    np.testing.assert_allclose(result["mean"], np.mean(result["values"]["observation.tactile.skin"], axis=0))


def test_lerobot_s_loader_decodes_the_nearest_frame_of_each_row(lab: Lab) -> None:
    frames = {}
    for name, encoder, ending in (("a", "mpeg4", "avi"), ("b", "mjpeg", "avi")):
        path = videos.write(lab.folder / f"{name}.{ending}", encoder, 40)
        frames[name] = np.array(videos.decoded(path), int)
    write_dataset(lab.folder / "rec", {name: ({"gel": frames_of(lab.folder / f"{name}.avi")}, {}) for name in frames})
    lab.run("export lerobot rec -o lr --rate-hz 25 --no-originals")
    result = read("lerobot_video", "lr")
    assert result["frames"] == 80
    for row, pixels in zip(result["rows"], result["images"], strict=True):
        expected = frames["ab"[row // 40]][row % 40]
        assert np.abs(np.array(pixels) * 255 - np.moveaxis(expected, 2, 0)).mean() < 6


def test_the_hub_s_library_opens_each_configuration_of_a_card_in_its_own_types(rig: Lab) -> None:
    rig.run("export card rec -o card --license cc-by-4.0")
    result = read("hub", "card")
    assert {name: value["rows"] for name, value in result.items()} == {"arm": 400, "odd": 60, "skin": 80, "labels": 2}
    assert result["skin"]["types"]["taxel01_x"] == "uint16"
    assert result["odd"]["types"]["uint32"] == "uint32"
    assert result["skin"]["last"]["recording"] == "trial-01"
    assert result["skin"]["last"]["t_ns"] == recordings.skin(1)["t_ns"][-1].as_py()
    assert result["labels"]["last"]["object"] == "cup"


def test_the_hub_s_library_opens_a_dataset_directory_as_it_is(rig: Lab) -> None:
    result = read("parquet", str(rig.folder / "rec/*/skin.parquet"))
    assert result["rows"] == 80
    assert result["types"]["taxel01_x"] == "uint16"


def test_croissant_metadata_are_valid_and_lead_to_the_rows(rig: Lab) -> None:
    rig.run(
        "export card rec -o card --license https://creativecommons.org/licenses/by/4.0/ --creators us --title Touch "
        "--url https://example.org/touch --published 2026-01-31 --cite-as 'us, 2026'"
    )
    result = read("croissant", "card")
    assert (result["errors"], result["warnings"], result["name"]) == ([], [], "Touch")
    assert {name: value["rows"] for name, value in result["records"].items()} == {"arm": 400, "odd": 60, "skin": 80}
    lines = {entry["skin/recording"] for entry in [result["records"]["skin"]["last"]]}
    assert lines <= {"trial-00", "trial-01"}


def test_an_export_is_not_larger_than_lerobot_s_own_writer_makes_it(rig: Lab) -> None:
    rig.run("export lerobot rec -o lr --rate-hz 100 --actions arm --no-originals")
    theirs = read("add_frame", "lr")
    ours = sum(path.stat().st_size for path in (rig.folder / "lr/data").rglob("*.parquet"))
    assert theirs["frames"] > 0
    assert ours < theirs["bytes"]
