"""The mean of several networks, and the weights that shrink it towards persistence."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given as each
from hypothesis import strategies as st
from torch import nn

from tacpipe.models.forecasts import Ensemble, Shrunk, build, persistence_weights
from tacpipe.models.windows import ForecastWindows
from tests.models.window_fakes import CONTEXT, HORIZON, LAYOUT, ahead, windows


def network(seed: int) -> nn.Module:
    """A network that no longer begins at persistence."""
    torch.manual_seed(seed)
    sizes = {"hidden": 8, "dropout": 0.0, "loss": "absolute", "context": CONTEXT, "horizon": HORIZON}
    member = build("gru", len(LAYOUT), LAYOUT, changes=False, **sizes)  # type: ignore[arg-type]
    for weight in member.parameters():
        nn.init.normal_(weight, std=0.3)
    return member.eval()


def calibrated(count: int) -> tuple[list[nn.Module], Ensemble, ForecastWindows]:
    members, inputs = [network(seed) for seed in range(count)], windows(40)
    ensemble = Ensemble(members)
    ensemble.calibrate(inputs, ahead(inputs))
    return members, ensemble.eval(), inputs


@torch.no_grad()
def test_the_forecast_of_an_ensemble_is_the_mean_of_its_members() -> None:
    members, ensemble, inputs = calibrated(3)
    expected = np.mean([member(inputs).numpy() for member in members], axis=0)
    np.testing.assert_allclose(ensemble(inputs).numpy(), expected, rtol=1e-5, atol=1e-4)


def test_each_member_gets_the_gradient_that_it_would_get_alone() -> None:
    members, ensemble, inputs = calibrated(2)
    ensemble.loss(inputs, ahead(inputs)).backward()  # type: ignore[no-untyped-call]
    ensemble_gradients = [weight.grad for weight in members[1].parameters()]
    members[1].zero_grad()
    members[1].loss(inputs, ahead(inputs)).backward()  # type: ignore[operator]
    for weight, half in zip(members[1].parameters(), ensemble_gradients, strict=True):
        if weight.grad is not None:
            assert half is not None
            torch.testing.assert_close(weight.grad / 2, half)


@torch.no_grad()
def test_a_shrunk_forecast_is_no_worse_than_persistence_at_any_step_of_the_windows_it_was_shrunk_on() -> None:
    _, ensemble, inputs = calibrated(2)
    truth = ahead(inputs)
    errors = (ensemble(inputs) - truth).abs().mean((1, 2))
    persistence = (inputs.touch[-1] - truth).abs().mean((1, 2))
    assert (errors > persistence).any()  # these networks were not trained
    now = inputs.touch[-1]
    recording = torch.zeros(40, dtype=torch.int64)
    shrunk = Shrunk(ensemble, persistence_weights(ensemble(inputs) - now, truth - now, recording))
    assert ((shrunk(inputs) - truth).abs().mean((1, 2)) <= persistence * (1 + 1e-6)).all()


@each(st.integers(0, 1000), st.integers(1, 5), st.floats(-3, 3, allow_nan=False))
def test_weights_never_raise_the_mean_over_recordings_of_the_error_beside_persistence(
    seed: int, recordings: int, gain: float
) -> None:
    generator = np.random.default_rng(seed)
    scales = 10.0 ** generator.normal(size=(1, 6, 1))  # counts of windows: one large recording decides nothing
    measured = torch.from_numpy(scales * generator.normal(size=(3, 6, 4)))
    changes = gain * measured + torch.from_numpy(scales * generator.normal(size=(3, 6, 4)))
    recording = torch.from_numpy(generator.integers(0, recordings, 6))
    weights = persistence_weights(changes, measured, recording)
    assert ((weights >= 0) & (weights <= 1)).all()
    errors = (measured - weights.double()[:, None, None] * changes).abs().mean(2).numpy()  # (step, window)
    persistence = measured.abs().mean(2).numpy()
    for step in range(3):
        ratios = [
            errors[step, recording == number].mean() / persistence[step, recording == number].mean()
            for number in torch.unique(recording)
        ]
        assert np.mean(ratios) <= 1 + 1e-9


def test_a_small_gain_counts_the_more_the_more_recordings_show_it() -> None:
    generator = torch.Generator().manual_seed(0)
    changes = torch.randn(1, 400, 30, generator=generator)
    measured = 0.05 * changes + torch.randn(1, 400, 30, generator=generator)
    one_recording, forty_recordings = (
        persistence_weights(changes, measured, torch.arange(400) % count) for count in (1, 40)
    )
    assert one_recording < forty_recordings
    assert (
        persistence_weights(measured, measured, torch.zeros(400)) == 1
    )  # one recording of a perfect forecast shows enough


def test_recordings_in_which_nothing_changes_decide_nothing() -> None:
    measured = torch.randn(2, 6, 3, generator=torch.Generator().manual_seed(0))
    recording = torch.tensor([0, 0, 0, 1, 1, 1])
    measured[:, 3:] = 0
    changes = measured.clone()
    assert persistence_weights(changes, measured, recording).tolist() == [1.0, 1.0]
