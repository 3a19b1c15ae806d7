"""What `tacpipe demo` runs of one task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple


class Demo(NamedTuple):
    """Commands without the leading ``tacpipe``, in their order, and the datasets that the page of results shows."""

    commands: list[list[str]]
    results: list[str]
    others: Sequence[str] = ()  # datasets that the page uses, which are not results
