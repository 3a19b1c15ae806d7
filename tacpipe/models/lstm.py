"""Recurrent layers: torch's layers in float32 under autocast, and an LSTM of computed weights.

Hochreiter and Schmidhuber, Long Short-Term Memory (Neural Computation 1997), with the forget gate of Gers, Schmidhuber
and Cummins, Learning to Forget (Neural Computation 2000), in torch's order of gates i, f, g, o.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

T = TypeVar("T")


def run_layer(layer: Callable[..., T], inputs: Tensor, *tensors: Any) -> T:
    """Call a recurrent layer and return its result, in float32 on a GPU and for an LSTM.

    ``inputs`` and ``tensors`` are passed to it; the latter may be tuples of tensors or None. Under `torch.autocast`,
    cuDNN computes recurrent layers in float16 whatever type is requested. Gradients below 6e-8 become zero there,
    because the loss is not scaled. On a CPU without AVX-512, oneDNN has no LSTM in bfloat16.
    """
    lacks_bfloat16 = inputs.device.type == "cuda" or isinstance(layer, nn.LSTM)
    return _in_float32(layer, inputs, *tensors) if lacks_bfloat16 else layer(inputs, *tensors)


def _in_float32(layer: Callable[..., T], inputs: Tensor, *tensors: Any) -> T:
    """Call a layer without autocast; its tensors are converted to float32 if autocast is enabled."""
    if not torch.is_autocast_enabled(inputs.device.type):
        return layer(inputs, *tensors)
    with torch.autocast(inputs.device.type, enabled=False):
        return layer(inputs.float(), *map(_to_float32, tensors))


def _to_float32(value: Any) -> Any:
    """Convert tensors, also in tuples, to float32."""
    if isinstance(value, tuple):
        return tuple(map(_to_float32, value))
    return value if value is None else value.float()


# computed weights are not contiguous, so cuDNN copies them in every call
warnings.filterwarnings("ignore", message="RNN module weights are not part of single contiguous chunk")
State = tuple[Tensor, Tensor]  # h and c, each (1, window, hidden)
Weights = tuple[Tensor, Tensor, Tensor]  # W (4 hidden, input), R (4 hidden, hidden), b (4 hidden,)


def lstm_of_weights(inputs: Tensor, state: State, weights: Weights) -> Tensor:
    """Return h of all steps (step, window, hidden) of an LSTM with ``weights``, for ``inputs`` (step, window, input).

    The result is in float32 also under autocast.
    """
    return _in_float32(_torch_lstm, inputs, state, weights)


def _torch_lstm(inputs: Tensor, state: State, weights: Weights) -> Tensor:
    """Return the result of `lstm_of_weights` in the type of the inputs."""
    flat = [*weights, torch.zeros_like(weights[2])]
    states: Tensor = torch.lstm(inputs, state, flat, True, 1, 0.0, torch.is_grad_enabled(), False, False)[0]
    return states
