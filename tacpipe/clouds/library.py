"""The library open3d, imported where it is needed, and silent: it would print warnings where we raise errors."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tacpipe.plugins import extras


@contextmanager
def open3d() -> Iterator[Any]:
    """Yield the module open3d; within, it prints nothing but errors. Raises `MissingModuleError` without it."""
    with extras.explain_missing("A cloud of points"):
        import open3d as module
    with module.utility.VerbosityContextManager(module.utility.VerbosityLevel.Error):
        yield module
