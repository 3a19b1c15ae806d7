"""WindowScores of touch, their labels, and the arithmetic of scores."""

import dataclasses

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score
from sklearn.preprocessing import StandardScaler

from tacpipe.arrays import AnyFloats
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.models.boosting import BoostedTrees, TreeSizes
from tacpipe.scores.table import MODEL, ScoreTable
from tacpipe.tasks.learning import estimators
from tacpipe.tasks.learning.estimators import FittedLinear
from tacpipe.tasks.learning.examples import Examples
from tacpipe.tasks.learning.features import ChannelAxes, stream_features
from tacpipe.tasks.slip import calibration, evaluation, metrics
from tacpipe.tasks.slip.calibration import ScoredTrack, SlipCalibration
from tacpipe.tasks.slip.labels import read_labels
from tacpipe.tasks.slip.params import SlipBoosting
from tacpipe.tasks.slip.training import areas, best_column, fit_columns, scores_of
from tacpipe.tasks.slip.windows import (
    BEFORE,
    DURING,
    STABLE,
    UNCOUNTED,
    are_slips,
    match_time,
    read_examples,
    read_training,
    shuffle_labels,
)
from tests.fake_recordings import FakeRecording, dataset
from tests.tasks.slip.slip_recordings import held_object, trials

AXES = ChannelAxes.from_layout([{"axis": axis} for axis in "xyzxyz"])
PLAIN = ChannelAxes.from_layout([{}, {}, {}, {}, {}, {}])


@settings(max_examples=50, deadline=None)
@given(
    arrays(np.float64, st.tuples(st.integers(2, 9), st.integers(1, 30), st.just(6)), elements=st.floats(-1e3, 1e3)),
    st.sampled_from([AXES, PLAIN]),
)
def test_a_window_has_the_same_features_by_itself_as_among_others(windows: np.ndarray, layout: ChannelAxes) -> None:
    together = stream_features(windows, layout)
    by_itself = np.concatenate([stream_features(window[None].copy(), layout) for window in windows])
    assert together.tobytes() == by_itself.tobytes()


def test_shear_over_load_is_that_of_the_means_of_taxels() -> None:
    window = np.zeros((1, 4, 6))
    window[0, :, [0, 3]] = 3.0  # x of both taxels
    window[0, :, [1, 4]] = 4.0  # y
    window[0, :, [2, 5]] = -10.0  # z
    from tacpipe.tasks.learning.features import NAMES

    features = dict(zip(NAMES, stream_features(window, AXES)[0], strict=True))
    assert features["shear over load"] == pytest.approx(0.5)
    assert features["spread of ratios"] == pytest.approx(0.0)
    assert features["speed"] == 0.0


@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_boosted_trees_score_as_scikit_learn_does(missing: float) -> None:
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(600, 5))
    labels = rows[:, 0] * rows[:, 1] > 0.3
    rows[rng.random(rows.shape) < missing] = np.nan
    rows[:, 1] = rows[:, 1].round(1)
    weights = np.where(rng.random(600) < missing, 0.0, 3 * rng.random(600))
    sizes = {"learning_rate": 0.2, "max_leaf_nodes": 8, "min_samples_leaf": 5, "l2_regularization": 1.0}
    oracle = HistGradientBoostingClassifier(max_iter=20, early_stopping=False, random_state=3, **sizes)
    oracle.fit(rows, labels, sample_weight=weights)
    trees = BoostedTrees.fit(rows, labels, weights, TreeSizes(20, 8, 5, 0.2, 1.0, 3))
    assert trees.scores(rows) == pytest.approx(oracle.decision_function(rows), abs=1e-9)
    loaded = BoostedTrees.from_arrays(trees.arrays(), 5)
    assert loaded.scores(rows[:1]).tobytes() == trees.scores(rows)[:1].tobytes()


def examples_of(recordings: int = 8) -> Examples:
    """Return every fifth window of recordings."""
    reader, tracks = read_training(dataset(*trials(recordings)), SlipBoosting())
    return read_examples(reader, tracks, SlipBoosting(), stride=5)


def test_a_regression_of_weighted_windows_scores_as_that_of_scikit_learn_does() -> None:
    examples = examples_of()
    rows, slips, weights = examples.features("statistics"), are_slips(examples), examples.training_weights
    known = np.isfinite(rows).all(axis=0)
    scaler = StandardScaler().fit(rows[:, known])
    oracle = LogisticRegression(C=1 / (0.01 * weights.sum()), max_iter=1000)
    oracle.fit(scaler.transform(rows[:, known]).clip(-10, 10), slips, weights)
    fitted = FittedLinear.fit(examples, np.stack([~slips, slips], axis=1).astype(float), "class")
    expected = oracle.decision_function(scaler.transform(rows[:, known]).clip(-10, 10))
    assert scores_of(fitted.outputs(examples)) == pytest.approx(expected, abs=1e-3)


