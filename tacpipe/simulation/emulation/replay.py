"""Replay recordings: encode the samples of their streams, and give each frame the time at which it is due.

Recordings follow one another and start again after the last one. Counters and clocks of devices continue across them.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Int64s
from tacpipe.channels.schema import is_truth
from tacpipe.channels.streams import EVENTS
from tacpipe.errors import UsageError
from tacpipe.links.link import Address
from tacpipe.plugins import params
from tacpipe.recording.rig import Rig, RigStream, build_sensor, to_toml
from tacpipe.sensors.encoding import split_frames, value_blocks
from tacpipe.sensors.sensor import Samples, Sensor, numbered_names
from tacpipe.video.stream import read_format

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Recording
    from tacpipe.io.columns import Columns

BLOCK_ROWS = 64  # samples that are encoded at once
PAUSE_NS = 10_000_000  # time between the last sample of a recording and the first of the next one
LINKS = ("serial", "udp", "tcp", "ws", "mjpeg", "v4l2")  # links on which a sensor's own frames are sent
TYPES = {"float": "f32", "double": "f64"} | {
    f"{kind}int{bits}": f"{kind or 'i'}{bits}" for kind in ("", "u") for bits in (8, 16, 32, 64)
}  # types of numbers of the sensor generic, by type of a column
REFUSED = {  # sensors that cannot be replayed, and the reason
    "clouds": "a recorded cloud has one row per point; copy the files of the clouds to the folder instead",
    "plan": "plans are for times that are over; remove the stream",
}
_ELEMENT = re.compile(r"(.*?)(\d+)?(?:_([a-z]))?")  # stem, number and axis of an array's column
STAMPS = {"seq": "u32", "t_device_ns": "i64"}  # recorded counter and clock, and their types in frames of generic
ARRIVAL, DEVICE_COUNTER = "t_ns", "device_seq"
SUM = "sum_of_frame"  # number of the checksum in frames of generic


class DueFrame(NamedTuple):
    """A frame, and the time at which it is sent, in ns since the start of the rig."""

    due_ns: int
    data: bytes


@dataclass(frozen=True)
class ReplayOptions:
    """The keys of ``emulate`` of a stream in a rig file."""

    stream: str = ""  # name of the stream in the recordings; empty: the name in the rig file


@dataclass(frozen=True)
class Part:
    """A recording that is replayed: the time of its first sample, and the time until the next recording begins."""

    recording: Recording
    begin_ns: int
    span_ns: int


class Replay:
    """Recordings whose streams a rig sends: ``rig`` has the streams as they are sent."""

    def __init__(self, rig: Rig, recordings: Iterable[Recording], lead_s: float = 0.0) -> None:
        """Prepare the replay of the recordings that have all streams of a rig.

        For ``lead_s`` before, each device repeats its first sample. Raises `UsageError` if no recording has all
        streams, or if a stream cannot be replayed.
        """
        self.lead_ns = round(lead_s * 1e9)
        self._names = {name: _recorded_name(stream) for name, stream in rig.streams.items()}
        names, existing, self.parts = set(self._names.values()), set[str](), list[Part]()
        for recording in recordings:
            existing |= set(recording.streams)
            if names <= set(recording.streams):
                self.parts.append(_part(recording, names))
        if not self.parts:
            raise UsageError(
                f"No recording has all streams of the rig file, {', '.join(sorted(names))}; the recordings have "
                f"{', '.join(sorted(existing)) or 'none'}. Give each stream the name of a recorded one, or add "
                'emulate = { stream = "NAME" } to it.'
            )
        streams = {name: _sendable(stream, self._columns(self.parts[0], name)) for name, stream in rig.streams.items()}
        self.rig = replace(rig, streams=streams)

    def _columns(self, part: Part, name: str) -> Columns:
        return part.recording.columns(self._names[name])

    def frames(self, name: str) -> Iterator[DueFrame]:
        """Yield the frames of a stream in order, without end."""
        sensor = self.rig.streams[name].sensor
        stamps = DeviceStamps(sensor)
        for is_first, due_ns, table in self._blocks(name):
            if is_first:
                stamps.start_recording()
            columns = [_cast(table, field).to_numpy() for field in sensor.fields()]
            samples = stamps.stamp(value_blocks(sensor, columns), table, due_ns)
            frames = split_frames(sensor, sensor.encode(samples))
            yield from map(DueFrame, due_ns.tolist(), frames)

    def table(self, stream: str, columns: Sequence[str]) -> pa.Table:
        """Return columns of a recorded stream in the first round of the recordings; ``t_ns`` counts from the rig's start."""
        tables, start_ns = [], self.lead_ns
        for part in self.parts:
            table = part.recording.table(stream, [ARRIVAL, *columns])
            since_ns = pa.array(table.column(ARRIVAL).to_numpy() - part.begin_ns + start_ns)
            tables.append(table.select(list(columns)).append_column(ARRIVAL, since_ns))
            start_ns += part.span_ns
        return pa.concat_tables(tables)

    def _blocks(self, name: str) -> Iterator[tuple[bool, Int64s, pa.Table]]:
        """Yield the samples of a stream in blocks: whether a recording starts, their due times (sample,), and the rows."""
        first = next(self._columns(self.parts[0], name).batches(rows=1))
        unstamped = first.drop_columns([column for column in (*STAMPS, DEVICE_COUNTER) if column in first.column_names])
        lead = np.arange(0, self.lead_ns, period_ns(self._columns(self.parts[0], name)) if self.lead_ns else 1)
        for start in range(0, len(lead), BLOCK_ROWS):
            due_ns = lead[start : start + BLOCK_ROWS]
            yield not start, due_ns, unstamped.take(np.zeros(len(due_ns), np.int64))
        start_ns = self.lead_ns
        for part in itertools.cycle(self.parts):
            for number, table in enumerate(self._columns(part, name).batches(rows=BLOCK_ROWS)):
                yield not number, start_ns + table.column(ARRIVAL).to_numpy() - part.begin_ns, table
            start_ns += part.span_ns


