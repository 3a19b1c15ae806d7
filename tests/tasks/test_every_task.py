"""From Python a loaded model predicts recordings as the command does."""

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tacpipe
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.errors import UsageError
from tacpipe.io import terminal
from tacpipe.plugins import registry
from tacpipe.tasks.forward.prediction import ForwardModel
from tests.conftest import Lab
from tests.stages.learning_fakes import motion
from tests.tasks.forward import trials
from tests.tasks.material import textures
from tests.tasks.touch import handmade


def test_a_classifier_predicts_from_python_what_the_command_writes_to_the_last_bit(lab: Lab) -> None:
    lab.run("simulate material --trials 24 --materials 2 -o data/touched")
    lab.run("segment slides data/touched -o data/slides")
    lab.run("split data/slides -o data/split --stratify sensor,material")
    lab.run("train material data/slides --split data/split -o models/material --preset quick")
    lab.run("predict models/material data/slides -o data/predicted")
    model, given = tacpipe.load("models/material"), tacpipe.open("data/slides")
    wanted = tacpipe.open("data/predicted").table()
    assert model.predict(given).equals(wanted) and wanted.num_rows == 24
    shard = given.recordings["trial-007"]
    (row,) = model.predict(shard).to_pylist()
    same = next(one for one in wanted.to_pylist() if one["recording"] == "trial-007")
    assert row.keys() == same.keys()  # scores of one slide and of many differ by how products of matrices are rounded
    assert [row[name] for name in ("recording", "sensor", "material")] == list(same.values())[:3]
    assert list(row.values())[3:] == pytest.approx(list(same.values())[3:], rel=1e-4, abs=1e-5)
    frames, sensor = model.frames(shard)
    assert (sensor, frames.dtype) == (row["sensor"], np.float32)
    assert set(model.layouts[sensor].channels) <= set(shard.table("slide").column_names)
    assert model.predict(frames, sensor).tolist() == [row["material"]]
    chances = model.probabilities(frames, sensor)
    assert chances.sum() == pytest.approx(1.0) and model.classes[chances.argmax()] == row["material"]
    assert model.predict(tacpipe.open("data/touched")).equals(wanted)  # which are segmented on the way


def test_a_predictor_of_touch_predicts_from_python_what_the_command_writes_to_the_last_bit(lab: Lab) -> None:
    lab.run("simulate touch --trials 12 --objects 1 -o data/pinched")
    lab.run("segment grasps data/pinched -o data/grasps")
    lab.run("split data/grasps -o data/split --val 0")
    lab.run("train touch data/grasps --split data/split -o models/touch --architecture trees --trees 10")
    lab.run("predict models/touch data/grasps -o data/predicted")
    model, given = tacpipe.load("models/touch"), tacpipe.open("data/grasps")
    wanted = tacpipe.open("data/predicted").table()
    assert model.predict(given).equals(wanted) and wanted.num_rows == 12
    shard = given.recordings["trial-007"]
    (row,) = model.predict(shard).to_pylist()
    assert row == next(one for one in wanted.to_pylist() if one["recording"] == "trial-007")
    touch = model.predict(Cloud.from_table(shard.table("cloud")), Grasp.from_table(shard.table("grasp")))
    assert np.float32(touch.pdc_th) == row["pdc_th"] and np.float32(touch.e_mf[6]) == row["e_mf_07"]
    assert model.predict(tacpipe.open("data/pinched")["trial-007"]).to_pylist() == [row]  # segmented on the way
    with pytest.raises(UsageError, match="Give predict"):
        model.predict(Cloud.from_table(shard.table("cloud")))


def test_the_steps_from_python_are_those_of_the_command() -> None:
    steps = inspect.signature(ForwardModel.predict).parameters["steps"].default
    assert ",".join(map(str, steps)) == registry.load("predict").params().steps


def test_a_recording_that_no_dataset_was_opened_for_says_where_to_take_it_from() -> None:
    from tacpipe.datasets.dataset import Recording

    shard = Recording("trial-000", {"attributes": {}, "shards": {}}, lambda digest, path: b"")
    with pytest.raises(UsageError, match="trial-000"):
        _ = shard.alone


def forward(folder: Path) -> Callable[[], Any]:
    model = trials.trained(folder)
    return lambda: trials.evaluated(model, motion(20), motion(21))


def material(folder: Path) -> Callable[[], Any]:
    slides = textures.slides(0, 2), textures.slides(2, 1)
    model = textures.trained(folder, *slides, architecture="minirocket")
    return lambda: textures.evaluated(model, textures.slides(3, 1))


def touch(folder: Path) -> Callable[[], Any]:
    model = handmade.trained(folder, architecture="trees")
    return lambda: handmade.evaluated(model, handmade.recordings(6, 1))


@pytest.mark.parametrize("task", [forward, material, touch])
def test_an_evaluation_moves_a_bar_to_its_end(
    task: Callable[[Path], Callable[[], Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluate, bars = task(tmp_path), []

    @contextmanager
    def followed(description: str, total: int) -> Iterator[Callable[..., None]]:
        steps: list[int] = []
        bars.append((description, total, steps))
        yield lambda by=1, note="": steps.append(by)

    monkeypatch.setattr(terminal, "progress_bar", followed)
    evaluate()
    ((description, total, steps),) = bars
    assert description == "evaluate" and sum(steps) == total
    assert len(steps) > 1
