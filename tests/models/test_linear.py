"""The linear baselines, against plain loops, scikit-learn and processes whose future is known."""

import numpy as np
import pytest
from safetensors.numpy import load, save
from sklearn.linear_model import Ridge
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from tacpipe.errors import TacpipeError
from tacpipe.models import linear
from tacpipe.models.linear import Autoregression, ChangeMap, FittedBaselines, PlanByLoad, Windows

CONTEXT, HORIZON, CHANNELS, STATES = 5, 4, 3, 2


def cut(values: np.ndarray, motion: np.ndarray, context: int = CONTEXT) -> Windows:
    """Return all windows of a recording, (time, channel) and (time, state)."""
    starts = np.arange(len(values) - context - HORIZON + 1)[:, None]
    window = values[starts + np.arange(context + HORIZON)].astype(np.float32)
    return window[:, :context], motion[starts + np.arange(context + HORIZON)].astype(np.float32), window[:, context:]


def walk(seed: int, rows: int = 200, context: int = CONTEXT) -> Windows:
    """Return windows of counts that a motion moves, in part, both far from zero."""
    rng = np.random.default_rng(seed)
    motion, steps = rng.normal(size=(rows, STATES)), rng.normal(size=(rows, CHANNELS)) * 10
    for row in range(1, rows):  # both last a while, so that the past tells something
        motion[row] += 0.5 * motion[row - 1]
        steps[row] += 0.5 * steps[row - 1]
    values = 3000 + (steps + motion @ np.full((STATES, CHANNELS), 5.0)).cumsum(axis=0)
    motion = 0.4 + 0.02 * motion
    return cut(values, motion, context)


def fit(training: Windows, validation: Windows) -> FittedBaselines:
    """Fit the baselines, with all validation windows of one recording."""
    return FittedBaselines.fit(training, validation, np.zeros(len(validation[0]), np.int64))


def change_maps(baselines: FittedBaselines) -> tuple[ChangeMap, ChangeMap]:
    autoregression, plan_by_load = baselines.change_maps
    assert isinstance(autoregression, Autoregression) and isinstance(plan_by_load, PlanByLoad)
    return autoregression, plan_by_load


@pytest.fixture(scope="module")
def fitted() -> FittedBaselines:
    return fit(walk(1), walk(2))


def features(part: Windows, plan: bool) -> np.ndarray:
    past, motion, _ = (array.astype(np.float64) for array in part)
    changes = [past[:, step] - past[:, -1] for step in range(past.shape[1] - 1)]
    states = motion if plan else motion[:, : past.shape[1]]
    return np.hstack([*changes, *(states[:, step] for step in range(states.shape[1]))])


def increments(part: Windows) -> np.ndarray:
    past, _, ahead = (array.astype(np.float64) for array in part)
    return (ahead - past[:, -1:]).reshape(len(past), -1)


@pytest.mark.parametrize(("name", "plan"), [("ridge", False), ("ridge_actions", True)])
def test_a_ridge_is_that_of_scikit_learn_at_the_alpha_that_validates_best(
    fitted: FittedBaselines, name: str, plan: bool
) -> None:
    training, validation = walk(1), walk(2)
    oracles = [
        make_pipeline(StandardScaler(), Ridge(alpha)).fit(features(training, plan), increments(training))
        for alpha in linear.ALPHAS
    ]
    x, y = features(validation, plan), increments(validation)
    errors = [np.square(oracle.predict(x) - y).mean() for oracle in oracles]
    best = int(np.argmin(errors))
    assert fitted.settings[f"{name}.alpha"] == linear.ALPHAS[best]
    assert 0 < best < len(linear.ALPHAS) - 1, "the test should not be decided by the ends of the grid"
    expected = validation[0][:, -1:] + oracles[best].predict(x).reshape(-1, HORIZON, CHANNELS)
    np.testing.assert_allclose(fitted.predict(*validation[:2])[name], expected, atol=0.01)


COEFFICIENTS = np.array([[0.5, 0.3, -0.2], [0.2, -0.3, 0.0], [-0.4, 0.0, 0.1]])  # (channel, change), newest first


def autoregressive(seed: int, repeats: int = 1) -> Windows:
    """Return windows of channels whose changes follow from their own last three, each row logged ``repeats`` times."""
    noise = np.random.default_rng(seed).normal(size=(3000, CHANNELS))
    for row in range(3, len(noise)):
        noise[row] += (COEFFICIENTS * noise[row - 3 : row][::-1].T).sum(axis=1)
    values = noise.cumsum(axis=0).repeat(repeats, axis=0)
    return cut(values, np.zeros((len(values), STATES)), context=4 * repeats)


