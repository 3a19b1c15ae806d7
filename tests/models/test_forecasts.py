"""Test that all forecasters start at persistence, do not look ahead, and reject what they cannot read."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given as each
from hypothesis import strategies as st
from torch import Tensor, nn

from tacpipe.errors import TacpipeError
from tacpipe.models.change import ChangeForecast, grid
from tacpipe.models.forecasts import Ensemble, RecurrentForecast, RecurrentForward, Shrunk, build, persistence_weights
from tacpipe.models.windows import ARM, POSE, ForecastWindows
from tacpipe.plugins import registry
from tests.models.window_fakes import CONTEXT, HORIZON, LAYOUT, ahead, windows

ARCHITECTURES = registry.architectures("forward")
CHANGE = [name for name in ARCHITECTURES if name != "recurrent"]
SIZES: dict[str, Any] = {"hidden": 12, "dropout": 0.2, "loss": "absolute", "context": CONTEXT, "horizon": HORIZON}


def built(architecture: str, *, changes: bool = False, **changed: Any) -> Any:
    """A model of random weights."""
    sizes = {**SIZES, **changed}
    if architecture == "recurrent":
        return RecurrentForecast(len(LAYOUT), sizes["hidden"])
    return build(architecture, len(LAYOUT), LAYOUT, changes=changes, **sizes)


def model(architecture: str, *, changes: bool = False, trained: bool = False, **changed: Any) -> nn.Module:
    """A calibrated model in evaluation mode; one that was ``trained`` no longer has a head of zeros."""
    torch.manual_seed(0)
    network = built(architecture, changes=changes, **changed)
    inputs = windows()
    network.calibrate(inputs, ahead(inputs))
    if trained:
        for weight in network.parameters():
            nn.init.normal_(weight, std=0.3)
    evaluated: nn.Module = network.eval()
    return evaluated


def change(network: nn.Module, inputs: ForecastWindows) -> Tensor:
    with torch.no_grad():
        predicted: Tensor = network(inputs)
    return predicted - inputs.touch[-1]


@pytest.mark.parametrize("architecture", CHANGE)
def test_an_untrained_model_is_persistence(architecture: str) -> None:
    inputs = windows()
    with torch.no_grad():
        predicted = model(architecture)(inputs)
    assert torch.equal(predicted, inputs.touch[-1].expand(HORIZON, -1, -1))


@pytest.mark.parametrize("architecture", [name for name in CHANGE if name != "taxelwise"])
def test_an_untrained_model_of_increments_tells_none(architecture: str) -> None:
    with torch.no_grad():
        assert not model(architecture, changes=True)(windows()).any()


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_the_plan_of_a_step_changes_only_it_and_later_ones(architecture: str) -> None:
    network, inputs = model(architecture, trained=True), windows()
    before = change(network, inputs)
    for step in range(HORIZON):
        arm = inputs.arm.clone()
        arm[CONTEXT + step, :, :3] += 0.02
        arm[CONTEXT + step, :, POSE:] += 0.3
        after = change(network, inputs._replace(arm=arm))
        assert torch.equal(after[:step], before[:step])
        assert ((after - before)[step:].abs().amax(dim=(1, 2)) > 0).all()


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_windows_of_a_batch_do_not_see_each_other(architecture: str) -> None:
    network, inputs = model(architecture, trained=True), windows()
    before, order = change(network, inputs), torch.tensor([4, 2, 0, 5, 1, 3])
    dealt = ForecastWindows(inputs.touch[:, order], inputs.arm[:, order], inputs.finger[:, order])
    assert torch.allclose(change(network, dealt), before[:, order], atol=1e-3)
    touch = inputs.touch.clone()
    touch[:-1, 0] += 50
    after = change(network, inputs._replace(touch=touch))
    assert torch.allclose(after[:, 1:], before[:, 1:], atol=1e-3)
    assert not torch.allclose(after[:, 0], before[:, 0], atol=1e-2)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_all_weights_learn_once_the_head_has_left_zero(architecture: str) -> None:
    network, inputs = model(architecture, trained=True), windows()
    network.loss(inputs, ahead(inputs)).backward()  # type: ignore[operator]
    for name, weight in network.named_parameters():
        assert weight.grad is not None, name
        assert weight.grad.isfinite().all() and weight.grad.abs().max() > 0, name


@pytest.mark.parametrize("architecture", CHANGE)
def test_the_first_step_of_training_leaves_persistence(architecture: str) -> None:
    network, inputs = model(architecture), windows()
    optimiser = torch.optim.SGD(network.parameters(), lr=0.1)
    network.loss(inputs, ahead(inputs)).backward()  # type: ignore[operator]
    optimiser.step()
    assert change(network, inputs).abs().max() > 0


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_channels_that_never_move_do_not_divide_by_zero(architecture: str) -> None:
    inputs = windows()
    touch = inputs.touch.clone()
    touch[..., 3] = 7.0
    arm = inputs.arm[:1].expand(CONTEXT + HORIZON, -1, -1)
    unmoving = inputs._replace(touch=touch, arm=arm, finger=torch.zeros_like(inputs.finger))
    network = built(architecture)
    for target in (ahead(unmoving), unmoving.touch[-1].expand(HORIZON, -1, -1)):
        network.calibrate(unmoving, target)
        assert all(value.isfinite().all() for value in network.state_dict().values())
        assert network(unmoving).isfinite().all()
        assert network.loss(unmoving, target).isfinite()


@pytest.mark.parametrize("architecture", ARCHITECTURES)
@pytest.mark.parametrize(("count", "context", "horizon"), [(1, 1, 1), (1, 5, 4), (3, 1, 2), (2, 2, 1)])
def test_the_smallest_windows_and_batches_work(architecture: str, count: int, context: int, horizon: int) -> None:
    inputs = windows(count, context=context, horizon=horizon)
    network = built(architecture, context=context, horizon=horizon)
    network.calibrate(inputs, ahead(inputs))
    predicted = network(inputs)
    assert predicted.shape == (horizon, count, len(LAYOUT))
    assert predicted.isfinite().all()


@pytest.mark.parametrize(("loss", "expected"), [("absolute", 2.0), ("squared", 4.0), ("huber", 1.5)])
def test_the_loss_is_in_units_of_the_usual_change(loss: str, expected: float) -> None:
    network, inputs = model("gru", loss=loss), windows()
    assert isinstance(network, ChangeForecast)
    usual = (ahead(inputs) - inputs.touch[-1]).square().mean().sqrt()
    assert torch.allclose(network.change_scale, usual)
    loss_value = network.loss(inputs, inputs.touch[-1] + 2 * usual.expand(HORIZON, 1, 1) * torch.ones(len(LAYOUT)))
    assert float(loss_value.detach()) == pytest.approx(expected, rel=1e-4)


def test_scales_of_the_recurrent_model_map_the_training_range_to_one() -> None:
    network, inputs = model("recurrent"), windows()
    values = torch.cat([inputs.touch, ahead(inputs)]).flatten(0, 1)
    scaled = (values - network.touch_centre) / network.touch_half  # type: ignore[operator]
    assert torch.allclose(scaled.amax(0), torch.ones(len(LAYOUT)), atol=1e-5)
    assert torch.allclose(scaled.amin(0), -torch.ones(len(LAYOUT)), atol=1e-5)


@pytest.mark.parametrize(("features", "hidden"), [(20, 200), (12, 16), (96, 8)])
def test_the_recurrent_model_has_as_many_parameters_as_its_equations(features: int, hidden: int) -> None:
    network = RecurrentForecast(features, hidden)
    inputs = features + POSE
    lstm = 4 * hidden * (inputs + hidden) + 2 * 4 * hidden
    assert sum(weight.numel() for weight in network.parameters()) == 2 * lstm + features * hidden + features


def test_velocities_are_nothing_that_the_recurrent_model_reads() -> None:
    network, inputs = model("recurrent", trained=True), windows()
    arm = torch.cat([inputs.arm[..., :POSE], torch.full((CONTEXT + HORIZON, 6, ARM - POSE), 9.0)], -1)
    assert torch.equal(change(network, inputs._replace(arm=arm)), change(network, inputs))


@pytest.mark.parametrize("architecture", CHANGE)
def test_neither_place_nor_heading_of_the_arm_changes_a_forecast(architecture: str) -> None:
    network, inputs = model(architecture, trained=True), windows()
    arm = inputs.arm.clone()
    arm[..., :3] += 3.0
    assert torch.allclose(change(network, inputs._replace(arm=arm)), change(network, inputs), atol=1e-2)


@pytest.mark.parametrize(
    ("architecture", "features", "layout", "reason"),
    [("transformer", 12, LAYOUT, "'transformer'; there are taxelwise, gru"), ("taxelwise", 6, (), "latents")],
)
def test_an_architecture_that_is_unknown_or_cannot_read_the_channels_is_refused(
    architecture: str, features: int, layout: Any, reason: str
) -> None:
    with pytest.raises(TacpipeError, match=reason):
        build(architecture, features, layout, **SIZES)


def test_every_loss_is_known_to_every_change_model() -> None:
    for architecture in CHANGE:
        for loss in ("absolute", "huber", "squared"):
            assert model(architecture, loss=loss).loss(windows(), ahead(windows())) > 0  # type: ignore[operator]


def test_the_grid_of_a_layout_is_read_off_it() -> None:
    assert grid(LAYOUT) == (2, 2, 3)
    assert grid([channel for channel in LAYOUT if channel["stream"] == "xela1"]) == (1, 2, 3)
    assert grid([channel for channel in LAYOUT if channel["axis"] == "z"]) == (2, 2, 1)
    assert grid([{"taxel": str(taxel), "axis": "z"} for taxel in range(16)]) == (1, 16, 1)


@pytest.mark.parametrize(
    "layout",
    [
        [],
        [{} for _ in LAYOUT],
        LAYOUT[1:],  # a taxel lacks an axis
        LAYOUT[:9],  # a sensor lacks a taxel
        LAYOUT[:3],  # a single taxel
        sorted(LAYOUT, key=lambda channel: channel["axis"]),
        sorted(LAYOUT, key=lambda channel: channel["taxel"]),
        [
            *LAYOUT[:6],
            *({**channel, "taxel": str(int(channel["taxel"]) + 8)} for channel in LAYOUT[6:]),
        ],  # named differently
        [*LAYOUT, *LAYOUT],
    ],
)
def test_channels_that_do_not_lie_taxel_by_taxel_are_refused(layout: list[dict[str, str]]) -> None:
    with pytest.raises(
        TacpipeError, match=f"these {len(layout)} channels are not" if layout else "the recordings contain latents"
    ):
        grid(layout)


def test_taxels_share_one_network_so_that_a_swap_of_their_traits_swaps_what_is_told() -> None:
    network, inputs = model("taxelwise", trained=True), windows()
    order = torch.tensor([3, 4, 5, 0, 1, 2, 6, 7, 8, 9, 10, 11])  # the taxels of the first sensor change places
    before = change(network, inputs)
    with torch.no_grad():
        traits = network.traits
        assert isinstance(traits, Tensor)
        traits.copy_(traits[[1, 0, 2, 3]])
    after = change(network, inputs._replace(touch=inputs.touch[..., order]))
    assert torch.allclose(after, before[..., order], atol=1e-2)


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


LATENTS, STATES, ROWS, STEPS, WINDOWS = 3, 2, 5, 4, 6


def recurrent_model() -> RecurrentForward:
    torch.manual_seed(0)
    return RecurrentForward(LATENTS, STATES, hidden=8)


def random_windows(seed: int = 1) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    past = torch.randn(ROWS, WINDOWS, LATENTS + STATES, generator=generator)
    return past, torch.randn(STEPS, WINDOWS, STATES, generator=generator)


def step_by_step(network: RecurrentForward, past: Tensor, plan: Tensor) -> Tensor:
    """The paper's model as its text reads: cell by cell, each prediction fed back."""
    cells = []
    for layer in (network.encoder, network.decoder):
        cell = nn.LSTMCell(LATENTS + STATES, network.hidden)
        for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
            setattr(cell, name, getattr(layer, f"{name}_l0"))
        cells.append(cell)
    hidden = past.new_zeros(past.shape[1], network.hidden), past.new_zeros(past.shape[1], network.hidden)
    for frame in past:
        hidden = cells[0](frame, hidden)
    predicted, steps = past[-1, :, :LATENTS], []
    for planned in plan:
        hidden = cells[1](torch.cat([predicted, planned], dim=1), hidden)
        predicted = network.head(hidden[0])
        steps.append(predicted)
    return torch.stack(steps)


