"""Recurrent layers of torch in products of fewer digits: on a GPU they stay in float32.

Under `torch.autocast` cuDNN computes recurrent layers in float16 whatever type was asked for. Gradients below 6e-8 are zero
there, and no loss is scaled to keep them from it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor

T = TypeVar("T")


def through(layer: Callable[..., T], inputs: Tensor, *tensors: Any) -> T:
    """Return what a layer returns for ``inputs`` and more tensors, tuples of tensors or None; on a GPU in float32."""
    if not in_float16(inputs):
        return layer(inputs, *tensors)
    with torch.autocast(inputs.device.type, enabled=False):
        return layer(inputs.float(), *map(_to_float32, tensors))


def in_float16(inputs: Tensor) -> bool:
    """Return whether a recurrent layer would be computed in float16 for such inputs."""
    return inputs.device.type == "cuda" and torch.is_autocast_enabled("cuda")


def _to_float32(value: Any) -> Any:
    """Return tensors, and those of tuples, in float32."""
    if isinstance(value, tuple):
        return tuple(map(_to_float32, value))
    return value if value is None else value.float()
