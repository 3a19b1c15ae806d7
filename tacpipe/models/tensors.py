"""Select tensors by a prefix of their names, and limit torch and numpy to one thread."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

import torch
from threadpoolctl import ThreadpoolController

Value = TypeVar("Value")


def tensors_under(prefix: str, values: Mapping[str, Value]) -> dict[str, Value]:
    """Return the entries whose name starts with ``prefix``, with the prefix removed."""
    return {name.removeprefix(prefix): value for name, value in values.items() if name.startswith(prefix)}


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
