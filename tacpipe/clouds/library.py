"""The library open3d, imported where it is needed, and silent: it would print warnings where we raise errors."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tacpipe.errors import TacpipeError


@contextmanager
def open3d() -> Iterator[Any]:
    """Yield the module open3d; within, it prints nothing but errors. Raises `TacpipeError` if it is not installed."""
    try:
        import open3d as module
    except ImportError as error:
        raise TacpipeError(
            f"open3d cannot be imported ({error}), and clouds of points need it. Install it: `pip install "
            f"'tacpipe[clouds]'` brings it."
        ) from error
    with module.utility.VerbosityContextManager(module.utility.VerbosityLevel.Error):
        yield module
