"""Recurrent layers of torch in products of fewer digits: on a GPU they stay in float32.

Under `torch.autocast` cuDNN computes recurrent layers in float16 whatever type was asked for. Gradients below 6e-8 are zero
there, and no loss is scaled to keep them from it.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

State = Tensor | tuple[Tensor, Tensor]  # of a GRU, or of an LSTM


def through(layer: nn.GRU | nn.LSTM, inputs: Tensor, state: State | None = None) -> tuple[Tensor, State]:
    """Return the states (time, window, hidden) of a layer and its last one, which begins at zero where none is given."""
    if not in_float16(inputs):
        return layer(inputs, state)  # type: ignore[no-any-return]
    with torch.autocast(inputs.device.type, enabled=False):
        if isinstance(state, tuple):
            state = state[0].float(), state[1].float()
        return layer(inputs.float(), state if state is None or isinstance(state, tuple) else state.float())  # type: ignore[no-any-return]


def in_float16(inputs: Tensor) -> bool:
    """Return whether a recurrent layer would be computed in float16 for such inputs."""
    return inputs.device.type == "cuda" and torch.is_autocast_enabled("cuda")