def test_the_best_feature_has_the_largest_mean_area_of_all_in_either_direction() -> None:
    examples = examples_of()
    features = examples.features("statistics")
    varying = [column for column in features.T if np.isfinite(column).any() and np.nanmax(column) > np.nanmin(column)]

    def area(values: np.ndarray) -> float:
        return float(np.mean(areas(np.nan_to_num(values), examples)))

    best = max(max(area(column), area(-column)) for column in varying)
    column = best_column(examples)
    assert max(area(features[:, column]), area(-features[:, column])) == pytest.approx(best, abs=1e-9)
    opposite = dataclasses.replace(examples, _features={"statistics": -features})
    assert best_column(opposite) == column


def test_a_baseline_of_some_columns_loads_with_the_same_bits() -> None:
    examples = examples_of()
    outputs = np.stack([~are_slips(examples), are_slips(examples)], axis=1).astype(float)
    fitted = fit_columns(FittedLinear.fit, examples, outputs, [best_column(examples)])
    loaded = estimators.load(fitted.arrays(), fitted.describe(), 2)
    assert loaded.outputs(examples).tobytes() == fitted.outputs(examples).tobytes()


def test_trees_whose_nodes_lead_back_are_refused() -> None:
    rows = np.random.default_rng(0).normal(size=(100, 2))
    trees = BoostedTrees.fit(rows, rows[:, 0] > 0, np.ones(100), TreeSizes(2, 4, 5, 0.2, 1.0, 0))
    arrays_by_name = trees.arrays()
    arrays_by_name["children"] = np.where(arrays_by_name["children"] > 0, 0, arrays_by_name["children"])
    with pytest.raises(ValueError, match="children"):
        BoostedTrees.from_arrays(arrays_by_name, 2)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000))