class DeviceStamps:
    """Counters and clock of a device, as recorded, which continue from one recording to the next.

    Samples without recorded ones are counted, and their due time is the device's time.
    """

    def __init__(self, sensor: Sensor) -> None:
        """Start the counters and the clock of a sensor."""
        wraps = {"seq": sensor.counter, "t_device_ns": sensor.device_wrap_ns, DEVICE_COUNTER: sensor.device_counter}
        self._wraps, self._step = wraps, sensor.step
        self._offsets: dict[str, int] = {}  # difference from the recorded value, in the current recording
        self._last = dict.fromkeys(wraps, 0)  # last value, before the counter wraps
        self._last_due_ns = -1

    def start_recording(self) -> None:
        """Continue with another recording."""
        self._offsets = {}

    def stamp(self, values: tuple[Any, ...], table: pa.Table, due_ns: Int64s) -> Samples:
        """Return the samples of ``values`` with stamps."""
        stamps = {}
        for name, wrap in self._wraps.items():
            is_clock = name == "t_device_ns"
            if name in table.column_names:
                recorded = table.column(name).to_numpy()
            else:
                recorded = due_ns if is_clock else self._step * np.arange(len(due_ns))
            advance = int(due_ns[0]) - self._last_due_ns if is_clock else self._step
            if name not in self._offsets or name not in table.column_names:
                self._offsets[name] = self._last[name] + advance - int(recorded[0])
            stamps[name] = recorded + self._offsets[name]
            self._last[name] = int(stamps[name][-1])
            stamps[name] = stamps[name] % wrap if wrap else stamps[name]
        self._last_due_ns = int(due_ns[-1])
        return Samples(values, stamps["seq"], stamps["t_device_ns"], stamps[DEVICE_COUNTER])


def waits_for_requests(sensor: Sensor) -> bool:
    """Return whether a device is polled, or must reply before it sends. A replay answers nothing."""
    for ask in sensor.opening({"host": "127.0.0.1", "port": 1}):
        if ask.until is not None:
            return True
    return bool(sensor.request())


def period_ns(columns: Columns) -> int:
    """Return the mean time between two samples of a recorded stream."""
    times = columns.column(ARRIVAL).to_numpy()
    return max(1, int((times[-1] - times[0]) / max(1, len(times) - 1)))


def _recorded_name(stream: RigStream) -> str:
    """Return the name of a rig's stream in the recordings. Raises `UsageError` for an unknown key of ``emulate``."""
    options: ReplayOptions = params.build_dataclass(
        ReplayOptions, stream.emulate, f"stream {stream.name}, emulate", "key"
    )
    return options.stream or stream.name


def _part(recording: Recording, names: Iterable[str]) -> Part:
    """Return a recording with its times. Raises `UsageError` if a stream is empty."""
    times = {name: recording.columns(name).column(ARRIVAL) for name in names}
    empty = [name for name, column in times.items() if not len(column)]
    if empty:
        raise UsageError(f"The stream {empty[0]} of recording {recording.name} is empty; select other recordings.")
    begin_ns = min(column[0].as_py() for column in times.values())
    end_ns = max(column[-1].as_py() for column in times.values())
    return Part(recording, begin_ns, end_ns - begin_ns + PAUSE_NS)


def _cast(table: pa.Table, field: pa.Field) -> pa.ChunkedArray:
    """Return the column of a field in its type. Raises `UsageError` if values do not fit."""
    try:
        return table.column(field.name).cast(field.type)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise UsageError(f"The recorded column {field.name} cannot be sent as {field.type}: {error}.") from error


