"""Several slides in one recording: where one is over, and what of the recording belongs to the next.

A slide is over once it ended, by the rule of `tacpipe segment slides` applied to the samples so far, and nothing of it came
for a pause. That is looked at at moments which the stamps of the finger alone determine, so that a recording is parted in
the same way while it lasts and afterwards. What comes behind such a moment is the next part: as if a recording began there.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.tasks.material.live.slide import SlideSoFar

if TYPE_CHECKING:
    import pyarrow as pa

    Tables = Mapping[str, pa.Table]

MOMENT_NS = 100_000_000  # between two moments of a part, from its finger's first sample on


class Parting:
    """Finds the ends of slides in what has come of a part of a recording."""

    def __init__(self, slide: SlideSoFar, finger: str, pause_ns: int) -> None:
        """Take what a slide is, the stream of the finger, and how long a pause is."""
        self._slide, self._finger, self._pause_ns = slide, finger, pause_ns
        self._looked = 0  # moments of this part so far

    def begin(self) -> None:
        """Begin another part."""
        self._looked = 0

    def end_ns(self, tables: Tables, until_ns: int) -> int | None:
        """Return the moment at which the slide of this part is over, None where it is not by ``until_ns``.

        ``tables`` are the streams of this part, of which all samples up to ``until_ns`` have come.
        """
        if self._finger not in tables:
            return None
        first_ns = int(tables[self._finger].column("t_ns")[0].as_py())
        while (at_ns := first_ns + (self._looked + 1) * MOMENT_NS) <= until_ns:
            self._looked += 1
            if self._slide.is_over(up_to(tables, at_ns), self._finger, self._pause_ns):
                return at_ns
        return None


def up_to(tables: Tables, t_ns: int) -> dict[str, pa.Table]:
    """Return the rows of each stream up to a time; streams without any are left out."""
    return {name: tables[name].slice(0, count) for name, count in _counts(tables, t_ns).items() if count}


def after(tables: Tables, t_ns: int) -> dict[str, pa.Table]:
    """Return the rows of each stream behind a time; streams without any are left out."""
    counts = _counts(tables, t_ns)
    return {name: tables[name].slice(count) for name, count in counts.items() if count < tables[name].num_rows}


def _counts(tables: Tables, t_ns: int) -> dict[str, int]:
    """Return how many rows each stream has up to a time."""
    return {
        name: int(np.searchsorted(table.column("t_ns").to_numpy(), t_ns, "right")) for name, table in tables.items()
    }


def parts(slide: SlideSoFar, finger: str, pause_ns: int, tables: Tables) -> Iterator[tuple[int, dict[str, pa.Table]]]:
    """Yield the end and the streams of each part of a whole recording; all of it is one where a pause is 0."""
    left = {name: table for name, table in tables.items() if table.num_rows}
    last_ns = max((int(table.column("t_ns")[-1].as_py()) for table in left.values()), default=0)
    parting = Parting(slide, finger, pause_ns)
    parted = False
    while pause_ns and (end_ns := parting.end_ns(left, last_ns)) is not None:
        yield end_ns, up_to(left, end_ns)
        left, parted = after(left, end_ns), True
        parting.begin()
    if finger in left or not parted:
        yield last_ns, left
