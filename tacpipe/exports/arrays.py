"""Synchronized recordings as arrays (frame, channel), one a stream and quantity, as replay buffers have them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.arrays import AnyArray
from tacpipe.channels.masks import GRID
from tacpipe.channels.streams import TRUTH
from tacpipe.exports import frames
from tacpipe.exports.contents import TIME

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Recording

ACTIONS = "actions"


@dataclass(frozen=True)
class Array:
    """An array of frames (frame, channel) or (frame,), with the names and units of its channels."""

    name: str
    values: AnyArray
    columns: Sequence[str]
    units: Sequence[str]


def of(table: pa.Table, actions: str = "") -> list[Array]:
    """Return the arrays of a synchronized table: the time, one a stream and quantity, one a mask, and the actions.

    Each has the type of its columns, the widest where they differ. Text is left out (see `losses`).
    """
    every = frames.channels(table)
    groups: dict[str, list[frames.Channel]] = {}
    for one in every:
        if one.type != "string":
            groups.setdefault(_name(one), []).append(one)
    made = [Array(TIME, table.column(TIME).to_numpy(), [TIME], ["ns"])]
    for name, chosen in groups.items():
        values = frames.matrix(table, chosen)
        flat = values[:, 0] if values.shape[1] == 1 else values
        made.append(Array(name, flat, [one.name for one in chosen], [one.unit for one in chosen]))
    if actions:
        chosen, values = frames.action_of(table, every, actions)
        made.append(Array(ACTIONS, values, [one.name for one in chosen], [one.unit for one in chosen]))
    return made


def losses(recording: Recording) -> Iterator[str]:
    """Yield what of a synchronized recording these arrays do not hold."""
    table = frames.table(recording)
    yield "rates of the streams and what happened between frames: one frame rate for all"
    yield "stream events and types of the recorded streams"
    for one in frames.channels(table):
        if one.type == "string":
            yield f"column {one.name}: arrays hold numbers"
    if recording.attributes[GRID] != "uniform":
        yield f"one distance between frames: the grid is {recording.attributes[GRID]}; {TIME} has the times"


def _name(one: frames.Channel) -> str:
    """Return the name of the array that a channel belongs to: stream and quantity; a mask or a label is one of its own."""
    if one.name.startswith(TRUTH):
        return "truth"
    if not one.signal:
        return one.name
    return one.stream if one.quantity in ("", one.stream) else f"{one.stream}_{one.quantity}"