def test_predictions_and_gradients_are_those_of_a_loop_over_cells() -> None:
    network, (past, plan) = recurrent_model(), random_windows()
    fast, slow = network(past, plan), step_by_step(network, past, plan)
    assert torch.allclose(fast, slow, atol=1e-6)
    weights = list(network.parameters())
    for ours, theirs in zip(
        torch.autograd.grad(fast.square().mean(), weights),
        torch.autograd.grad(slow.square().mean(), weights),
        strict=True,
    ):
        assert torch.allclose(ours, theirs, atol=1e-6)


def test_all_weights_learn_those_of_the_encoder_too() -> None:
    network, (past, plan) = recurrent_model(), random_windows()
    network(past, plan)[-1].square().mean().backward()
    for name, weight in network.named_parameters():
        assert weight.grad is not None, name
        assert weight.grad.abs().max() > 0, name


def test_a_prediction_does_not_know_the_plan_of_later_steps() -> None:
    network, (past, plan) = recurrent_model(), random_windows()
    before = network(past, plan)
    for step in range(STEPS):
        changed = plan.clone()
        changed[step] += 1
        after = network(past, changed)
        assert torch.equal(after[:step], before[:step])
        assert (after[step:] != before[step:]).all()


def test_windows_of_a_batch_do_not_see_each_other_in_a_recurrent_network() -> None:
    network, (past, plan) = recurrent_model(), random_windows()
    before, changed = network(past, plan), past.clone()
    changed[:, 0] += 1
    after = network(changed, plan)
    assert torch.allclose(after[:, 1:], before[:, 1:], atol=1e-6)
    assert not torch.allclose(after[:, 0], before[:, 0], atol=1e-3)


def test_a_horizon_of_one_step_works() -> None:
    past, plan = random_windows()
    assert np.shape(recurrent_model()(past, plan[:1])) == (1, WINDOWS, LATENTS)


def test_without_gradients_predictions_are_the_same() -> None:
    network, (past, plan) = recurrent_model(), random_windows()
    with torch.no_grad():
        plain = network(past, plan)
    assert torch.allclose(network(past, plan), plain, atol=1e-6)


def test_names_of_the_weights_are_those_of_stored_models() -> None:
    lstm = [f"{name}_l0" for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")]
    expected = [f"{layer}.{name}" for layer in ("encoder", "decoder") for name in lstm] + ["head.weight", "head.bias"]
    assert list(recurrent_model().state_dict()) == expected