def test_the_area_under_the_curve_is_that_of_scikit_learn_for_any_draw_of_objects(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tracks = []
    for name in "abc":
        states = np.where(rng.random(30) < 0.4, BEFORE, STABLE)
        states[:2] = BEFORE, STABLE
        track = scored(rng.integers(0, 6, 30).astype(float), states)
        tracks.append(dataclasses.replace(track, name=name, object=name, weights=rng.random(30) + 0.1))
    windows = metrics.WindowScores(tracks)
    layout, rows = sums_of(windows)
    chosen = np.array([[1.0, 1.0, 1.0], [1.0, 0.0, 1.0]])
    expected = [
        roc_auc_score(windows.states > 0, windows.scores, sample_weight=windows.weights * draw[windows.objects])
        for draw in chosen
    ]
    assert layout.area(chosen @ np.stack(list(rows.values()))) == pytest.approx(expected)


def sums_of(windows: metrics.WindowScores, part: str = "before") -> tuple[metrics.AreaLayout, dict[str, AnyFloats]]:
    """Return the sums of recordings for the area of a part, and their layout."""
    layout = metrics.AreaLayout(track.object for track in windows.tracks)
    return layout, windows.sums(part, layout, np.zeros(len(windows.scores)))


def estimate_of(windows: metrics.WindowScores) -> metrics.ObjectEstimate:
    """Return the area under the curve of windows before slips."""
    layout, rows = sums_of(windows)
    table = ScoreTable(layout.measure(), {MODEL: rows}, {track.name: track.object for track in windows.tracks})
    return metrics.to_json(table.score(MODEL))


def test_scores_of_different_folds_are_not_compared() -> None:
    states = np.repeat([BEFORE, STABLE], 5)
    perfect = {fold: scored(np.where(states == BEFORE, 1.0, 0.0) + 10 * fold, states) for fold in (0, 1)}
    tracks = tuple(dataclasses.replace(track, name=f"r{fold}", object=f"o{fold}") for fold, track in perfect.items())
    scores = {MODEL: tuple(track.scores for track in tracks)}
    areas = []
    for folds in ((0, 0), (0, 1)):
        evaluated = evaluation.EvaluatedSlips(tracks, scores, {**scores}, {}, folds=folds)
        areas.append(evaluated.tables()["before"].score(MODEL).mean)
    assert areas == [0.75, 1.0]  # the second fold's scores are higher throughout


def objects_with_slips(count: int, seed: int = 0) -> metrics.WindowScores:
    """Return windows of objects, half of them before a slip."""
    rng = np.random.default_rng(seed)
    tracks = []
    for number in range(count):
        states = np.repeat([BEFORE, STABLE], 10)
        scores = rng.standard_normal() + rng.standard_normal(20) + (states == BEFORE)
        tracks.append(dataclasses.replace(scored(scores, states), name=str(number), object=str(number)))
    return metrics.WindowScores(tracks)


def test_the_interval_of_an_area_is_students_over_areas_without_one_object_each() -> None:
    windows, other = objects_with_slips(9), objects_with_slips(9, 1)

    def without(windows: metrics.WindowScores, number: int) -> float:
        rest = windows.objects != number
        return float(roc_auc_score(windows.states[rest] > 0, windows.scores[rest]))

    areas, others = (np.array([without(part, number) for number in range(9)]) for part in (windows, other))
    value = float(roc_auc_score(windows.states > 0, windows.scores))
    odds = np.log(areas / (1 - areas))
    width = scipy.stats.t.ppf(0.975, 8) * np.sqrt(8 / 9 * np.square(odds - odds.mean()).sum())
    ends = [1 / (1 + np.exp(-(np.log(value / (1 - value)) + sign * width))) for sign in (-1, 1)]
    estimate = estimate_of(windows)
    assert [estimate["value"], estimate["low"], estimate["high"]] == pytest.approx([value, *ends], rel=1e-5)
    difference = areas - others
    width = scipy.stats.t.ppf(0.975, 8) * np.sqrt(8 / 9 * np.square(difference - difference.mean()).sum())
    (layout, rows), (_, other_rows) = sums_of(windows), sums_of(other)
    margin = ScoreTable(layout.measure(), {MODEL: rows, "other": other_rows}).gain_over("other")
    assert margin.high - margin.mean == pytest.approx(width, rel=1e-4)


def test_values_that_no_object_changes_and_those_of_two_objects_have_no_interval() -> None:
    windows = objects_with_slips(9)
    windows.scores[:] = 0.0
    assert estimate_of(windows) == {"value": 0.5, "low": None, "high": None}
    assert estimate_of(objects_with_slips(2))["low"] is None
    no_slip = metrics.ratio_estimate(np.zeros(0, bool), np.zeros(0, np.intp), 3)
    assert no_slip == {"value": None, "low": None, "high": None}


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000))
def test_matched_windows_with_and_without_a_slip_have_the_same_distribution_of_time(seed: int) -> None:
    rng = np.random.default_rng(seed)
    since_s = rng.random(200) * 8
    slips = rng.random(200) < np.where(since_s < 4, 0.5, 0.1)
    weights = match_time(since_s, slips)
    bins = np.floor(since_s)
    shares = []
    for kind in (slips, ~slips):
        total = weights[kind].sum()
        shares.append([weights[kind & (bins == place)].sum() / total if total else 0.0 for place in range(8)])
    assert shares[0] == pytest.approx(shares[1])


def test_states_are_before_during_and_after_a_slip_and_unknown_at_the_end() -> None:
    _, (track,) = read_training(dataset(held_object(1, 5.0)), SlipBoosting())
    states = track.states(1_000_000_000, 500_000_000)
    at_s = track.since_s

    def state(second: float) -> int:
        return int(states[np.argmin(np.abs(at_s - second))])

    assert [state(second) for second in (0.5, 2.0, 3.9, 4.1, 4.9, 5.0, 5.5, 5.7, 6.1, 8.9, 9.5)] == [
        *(UNCOUNTED, STABLE, STABLE, BEFORE, BEFORE, DURING, DURING, UNCOUNTED, STABLE, STABLE, UNCOUNTED),
    ]


def test_rows_without_contact_are_not_counted() -> None:
    recording = held_object(1, None)
    table = recording.tables["left"]
    import pyarrow as pa

    contact = np.where(table["t_ns"].to_numpy() < 4_000_000_000, 0, -1).astype(np.int8)
    with_contact = {**recording.tables, "left": table.append_column("contact", pa.array(contact))}
    _, (track,) = read_training(dataset(dataclasses.replace(recording, tables=with_contact)), SlipBoosting())
    states = track.states(1_000_000_000, 0)
    assert (states[track.since_s >= 4.0] == UNCOUNTED).all()
    assert (states[(track.since_s > 2) & (track.since_s < 4)] == STABLE).all()


def test_intervals_of_a_recording_replace_a_column_of_slips() -> None:
    recording = held_object(1, 5.0, slip_intervals="2-2.5 7-7.25")
    labels = read_labels(recording)  # type: ignore[arg-type]
    assert labels is not None
    assert (labels.events / 1e9).tolist() == [[2.0, 2.5], [7.0, 7.25]]
    none = read_labels(dataclasses.replace(recording, attributes={"slip_intervals": ""}))  # type: ignore[arg-type]
    assert none is not None
    assert len(none.events) == 0


