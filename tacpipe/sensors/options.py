"""Check the values of sensor options, and raise errors for invalid ones."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from tacpipe.errors import UsageError


def positive(sensor: str, **values: float) -> None:
    """Raise `UsageError` for an option of ``sensor`` that is not above 0."""
    for name, value in values.items():
        if not 0 < value < float("inf"):
            raise UsageError(f"{sensor}: {name} is {value:g}; it must be above 0.")


def within(sensor: str, name: str, value: float, least: float, most: float) -> None:
    """Raise `UsageError` for an option of ``sensor`` that is not between ``least`` and ``most``, these included."""
    if not least <= value <= most:
        raise UsageError(f"{sensor}: {name} is {value:g}; it must be between {least:g} and {most:g}.")


def known(sensor: str, name: str, value: Any, among: Iterable[Any]) -> None:
    """Raise `UsageError` for an option of ``sensor`` that is none of those ``among`` which it must be."""
    allowed = list(among)
    if value not in allowed:
        raise UsageError(f"{sensor}: {name} is {value!r}; it must be one of {', '.join(map(str, allowed))}.")
