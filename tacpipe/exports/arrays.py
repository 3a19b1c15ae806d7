"""Arrange synchronized recordings as arrays (frame, channel), one per stream and quantity, as replay buffers have them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.arrays import AnyArray, ArrayType
from tacpipe.channels.streams import GRID
from tacpipe.exports import contents, frames
from tacpipe.exports.contents import TIME, Loss
from tacpipe.exports.frames import Channel

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Recording
    from tacpipe.io.columns import Columns

ACTIONS = "actions"


@dataclass(frozen=True)
class FrameArray:
    """An array of frames (frame, channel), or (frame,) of a single channel."""

    name: str
    channels: Sequence[Channel]
    actions: bool = False
    later: bool = False  # True where a frame has the values of the next frame, as actions without targets have

    @property
    def columns(self) -> list[str]:
        """The names of the channels."""
        return [channel.name for channel in self.channels]

    @property
    def units(self) -> list[str]:
        """The units of the channels."""
        return [channel.unit for channel in self.channels]

    @property
    def observed(self) -> bool:
        """True for what was measured or is computed of that; no action, clock, mask, label or ground truth."""
        return not self.actions and any(channel.observed for channel in self.channels)

    def type_in(self, columns: Columns) -> ArrayType:
        """Return the type of the values of a recording: float32 for actions, else the widest of the columns."""
        import numpy as np

        return np.dtype(np.float32) if self.actions else frames.common_type(columns, self.channels)

    def shape(self, rows: int) -> tuple[int, ...]:
        """Return the shape of so many frames."""
        return (rows,) if len(self.channels) == 1 else (rows, len(self.channels))

    def blocks(self, columns: Columns, kind: ArrayType) -> Iterator[AnyArray]:
        """Yield the values of a recording as ``kind``, some frames at a time."""
        for values in frames.value_blocks(columns, self.channels, kind, later=self.later):
            yield values.reshape(self.shape(len(values)))


def arrays_of_frames(columns: Columns, actions: str = "") -> list[FrameArray]:
    """Return the arrays of a synchronized recording: the time, one per stream and quantity, one per mask, and the actions.

    Columns of other types than numbers are left out.
    """
    channels = frames.channels(columns)
    groups: dict[str, list[Channel]] = {TIME: [Channel(TIME, "", "time", "ns", "int64")]}
    for channel in channels:
        if channel.number:
            groups.setdefault(_name(channel), []).append(channel)
    arrays = [FrameArray(name, members) for name, members in groups.items()]
    if actions:
        members, later = frames.action_channels(channels, actions)
        arrays.append(FrameArray(ACTIONS, members, actions=True, later=later))
    return arrays


def describe(recording: Recording) -> dict[str, pa.Table]:
    """Return the tables that describe a synchronized recording and what these arrays do not hold of it."""
    columns = frames.synchronized_columns(recording)
    losses = [
        Loss("rates of the streams and what happened between frames: one frame rate for all"),
        Loss("stream events and types of the recorded streams"),
    ]
    unsupported = [channel for channel in frames.channels(columns) if not channel.number]
    losses += [
        Loss(f"arrays hold numbers, not {channel.type}", channel.stream, channel.short) for channel in unsupported
    ]
    if recording.attributes[GRID] != "uniform":
        losses.append(
            Loss(f"one distance between frames: the grid is {recording.attributes[GRID]}; {TIME} has the times")
        )
    carried = [("", column) for array in arrays_of_frames(columns) for column in array.columns]
    return contents.part(recording, losses, [*carried, *(("", channel.name) for channel in unsupported)])


def _name(channel: Channel) -> str:
    """Return the name of the array of a channel: its stream and quantity; masks and labels have arrays of their own."""
    if channel.truth:
        return "truth"
    if not channel.signal:
        return channel.name
    if channel.quantity in ("", channel.stream):
        return channel.stream
    return f"{channel.stream}_{channel.quantity}"
