"""Labelled intervals of recordings, stored as one text label per kind, such as ``slip_intervals``.

The text lists intervals in seconds since the first sample of the recording: ``1.2-1.5 4-4.2``. An empty text means that
there are no intervals, which differs from a missing label.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

from tacpipe.errors import UsageError
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import plain

Interval = tuple[float, float]  # seconds since the first sample of the recording
SUFFIX = "_intervals"
NUMBER = r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)"


def attribute(label: str) -> str:
    """Return the name of the label that keeps the intervals of a kind. Raises `UsageError` for an invalid name.

    >>> attribute("slip")
    'slip_intervals'
    """
    if not label.isidentifier():
        raise UsageError(f"{plain(label)} is not a name for intervals. Give letters, digits and _, as in slip.")
    return f"{label}{SUFFIX}"


def to_text(intervals: Sequence[Interval]) -> str:
    """Return intervals as a text, sorted, with overlapping ones joined.

    >>> to_text([(2.0, 2.5), (0.25, 1.0), (0.5, 1.5)])
    '0.25-1.5 2-2.5'
    """
    joined: list[list[float]] = []
    for begin, end in sorted(intervals):
        if joined and begin <= joined[-1][1]:
            joined[-1][1] = max(joined[-1][1], end)
        else:
            joined.append([begin, end])
    return " ".join(f"{begin:.9g}-{end:.9g}" for begin, end in joined)


def from_text(text: str) -> list[Interval]:
    """Return the intervals in a text. Raises `UsageError` for anything else.

    >>> from_text("0.25-1.5 2-2.5"), from_text("")
    ([(0.25, 1.5), (2.0, 2.5)], [])
    """
    intervals = []
    for word in text.split():
        match = re.fullmatch(f"{NUMBER}-{NUMBER}", word)
        if match is None:
            raise UsageError(f"{plain(word)} is not an interval. Give seconds as FROM-TO, as in 1.2-1.5.")
        intervals.append(checked_interval(float(match[1]), float(match[2])))
    return intervals


def checked_interval(begin: float, end: float) -> Interval:
    """Return an interval. Raises `UsageError` if it is negative, infinite or ends before it begins."""
    if not (0 <= begin <= end < math.inf):
        raise UsageError(
            f"The interval {begin:g} to {end:g} is invalid. Give seconds since the first sample, the smaller one first."
        )
    return begin, end


def intervals_of(attributes: Mapping[str, Attribute], label: str) -> list[Interval] | None:
    """Return the intervals of a kind among the labels of a recording, or None if it has no such label."""
    text = attributes.get(attribute(label))
    return from_text(str(text)) if text is not None else None


def all_intervals(attributes: Mapping[str, Attribute]) -> dict[str, list[Interval]]:
    """Return the labelled intervals of a recording by name.

    >>> all_intervals({"object": "cup", "slip_intervals": "1-2"})
    {'slip': [(1.0, 2.0)]}
    """
    names = [name.removesuffix(SUFFIX) for name in attributes if name.endswith(SUFFIX)]
    return {name: intervals_of(attributes, name) or [] for name in names}
