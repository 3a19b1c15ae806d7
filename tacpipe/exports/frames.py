"""Read synchronized recordings as frames of arrays: group columns, and select state and actions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, ArrayType
from tacpipe.channels.schema import TRUTH, is_truth
from tacpipe.channels.streams import GRID
from tacpipe.datasets.dataset import Dataset, Recording
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.exports import contents
from tacpipe.exports.contents import TIME, Contents, Loss
from tacpipe.io.columns import Columns
from tacpipe.printable import listed, plain

RATE = "grid_rate_hz"  # attribute of a synchronized recording
LEFT_OUT = "not_synchronized"  # attribute with the streams that `synchronize` skipped
SYNCHRONIZE = "synchronize"
ROBOT = ("joint_position", "position", "orientation")  # a stream with one of these quantities belongs to a robot
TARGETS = "target_"  # prefix of the quantities of a robot's commands
CLOCKS = ("time", "sequence", "mask", "label", "status", "text")  # quantities that are not signals
TACTILE, LATENT, IMAGE = "tactile", "latent", "image"
_NO_FRAMES = "it has no value in each frame, as images, text and single rows have none"


@dataclass(frozen=True)
class Channel:
    """A column of a synchronized table and its stream, which is empty for columns that stages added."""

    name: str
    stream: str
    quantity: str
    unit: str
    type: str
    is_target: bool = False  # whether it is ground truth of a simulation, or measured truth

    @property
    def short(self) -> str:
        """Its recorded name, without the stream."""
        return self.name.removeprefix(f"{self.stream}_") if self.stream and not self.truth else self.name

    @property
    def observed(self) -> bool:
        """Whether it is a signal, or computed from signals by a codec, so that a policy may read it."""
        return self.signal or self.quantity == LATENT

    @property
    def number(self) -> bool:
        """Whether arrays support its type."""
        return self.type.startswith(("int", "uint", "float", "double", "half", "bool"))

    @property
    def truth(self) -> bool:
        """Whether it is ground truth of a simulation, which keeps its name."""
        return self.name.startswith(TRUTH)

    @property
    def signal(self) -> bool:
        """Whether it is a number measured by a sensor or a robot, and no ground truth."""
        return (
            bool(self.stream)
            and self.number
            and self.type != "bool"
            and self.quantity not in CLOCKS
            and not self.is_target
        )


def synchronize_stage(rate_hz: float | None, master: str) -> dict[str, dict[str, str | float]]:
    """Return the params of the stage that resamples recordings to one rate, by stage name; empty without a rate."""
    if rate_hz is None:
        return {}
    return {SYNCHRONIZE: {"rate_hz": rate_hz, **({"master": master} if master else {})}}


def synchronized_columns(recording: Recording) -> Columns:
    """Return the columns of a synchronized recording. Raises `UsageError` if it is not synchronized."""
    if set(recording.streams) != {""} or GRID not in recording.attributes:
        raise UsageError(
            f"Recording {recording.name} is not synchronized, and the format has one rate for all streams. Give "
            f"--rate-hz, or the output of `tacpipe {SYNCHRONIZE}`."
        )
    return recording.columns()


def frame_columns(described: Contents, *, common: bool) -> tuple[list[str], Contents]:
    """Return the columns of the frames, and ``described`` with the omitted columns added to its losses.

    If the columns of recordings differ, only those that all recordings have are used if ``common`` is set, otherwise
    `UsageError` is raised.
    """
    (stream,) = described.streams.values()
    if not stream.differing:
        return list(stream.shared), described
    if not common:
        missing = [column.name for column in stream.columns if column.name not in stream.shared]
        difference = f"lacks {listed(missing, 3)}" if missing else "has more columns than"
        raise UsageError(
            f"Recording {stream.differing[0]} {difference}{', unlike' if missing else ''} the first one "
            f"({len(stream.differing)} of {len(stream.recordings)} recordings differ), and the format has the same in all. "
            f"Export recordings of one rig at a time, or give --common to leave out what not all of them have."
        )
    uncommon = [plain(name) for name in stream.all_columns if name not in stream.shared]
    sentence = f"columns that not all recordings have: {', '.join(uncommon)}"
    return list(stream.shared), replace(described, losses={**described.losses, sentence: list(stream.recordings)})


def add_frame_losses(
    described: Contents,
    recordings: Dataset,
    originals: Dataset,
    retained: str = "",
    videos: Sequence[str] = (),
) -> Contents:
    """Return ``described`` with the streams and columns that the frames lack added to its losses.

    ``originals`` are the recordings before this export synchronized them; ``retained`` ends each sentence. Streams of
    ``videos`` are not in the frames, but in the export.
    """
    losses = []
    for recording in recordings:
        original = originals[recording.name]
        if set(original.streams) == {""}:  # the user synchronized this recording before the export
            names = str(recording.attributes.get(LEFT_OUT) or "").split(", ")
            names += [channel.stream for channel in channels(recording.columns()) if channel.quantity == IMAGE]
            losses += [(recording.name, Loss(_NO_FRAMES, stream)) for stream in names if stream]
            continue
        streams = [stream for stream in original.streams if stream not in videos]
        columns = [(stream, name) for stream in streams for name in original.columns(stream).schema.names]
        carried = [(channel.stream, channel.short) for channel in channels(recording.columns())]
        carried += [(stream, TIME) for stream in original.streams]
        losses += [
            (recording.name, loss) for loss in contents.unwritten_losses(columns, carried, reason=_NO_FRAMES + retained)
        ]
    return replace(described, losses={**described.losses, **contents.loss_sentences(losses)})


def channels(table: pa.Table | Columns) -> list[Channel]:
    """Return all columns except the time."""
    result = []
    for field in table.schema:
        if field.name != TIME:
            metadata = contents.field_metadata(field)
            described = (metadata.get("stream", ""), metadata.get("quantity", ""), metadata.get("unit", ""))
            result.append(Channel(field.name, *described, str(field.type), is_truth(field)))
    return result


def state_channels(all_channels: Sequence[Channel], streams: Sequence[str]) -> list[Channel]:
    """Return the channels of the robot's state: those of ``streams``, or of all streams with joints or a pose.

    Raises `UsageError` if a stream does not exist.
    """
    streams_present = list(dict.fromkeys(channel.stream for channel in all_channels if channel.stream))
    for name in streams:
        if name not in streams_present:
            raise UsageError(f"There is no stream {plain(name)} in these frames; there are {listed(streams_present)}.")
    with_robot_columns = {channel.stream for channel in all_channels if channel.quantity in ROBOT}
    robots = streams or [stream for stream in streams_present if stream in with_robot_columns]
    return [
        channel
        for channel in all_channels
        if channel.stream in robots and channel.signal and not channel.quantity.startswith(TARGETS)
    ]


def action_channels(all_channels: Sequence[Channel], stream: str) -> tuple[list[Channel], bool]:
    """Return the channels of the actions, and whether an action is their value one frame later.

    These are the recorded targets of ``stream`` at the same frame, or without targets its measured state one frame
    later; the last frame then repeats its own. Raises `UsageError` if the stream does not exist.
    """
    targets = [channel for channel in all_channels if channel.stream == stream and channel.quantity.startswith(TARGETS)]
    return targets or state_channels(all_channels, [stream]), not targets


def common_type(columns: Columns, chosen: Sequence[Channel]) -> ArrayType:
    """Return the smallest type for all values of some channels; a missing integer is NaN, so it requires float64."""
    return np.result_type(*(_channel_type(columns, channel) for channel in chosen))


def _channel_type(columns: Columns, channel: Channel) -> ArrayType:
    kind = np.dtype(columns.schema.field(channel.name).type.to_pandas_dtype())
    missing = kind.kind in "iub" and columns.column(channel.name).null_count
    return np.dtype(np.float64) if missing else kind


def value_blocks(
    columns: Columns, chosen: Sequence[Channel], kind: ArrayType, *, later: bool = False
) -> Iterator[AnyArray]:
    """Yield the values of channels (time, channel) as ``kind`` in blocks of rows.

    With ``later``, each row has the values of the next one, and the last row its own.
    """
    previous_block: AnyArray | None = None
    for table in columns.batches([channel.name for channel in chosen]):
        with np.errstate(over="ignore"):
            values = np.column_stack([table.column(channel.name).to_numpy() for channel in chosen]).astype(kind)
        if not later:
            yield values
            continue
        if previous_block is not None:
            yield np.concatenate([previous_block[1:], values[:1]])
        previous_block = values
    if previous_block is not None:
        yield np.concatenate([previous_block[1:], previous_block[-1:]])


def rounded_channels(columns: Columns, chosen: Sequence[Channel]) -> list[Channel]:
    """Return the channels that float32 cannot represent exactly."""
    rounded = []
    for channel in chosen:
        values = columns.column(channel.name).to_numpy()
        with np.errstate(over="ignore"):
            restored = values.astype(np.float32).astype(values.dtype)
        if not np.array_equal(values, restored, equal_nan=values.dtype.kind == "f"):
            rounded.append(channel)
    return rounded


def common_rate_hz(recordings: Sequence[Recording]) -> float:
    """Return the common rate of all recordings. Raises `UsageError` if rates differ."""
    rates = sorted({_rate(recording) for recording in recordings})
    if len(rates) > 1:
        raise UsageError(
            f"The recordings have rates of {listed([f'{rate:g}' for rate in rates], 4)} Hz, and the format has one. Give "
            f"recordings as they were recorded with --rate-hz, or synchronize them alike."
        )
    return rates[0]


def _rate(recording: Recording) -> float:
    rate = recording.attributes.get(RATE)
    if not isinstance(rate, int | float) or rate <= 0:
        raise TacpipeError(f"Recording {recording.name} does not state its rate ({RATE}). Synchronize it again.")
    return float(rate)


ACTIONS = "actions"


@dataclass(frozen=True)
class FrameArray:
    """An array of frames (frame, channel), or (frame,) for a single channel."""

    name: str
    channels: Sequence[Channel]
    actions: bool = False
    later: bool = False  # whether a frame has the values of the next frame, as for actions without targets

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
        """Whether it was measured or computed from measurements; not an action, clock, mask, label or ground truth."""
        return not self.actions and any(channel.observed for channel in self.channels)

    def type_in(self, columns: Columns) -> ArrayType:
        """Return the type of a recording's values: float32 for actions, otherwise the widest type of the columns."""
        return np.dtype(np.float32) if self.actions else common_type(columns, self.channels)

    def shape(self, rows: int) -> tuple[int, ...]:
        """Return the shape for this number of frames."""
        return (rows,) if len(self.channels) == 1 else (rows, len(self.channels))

    def blocks(self, columns: Columns, kind: ArrayType) -> Iterator[AnyArray]:
        """Yield the values of a recording as ``kind`` in blocks of frames."""
        for values in value_blocks(columns, self.channels, kind, later=self.later):
            yield values.reshape(self.shape(len(values)))


