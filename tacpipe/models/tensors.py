"""Select tensors by their names, check what architectures build, and limit the threads of torch and numpy."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

import torch
from threadpoolctl import ThreadpoolController
from torch import nn

from tacpipe.errors import TacpipeError

Value = TypeVar("Value")


def tensors_under(prefix: str, values: Mapping[str, Value]) -> dict[str, Value]:
    """Return the entries whose name starts with ``prefix``, with the prefix removed."""
    return {name.removeprefix(prefix): value for name, value in values.items() if name.startswith(prefix)}


def require_network(built: object, architecture: str) -> nn.Module:
    """Return the network that an architecture built. Raises `TacpipeError` if it built anything else."""
    if not isinstance(built, nn.Module):
        raise TacpipeError(
            f"The architecture {architecture} built {type(built).__name__}; it must build a torch.nn.Module."
        )
    return built


def require_output(output: object, shape: tuple[int, ...], architecture: str, rows: str, axes: str) -> None:
    """Raise `TacpipeError` unless ``output``, a network's output for ``rows``, is a tensor of ``shape``.

    ``axes`` names the axes in the message.
    """
    if not isinstance(output, torch.Tensor) or tuple(output.shape) != shape:
        returned = str(tuple(output.shape)) if isinstance(output, torch.Tensor) else type(output).__name__
        raise TacpipeError(
            f"The network of the architecture {architecture} returns {returned} for {rows}; it must return {axes}, "
            f"here {shape}."
        )


_is_limited: ContextVar[bool] = ContextVar("within", default=False)


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch and numpy to one thread: a row is too small to parallelise, and parallel sums round differently.

    Nested blocks have no effect and no cost.
    """
    if _is_limited.get():
        yield
        return
    before, token = torch.get_num_threads(), _is_limited.set(True)
    torch.set_num_threads(1)
    try:
        with _libraries().limit(limits=1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(before)
        _is_limited.reset(token)


@functools.cache
def _libraries() -> ThreadpoolController:
    """Return the loaded linear algebra libraries, cached because searching for them takes a millisecond."""
    return ThreadpoolController()