def test_the_autoregression_has_the_coefficients_of_an_autoregressive_process() -> None:
    autoregression, _ = change_maps(fit(autoregressive(1), autoregressive(2)))
    newest_is_new = autoregression.weight[:, :3, 0]
    np.testing.assert_allclose(newest_is_new, COEFFICIENTS, atol=0.06)
    rows_ahead_2 = COEFFICIENTS[:, :1] * (1 + COEFFICIENTS[:, :1]) + COEFFICIENTS[:, 1:2]
    np.testing.assert_allclose(autoregression.weight[:, :1, 1], rows_ahead_2, atol=0.08)


def test_the_autoregression_skips_repeated_rows_and_knows_how_old_the_newest_is() -> None:
    autoregression, _ = change_maps(fit(autoregressive(1, repeats=2), autoregressive(2, repeats=2)))
    by_age = autoregression.weight.reshape(CHANNELS, -1, 3, HORIZON)
    np.testing.assert_allclose(by_age[:, 1, :, 0], COEFFICIENTS, atol=0.06)  # the next row is new
    np.testing.assert_allclose(by_age[:, 0, :, 0], 0, atol=1e-6)  # the next row repeats this one
    np.testing.assert_allclose(by_age[:, 0, :, 1], COEFFICIENTS, atol=0.06)


def test_the_coefficients_of_few_windows_are_those_shared_by_all_channels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(linear, "ALPHAS", (1e12,))
    autoregression, _ = change_maps(fit(autoregressive(1), autoregressive(2)))
    past, _, ahead = (array.astype(np.float64) for array in autoregressive(1))
    changes = np.diff(past, axis=1)[:, ::-1].transpose(2, 0, 1).reshape(-1, 3)  # newest first, of all channels
    targets = (ahead - past[:, -1:]).transpose(2, 0, 1).reshape(-1, HORIZON)
    shared = np.linalg.lstsq(changes, targets, rcond=None)[0]
    for channel in range(CHANNELS):
        np.testing.assert_allclose(autoregression.weight[channel, :3], shared, atol=1e-4)


def test_where_nothing_goes_on_the_autoregression_is_persistence() -> None:
    def steps(seed: int) -> Windows:
        return cut(np.random.default_rng(seed).normal(size=(2000, CHANNELS)).cumsum(axis=0), np.zeros((2000, STATES)))

    baselines = fit(steps(3), steps(4))
    past, motion, _ = steps(5)
    assert np.array_equal(baselines.predict(past, motion)["autoregression"], np.repeat(past[:, -1:], HORIZON, axis=1))


def carried(seed: int) -> Windows:
    """Return windows in which the planned motion changes each channel in proportion to the load, which varies widely."""
    rng = np.random.default_rng(seed)
    level = rng.lognormal(5, 1, (800, 1, 1)) * [[[1.0, -0.5, 2.0]]]
    motion = rng.normal(size=(800, CONTEXT + HORIZON, STATES))
    load = np.abs(level).mean(axis=2, keepdims=True)
    ahead = level + load * (motion[:, CONTEXT:] @ [[0.1, 0.2, -0.1], [0.3, 0.0, 0.2]])
    past = np.repeat(level, CONTEXT, axis=1)
    return past.astype(np.float32), motion.astype(np.float32), ahead.astype(np.float32)


def test_a_motion_whose_effect_grows_with_the_load_is_predicted_by_the_plan_times_the_load_alone() -> None:
    predicted = fit(carried(1), carried(2)).predict(*carried(3)[:2])
    past, _, ahead = carried(3)
    persistence = np.abs(ahead - past[:, -1:]).mean()
    error = {name: np.abs(values - ahead).mean() / persistence for name, values in predicted.items()}
    assert error["plan_by_load"] < 0.03
    assert error["ridge_actions"] > 0.3
    assert error["ridge"] > 0.9


def test_the_plan_times_the_load_is_the_ridge_of_scikit_learn_without_intercept(fitted: FittedBaselines) -> None:
    past, motion, ahead = (array.astype(np.float64) for array in walk(1))
    _, plan_by_load = change_maps(fitted)
    load = np.abs(past[:, -1]).mean(axis=1, keepdims=True)
    for step in range(HORIZON):
        x = np.hstack([motion[:, CONTEXT - 1], motion[:, CONTEXT + step]]) * load
        scale = np.sqrt(np.square(x).mean(axis=0))
        oracle = Ridge(plan_by_load.alpha, fit_intercept=False).fit(x / scale, ahead[:, step] - past[:, -1])
        np.testing.assert_allclose(plan_by_load.weight[step], (oracle.coef_ / scale).T, rtol=1e-3, atol=1e-6)