def arrays_of_frames(columns: Columns, actions: str = "") -> list[FrameArray]:
    """Return the arrays of a synchronized recording: the time, one per stream and quantity, and last the actions, if any.

    Masks and labels have an array each. Columns that are not numbers are omitted.
    """
    signals = channels(columns)
    groups: dict[str, list[Channel]] = {TIME: [Channel(TIME, "", "time", "ns", "int64")]}
    for channel in signals:
        if channel.number:
            groups.setdefault(_name(channel), []).append(channel)
    arrays = [FrameArray(name, members) for name, members in groups.items()]
    if actions:
        members, is_next_frame = action_channels(signals, actions)
        arrays.append(FrameArray(ACTIONS, members, actions=True, later=is_next_frame))
    return arrays


def describe(recording: Recording) -> dict[str, pa.Table]:
    """Return the tables that describe a synchronized recording and the losses of these arrays."""
    columns = synchronized_columns(recording)
    losses = [
        Loss("rates of the streams and what happened between frames: one frame rate for all"),
        Loss("stream events and types of the recorded streams"),
    ]
    unsupported = [channel for channel in channels(columns) if not channel.number]
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
    """Return the array name of a channel: its stream and quantity; each mask and label has its own array."""
    if channel.truth:
        return "truth"
    if not channel.signal:
        return channel.name
    if channel.quantity in ("", channel.stream):
        return channel.stream
    return f"{channel.stream}_{channel.quantity}"
