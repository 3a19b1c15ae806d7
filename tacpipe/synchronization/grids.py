"""Which stream sets the grid of a recording, and its points."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from tacpipe import printable
from tacpipe.channels.absent import absent
from tacpipe.errors import TacpipeError
from tacpipe.synchronization.methods import listed
from tacpipe.synchronization.streams import Stream

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import Int64s, Times


def master(recording: str, wanted: str, schemas: Mapping[str, pa.Schema]) -> str:
    """Return the name of the stream that sets the grid: the ``wanted`` one, or the first with a tactile channel.

    Raises `TacpipeError` where there is none.
    """
    if wanted:
        if wanted not in schemas:
            raise TacpipeError(
                f"Recording {recording} has no stream {wanted!r} to be master; it has {listed(schemas)}."
            )
        return wanted
    for name, schema in schemas.items():
        if any((field.metadata or {}).get(b"quantity") == b"tactile" for field in schema):
            return name
    found = absent(recording, "tactile", schemas)
    raise TacpipeError(f"{found} Without a tactile stream, name the master among {listed(schemas)} with --master.")


def grid(
    recording: str, kind: str, rate_hz: float | None, streams: Mapping[str, Stream], master: Stream, *, held: bool
) -> tuple[Int64s, Int64s]:
    """Return the grid points that lie within every stream, and the row of each: of the master, or of the grid itself.

    A uniform grid is on the phase of the master's first sample. With ``held`` values it ends where the last stream does,
    because nobody knows yet which sample of a stream is its last, and it has one point where stamps are equal.
    Raises `TacpipeError` where no point is left.
    """
    import numpy as np

    from tacpipe.signals.resampling import uniform_grid

    first = max(int(stream.t_ns[0]) for stream in streams.values())
    last = (max if held else min)(int(stream.t_ns[-1]) for stream in streams.values())
    grid_ns = uniform_grid(int(master.t_ns[0]), last, rate_hz) if rate_hz is not None else master.t_ns
    within = (grid_ns >= first) & (grid_ns <= last)
    if kind == "fresh":
        within &= ~master.held
    if held and rate_hz is None:
        within &= np.append(np.diff(grid_ns) > 0, True)
    rows = np.flatnonzero(within)
    if not len(rows):
        late = max(streams.values(), key=lambda stream: int(stream.t_ns[0]))
        early = min(streams.values(), key=lambda stream: int(stream.t_ns[-1]))
        raise TacpipeError(
            f"Recording {recording}: its streams have no time in common, or no row of {master.name} lies in it. "
            f"Stream {late.name} starts last, at {printable.moment(int(late.t_ns[0]))}, and {early.name} ends first, at "
            f"{printable.moment(int(early.t_ns[-1]))}. Leave one of them out with --without, or check their clocks."
        )
    return grid_ns[rows], rows


def rows_at(t_ns: Times, grid_ns: Times, grid_rows: Int64s) -> Int64s | None:
    """Return the rows whose stamps are the grid's, or None if the stream has no sample at some grid point.

    ``grid_rows`` (grid,) are the rows that a stream has there which was stamped along with the grid's.
    """
    import numpy as np

    rows: Int64s = np.searchsorted(t_ns, grid_ns[0]) + grid_rows - grid_rows[0]
    if rows[-1] < len(t_ns) and np.array_equal(t_ns[rows], grid_ns):
        return rows  # one clock for both, equal stamps in a row included
    rows = np.searchsorted(t_ns, grid_ns).astype(np.int64)
    found = rows[-1] < len(t_ns) and np.array_equal(t_ns[rows], grid_ns)
    return rows if found else None
