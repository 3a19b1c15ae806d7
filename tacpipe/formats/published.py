"""Which recordings are those of a published set, and not a lab's own in the same layout: known by when they were recorded.

What a set's paper printed, and what is known of how it was recorded, holds for its recordings alone.
"""

from __future__ import annotations

from datetime import UTC, datetime

from tacpipe.datasets.origin import PUBLISHED
from tacpipe.plugins.stage import Attribute

MONTHS = {  # first and last month (UTC) in which a set was recorded, by format; one without stamps is known by its layout
    "biotac-slide": ("2020-02", "2020-02"),
    "vision2tactile": ("2019-05", "2019-07"),
    "xela-flat": ("2021-11", "2021-11"),
}


def mark(name: str, t_ns: int | None = None) -> dict[str, Attribute]:
    """Return the attribute that names the published set of a recording, given its format and its first time stamp (UTC).

    Empty for a recording of another time; one of a format without stamps is of the set.

    >>> mark("vision2tactile", 1561629162 * 10**9), mark("vision2tactile", 1861629162 * 10**9), mark("roboskin")
    ({'published': 'vision2tactile'}, {}, {'published': 'roboskin'})
    """
    if t_ns is None:
        return {PUBLISHED: name}
    first, last = MONTHS[name]
    month = f"{datetime.fromtimestamp(t_ns // 10**9, UTC):%Y-%m}"
    return {PUBLISHED: name} if first <= month <= last else {}
