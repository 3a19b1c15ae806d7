"""Forecasts of rigs other than the paper's: no arm, an arm of any name, one axis, other units."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.scores import headline
from tacpipe.tasks.forward import evaluation as forward_evaluation
from tacpipe.tasks.forward import prediction
from tacpipe.tasks.forward import prediction as forward_prediction
from tacpipe.tasks.forward import training as forward_training
from tacpipe.tasks.forward.prediction import ForwardModel
from tests.fake_recordings import FakeShard, dataset
from tests.tasks.forward.trials import CONTEXT, HORIZON, params

AXES = ("x", "y", "z")


def recording(
    seed: int,
    *,
    taxels: int = 5,
    declared: bool = True,
    unit: str = "kPa",
    place: str | None = "mm",
    turned: bool = False,
) -> FakeShard:
    """An array of one axis whose taxels feel how far a stage has moved; ``place`` is the stage's unit, None: no stage."""
    rng, rows = np.random.default_rng(seed), 90
    moved = 0.1 * np.sin(2 * np.pi * (1 + 0.3 * rng.random()) * np.arange(rows) * 0.02 + rng.random())
    columns: dict[str, Any] = {"t_ns": np.arange(rows) * 20_000_000}
    about: dict[str, dict[str, str]] = {"t_ns": {"quantity": "time", "unit": "ns"}}
    for taxel in range(taxels):
        name = f"pad_{taxel}"
        columns[name] = (3 + moved * (taxel + 1) + rng.normal(0, 1e-3, rows)).astype(np.float32)
        about[name] = {"quantity": "tactile", "unit": unit, "stream": "pad", "rest": "3.0"}
        about[name] |= {"taxel": str(taxel)} if declared else {}
    scale = {"mm": 1000.0, "cm": 100.0}.get(place or "", 1.0)
    for axis in AXES if place else ():
        columns[f"ur_{axis}"] = moved * scale if axis == "z" else np.zeros(rows)
        about[f"ur_{axis}"] = {"quantity": "position", "unit": place or "", "stream": "ur"}
    for part in "xyzw" if turned else ():
        columns[f"ur_q{part}"] = np.full(rows, float(part == "w"))
        about[f"ur_q{part}"] = {"quantity": "orientation", "unit": "1", "stream": "ur"}
    columns["contact"] = np.zeros(rows, np.int32)
    fields = [pa.field(name, pa.array(values).type, metadata=about.get(name)) for name, values in columns.items()]
    return FakeShard(f"trial-{seed:02d}", pa.table(columns, schema=pa.schema(fields)))


def trained(folder: Path, architecture: str = "auto", actions: str = "planned", arm: str = "", **options: Any) -> Any:
    training, validation = (dataset(*(recording(seed, **options) for seed in seeds)) for seeds in (range(3), [10]))
    requested = params(architecture=architecture, actions=actions, arm=arm)
    return forward_training.train(requested, training, validation, folder)


@pytest.mark.long
@pytest.mark.parametrize("architecture", ["auto", "taxelwise", "gru", "tcn", "recurrent"])
@pytest.mark.parametrize("options", [{"place": None}, {"place": "mm"}, {"place": "m", "turned": True}], ids=str)
def test_each_architecture_reads_an_array_of_one_axis_with_and_without_an_arm(
    tmp_path: Path, architecture: str, options: dict[str, Any]
) -> None:
    model = trained(tmp_path, architecture, "planned" if options["place"] else "none", **options)
    loaded = ForwardModel.load(model)
    assert loaded.config["architecture"] == ("taxelwise" if architecture == "auto" else architecture)
    window, plan, _ = prediction.inputs(loaded, dataset(recording(20, **options)))
    assert plan.shape[1:] == (HORIZON, len(loaded.plan_columns) + len(loaded.derived_columns))
    assert window.shape[1:] == (CONTEXT, len(loaded.window_columns) + len(loaded.derived_columns) + 1)
    (output,) = forward_prediction.predict(model, dataset(recording(20, **options)), [HORIZON]).recordings.values()
    levels = loaded.predict(window, plan)
    for channel in range(5):
        stored = output.streams[""].column(f"pad_{channel}_t{HORIZON}").to_numpy()
        assert np.allclose(levels[:, HORIZON - 1, channel], stored, atol=1e-4)


