"""Models of quantities and of classes learn from windows of touch, choose an estimator and state their uncertainty."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.linear_model import RidgeCV
from sklearn.metrics import mean_absolute_error

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.scores import headline
from tacpipe.tasks.classify.params import ClassifyAuto, ClassifyLinear, ClassifyMinirocket
from tacpipe.tasks.classify.task import ClassifyTask
from tacpipe.tasks.learning import evaluation, examples, selection
from tacpipe.tasks.learning.answers import Classes, Quantities, Target
from tacpipe.tasks.learning.estimators import (
    FittedBoosting,
    FittedConstant,
    FittedLinear,
    FittedMinirocket,
    FittedTrees,
    load,
)
from tacpipe.tasks.learning.inputs import InputRows, find_inputs
from tacpipe.tasks.learning.model import LearnedModel, calibrate, recentre
from tacpipe.tasks.learning.uncertainty import ErrorQuantiles
from tacpipe.tasks.regress.params import RegressAuto, RegressBoosting, RegressLinear, RegressTrees
from tacpipe.tasks.regress.task import RegressTask
from tacpipe.tasks.task import CalibrationRequest
from tests.fake_recordings import FakeDataset, FakeShard, dataset
from tests.tasks.learning.presses import press, presses

FORCE = RegressLinear(target="ft_force", context_s=0.2)


CONTEXT = {"target": "ft_force", "context_s": 0.2}


def one_channel(recording: Any) -> InputRows:
    """Return the rows of the first taxel alone."""
    inputs, _ = find_inputs(dataset(recording), lambda stream, schema: ["skin_taxel01_z"], 0.0, lambda rate, raw: 1)
    return inputs.read(recording)


def with_column(recording: FakeShard, name: str, values: np.ndarray) -> FakeShard:
    """Return a recording with other values of a column."""
    schema = recording.content.schema
    place = schema.get_field_index(name)
    return dataclasses.replace(
        recording, content=recording.content.set_column(place, schema.field(place), pa.array(values))
    )


def trained(params: Any, recordings: list[Any], folder: Path) -> LearnedModel:
    task = RegressTask if params.KIND == "quantity" else ClassifyTask
    result = task.train.function(params, dataset(*recordings), None, folder)
    return LearnedModel.load(result.files)


def files_of(params: Any, recordings: list[Any], folder: Path) -> dict[str, bytes]:
    task = RegressTask if params.KIND == "quantity" else ClassifyTask
    return dict(task.train.function(params, dataset(*recordings), None, folder).files)


def test_ridge_regression_of_the_last_row_is_that_of_scikit_learn(tmp_path: Path) -> None:
    model = trained(dataclasses.replace(FORCE, context_s=0.0), presses(range(4)), tmp_path)
    assert [stream.rows for stream in model.inputs.streams] == [1]
    tables = [recording.content for recording in presses(range(4))]
    rows = np.concatenate(
        [np.column_stack([table[name].to_numpy() for name in model.inputs.streams[0].channels]) for table in tables]
    )
    forces = np.concatenate([table["ft_force"].to_numpy() for table in tables])
    new = press(7).content
    inputs = np.column_stack([new[name].to_numpy() for name in model.inputs.streams[0].channels])
    mean, deviation = rows.mean(axis=0), rows.std(axis=0)
    oracle = RidgeCV(tuple(10.0**power for power in range(-3, 6))).fit((rows - mean) / deviation, forces)
    predicted = model.tables(dataset(press(7)))["press-007"]["ft_force"].to_numpy()
    assert np.allclose(predicted, oracle.predict((inputs - mean) / deviation), atol=1e-6)


@pytest.mark.parametrize(
    "params", [FORCE, RegressTrees(target="ft_force", context_s=0.2), RegressBoosting(target="ft_force", context_s=0.2)]
)
def test_each_estimator_finds_the_force_that_the_taxels_see(params: Any, tmp_path: Path) -> None:
    model = trained(params, presses(range(6)), tmp_path)
    new = press(20)
    table = model.tables(dataset(new))["press-020"]
    places = np.searchsorted(new.content["t_ns"].to_numpy(), table["t_ns"].to_numpy())
    true = new.content["ft_force"].to_numpy()[places]
    assert mean_absolute_error(true, table["ft_force"].to_numpy()) < 0.2 * np.abs(true - np.median(true)).mean()
    assert table.schema.field("ft_force").metadata[b"unit"] == b"N"


def test_an_angle_that_wraps_is_estimated_the_shorter_way_around(tmp_path: Path) -> None:
    model = trained(RegressTrees(target="ft_angle", context_s=0.0), presses(range(6), noise=0.1), tmp_path)
    new = press(20, noise=0.1)
    estimated = model.tables(dataset(new))["press-020"]["ft_angle"].to_numpy()
    error = (estimated - new.content["ft_angle"].to_numpy() + 180) % 360 - 180
    assert np.median(np.abs(error)) < 5


@pytest.mark.parametrize("architecture", [ClassifyLinear, ClassifyMinirocket, ClassifyAuto])
def test_the_shape_that_presses_is_named_from_the_whole_recording(architecture: Any, tmp_path: Path) -> None:
    model = trained(architecture(label="shape"), presses(range(30), seconds=4), tmp_path)
    new = presses(range(30, 42), seconds=4)
    tables: Any = model.tables(dataset(*new))
    assert [table.num_rows for table in tables.values()] == [1] * 12
    right = [tables[recording.name]["shape"][0].as_py() == recording.attributes["shape"] for recording in new]
    assert sum(right) >= 11
    columns = [name for name in next(iter(tables.values())).column_names if name.startswith("probability_")]
    assert columns == ["probability_ball", "probability_edge", "probability_pin"]


def test_a_column_and_labelled_intervals_give_a_class_at_each_row(tmp_path: Path) -> None:
    model = trained(ClassifyLinear(label="phase", context_s=0.2), presses(range(6)), tmp_path)
    new = press(20)
    table: Any = model.tables(dataset(new))
    places = np.searchsorted(new.content["t_ns"].to_numpy(), table["press-020"]["t_ns"].to_numpy())
    assert (
        np.mean(np.array(table["press-020"]["phase"].to_pylist(), int) == new.content["phase"].to_numpy()[places]) > 0.9
    )
    recordings = [press(seed, touch_intervals="2-6") for seed in range(4)]
    answers = Classes.find(dataset(*recordings), "touch")
    assert answers.classes == ("no touch", "touch")
    rows = one_channel(recordings[0])
    numbers = answers.read(rows, recordings[0])[:, 0]
    assert numbers.sum() == ((rows.since_s >= 2) & (rows.since_s <= 6)).sum()


def test_the_default_is_a_baseline_where_touch_says_nothing(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    recordings = [with_column(press(seed), "ft_force", rng.normal(0, 1, 200)) for seed in range(6)]
    result = RegressTask.train.function(
        RegressAuto(target="ft_force", context_s=0.2), dataset(*recordings), None, tmp_path
    )
    config = json.loads(result.files["config.json"])
    assert config["chosen_is_baseline"]
    assert "the model is that baseline" in result.notes[0]
    assert all(row["loss"] >= config["candidates"][0]["loss"] - row["error"] - 0.05 for row in config["candidates"])


def test_the_default_is_the_simplest_candidate_within_one_standard_error(tmp_path: Path) -> None:
    config = json.loads(
        files_of(RegressAuto(target="ft_force", context_s=0.2), presses(range(6)), tmp_path)["config.json"]
    )
    names = [row["name"] for row in config["candidates"]]
    assert names == ["constant", "time_alone", "last_row", "linear", "trees", "boosting"]
    within = [row["name"] for row in config["candidates"] if row["excess"] <= row["error"]]
    assert config["chosen"] == within[0] and min(row["excess"] for row in config["candidates"]) == 0


@given(st.lists(st.integers(0, 6), min_size=2, max_size=60), st.integers(0, 5))
def test_a_group_is_in_one_fold_and_no_fold_is_empty(groups: list[int], seed: int) -> None:
    inputs: Any = None
    chosen = examples.Examples(
        inputs,
        (),
        tuple(map(str, range(7))),
        np.array(groups, np.intp),
        np.zeros(len(groups), np.intp),
        np.zeros((len(groups), 1)),
    )
    folds = selection.assign_folds(chosen, seed)
    distinct = len(set(groups))
    assert set(folds.tolist()) == set(range(min(5, distinct if distinct > 1 else len(groups))))
    if distinct > 1:
        assert all(
            len({fold for fold, group in zip(folds.tolist(), groups, strict=True) if group == one}) == 1
            for one in set(groups)
        )


def test_no_input_is_the_target_or_measured_by_its_stream(tmp_path: Path) -> None:
    model = trained(RegressLinear(target="ft_force", inputs="*", context_s=0.0), presses(range(3)), tmp_path)
    assert [name for stream in model.inputs.streams for name in stream.channels] == [
        "skin_taxel01_x", "skin_taxel01_y", "skin_taxel01_z", "skin_taxel02_z",
    ]  # fmt: skip


def test_truth_is_no_input_whichever_pattern_matches_it(tmp_path: Path) -> None:
    recordings = []
    for recording in presses(range(6)):
        marked = pa.field("scale", pa.float64(), metadata={"unit": "N", "quantity": "force", "truth": "1"})
        content = recording.content.append_column(marked, recording.content["ft_force"])
        content = content.append_column(marked.with_name("gt_force").remove_metadata(), content["ft_force"])
        recordings.append(dataclasses.replace(recording, content=content))
    model = trained(ClassifyLinear(label="shape", inputs="*"), recordings, tmp_path)
    channels = [name for stream in model.inputs.streams for name in stream.channels]
    assert "skin_taxel01_x" in channels and not {"scale", "gt_force"} & set(channels)


def test_a_target_ahead_is_the_value_at_that_time(tmp_path: Path) -> None:
    recordings = dataset(press(0))
    answers = Quantities.find(recordings, ["ft_force"], 0.5)
    rows = one_channel(press(0))
    values = answers.read(rows, press(0))[:, 0]
    force = press(0).content["ft_force"].to_numpy()
    assert np.array_equal(values[:-10], force[10:]) and np.isnan(values[-10:]).all()


@pytest.mark.parametrize(
    ("params", "change", "sentence"),
    [
        (FORCE, {"target": ""}, "--target names no column"),
        (FORCE, {"target": "torque"}, "--target torque matches no column and no label of numbers. The recordings have"),
        (FORCE, {"group": "operator"}, "press-000 has no label operator"),
        (FORCE, {"context_s": 60.0}, "No training row has a full window and a known ft_force"),
        (ClassifyLinear(), {}, "--label names no label"),
        (ClassifyLinear(label="operator"), {}, "None of 6 training recordings has the label operator"),
        (ClassifyLinear(label="grid_master"), {}, "The label grid_master has 1 value"),
        (ClassifyLinear(label="shape"), {"group": "shape"}, "The class ball of shape is in one training group only"),
    ],
)  # fmt: skip
def test_what_cannot_be_learned_is_said_in_a_sentence(params: Any, change: Any, sentence: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=sentence):
        files_of(dataclasses.replace(params, **change), presses(range(6)), tmp_path)


def test_a_target_that_is_constant_or_has_two_units_is_refused(tmp_path: Path) -> None:
    recordings = [
        dataclasses.replace(recording, attributes={**recording.attributes, "weight_g": 3.0})
        for recording in presses(range(4), seconds=1)
    ]
    with pytest.raises(UsageError, match="The target weight_g is 3 in all training rows"):
        files_of(RegressLinear(target="weight_g"), recordings, tmp_path)
    other = press(1)
    schema = other.content.schema
    place = schema.get_field_index("ft_force")
    field = schema.field(place).with_metadata({"unit": "gf", "quantity": "force", "stream": "ft"})
    changed = dataclasses.replace(other, content=other.content.cast(schema.set(place, field)))
    with pytest.raises(UsageError, match="press-001 states ft_force in gf, and other recordings in N"):
        files_of(FORCE, [press(0), changed], tmp_path)


def test_a_label_of_recordings_is_estimated_from_each_as_a_whole(tmp_path: Path) -> None:
    model = trained(RegressTrees(target="weight_g"), presses(range(18), seconds=2), tmp_path)
    new = presses(range(30, 36), seconds=2)
    tables: Any = model.tables(dataset(*new))
    assert all(
        abs(tables[recording.name]["weight_g"][0].as_py() - recording.attributes["weight_g"]) < 80 for recording in new
    )


def test_recentred_sessions_are_compared_without_their_own_levels(tmp_path: Path) -> None:
    def shifted(recording: Any) -> Any:
        level = 50.0 if recording.attributes["session"] == "day-1" else 0.0
        names = [name for name in recording.content.column_names if name.startswith("skin_")]
        table = recording.content
        for name in names:
            place = table.schema.get_field_index(name)
            table = table.set_column(place, table.schema.field(place), pa.array(table[name].to_numpy() + level))
        return dataclasses.replace(recording, content=table)

    recordings = [shifted(recording) for recording in presses(range(60), seconds=4)]
    first = [recording for recording in recordings if recording.attributes["session"] == "day-0"]
    second = [recording for recording in recordings if recording.attributes["session"] == "day-1"]
    right = {}
    for label in ("", "session"):
        model = trained(ClassifyLinear(label="shape", recentre=label), first, tmp_path)
        tables: Any = model.tables(dataset(*second))
        right[label] = np.mean([tables[each.name]["shape"][0].as_py() == each.attributes["shape"] for each in second])
    assert right["session"] > right[""] + 0.2
    files = files_of(ClassifyLinear(label="shape", recentre="session"), first, tmp_path)
    adapted = recentre(files, dataset(*second))
    assert adapted.notes[0].startswith("The level is the median of ")
    again: Any = LearnedModel.load(recentre(adapted.files, dataset(*second)).files).tables(dataset(*second))
    assert all(again[name].equals(table) for name, table in tables.items())
    with pytest.raises(UsageError, match="several values of session, day-0, day-1"):
        recentre(adapted.files, dataset(*recordings))
    with pytest.raises(UsageError, match="Train it with --recentre session"):
        recentre(files_of(ClassifyLinear(label="shape"), first, tmp_path), dataset(*second))


@pytest.mark.parametrize(
    "estimator", ["constant", "linear", "trees", "boosting", "boosting of two classes", "minirocket"]
)
def test_a_window_gives_the_same_bits_alone_as_among_others_and_after_it_was_stored(estimator: str) -> None:
    rng = np.random.default_rng(0)
    recordings = dataset(press(0), press(1))
    inputs, _ = find_inputs(
        recordings,
        lambda stream, schema: [name for name in schema.names if name.startswith("skin_")],
        0.2,
        lambda rate, raw: 10,
    )
    parts = []
    for recording in (press(0), press(1)):
        rows = inputs.read(recording)
        ends = np.flatnonzero(rows.ready)
        parts.append((rows, recording.name, ends, rng.normal(0, 1, (len(ends), 1))))
    chosen = examples.join(inputs, parts)
    kind: Any = "class" if estimator in ("minirocket", "boosting of two classes") else "quantity"
    outputs = np.eye(2)[chosen.owner] if kind == "class" else chosen.values
    fits: dict[str, Any] = {
        "constant": lambda: FittedConstant.fit(chosen, outputs, kind, by_group=True),
        "linear": lambda: FittedLinear.fit(chosen, outputs, kind),
        "trees": lambda: FittedTrees.fit(chosen, outputs, kind, trees=10),
        "boosting": lambda: FittedBoosting.fit(chosen, outputs, kind, trees=10),
        "boosting of two classes": lambda: FittedBoosting.fit(chosen, outputs, kind, trees=10),
        "minirocket": lambda: FittedMinirocket.fit(chosen, outputs),
    }
    fitted = fits[estimator]()
    together = fitted.outputs(chosen)
    stored = load(fitted.arrays(), json.loads(json.dumps(fitted.describe())), outputs.shape[1])
    assert stored.outputs(chosen).tobytes() == together.tobytes()
    for index in range(0, len(chosen), 17):
        alone = fitted.outputs(chosen.select(np.array([index])))
        if estimator == "minirocket":  # its readout is a product of matrices of float32
            assert np.allclose(alone[0], together[index], atol=1e-4)
        else:
            assert alone[0].tobytes() == together[index].tobytes()


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 1000), st.integers(30, 3000))
def test_bands_cover_what_they_state_for_new_errors_of_the_same_kind(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    answers = Quantities((Target("force", "N"),), scales=(1.0,))

    def drawn(rows: int) -> tuple[np.ndarray, np.ndarray]:
        estimates = rng.uniform(0, 10, (rows, 1))
        return estimates, estimates + rng.normal(0, 0.1 + 0.1 * estimates)

    bands = ErrorQuantiles.fit(answers, *drawn(count))
    assert ErrorQuantiles.from_config(json.loads(json.dumps(bands.to_config())), 1) == bands
    estimates, values = drawn(4000)
    low, high = (bands.bands(estimates)[:, 0, bands.percents.index(percent)] for percent in (10, 90))
    covered = np.mean((values[:, 0] >= low) & (values[:, 0] <= high))
    assert abs(covered - 0.8) < 0.04 + 1.5 / np.sqrt(count)


def test_calibration_on_other_recordings_sets_levels_and_records_them(tmp_path: Path) -> None:
    files = files_of(FORCE, presses(range(4)), tmp_path)
    request = CalibrationRequest((10, 50, 90), False, 0.05, 0)
    calibrated = calibrate(files, request, dataset(*presses(range(4))), dataset(*presses(range(4, 8))))
    model = LearnedModel.load(calibrated)
    assert isinstance(model.uncertainty, ErrorQuantiles) and model.uncertainty.percents == (10, 50, 90)
    assert set(model.config["trained_on"]) == {f"press-{seed:03d}" for seed in range(8)}
    table: Any = model.tables(dataset(press(20)), quantiles=[10, 90])
    assert (table["press-020"]["ft_force_p10"].to_numpy() < table["press-020"]["ft_force_p90"].to_numpy()).all()


def test_results_compare_with_baselines_on_unseen_recordings_only(tmp_path: Path) -> None:
    files = files_of(dataclasses.replace(FORCE, target="ft_force,ft_angle"), presses(range(6)), tmp_path)
    result = evaluation.evaluate(files, dataset(*presses(range(14))))
    metrics = json.loads(result.files["metrics.json"])
    assert metrics["counts"]["recordings"] == 8
    table = result.recordings["predictions"].streams[""]
    errors = np.abs(table["ft_force by true"].to_numpy() - table["ft_force by model"].to_numpy())
    assert metrics["ft_force"]["model"]["mean absolute error (N)"] == pytest.approx(errors.mean(), rel=1e-5)
    assert [row.target for row in headline.read(result.files["headline.json"])] == ["ft_force", "ft_angle"]
    assert max(metrics["importance"], key=lambda name: metrics["importance"][name]) in {
        "skin taxel 01",
        "skin taxel 02",
    }
    with pytest.raises(TacpipeError, match="No recording has a known ft_force"):
        evaluation.evaluate(files, dataset(*presses(range(6))))


def test_a_class_that_was_not_learned_counts_as_wrong_and_is_said(tmp_path: Path) -> None:
    files = files_of(
        ClassifyLinear(label="shape"),
        [recording for recording in presses(range(18), seconds=2) if recording.attributes["shape"] != "pin"],
        tmp_path,
    )
    result = evaluation.evaluate(files, dataset(*presses(range(30, 36), seconds=2)))
    metrics = json.loads(result.files["metrics.json"])
    assert metrics["classes"]["model"]["accuracy (%)"] <= 67
    assert any("2 of 6 windows have a class of shape that the model did not learn" in note for note in result.notes)


def test_a_part_of_one_class_gives_that_class_to_every_window() -> None:
    recordings = dataset(press(0))
    inputs, _ = find_inputs(recordings, lambda stream, schema: ["skin_taxel01_z"], 0.0, lambda rate, raw: 1)
    rows = inputs.read(recordings.recordings["press-000"])
    chosen = examples.join(inputs, [(rows, "a", np.arange(20), np.zeros((20, 1)))])
    outputs = np.tile([0.0, 1.0], (20, 1))
    for fitted in (FittedLinear.fit(chosen, outputs, "class"), FittedTrees.fit(chosen, outputs, "class", trees=2)):
        assert (fitted.outputs(chosen).argmax(axis=1) == 1).all()
    assert (FittedBoosting.fit(chosen, outputs, "class", trees=2).outputs(chosen).argmax(axis=1) == 1).all()


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    files = files_of(FORCE, presses(range(3)), tmp_path)
    config = json.loads(files["config.json"])
    changes: list[dict[str, Any]] = [
        {"answers": {}},
        {"inputs": []},
        {"estimator": {"estimator": "magic"}},
        {"calibration": {"edges": []}},
    ]
    for change in changes:
        with pytest.raises(TacpipeError):
            LearnedModel.load({**files, "config.json": json.dumps({**config, **change}).encode()})


def test_the_report_reads_what_evaluate_wrote(tmp_path: Path) -> None:
    from tacpipe.tasks.learning.report import LearningReport
    from tests.tasks.slip.slip_recordings import stored

    files = files_of(FORCE, presses(range(6)), tmp_path)
    result: FakeDataset = stored(evaluation.evaluate(files, dataset(*presses(range(6, 12)))))
    (run,) = LearningReport("regress").read([result])  # type: ignore[list-item]
    metrics = json.loads(result.files["metrics.json"])
    ((question, errors),) = run.questions.items()
    total = np.sum(list(errors.sums["model"].values()), axis=0)
    assert question.target == "ft_force"
    assert errors.measure.values(total)[0] == pytest.approx(
        metrics["ft_force"]["model"]["mean absolute error (N)"], rel=1e-5
    )
