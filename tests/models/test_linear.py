"""The linear baselines, against plain loops, scikit-learn and processes whose future is known."""

import itertools

import numpy as np
import pytest
from safetensors.numpy import load, save
from sklearn.linear_model import Ridge
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from tacpipe.errors import TacpipeError
from tacpipe.models import linear
from tacpipe.models.linear import FittedBaselines, Windows

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


@pytest.fixture(scope="module")
def fitted() -> FittedBaselines:
    return FittedBaselines.fit(walk(1), walk(2))


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


@pytest.mark.parametrize("repeats", [1, 3])
def test_the_trend_is_that_of_the_phi_and_lag_that_err_least_of_all_in_the_grid(repeats: int) -> None:
    frames = walk(1)[0][:, -1].repeat(repeats, axis=0)  # (time, channel), each frame held
    windows = cut(frames, np.zeros((len(frames), STATES)))
    past, _, ahead = (array.astype(np.float64) for array in windows)
    fitted = FittedBaselines.fit(windows, windows)

    def trend(phi: float, lag: int) -> np.ndarray:
        slope = (past[:, -1] - past[:, -1 - lag]) / lag
        return np.stack([past[:, -1] + sum(phi**k for k in range(1, h + 1)) * slope for h in range(1, HORIZON + 1)], 1)

    grid = list(itertools.product(linear.PHIS, range(1, CONTEXT)))
    phi, lag = min(grid, key=lambda array: float(np.square(trend(*array) - ahead).sum()))
    assert (fitted.settings["damped_trend.phi"], fitted.settings["damped_trend.lag"]) == (phi, lag)
    assert phi > 0
    assert (lag > 1) == (repeats > 1)
    np.testing.assert_allclose(fitted.predict(*windows[:2])["damped_trend"], trend(phi, lag), atol=0.01)


def test_a_trend_that_is_damped_by_0_6_a_step_is_predicted_exactly() -> None:
    steps = np.outer(0.6 ** np.arange(CONTEXT + HORIZON), [200.0, -100.0, 50.0])
    values = 1000 + np.cumsum(np.stack([steps, -2 * steps, 3 * steps]), axis=1)
    windows = values[:, :CONTEXT], np.zeros((3, CONTEXT + HORIZON, STATES)), values[:, CONTEXT:]
    baselines = FittedBaselines.fit(windows, windows)
    assert (baselines.phi, baselines.lag) == (0.6, 1)
    np.testing.assert_allclose(baselines.predict(*windows[:2])["damped_trend"], windows[2], rtol=1e-5)


def test_where_nothing_goes_on_the_trend_is_persistence() -> None:
    rng = np.random.default_rng(3)
    noise = cut(rng.normal(size=(400, CHANNELS)), np.zeros((400, STATES)))
    baselines = FittedBaselines.fit(noise, noise)
    assert (baselines.phi, baselines.lag) == (0.0, 1)
    assert np.array_equal(baselines.predict(*noise[:2])["damped_trend"], np.repeat(noise[0][:, -1:], HORIZON, axis=1))


def test_the_last_value_map_is_least_squares_over_the_windows_of_all_channels(fitted: FittedBaselines) -> None:
    past, _, ahead = (array.astype(np.float64) for array in walk(1))
    x = np.concatenate([past[:, :-1, channel] - past[:, -1:, channel] for channel in range(CHANNELS)])
    y = np.concatenate([ahead[:, :, channel] - past[:, -1:, channel] for channel in range(CHANNELS)])
    weight = np.linalg.lstsq(np.hstack([x, np.ones((len(x), 1))]), y, rcond=None)[0]
    other_windows = walk(2)
    changes = other_windows[0][:, :-1].astype(np.float64) - other_windows[0][:, -1:]
    for channel in range(CHANNELS):
        expected = other_windows[0][:, -1:, channel] + changes[:, :, channel] @ weight[:-1] + weight[-1]
        np.testing.assert_allclose(
            fitted.predict(*other_windows[:2])["last_value_linear"][:, :, channel], expected, atol=0.01
        )


def test_the_mean_is_that_of_what_was_to_be_predicted_in_training(fitted: FittedBaselines) -> None:
    predicted = fitted.predict(*walk(2)[:2])["train_mean"]
    np.testing.assert_allclose(predicted[7, 3], walk(1)[2].astype(np.float64).mean(axis=(0, 1)), rtol=1e-6)
    assert (predicted == predicted[0, 0]).all()


def test_a_load_that_the_plan_decides_is_predicted_only_with_the_plan() -> None:
    def held_mass(seed: int) -> Windows:
        """A mass of 2 kg at 300 counts a newton, whose acceleration is white: its past says nothing of its future."""
        acceleration = np.random.default_rng(seed).normal(size=(600, 1))
        return cut(2 * 300 * acceleration * [[1.0, 0.5, -0.2]], np.hstack([acceleration, np.zeros_like(acceleration)]))

    baselines = FittedBaselines.fit(held_mass(1), held_mass(2))
    past, motion, ahead = held_mass(3)
    predicted = baselines.predict(past, motion)
    error = {name: float(np.square(values - ahead).mean()) for name, values in predicted.items()}
    assert error["ridge_actions"] < 0.01 * error["train_mean"]
    assert error["ridge"] > 0.9 * error["train_mean"]
    assert error["damped_trend"] > error["train_mean"]


