"""The mixed forecast: what it reads, and that its blend is what its parts and the validation windows make of it."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tacpipe.models import blending
from tacpipe.models.channel_rows import ChannelRows
from tacpipe.models.frames import FramesForecast, newest
from tacpipe.models.mixed import BOOSTED, NETWORKS, MixedForecast, Size
from tacpipe.models.windows import Windows
from tests.models.window_fakes import CONTEXT, HORIZON, LAYOUT, ahead, windows

SIZE = Size(networks=1, frames=3, trees=5, hidden=8, context=3, history=CONTEXT, horizon=HORIZON, dropout=0.0)


def made(size: Size = SIZE, count: int = 40) -> tuple[MixedForecast, Windows, Tensor]:
    torch.manual_seed(0)
    model, given = MixedForecast(LAYOUT, size), windows(count)
    model.calibrate(given, ahead(given))
    return model.eval(), given, ahead(given)


def test_the_newest_frames_are_those_that_differ_from_the_row_before() -> None:
    rng = np.random.default_rng(0)
    new = rng.random((30, 20)) < 0.3
    touch = np.cumsum(new[..., None] * rng.normal(size=(30, 20, 3)), axis=0)
    rows, ages = newest(torch.from_numpy(touch), 4)
    for window in range(20):
        frames = [row for row in range(29, 0, -1) if new[row, window]] + [0]
        wanted = (frames + [0] * 4)[:4]
        assert rows[:, window].tolist() == wanted
        assert ages[:, window].tolist() == [29 - row for row in wanted]


def test_repeated_rows_at_the_beginning_change_the_ages_of_the_oldest_frame_alone() -> None:
    given = windows().touch
    longer = torch.cat([given[:1].expand(7, -1, -1), given])
    (rows, ages), (shifted, later) = newest(given, 3), newest(longer, 3)
    seen, again = (touch[at, torch.arange(given.shape[1])] for touch, at in ((given, rows), (longer, shifted)))
    assert torch.equal(seen, again)
    assert torch.equal(ages[rows > 0], later[rows > 0])


def test_a_row_of_a_channel_holds_its_own_changes_its_ages_and_the_plan_of_its_step() -> None:
    given, reader = windows(), ChannelRows(2, 2, 3, frames=3)
    past = reader.past(given, floor=1.0)
    row = reader.step(past, 2)
    assert row.shape == (6, len(LAYOUT), reader.width)
    rows, ages = newest(given.touch, 3)
    for window, channel in itertools.product((0, 5), (0, 7, 11)):
        wanted = [given.touch[-1, window, channel] - given.touch[rows[at, window], window, channel] for at in (1, 2)]
        np.testing.assert_allclose(row[window, channel, :2], wanted, rtol=1e-6)
        moved = float(past.moved[window, channel])
        np.testing.assert_allclose(row[window, channel, 2:4] * moved, wanted, rtol=1e-4)
        assert row[window, channel, 4] == given.touch[-1, window, channel]
        assert row[window, channel, -1] == 2
        assert torch.equal(row[window, channel, -16:-1], past.plan[1, window])
        assert ages[:, window].to(torch.float32).tolist() == row[window, channel, -22:-19].tolist()
        assert row[window, channel, -19:-16].tolist() == [channel // 6, channel % 6 // 3, channel % 3]
    taxel = slice(6, 9)  # the levels of the three axes of the channel's taxel
    assert torch.equal(row[:, 6, taxel], row[:, 8, taxel])
    assert torch.equal(row[:, 7, taxel], given.touch[-1][:, 6:9])


def test_a_forecast_is_the_blend_of_the_mean_of_networks_with_trees() -> None:
    model, given, truth = made()
    for weight in model.parameters():
        torch.nn.init.normal_(weight, std=0.2)
    model.complete((given, truth), (given, truth), seed=0)
    with torch.no_grad():
        of_frames: Tensor = model.frames[0](given)
        networks = (model.taxelwise(given.latest(3)) + of_frames) / 2 - given.touch[-1]
        trees = model.of_trees(given)
        found = model(given) - given.touch[-1]
    assert not trees[0].any() and trees[1:].abs().amax((1, 2)).min() > 0
    wanted = model.blend[NETWORKS, :, None, None] * networks + model.blend[BOOSTED, :, None, None] * trees
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-3)
    assert model.blend[BOOSTED, 0] == 0 < model.blend[BOOSTED].max()
    assert (model.blend >= 0).all() and (model.blend.sum(0) <= 1 + 1e-6).all()


def test_trees_lower_the_error_of_a_change_that_the_channels_themselves_announce() -> None:
    model, given, _ = made(SIZE._replace(trees=30), 400)
    truth = given.touch[-1] + 0.7 * (given.touch[-1] - given.touch[-2]).expand(HORIZON, -1, -1)
    model.complete((given, truth), (given, truth), seed=0)
    with torch.no_grad():
        error = (model(given) - truth).abs().mean((1, 2)) / (given.touch[-1] - truth).abs().mean((1, 2))
    assert (error[1:] < 0.6).all() and error[0] == 1


def test_where_everything_fitted_is_wrong_the_forecast_is_persistence() -> None:
    model, given, _ = made()
    for weight in model.parameters():
        torch.nn.init.normal_(weight, std=0.2)
    with torch.no_grad():
        change = model(given) - given.touch[-1]
    still = given.touch[-1] - 3 * change  # the networks predict the wrong direction
    model.complete((given, given.touch[-1].expand(HORIZON, -1, -1)), (given, still), seed=0)
    assert not model.blend.any()
    with torch.no_grad():
        assert torch.equal(model(given), given.touch[-1].expand(HORIZON, -1, -1))


def test_without_trees_or_with_one_step_alone_networks_and_persistence_are_blended() -> None:
    for size in (SIZE._replace(trees=0), SIZE._replace(horizon=1)):
        torch.manual_seed(0)
        given = windows(horizon=size.horizon)
        model = MixedForecast(LAYOUT, size).eval()
        model.calibrate(given, ahead(given))
        model.complete((given, ahead(given)), (given, ahead(given)), seed=0)
        assert model(given).shape == (size.horizon, 6, len(LAYOUT))
        assert not model.blend[BOOSTED].any()


@pytest.mark.parametrize("forecasts", [1, 2])
def test_weights_are_the_best_of_all_multiples_of_a_part(forecasts: int) -> None:
    rng = np.random.default_rng(forecasts)
    truth = rng.standard_cauchy(200)
    changes = np.stack([truth + rng.standard_cauchy(200) for _ in range(forecasts)])
    found = blending.weights(changes, truth, parts=10)
    errors = {
        whole: float(np.abs(truth - np.array(whole) / 10 @ changes).sum())
        for whole in itertools.product(range(11), repeat=forecasts)
        if sum(whole) <= 10
    }
    assert tuple(np.rint(found * 10).astype(int)) == min(errors, key=lambda one: errors[one])
    assert min(errors.values()) < errors[(0,) * forecasts]


def test_networks_of_frames_read_more_rows_without_more_weights_for_touch() -> None:
    shared: dict[str, Any] = {"hidden": 8, "frames": 3, "horizon": HORIZON, "dropout": 0.0, "loss": "absolute"}
    short, long = (FramesForecast(LAYOUT, context=context, **shared) for context in (20, 60))
    assert short.own.weight.shape == long.own.weight.shape
    assert len(long.arm_rows) - len(short.arm_rows) == 40 // 5
