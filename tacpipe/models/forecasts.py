"""Create forecasters by name. Each reads the same windows and predicts touch in the unit of its input."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from tacpipe.errors import TacpipeError
from tacpipe.models.change import CELLS, ChangeForecast, SequenceForecast, TaxelwiseForecast, grid
from tacpipe.models.lstm import lstm_of_weights, run_layer
from tacpipe.models.windows import POSE, ForecastWindows

CANDIDATE_WEIGHTS = torch.linspace(0, 1, 21)  # candidate weights; the best is chosen for each step
# prior: a virtual recording on which the full forecast is worse by this fraction of persistence's error
PRIOR_LOSS = 0.05


class Ensemble(nn.Module):
    """The mean of several networks with independent weights.

    The mean has a smaller error than its members have on average (Krogh and Vedelsby, Neural network ensembles, cross
    validation, and active learning, 1995).
    """

    def __init__(self, members: Sequence[nn.Module]) -> None:
        """Combine networks that scale their inputs and outputs themselves."""
        super().__init__()
        self.members = nn.ModuleList(members)
        self.change_only = members[0].change_only

    def calibrate(self, windows: ForecastWindows, ahead: Tensor) -> None:
        """Fit the scales of all members on training windows; ``ahead`` is (horizon, window, feature)."""
        for member in self.members:
            member.calibrate(windows, ahead)  # type: ignore[operator]

    def loss(self, windows: ForecastWindows, ahead: Tensor) -> Tensor:
        """Return the mean of the members' losses; the gradient of a member depends on its own loss only."""
        losses = [member.loss(windows, ahead) for member in self.members]  # type: ignore[operator]
        return torch.stack(losses).mean()

    def forward(self, windows: ForecastWindows) -> Tensor:
        """Return the predicted features (horizon, window, feature)."""
        return torch.stack([member(windows) for member in self.members]).mean(0)


class Shrunk(nn.Module):
    """A trained network whose predicted change is multiplied by a weight from 0 (persistence) to 1 at each step."""

    weight: Tensor  # (horizon,)

    def __init__(self, network: nn.Module, weight: Tensor) -> None:
        """Wrap a network of change. Raises `ValueError` if a weight is below 0 or above 1."""
        super().__init__()
        if not ((weight >= 0) & (weight <= 1)).all():
            raise ValueError("a weight of the forecast is not between 0 and 1")
        self.network, self.change_only = network, True
        self.register_buffer("weight", weight)

    def forward(self, windows: ForecastWindows) -> Tensor:
        """Return the predicted features (horizon, window, feature)."""
        now = windows.touch[-1]
        ahead: Tensor = now + self.weight[:, None, None] * (self.network(windows) - now)
        return ahead


def persistence_weights(changes: Tensor, measured: Tensor, recording: Tensor) -> Tensor:
    """Return the weight (horizon,) of predicted ``changes`` (horizon, window, feature), from 0 to 1.

    ``recording`` (window,) is the number of each window's recording. The weight minimises the mean over recordings of the
    mean absolute error of the ``measured`` changes divided by that of persistence, plus a virtual recording on which the
    forecast is `PRIOR_LOSS` worse. So with few recordings, the weight is close to persistence. The error is convex in the
    weight, so this mean is at most 1 at every step.

    >>> changes, measured = torch.full((1, 1, 2), 2.0), torch.ones(1, 1, 2)
    >>> persistence_weights(changes, measured, torch.zeros(1, dtype=torch.int64))
    tensor([0.5000])
    """
    total = PRIOR_LOSS * CANDIDATE_WEIGHTS[:, None].double().expand(-1, len(changes)).clone()  # (weight, horizon)
    for number in torch.unique(recording):
        windows = recording == number
        predicted, truth = changes[:, windows].double(), measured[:, windows].double()
        errors = torch.stack([(truth - weight * predicted).abs().mean((1, 2)) for weight in CANDIDATE_WEIGHTS])
        total += errors / errors[0].clamp_min(torch.finfo(torch.float64).tiny)
    return CANDIDATE_WEIGHTS[total.argmin(0)]


class RecurrentForward(nn.Module):
    """An LSTM encoder and decoder of one layer each with a linear head; the decoder is free-running, also in training.

    After Nazari, Mandil, Hanheide and Ghalamzan Esfahani, Tactile Dynamic Behaviour Prediction Based on Robot Action
    (TAROS 2021): the encoder reads [tactile features ; robot state] step by step, and its (h, c) initialise the
    decoder, whose input at each step is [last predicted tactile features ; planned robot state]. The paper states no
    layer sizes: one layer of 200 units follows its authors' later models, and the linear head is our choice.
    """

    def __init__(self, latents: int, states: int, hidden: int = 200) -> None:
        """Create a network with random weights; sizes are numbers of features and of recurrent units."""
        super().__init__()
        self.latents, self.states, self.hidden = latents, states, hidden
        self.encoder = nn.LSTM(latents + states, hidden)
        self.decoder = nn.LSTM(latents + states, hidden)
        self.head = nn.Linear(hidden, latents)

    def forward(self, past: Tensor, plan: Tensor) -> Tensor:
        """Return the predicted tactile features, shape (horizon, window, latent).

        ``past`` is (context, window, latent + state), tactile features first; ``plan`` is (horizon, window, state).

        Feeding the head's output z = V h + b back into the gates, U z + W h, is the same as a recurrent weight
        W + U V and a bias U b. So the decoder is an ordinary LSTM over the plan, which one call computes for all
        steps. Only the first step reads what is fed back, where the measured features differ from the predicted ones.
        """
        state = run_layer(self.encoder, past)[1]
        from_input, from_state, *biases = self.decoder.parameters()
        feedback = from_input[:, : self.latents]  # (gate, latent)
        measured = past[-1, :, : self.latents] - self.head(state[0][0])  # (window, latent)
        later = measured.new_zeros(len(plan) - 1, *measured.shape)
        inputs = torch.cat([torch.cat([measured[None], later]), plan], -1)
        recurrent = torch.addmm(from_state, feedback, self.head.weight)
        bias = biases[0] + biases[1] + feedback @ self.head.bias
        states = lstm_of_weights(inputs, state, (from_input, recurrent, bias))
        predicted: Tensor = self.head(states)
        return predicted