@pytest.mark.long
def test_a_stage_in_millimetres_is_the_same_stage_as_in_metres(tmp_path: Path) -> None:
    in_mm, in_m = (ForwardModel.load(trained(tmp_path / place, place=place)) for place in ("mm", "m"))
    window, plan, _ = prediction.inputs(in_m, dataset(recording(20, place="m")))
    window_in_mm, plan_in_mm, _ = prediction.inputs(in_mm, dataset(recording(20, place="mm")))
    assert np.allclose(window, window_in_mm, atol=1e-6) and np.allclose(plan, plan_in_mm, atol=1e-6)
    assert np.allclose(in_m.predict(window, plan), in_mm.predict(window_in_mm, plan_in_mm), atol=1e-4)
    assert in_m.plan_columns == ("ur_x", "ur_y", "ur_z")


@pytest.mark.long
def test_a_model_without_a_plan_predicts_the_same_whatever_the_stage_will_do(tmp_path: Path) -> None:
    model = ForwardModel.load(trained(tmp_path, actions="none", place="m"))
    window, plan, _ = prediction.inputs(model, dataset(recording(20, place="m")))
    assert np.array_equal(model.predict(window, plan), model.predict(window, plan[::-1]))


def test_without_an_arm_a_plan_is_refused_with_the_line_of_the_layout_file_and_the_option(tmp_path: Path) -> None:
    with pytest.raises(TacpipeError, match=r"trial-00.*position.*5 of tactile.*--actions none"):
        trained(tmp_path, place=None)


def test_an_arm_that_is_not_there_is_a_mistake_of_the_command(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"'wrist'.*ur"):
        trained(tmp_path, arm="wrist")


@pytest.mark.long
def test_errors_are_given_in_the_unit_of_the_channels(tmp_path: Path) -> None:
    for unit, unit_in_text in (("kPa", "kPa"), ("count", "counts")):
        model = trained(tmp_path / unit, unit=unit)
        result = forward_evaluation.evaluate(model, dataset(recording(20, unit=unit), recording(21, unit=unit)))
        assert {compared.unit for compared in headline.read(result.files[headline.FILE])} == {unit_in_text}
        (table, *_) = forward_prediction.predict(model, dataset(recording(20, unit=unit)), [1]).recordings.values()
        assert table.streams[""].schema.field("pad_0_t1").metadata[b"unit"] == unit.encode()
        assert ("unit" in json.loads(model["config.json"])["inputs"]) == (unit != "count")


@pytest.mark.long
def test_channels_that_state_no_taxel_give_another_network_and_a_note(tmp_path: Path) -> None:
    model = trained(tmp_path, declared=False)
    notes = forward_training.notes(params(architecture="auto"), model)
    assert json.loads(model["config.json"])["architecture"] == "gru"
    assert any("{taxel}" in note for note in notes)
    assert not any("{taxel}" in note for note in forward_training.notes(params(architecture="gru"), model))
    with pytest.raises(TacpipeError, match=r"\{taxel\}"):
        trained(tmp_path / "other", "taxelwise", declared=False)


@pytest.mark.long
def test_a_model_to_begin_with_must_read_the_same_arm(tmp_path: Path) -> None:
    start = trained(tmp_path / "one", "gru", place="m")
    part = dataset(*(recording(seed, place="m", turned=True) for seed in range(3)))
    with pytest.raises(TacpipeError, match=r"ur_x, ur_y, ur_z and the recordings hold ur_x, ur_y, ur_z, ur_qx"):
        forward_training.train(params(architecture="gru"), part, part, tmp_path / "two", start)