def test_a_step_does_not_depend_on_the_plan_after_it() -> None:
    past, motion, _ = carried(3)
    changed = motion.copy()
    changed[:, CONTEXT + 2 :] += 1
    baselines = fit(carried(1), carried(2))
    before, after = (baselines.predict(past, planned)["plan_by_load"] for planned in (motion, changed))
    assert np.array_equal(before[:, :2], after[:, :2])
    assert not np.isclose(before[:, 2:], after[:, 2:]).any()


def test_validation_windows_choose_alphas_and_weights_per_step_and_nothing_else(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(linear, "ALPHAS", (10.0,))
    first, second = (fit(walk(1), walk(seed)).to_tensors() for seed in (2, 5))
    assert [name for name in first if not np.array_equal(first[name], second[name])] == ["autoregression.shrinkage"]


def test_on_the_validation_recordings_changes_are_shrunk_until_they_err_no_more_than_persistence() -> None:
    past, motion, ahead = walk(2)
    recordings = np.arange(len(past)) * 3 // len(past)
    baselines = FittedBaselines.fit(walk(1), (past, motion, ahead), recordings)
    still = np.abs(past[:, -1:] - ahead).mean(axis=2)
    predicted = baselines.predict(past, motion)
    for fitted in change_maps(baselines):
        ratios = [
            np.abs(predicted[fitted.NAME] - ahead).mean(axis=2)[recordings == number].mean(axis=0)
            / still[recordings == number].mean(axis=0)
            for number in range(3)
        ]
        assert (np.mean(ratios, axis=0) <= 1 + 1e-6).all()
        assert ((fitted.shrinkage >= 0) & (fitted.shrinkage <= 1)).all()


def test_the_mean_is_that_of_what_was_to_be_predicted_in_training(fitted: FittedBaselines) -> None:
    predicted = fitted.predict(*walk(2)[:2])["train_mean"]
    np.testing.assert_allclose(predicted[7, 3], walk(1)[2].astype(np.float64).mean(axis=(0, 1)), rtol=1e-6)
    assert (predicted == predicted[0, 0]).all()


def test_a_load_that_the_plan_decides_is_predicted_only_with_the_plan() -> None:
    def held_mass(seed: int) -> Windows:
        """A mass of 2 kg at 300 counts a newton, whose acceleration is white: its past says nothing of its future."""
        acceleration = np.random.default_rng(seed).normal(size=(600, 1))
        return cut(2 * 300 * acceleration * [[1.0, 0.5, -0.2]], np.hstack([acceleration, np.zeros_like(acceleration)]))

    baselines = fit(held_mass(1), held_mass(2))
    past, motion, ahead = held_mass(3)
    predicted = baselines.predict(past, motion)
    error = {name: float(np.square(values - ahead).mean()) for name, values in predicted.items()}
    assert error["ridge_actions"] < 0.01 * error["train_mean"]
    assert error["ridge"] > 0.9 * error["train_mean"]
    assert error["autoregression"] > error["train_mean"]


def test_two_baselines_know_the_plan() -> None:
    past, motion, _ = carried(3)
    changed = motion.copy()
    changed[:, CONTEXT:] += 0.1
    baselines = fit(carried(1), carried(2))
    before, after = baselines.predict(past, motion), baselines.predict(past, changed)
    differing = [name for name in linear.NAMES if not np.array_equal(before[name], after[name])]
    assert differing == ["plan_by_load", "ridge_actions"]


def test_all_but_the_mean_and_the_plan_times_the_load_move_with_the_level_of_the_counts(
    fitted: FittedBaselines,
) -> None:
    past, motion, _ = walk(2)
    before, after = fitted.predict(past, motion), fitted.predict(past + np.float32(512), motion)
    for name in set(linear.NAMES) - {"plan_by_load"}:
        np.testing.assert_allclose(after[name] - before[name], 0 if name == "train_mean" else 512, atol=0.01)


def test_a_forecast_does_not_depend_on_the_windows_beside_it_nor_the_fit_on_its_pieces(
    fitted: FittedBaselines, monkeypatch: pytest.MonkeyPatch
) -> None:
    past, motion, _ = walk(2)
    batched, single = fitted.predict(past, motion), fitted.predict(past[9:10], motion[9:10])
    for name in linear.NAMES:
        np.testing.assert_allclose(single[name][0], batched[name][9], rtol=1e-5)
    monkeypatch.setattr(linear, "CHUNK", 7)
    pieces = fit(walk(1), walk(2)).predict(past, motion)
    for name in linear.NAMES:
        np.testing.assert_allclose(pieces[name], batched[name], rtol=1e-5)


def test_channels_and_states_that_stand_still_in_training_are_left_where_they_are() -> None:
    def constant_windows(seed: int) -> Windows:
        rng, (past, motion, ahead) = np.random.default_rng(seed), (array.copy() for array in walk(seed))
        past[:, :, 1] = ahead[:, :, 1] = 77.1
        sides = rng.integers(2, size=motion.shape[:2]).astype(np.float32)
        motion[:, :, 0] = np.nextafter(np.float32(0.3), sides)  # still but for the last bit
        return past, motion, ahead

    baselines = fit(constant_windows(1), constant_windows(2))
    past, motion, _ = constant_windows(3)
    stirred = motion.copy()
    stirred[:, :, 0] += 1
    predicted = baselines.predict(past, motion)
    for name in ("train_mean", "autoregression", "ridge", "ridge_actions"):
        np.testing.assert_allclose(predicted[name][:, :, 1], 77.1, rtol=1e-5)
        assert np.isfinite(predicted[name]).all()
        assert np.array_equal(baselines.predict(past, stirred)[name], predicted[name])


def test_windows_in_which_nothing_moves_give_persistence() -> None:
    constant_windows = cut(np.full((30, CHANNELS), 5.0), np.full((30, STATES), 0.3))
    baselines = fit(constant_windows, constant_windows)
    for values in baselines.predict(*constant_windows[:2]).values():
        np.testing.assert_allclose(values, 5.0)


def test_a_single_past_frame_has_no_changes_but_a_motion() -> None:
    baselines = fit(walk(1, context=1), walk(2, context=1))
    past, motion, _ = walk(3, context=1)
    predicted = baselines.predict(past, motion)
    assert np.array_equal(predicted["autoregression"], np.repeat(past, HORIZON, axis=1))
    assert np.ptp(predicted["ridge"] - past) > 1


def test_baselines_read_back_are_the_same(fitted: FittedBaselines) -> None:
    read = FittedBaselines.from_tensors(load(save(fitted.to_tensors())))
    assert read.settings == fitted.settings
    before, after = fitted.predict(*walk(2)[:2]), read.predict(*walk(2)[:2])
    assert tuple(after) == linear.NAMES
    for name in linear.NAMES:
        assert np.array_equal(after[name], before[name])
        assert after[name].shape == (192, HORIZON, CHANNELS)
        assert after[name].dtype == np.float32


def test_a_model_without_an_autoregression_keeps_its_other_baselines(fitted: FittedBaselines) -> None:
    """Models from before version 8 of `train forward` have two others instead, which are not read."""
    stored = {
        name: values
        for name, values in fitted.to_tensors().items()
        if not name.startswith(("autoregression", "plan_by_load"))
    }
    read = FittedBaselines.from_tensors({**stored, "damped_trend.phi": np.ones(1)})
    assert set(read.predict(*walk(2)[:2])) == {"train_mean", "ridge", "ridge_actions"}


def test_windows_that_are_none_or_do_not_fit_are_refused() -> None:
    past, motion, ahead = walk(1)
    none = past[:0], motion[:0], ahead[:0]
    with pytest.raises(TacpipeError, match="training recordings contain no window"):
        fit(none, walk(2))
    with pytest.raises(TacpipeError, match="validation recordings contain no window"):
        fit(walk(1), none)
    for part in ((past, motion[:, 1:], ahead), (past, motion, ahead[:, :, 1:]), (past[1:], motion, ahead)):
        with pytest.raises(TacpipeError, match="do not match"):
            fit(part, walk(2))
    with pytest.raises(TacpipeError, match="do not fit training windows"):
        fit(walk(1), (past[:, 1:], motion[:, 1:], ahead))
    broken = past.copy()
    broken[3, 2, 1] = np.nan
    with pytest.raises(TacpipeError, match="not finite"):
        fit((broken, motion, ahead), walk(2))


def test_a_past_that_was_not_fitted_is_refused(fitted: FittedBaselines) -> None:
    past, motion, _ = walk(2)
    for part in ((past[:, 1:], motion), (past, motion[:, 1:]), (past, motion[:, :, 1:]), (past[1:], motion)):
        with pytest.raises(TacpipeError, match="do not fit the baselines"):
            fitted.predict(*part)