AUTO, TAXELWISE = "auto", "taxelwise"
FALLBACK = "gru"  # the meaning of auto if the taxelwise model cannot read the channels
Layout = Sequence[Mapping[str, str]]
Loss = Literal["absolute", "huber", "squared"]
AnyLoss = Literal["auto", "absolute", "huber", "squared"]


class RecurrentForecast(nn.Module):
    """The paper's model with its scaling of features and poses to [-1, 1] and back. It predicts levels, not changes."""

    change_only = False
    touch_centre: Tensor
    touch_half: Tensor
    pose_centre: Tensor
    pose_half: Tensor

    def __init__(self, features: int, hidden: int) -> None:
        """Create a network with random weights and scaling for data in [-1, 1]."""
        super().__init__()
        self.network = RecurrentForward(features, POSE, hidden)
        for name, width in (("touch", features), ("pose", POSE)):
            self.register_buffer(f"{name}_centre", torch.zeros(width))
            self.register_buffer(f"{name}_half", torch.ones(width))

    def calibrate(self, windows: ForecastWindows, ahead: Tensor) -> None:
        """Fit the scaling on training windows: the minimum and maximum of each feature and coordinate."""
        for name, values in (("touch", torch.cat([windows.touch, ahead])), ("pose", windows.arm[..., :POSE])):
            low, high = values.flatten(0, 1).amin(0), values.flatten(0, 1).amax(0)
            half = (high - low) / 2
            getattr(self, f"{name}_centre").copy_((high + low) / 2)
            getattr(self, f"{name}_half").copy_(torch.where(half > 0, half, 1.0))

    def forward(self, windows: ForecastWindows) -> Tensor:
        """Return the predicted features (horizon, window, feature), in their own unit."""
        restored: Tensor = self._predict_scaled(windows) * self.touch_half + self.touch_centre
        return restored

    def loss(self, windows: ForecastWindows, ahead: Tensor) -> Tensor:
        """Return the mean squared error of scaled features, the paper's loss; ``ahead`` is (horizon, window, feature)."""
        return nn.functional.mse_loss(self._predict_scaled(windows), (ahead - self.touch_centre) / self.touch_half)

    def _predict_scaled(self, windows: ForecastWindows) -> Tensor:
        """Return the predicted touch (horizon, window, feature) in the network's scale."""
        touch = (windows.touch - self.touch_centre) / self.touch_half
        pose = (windows.arm[..., :POSE] - self.pose_centre) / self.pose_half
        past = torch.cat([touch, pose[: windows.context]], -1)
        predicted: Tensor = self.network(past, pose[windows.context :])
        return predicted


def build(
    architecture: str,
    features: int,
    layout: Layout,
    *,
    hidden: int,
    context: int,
    horizon: int,
    dropout: float,
    loss: str,
    changes: bool = False,
) -> ChangeForecast:
    """Return a model of change with random weights for ``features`` latents or channels.

    ``layout`` describes the position of each channel; ``changes``: features are already increments. Raises
    `TacpipeError` if the architecture is unknown or cannot read this representation.
    """
    if architecture in CELLS:
        return SequenceForecast(
            features,
            cell=architecture,
            increments=changes,
            hidden=hidden,
            dropout=dropout,
            loss=loss,
            context=context,
            horizon=horizon,
        )
    if architecture == TAXELWISE:
        return TaxelwiseForecast(layout, hidden=hidden, dropout=dropout, loss=loss, context=context, horizon=horizon)
    raise TacpipeError(f"There is no architecture {architecture!r}; there are {', '.join((TAXELWISE, *CELLS))}.")


def resolve_loss(loss: AnyLoss, *, changes: bool) -> Loss:
    """Return ``loss``, or the default loss if it is ``auto``. ``changes``: features are already increments.

    If a sensor repeats samples, most increments are 0, and so is their median, which is all that a network would learn
    from the absolute error.

    >>> resolve_loss("auto", changes=True), resolve_loss("auto", changes=False), resolve_loss("squared", changes=True)
    ('huber', 'absolute', 'squared')
    """
    if loss != "auto":
        return loss
    return "huber" if changes else "absolute"


def resolve_architecture(architecture: str, layout: Layout) -> str:
    """Return ``architecture``, or if it is ``auto`` the default for channels with this ``layout`` (empty for latents).

    Raises `TacpipeError` if the taxelwise architecture is requested and cannot read the channels.

    >>> resolve_architecture("auto", ()), resolve_architecture("tcn", ())
    ('gru', 'tcn')
    """
    if architecture not in (AUTO, TAXELWISE):
        return architecture
    try:
        grid(layout)
    except TacpipeError:
        if architecture == AUTO:
            return FALLBACK
        raise
    return TAXELWISE


__all__ = ["AUTO", "ChangeForecast", "RecurrentForecast", "build", "resolve_architecture", "resolve_loss"]
