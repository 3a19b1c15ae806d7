"""Select the tensors of a part by their names, and limit the threads that torch and numpy compute with."""

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
    """Return the entries whose name begins with ``prefix``, without it.

    >>> tensors_under("a.", {"a.weight": 1, "b.weight": 2})
    {'weight': 1}
    """
    return {name.removeprefix(prefix): value for name, value in values.items() if name.startswith(prefix)}


_is_limited: ContextVar[bool] = ContextVar("within", default=False)


@contextmanager
def one_thread() -> Iterator[None]:
    """Have torch and numpy work in one thread: a row is too little to share, and sums in several threads round otherwise.

    Within another such block it does nothing, and costs nothing.
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
    """Return the libraries of linear algebra that are loaded; to look for them takes a millisecond."""
    return ThreadpoolController()
