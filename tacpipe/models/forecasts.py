"""The forecasters by name, each reading the same windows and giving touch in the unit that it was given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from tacpipe.errors import TacpipeError
from tacpipe.models.change import CELLS, ChangeForecast, SequenceForecast
from tacpipe.models.recurrent_forward import RecurrentForward
from tacpipe.models.taxelwise import TaxelwiseForecast, grid
from tacpipe.models.windows import POSE, Windows

AUTO, TAXELWISE = "auto", "taxelwise"
ELSE = "gru"  # the meaning of auto where the taxelwise model cannot read the channels
Layout = Sequence[Mapping[str, str]]
Loss = Literal["absolute", "huber", "squared"]
AnyLoss = Literal["auto", "absolute", "huber", "squared"]


class RecurrentForecast(nn.Module):
    """The paper's model between its scalings: features and poses to [-1, 1] and back; it predicts levels, not changes."""

    change_only = False
    touch_centre: Tensor
    touch_half: Tensor
    pose_centre: Tensor
    pose_half: Tensor

    def __init__(self, features: int, hidden: int) -> None:
        """Make a model of random weights whose scalings are those of data within [-1, 1]."""
        super().__init__()
        self.network = RecurrentForward(features, POSE, hidden)
        for name, width in (("touch", features), ("pose", POSE)):
            self.register_buffer(f"{name}_centre", torch.zeros(width))
            self.register_buffer(f"{name}_half", torch.ones(width))

    def calibrate(self, windows: Windows, ahead: Tensor) -> None:
        """Fit the scalings on training windows: the lowest and highest value of each feature and coordinate."""
        for name, values in (("touch", torch.cat([windows.touch, ahead])), ("pose", windows.arm[..., :POSE])):
            low, high = values.flatten(0, 1).amin(0), values.flatten(0, 1).amax(0)
            half = (high - low) / 2
            getattr(self, f"{name}_centre").copy_((high + low) / 2)
            getattr(self, f"{name}_half").copy_(torch.where(half > 0, half, 1.0))

    def forward(self, windows: Windows) -> Tensor:
        """Return the features to come (horizon, window, feature), in their own unit."""
        restored: Tensor = self._scaled(windows) * self.touch_half + self.touch_centre
        return restored

    def loss(self, windows: Windows, ahead: Tensor) -> Tensor:
        """Return the mean squared error in scaled features, the paper's measure; ``ahead`` (horizon, window, feature)."""
        return nn.functional.mse_loss(self._scaled(windows), (ahead - self.touch_centre) / self.touch_half)

    def _scaled(self, windows: Windows) -> Tensor:
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
    """Return a model of change of random weights for ``features`` latents or channels.

    ``layout`` describes where each channel lies; ``changes``: features are increments already. Raises `TacpipeError` for
    an architecture that is unknown and for a representation that it cannot read.
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


def resolved_loss(loss: AnyLoss, *, changes: bool) -> Loss:
    """Return the loss that ``auto`` is; ``changes``: features are increments already.

    Where a sensor repeats samples most increments are 0, and so is their median, which is all that the absolute error
    teaches.

    >>> resolved_loss("auto", changes=True), resolved_loss("auto", changes=False), resolved_loss("squared", changes=True)
    ('huber', 'absolute', 'squared')
    """
    if loss != "auto":
        return loss
    return "huber" if changes else "absolute"


def resolved(architecture: str, layout: Layout) -> str:
    """Return the architecture that ``auto`` is for channels that lie like ``layout``, empty for latents; others as they are.

    Raises `TacpipeError` for one that cannot read them.

    >>> resolved("auto", ()), resolved("tcn", ())
    ('gru', 'tcn')
    """
    if architecture not in (AUTO, TAXELWISE):
        return architecture
    try:
        grid(layout)
    except TacpipeError:
        if architecture == AUTO:
            return ELSE
        raise
    return TAXELWISE


__all__ = ["AUTO", "ChangeForecast", "RecurrentForecast", "build", "resolved", "resolved_loss"]