def _sendable(stream: RigStream, recorded: Columns) -> RigStream:
    """Return a stream as it is sent: with the frames of its sensor, or as the sensor ``generic`` over TCP.

    The latter replaces devices that wait for requests, and links that are not emulated. Raises `UsageError` if the
    recorded stream cannot be sent.
    """
    if stream.kind in REFUSED:
        raise UsageError(f"{stream.name}: {stream.kind} cannot be replayed, because {REFUSED[stream.kind]}.")
    if stream.address.scheme not in LINKS or waits_for_requests(stream.sensor):
        if texts := _not_numbers(recorded):
            raise UsageError(
                f"{stream.name}: {stream.kind} cannot be emulated on {stream.address.scheme}, and its column {texts[0]} is "
                "not a number that generic could send instead; remove the stream."
            )
        return _as_generic(stream.name, recorded, stream.sensor.rate_hz, stream.sensor.step)
    missing = [field.name for field in stream.sensor.fields() if field.name not in recorded.column_names]
    if missing:
        raise UsageError(
            f"{stream.name}: the recorded stream has no column {missing[0]}, which {stream.kind} sends; correct the "
            "options of the stream, or select other recordings."
        )
    video_format = read_format(recorded.schema)
    if video_format is not None and video_format.codec != "mjpeg":
        raise UsageError(
            f"{stream.name}: the recorded video is {video_format.codec}; cameras are emulated with JPEG images."
        )
    return stream


def rig_of(recording: Recording) -> Rig:
    """Return a rig that sends the streams of a recording: JPEG images as a camera, and numbers as ``generic`` over TCP.

    Streams of text, of other videos, of plans, of ground truth and of a single row are left out. The master is that of
    the recording, or the first with tactile channels. Raises `UsageError` if none is left.
    """
    streams, tactile = {}, []
    for name in recording.streams:
        columns = recording.columns(name)
        video_format = read_format(columns)
        quantities = {(field.metadata or {}).get(b"quantity", b"").decode() for field in columns.schema}
        is_signal = name != EVENTS and "plan" not in quantities and not any(map(is_truth, columns.schema))
        if not is_signal or columns.num_rows < 2:
            continue
        tactile += [name] if "tactile" in quantities else []
        if video_format is not None and video_format.codec == "mjpeg":
            size = {"width_px": video_format.width_px, "height_px": video_format.height_px}
            options = {**size, "rate_hz": round(1e9 / period_ns(columns), 3)}
            camera = build_sensor("camera", options, f"stream {name}")
            streams[name] = RigStream(name, "camera", camera, Address("v4l2", "/dev/video0"), options)
        elif not _not_numbers(columns):
            streams[name] = _as_generic(name, columns)
    if not streams:
        raise UsageError(f"Recording {recording.name} has no stream that can be replayed.")
    master = str(recording.attributes.get("master", ""))
    rig = Rig(streams, master if master in streams else [*tactile, *streams][0])
    return replace(rig, text=to_toml(rig))


def _not_numbers(recorded: Columns) -> list[str]:
    return [field.name for field in _values(recorded) if str(field.type) not in TYPES]


def _values(recorded: Columns) -> list[pa.Field]:
    return [field for field in recorded.schema if field.name not in (ARRIVAL, *STAMPS, DEVICE_COUNTER)]


def _numbers(fields: Sequence[pa.Field]) -> Iterator[dict[str, Any]]:
    """Yield the numbers of ``generic`` for columns. Tactile columns of one array are one number, so their places stay."""
    start, stems = 0, set[str]()
    while start < len(fields):
        shared = _shared(fields[start])
        alike = [
            field.name
            for field in itertools.takewhile(lambda field: _shared(field) == shared, fields[start:])  # noqa: B023
        ]
        parts = [_ELEMENT.fullmatch(name) for name in alike]
        stem = parts[0][1] if parts[0] else ""
        axes = list(dict.fromkeys(part[3] for part in parts if part and part[3]))
        count = len(alike) // max(1, len(axes))
        names = [
            f"{name}_{axis}" if axis else name for name in numbered_names(stem, max(1, count)) for axis in axes or [""]
        ]
        if shared["quantity"] == "tactile" and count > 1 and names == alike and stem not in stems:
            yield {"name": stem, "count": count, "axes": "".join(axes), **shared}
            stems.add(stem)
            start += len(names)
        else:
            yield {"name": fields[start].name, **shared}
            start += 1


def _shared(field: pa.Field) -> dict[str, str]:
    """Return what the columns of an array have in common."""
    metadata = field.metadata or {}
    about = {key: metadata.get(key.encode(), b"1").decode() for key in ("unit", "quantity")}
    return {"type": TYPES[str(field.type)], **about}


def _as_generic(name: str, recorded: Columns, rate_hz: float = 0.0, step: int = 1) -> RigStream:
    """Return a stream that sends the recorded columns, all of them numbers, as frames of the sensor ``generic``.

    ``rate_hz`` is the mean rate of the recording if it is 0, and ``step`` the increment of the counter per sample.
    """
    stamps = [{"name": name, "type": kind} for name, kind in STAMPS.items() if name in recorded.column_names]
    options: dict[str, Any] = {
        "rate_hz": rate_hz or round(1e9 / period_ns(recorded), 3),
        "marker": "A5 5A 96 69",
        "numbers": [*stamps, *_numbers(_values(recorded)), {"name": SUM, "type": "u32"}],
        "sum": {"kind": "crc32", "number": SUM},
    }
    roles = {"seq": {"sequence": {"number": "seq", "step": step}}}
    roles["t_device_ns"] = {"clock": {"number": "t_device_ns", "unit": "ns"}}
    for number in stamps:
        options |= roles[number["name"]]
    return RigStream(name, "generic", build_sensor("generic", options, name), Address("tcp", ""), options)
