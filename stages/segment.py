"""Cut synchronized recordings down to the part that matters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tacpipe.errors import TacpipeError
from tacpipe.stage import stage

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.dataset import Shard


@dataclass(frozen=True)
class Params:
    """What counts as contact.

    The thresholds stem from 52 published pick-and-move trials of a XELA uSkin: at rest the load stays below 6 counts,
    in the grasp above 240 and mostly above 1000, and after a drop up to 65 counts remain for seconds.
    """

    begins: str = "free"  # free: nothing is touched at first; grasped: all of the recording is one contact
    rest_s: float = 0.2  # seconds at the start whose median is each channel's level without load
    on_count: float = 120.0  # device counts by which a finger's taxels leave rest on average, where contact starts
    off_count: float = 80.0  # device counts below which it ends
    merge_s: float = 0.5  # seconds; contacts that are no further apart are one
    min_s: float = 0.3  # seconds; shorter contacts are left out
    pad_s: float = 0.5  # seconds kept before and after each contact


@stage(version=1)
def contacts(params: Params, recording: Shard) -> pa.Table:
    """Return the rows in which either finger touches something, numbered in ``contact``; none if it never does."""
    import numpy as np
    import pyarrow as pa

    from tacpipe.signals.contact import contact_intervals, load, rest_level
    from tacpipe.tables import with_metadata

    if params.begins not in ("free", "grasped"):
        raise TacpipeError(f"begins is {params.begins!r}; it must be free or grasped.")
    table = recording.table()
    t_ns = table.column("t_ns").to_numpy()  # (time,)
    loads: list[Any] = []
    rest: dict[str, dict[str, str]] = {}
    for names in _sensors(recording.name, table).values():
        values = np.column_stack([table.column(name).to_numpy() for name in names])  # (time, channel)
        level = rest_level(values, t_ns, params.rest_s)
        rest |= {name: {"rest": repr(float(value))} for name, value in zip(names, level, strict=True)}
        axes = len({(table.field(name).metadata or {}).get(b"axis") for name in names})
        loads.append(load(values, level, axes))
    if params.begins == "grasped":
        intervals = np.array([[0, len(t_ns)]])
    else:
        intervals = contact_intervals(
            np.max(loads, axis=0), t_ns, params.on_count, params.off_count, params.min_s, params.merge_s, params.pad_s
        )
    lengths = intervals[:, 1] - intervals[:, 0]
    rows = np.concatenate([np.arange(start, stop) for start, stop in intervals] or [np.zeros(0, dtype=np.int64)])
    numbers = np.repeat(np.arange(len(intervals), dtype=np.int32), lengths)
    field = pa.field("contact", pa.int32(), metadata={"unit": "1", "quantity": "label"})
    return with_metadata(table.take(pa.array(rows)).append_column(field, pa.array(numbers)), rest)


def _sensors(name: str, table: pa.Table) -> dict[Any, list[str]]:
    """Return the tactile columns of each stream, taxel by taxel."""
    found: dict[Any, list[str]] = {}
    for field in table.schema:
        metadata = field.metadata or {}
        if metadata.get(b"quantity") == b"tactile":
            found.setdefault(metadata.get(b"stream"), []).append(field.name)
    if not found:
        raise TacpipeError(
            f"Recording {name} has no tactile channel: no column's quantity is tactile. Give a synchronized dataset "
            f"with a tactile stream."
        )
    return found
