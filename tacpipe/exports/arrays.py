"""Arrange synchronized recordings as arrays (frame, channel), one per stream and quantity, as replay buffers have them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.arrays import AnyArray
from tacpipe.channels.streams import GRID
from tacpipe.exports import contents, frames
from tacpipe.exports.contents import TIME, Loss

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
    actions: bool = False
    observed: bool = (
        False  # measured by a sensor or a robot, or computed of such; no clock, mask, label or ground truth
    )


def from_table(table: pa.Table, actions: str = "") -> list[Array]:
    """Return the arrays of a synchronized table: the time, one per stream and quantity, one per mask, and the actions.

    Each has the type of its columns, the widest where they differ. Columns of other types than numbers are left out.
    """
    channels = frames.channels(table)
    groups: dict[str, list[frames.Channel]] = {}
    for channel in channels:
        if channel.number:
            groups.setdefault(_name(channel), []).append(channel)
    arrays = [Array(TIME, table.column(TIME).to_numpy(), [TIME], ["ns"])]
    for name, members in groups.items():
        values = frames.matrix(table, members)
        flat = values[:, 0] if values.shape[1] == 1 else values
        names, units = [channel.name for channel in members], [channel.unit for channel in members]
        arrays.append(Array(name, flat, names, units, observed=any(channel.observed for channel in members)))
    if actions:
        members, values = frames.actions(table, channels, actions)
        names, units = [channel.name for channel in members], [channel.unit for channel in members]
        arrays.append(Array(ACTIONS, values, names, units, actions=True))
    return arrays


def describe(recording: Recording) -> dict[str, pa.Table]:
    """Return the tables that describe a synchronized recording and what these arrays do not hold of it."""
    table = frames.synchronized_table(recording)
    losses = [
        Loss("rates of the streams and what happened between frames: one frame rate for all"),
        Loss("stream events and types of the recorded streams"),
    ]
    unsupported = [channel for channel in frames.channels(table) if not channel.number]
    losses += [
        Loss(f"arrays hold numbers, not {channel.type}", channel.stream, channel.short) for channel in unsupported
    ]
    if recording.attributes[GRID] != "uniform":
        losses.append(
            Loss(f"one distance between frames: the grid is {recording.attributes[GRID]}; {TIME} has the times")
        )
    carried = [("", column) for array in from_table(table) for column in array.columns]
    return contents.part(recording, losses, [*carried, *(("", channel.name) for channel in unsupported)])


def _name(channel: frames.Channel) -> str:
    """Return the name of the array of a channel: its stream and quantity; masks and labels have arrays of their own."""
    if channel.truth:
        return "truth"
    if not channel.signal:
        return channel.name
    if channel.quantity in ("", channel.stream):
        return channel.stream
    return f"{channel.stream}_{channel.quantity}"