def test_only_the_ridge_with_actions_knows_the_plan(fitted: FittedBaselines) -> None:
    past, motion, _ = walk(2)
    changed = motion.copy()
    changed[:, CONTEXT:] += 0.1
    before, after = fitted.predict(past, motion), fitted.predict(past, changed)
    assert [name for name in linear.NAMES if not np.array_equal(before[name], after[name])] == ["ridge_actions"]


def test_all_but_the_mean_move_with_the_level_of_the_counts(fitted: FittedBaselines) -> None:
    past, motion, _ = walk(2)
    before, after = fitted.predict(past, motion), fitted.predict(past + np.float32(512), motion)
    for name in linear.NAMES:
        np.testing.assert_allclose(after[name] - before[name], 0 if name == "train_mean" else 512, atol=0.01)


def test_a_forecast_does_not_depend_on_the_windows_beside_it_nor_the_fit_on_its_pieces(
    fitted: FittedBaselines, monkeypatch: pytest.MonkeyPatch
) -> None:
    past, motion, _ = walk(2)
    batched, single = fitted.predict(past, motion), fitted.predict(past[9:10], motion[9:10])
    for name in linear.NAMES:
        np.testing.assert_allclose(single[name][0], batched[name][9], rtol=1e-5)
    monkeypatch.setattr(linear, "CHUNK", 7)
    pieces = FittedBaselines.fit(walk(1), walk(2)).predict(past, motion)
    for name in linear.NAMES:
        np.testing.assert_allclose(pieces[name], batched[name], rtol=1e-5)


def test_channels_and_states_that_stand_still_in_training_are_left_where_they_are() -> None:
    def constant_windows(seed: int) -> Windows:
        rng, (past, motion, ahead) = np.random.default_rng(seed), (array.copy() for array in walk(seed))
        past[:, :, 1] = ahead[:, :, 1] = 77.1
        sides = rng.integers(2, size=motion.shape[:2]).astype(np.float32)
        motion[:, :, 0] = np.nextafter(np.float32(0.3), sides)  # still but for the last bit
        return past, motion, ahead

    baselines = FittedBaselines.fit(constant_windows(1), constant_windows(2))
    past, motion, _ = constant_windows(3)
    stirred = motion.copy()
    stirred[:, :, 0] += 1
    predicted = baselines.predict(past, motion)
    for name in ("train_mean", "damped_trend", "ridge", "ridge_actions"):
        np.testing.assert_allclose(predicted[name][:, :, 1], 77.1, rtol=1e-5)
        assert np.isfinite(predicted[name]).all()
        assert np.array_equal(baselines.predict(past, stirred)[name], predicted[name])


def test_windows_in_which_nothing_moves_give_persistence() -> None:
    constant_windows = cut(np.full((30, CHANNELS), 5.0), np.full((30, STATES), 0.3))
    baselines = FittedBaselines.fit(constant_windows, constant_windows)
    for values in baselines.predict(*constant_windows[:2]).values():
        np.testing.assert_allclose(values, 5.0)


def test_a_single_past_frame_has_no_trend_but_a_motion() -> None:
    baselines = FittedBaselines.fit(walk(1, context=1), walk(2, context=1))
    past, motion, _ = walk(3, context=1)
    predicted = baselines.predict(past, motion)
    assert baselines.settings["damped_trend.lag"] == 0
    assert np.array_equal(predicted["damped_trend"], np.repeat(past, HORIZON, axis=1))
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


def test_windows_that_are_none_or_do_not_fit_are_refused() -> None:
    past, motion, ahead = walk(1)
    none = past[:0], motion[:0], ahead[:0]
    with pytest.raises(TacpipeError, match="training recordings contain no window"):
        FittedBaselines.fit(none, walk(2))
    with pytest.raises(TacpipeError, match="validation recordings contain no window"):
        FittedBaselines.fit(walk(1), none)
    for part in ((past, motion[:, 1:], ahead), (past, motion, ahead[:, :, 1:]), (past[1:], motion, ahead)):
        with pytest.raises(TacpipeError, match="do not match"):
            FittedBaselines.fit(part, walk(2))
    with pytest.raises(TacpipeError, match="do not fit training windows"):
        FittedBaselines.fit(walk(1), (past[:, 1:], motion[:, 1:], ahead))
    broken = past.copy()
    broken[3, 2, 1] = np.nan
    with pytest.raises(TacpipeError, match="not finite"):
        FittedBaselines.fit((broken, motion, ahead), walk(2))


def test_a_past_that_was_not_fitted_is_refused(fitted: FittedBaselines) -> None:
    past, motion, _ = walk(2)
    for part in ((past[:, 1:], motion), (past, motion[:, 1:]), (past, motion[:, :, 1:]), (past[1:], motion)):
        with pytest.raises(TacpipeError, match="do not fit the baselines"):
            fitted.predict(*part)