def test_a_recording_without_labels_has_none_and_an_unknown_slip_is_no_label() -> None:
    recording = held_object(1, None)
    tables = {
        name: table.drop_columns(["slip"]) if name == "left" else table for name, table in recording.tables.items()
    }
    assert read_labels(FakeRecording(tables)) is None  # type: ignore[arg-type]
    import pyarrow as pa

    unknown = tables["left"].append_column("slip", pa.array(np.full(tables["left"].num_rows, -1, np.int8)))
    assert read_labels(FakeRecording({**tables, "left": unknown})) is None  # type: ignore[arg-type]


def test_an_interval_that_is_no_interval_is_refused() -> None:
    with pytest.raises(UsageError, match="is not an interval"):
        read_labels(held_object(1, None, slip_intervals="from 2 to 3"))  # type: ignore[arg-type]


def test_shuffled_labels_keep_the_number_of_slips_and_their_times() -> None:
    _, tracks = read_training(dataset(*trials(8)), SlipBoosting())
    shuffled = shuffle_labels(tracks, 1)
    assert sorted((track.events - track.start_ns).tolist() for track in tracks) == sorted(
        (track.events - track.start_ns).tolist() for track in shuffled
    )
    assert [track.events.tolist() for track in tracks] != [track.events.tolist() for track in shuffled]


def test_a_recording_of_other_channels_is_refused() -> None:
    recording = held_object(2, None)
    fewer = {**recording.tables, "right": recording.tables["right"].drop_columns(["taxel01_x"])}
    with pytest.raises(TacpipeError, match="other input channels"):
        read_training(dataset(held_object(1, None), dataclasses.replace(recording, tables=fewer)), SlipBoosting())


def scored(scores: np.ndarray, states: np.ndarray, events: list[list[int]] | None = None) -> ScoredTrack:
    t_ns = np.arange(len(scores), dtype=np.int64) * 100_000_000
    return ScoredTrack(
        "a",
        "b",
        t_ns,
        states,
        scores,
        np.array(events or [], np.int64).reshape(-1, 2),
        np.ones(len(scores)),
        t_ns / 1e9,
    )


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([0.1, 1.0, 10.0, 60.0]))
def test_alarms_at_their_level_are_never_more_than_allowed_where_it_was_set(seed: int, per_minute: float) -> None:
    rng = np.random.default_rng(seed)
    tracks = [
        scored(rng.normal(size=300).round(1), np.where(rng.random(300) < 0.8, STABLE, UNCOUNTED)) for _ in range(3)
    ]
    level = calibration.alarm_level(tracks, per_minute, 1_000_000_000)
    counted = sum(calibration.false_alarms(track, level, 1_000_000_000) for track in tracks)
    assert counted <= per_minute * calibration.stable_minutes(tracks)


def test_a_false_alarm_lasts_for_the_horizon() -> None:
    scores = np.zeros(30)
    scores[[2, 5, 20]] = 1.0  # 0.2, 0.5 and 2 s
    assert calibration.false_alarms(scored(scores, np.zeros(30, np.int64)), 0.5, 1_000_000_000) == 2


def test_an_alarm_before_a_slip_leads_it_and_one_during_it_detects_it() -> None:
    states = np.zeros(40, np.int64)
    states[10:20], states[20:25] = BEFORE, DURING
    events = [[2_000_000_000, 2_400_000_000]]
    scores = np.zeros(40)
    scores[17] = 1.0
    (early,) = calibration.score_events(scored(scores, states, events), 0.5, 1_000_000_000)
    assert (early.lead_ms, early.to_end_ms) == (300.0, 700.0)
    scores = np.zeros(40)
    scores[22] = 1.0
    (late,) = calibration.score_events(scored(scores, states, events), 0.5, 1_000_000_000)
    assert np.isnan(late.lead_ms)
    assert (late.detected_ms, late.to_end_ms) == (200.0, 200.0)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000))
def test_probabilities_rise_with_the_score_and_are_calibrated_where_they_were_fitted(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scores = rng.normal(size=500)
    slips = rng.random(500) < 1 / (1 + np.exp(-2 * scores))
    fitted = SlipCalibration.fit(scores, slips, np.ones(500), [scored(scores, np.zeros(500, np.int64))], "x", 10**9)
    probabilities = fitted.probability(np.sort(scores))
    assert (np.diff(probabilities) >= 0).all()
    assert 0 < probabilities.min() <= probabilities.max() < 1
    assert fitted.probability(scores).mean() == pytest.approx(slips.mean(), abs=0.02)
    again = SlipCalibration.from_config(fitted.to_config())
    assert again.probability(scores).tobytes() == fitted.probability(scores).tobytes()
