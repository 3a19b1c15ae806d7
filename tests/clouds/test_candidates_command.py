"""The command ``tacpipe candidates``."""

import csv
import io
import json
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import open3d
import pytest

from tacpipe.cli import candidates as candidates_command
from tacpipe.clouds.candidates import candidates
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.tasks.touch.model import grasp_values
from tests.clouds import shapes
from tests.conftest import Lab
from tests.fake_recordings import write_dataset


class Model:
    """Predicts what follows from the opening by hand."""

    def predict(self, cloud: Cloud, grasp: Grasp) -> SimpleNamespace:
        """Return a touch whose pressure is the opening in millimetres, and whose electrodes are numbered."""
        assert len(cloud) > 1000
        numbered = np.arange(1, 25.0)
        return SimpleNamespace(pdc_th=grasp.opening_m * 1e3, pdc_mf=1800.0, e_th=numbered, e_mf=100 * numbered)


@pytest.fixture
def bottle(lab: Lab) -> Cloud:
    """A file ``bottle.ply`` with a cloud."""
    cloud = shapes.visible_half(shapes.cylinder(0.035, 0.2))
    point_cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.points_m.astype(float)))
    open3d.io.write_point_cloud(Path("bottle.ply"), point_cloud)
    return cloud


def rows(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_csv_holds_what_the_function_returns(lab: Lab, bottle: Cloud) -> None:
    proposals = candidates(bottle, count=4, seed=2)
    printed = rows(lab.run("candidates bottle.ply --count 4 --seed 2").out)
    assert [row["rank"] for row in printed] == ["1", "2", "3", "4"]
    for row, candidate in zip(printed, proposals, strict=True):
        assert float(row["opening_m"]) == pytest.approx(candidate.grasp.opening_m, abs=1e-6)
        assert float(row["g2_y_m"]) == pytest.approx(candidate.grasp.g2_m[1], abs=1e-6)
        assert candidate.grasp.wrist is not None
        assert float(row["wrist_x_z"]) == pytest.approx(candidate.grasp.wrist[2, 0], abs=1e-6)
        assert float(row["wrist_z_x"]) == pytest.approx(candidate.grasp.wrist[0, 2], abs=1e-6)


def test_limits_and_the_shift_reach_the_search(lab: Lab, bottle: Cloud) -> None:
    assert len(rows(lab.run("candidates bottle.ply --shift 0").out)) == 1
    refused = lab.call("candidates bottle.ply --opening-mm 20 40")
    assert refused.code == 1
    assert "mm wide where it was cut, and the fingers open 20 to 40 mm" in refused.err


def test_with_a_model_each_row_has_the_fifty_values_with_their_units(
    lab: Lab, bottle: Cloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded_paths: list[Path] = []

    def load(path: Path) -> Any:
        loaded_paths.append(path)
        return partial(grasp_values, cast(Any, Model()))

    monkeypatch.setattr(candidates_command, "_predict_grasp", load)
    value = json.loads(lab.run("candidates bottle.ply --model models/touch --count 3 --json").out)
    assert loaded_paths == [Path("models/touch")]
    counts = [name for name, unit in value["units"].items() if unit == "count"]
    assert len(counts) == 50
    first = value["candidates"][0]
    assert first["pdc_th_counts"] == pytest.approx(first["opening_m"] * 1e3, abs=0.06)
    assert (first["e_th_01_counts"], first["e_mf_24_counts"]) == (1, 2400)
    assert value["units"]["g1_x_m"] == "m" and value["units"]["off_deg"] == "degree"


def test_a_terminal_gets_a_table_with_the_mean_of_the_electrodes(
    lab: Lab, bottle: Cloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(candidates_command, "_predict_grasp", lambda path: partial(grasp_values, cast(Any, Model())))
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "160")
    printed = lab.run("candidates bottle.ply --model models/touch --count 2").out.splitlines()
    heading = next(line for line in printed if "score" in line)
    assert "mean E mf" in heading and "approach" in heading
    assert [line.split()[-2:] for line in printed if line.strip()[:1] in ("1", "2")] == [["12", "1250"]] * 2


@pytest.mark.parametrize("suffix", ["png", "svg"])
def test_files_are_written_whole_and_a_picture_is_drawn(lab: Lab, bottle: Cloud, suffix: str) -> None:
    printed = lab.run(f"candidates bottle.ply -o new/grasps.csv --picture new/grasps.{suffix}").out
    assert printed == "new/grasps.csv\n"
    assert len(rows(Path("new/grasps.csv").read_text())) == 10
    begins = {"png": b"\x89PNG", "svg": b"<?xml"}[suffix]
    assert Path(f"new/grasps.{suffix}").read_bytes().startswith(begins)
    assert sorted(path.name for path in Path("new").iterdir()) == sorted(["grasps.csv", f"grasps.{suffix}"])


def test_a_dataset_is_asked_for_one_recording(lab: Lab, bottle: Cloud) -> None:
    grasp = bottle.table()
    write_dataset(
        Path("data/grasps"),
        {"bleach-1": ({"cloud": bottle.table(), "grasp": grasp}, {}), "bleach-2": ({"grasp": grasp}, {})},
    )
    printed = rows(lab.run("candidates data/grasps --recording bleach-1 --count 3").out)
    assert printed == rows(lab.run("candidates bottle.ply --count 3").out)
    for words, sentence in (
        ("", "has 2 recordings. Choose one with --recording: bleach-1, bleach-2"),
        ("--recording wood-1", "no recording wood-1"),
        ("--recording bleach-2", "has no cloud; it has the streams grasp"),
    ):
        refused = lab.call(f"candidates data/grasps {words}")
        assert refused.code == 2 and sentence in refused.err, refused.err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("nowhere.ply", "nowhere.ply does not exist"),
        ("nowhere", "nowhere does not exist or is empty"),
        ("bottle.ply --recording a", "--recording a selects from a dataset"),
        ("bottle.ply -o grasps.xlsx", "grasps.xlsx must end in .csv"),
        ("bottle.ply --picture grasps.doc", ".pdf, .png, .svg"),
        ("bottle.ply --count 0", "0 candidates"),
        ("bottle.ply --camera-m 0.05 -0.1 1.2", "is inside the cloud"),
        ("bottle.ply --model nowhere", "nowhere does not exist or is empty"),
    ],
)
def test_a_mistake_is_a_sentence(lab: Lab, bottle: Cloud, words: str, sentence: str) -> None:
    refused = lab.call(f"candidates {words}")
    assert refused.code in (1, 2)
    assert sentence in refused.err and "Traceback" not in refused.err
    assert [path.name for path in Path().iterdir() if path.name.startswith("grasps")] == []


def test_a_model_of_another_task_is_refused(lab: Lab, bottle: Cloud, chained: Path) -> None:
    refused = lab.call(f"candidates bottle.ply --model {chained}/models/forward")
    assert refused.code == 2
    assert "models/forward is a model of task forward" in refused.err
