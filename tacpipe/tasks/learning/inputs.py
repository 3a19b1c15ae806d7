"""Read recordings as windows: for each row of the first stream, the last rows of every stream that a model reads."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NotRequired, TypedDict

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Floats, Indices, Times
from tacpipe.channels.schema import field_metadata
from tacpipe.codecs import tactile
from tacpipe.errors import TacpipeError
from tacpipe.plugins.rows import NO_WINDOW, RowCounts, count_rows
from tacpipe.signals.runs import rows_in_windows
from tacpipe.tasks.learning.features import FeatureKind, Layout, window_features

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording

MAX_ROWS = 100_000  # maximum number of rows of a window


class StreamConfig(TypedDict):
    """A stream that a model reads, as ``config.json`` has it."""

    stream: str
    channels: list[str]
    layout: list[dict[str, str]]  # taxel and axis of each channel, if its metadata contains them
    rows: int  # number of rows of a window
    rate_hz: float
    scale: list[float]  # (channel,), the divisor of values above rest
    level: NotRequired[list[float]]  # (channel,), the scaled level of a session, which is subtracted


@dataclass(frozen=True)
class InputStream:
    """A stream as a model reads it."""

    stream: str
    channels: tuple[str, ...]
    layout: tuple[Mapping[str, str], ...]
    rows: int  # number of rows of a window
    rate_hz: float
    scale: Floats  # (channel,)
    level: Floats | None = None  # (channel,), the scaled level of a session, which is subtracted

    @classmethod
    def from_config(cls, config: StreamConfig) -> InputStream:
        """Return a stream as `to_config` wrote it. Raises `ValueError` if its parts do not fit one another."""
        channels, scale = tuple(config["channels"]), np.array(config["scale"], np.float64)
        if not (0 < config["rows"] <= MAX_ROWS and len(config["layout"]) == len(channels) == len(scale) > 0):
            raise ValueError(f"the stream {config['stream']} has {config['rows']} rows and {len(scale)} scales")
        level = np.array(config["level"], np.float64) if "level" in config else None
        if level is not None and len(level) != len(channels):
            raise ValueError(f"the stream {config['stream']} has {len(channels)} channels and {len(level)} levels")
        return cls(config["stream"], channels, tuple(config["layout"]), config["rows"], config["rate_hz"], scale, level)

    def to_config(self) -> StreamConfig:
        """Return the stream as ``config.json`` has it."""
        layout = [dict(place) for place in self.layout]
        config: StreamConfig = {
            "stream": self.stream,
            "channels": list(self.channels),
            "layout": layout,
            "rows": self.rows,
            "rate_hz": self.rate_hz,
            "scale": self.scale.tolist(),
        }
        return config if self.level is None else {**config, "level": self.level.tolist()}

    def centred(self, values: AnyFloats) -> AnyFloats:
        """Return scaled values (row, channel) without the level of the session, if the model has one."""
        return values if self.level is None else values - self.level


@dataclass(frozen=True)
class StreamRows:
    """The rows of a stream in one recording."""

    t_ns: Times  # (row,)
    values: AnyFloats  # (row, channel), above rest and scaled; NaN is replaced by the previous value
    begin: int  # first row after the rest level is measured


def measure_rest(t_ns: Times, values: AnyFloats, rest_ns: int) -> tuple[Floats, int] | None:
    """Return the level at rest (channel,) and the number of its rows, or None until ``rest_ns`` have passed."""
    if not rest_ns:
        return np.zeros(values.shape[1]), 0
    count = int(np.searchsorted(t_ns, t_ns[0] + rest_ns)) if len(t_ns) else 0
    if not count or count == len(t_ns):
        return None
    first = values[:count]
    if np.isnan(first).any():
        present = ~np.isnan(first)
        return np.where(present, first, 0.0).sum(axis=0) / np.maximum(present.sum(axis=0), 1), count
    return np.asarray(first.mean(axis=0)), count


def fill_missing(values: AnyFloats, before: Floats) -> Floats:
    """Return values (row, channel) with NaN replaced by the value before; ``before`` (channel,) precedes the first row.

    >>> fill_missing(np.array([[np.nan], [2.0], [np.nan]]), np.array([1.0])).ravel().tolist()
    [1.0, 2.0, 2.0]
    """
    stacked = np.concatenate([before[None], values])
    places = np.where(np.isnan(stacked), 0, np.arange(len(stacked))[:, None])
    return np.take_along_axis(stacked, np.maximum.accumulate(places, axis=0), axis=0)[1:]


@dataclass(frozen=True)
class RawStream:
    """The recorded values of a stream."""

    t_ns: Times  # (row,)
    values: AnyFloats  # (row, channel)

    @classmethod
    def from_table(cls, table: pa.Table, channels: Sequence[str]) -> RawStream:
        """Return the channels of a table."""
        return cls(table.column("t_ns").to_numpy(), tactile.matrix(table, channels))

    def above_rest(self, stream: InputStream, rest_ns: int) -> StreamRows:
        """Return the values above rest and scaled; no row begins if the recording is too short to measure the rest."""
        measured = measure_rest(self.t_ns, self.values, rest_ns)
        if measured is None:
            return StreamRows(self.t_ns, np.zeros_like(self.values), len(self.t_ns))
        rest, count = measured
        scaled = (self.values - rest) / stream.scale
        return StreamRows(self.t_ns, stream.centred(fill_missing(scaled, np.zeros(len(stream.scale)))), count)


@dataclass(frozen=True)
class InputRows:
    """The rows of all input streams of a recording, of which those of the first stream can be answered."""

    name: str
    digest: str
    t_ns: Times  # (time,)
    start_ns: int  # time of the first sample of any stream
    streams: tuple[StreamRows, ...]
    newest: Indices  # (time, stream), the newest row of each stream
    ready: Bools  # (time,), whether all windows are full
    recording: Recording | None  # the recording that was read; None for rows of another source

    @property
    def since_s(self) -> Floats:
        """Seconds since the first sample (time,)."""
        return np.asarray((self.t_ns - self.start_ns) / 1e9)

    def stored_stream(self, stream: str) -> str:
        """Return the name under which a stream is stored: "" for a stream in a table of all streams."""
        return stream if self.recording is None or stream in self.recording.streams else ""

    def windows(self, rows: Indices, stream: int, length: int) -> AnyFloats:
        """Return the windows (window, time, channel) of a stream that end in these rows."""
        ends = self.newest[rows, stream]
        return np.asarray(self.streams[stream].values[ends[:, None] + np.arange(1 - length, 1)])


@dataclass(frozen=True)
class Inputs:
    """Reads recordings for a model that reads some streams."""

    streams: tuple[InputStream, ...]
    rest_ns: int

    def read(self, recording: Recording) -> InputRows:
        """Return the rows of a recording. Raises `TacpipeError` if it lacks a stream or a channel."""
        raw = {
            stream.stream: RawStream.from_table(self.table(recording, stream), stream.channels)
            for stream in self.streams
        }
        return self.place(recording, raw)

    def place(self, recording: Recording, raw: Mapping[str, RawStream]) -> InputRows:
        """Return the rows of a recording; ``raw`` contains the values of its streams by name."""
        streams = tuple(raw[stream.stream].above_rest(stream, self.rest_ns) for stream in self.streams)
        t_ns = streams[0].t_ns
        newest = np.stack([np.searchsorted(rows.t_ns, t_ns, side="right") - 1 for rows in streams], axis=1)
        first = [rows.begin + stream.rows - 1 for rows, stream in zip(streams, self.streams, strict=True)]
        ready = np.asarray((newest >= np.array(first)).all(axis=1))
        start_ns = min((int(rows.t_ns[0]) for rows in streams if len(rows.t_ns)), default=0)
        return InputRows(recording.name, recording.digest, t_ns, start_ns, streams, newest, ready, recording)

    def count_rows(self, rows: InputRows, used_rows: Indices, otherwise: str = NO_WINDOW) -> None:
        """Count the samples in the windows that end in ``used_rows`` as used, with those that measure the rest level."""
        for index, (stream, samples) in enumerate(zip(self.streams, rows.streams, strict=True)):
            starts = rows.newest[used_rows, index] + 1 - stream.rows
            used = rows_in_windows(starts, stream.rows, len(samples.t_ns))
            used[: samples.begin if len(used_rows) else 0] = True
            count_rows(rows.name, rows.stored_stream(stream.stream), RowCounts.from_masks(used, [], otherwise))

    def table(self, recording: Recording, stream: InputStream) -> pa.Table:
        """Return the columns of a stream in a recording. Raises `TacpipeError` if a stream or column is missing."""
        names = ["t_ns", *stream.channels]
        stored = "" if set(recording.streams) == {""} else stream.stream
        if stored not in recording.streams:
            raise TacpipeError(
                f"{recording.name} has the streams {', '.join(recording.streams)}, and the model reads {stream.stream}. "
                f"Give recordings of the sensors that it was trained on."
            )
        missing = sorted(set(names) - set(recording.columns(stored).column_names))
        if missing:
            raise TacpipeError(
                f"{recording.name} has no column {missing[0]}, which the model reads. Give recordings that went "
                f"through the same stages as the training recordings."
            )
        return recording.table(stored, names)

    @property
    def window_shapes(self) -> list[tuple[int, int]]:
        """Rows and channels of each of `windows`."""
        return [(stream.rows, len(stream.channels)) for stream in self.streams]

    def windows(self, rows: InputRows, ends: Indices) -> list[AnyFloats]:
        """Return the windows of each stream that end in rows (window, time, channel)."""
        return [rows.windows(ends, index, stream.rows) for index, stream in enumerate(self.streams)]

    def features(self, kind: FeatureKind, windows: Sequence[AnyFloats]) -> Floats:
        """Return the features (window, feature) of `windows`, as `window_features`."""
        return window_features(kind, windows, [stream.layout for stream in self.streams])


Chooser = Callable[[str, "pa.Schema"], Sequence[str]]  # name of a stored stream and its schema -> columns to read


def find_inputs(
    recordings: Dataset, choose: Chooser, rest_s: float, window_rows: Callable[[float, Sequence[RawStream]], int]
) -> tuple[Inputs, dict[str, dict[str, RawStream]]]:
    """Return the inputs of the training recordings, and the values of each recording by stream.

    ``choose`` selects the columns; columns of a synchronized recording belong to the stream in their metadata.
    ``window_rows`` returns the rows of a window for a stream's rate in Hz and its values in all recordings. Scales are
    the root mean square of each axis over all training recordings. Raises `TacpipeError` if a recording has other
    channels than the first one, or there is no recording.
    """
    rest_ns = round(rest_s * 1e9)
    schemas: dict[str, tuple[tuple[str, ...], tuple[Mapping[str, str], ...]]] = {}
    raw: dict[str, dict[str, RawStream]] = {}
    for name, recording in sorted(recordings.recordings.items()):
        raw[name] = {}
        for stream, table in _input_tables(recording, choose):
            channels = tuple(column for column in table.column_names if column != "t_ns")
            schemas.setdefault(stream, (channels, tuple(tactile.layout(table.schema, channels))))
            if channels != schemas[stream][0]:
                raise TacpipeError(
                    f"{name} has other input channels in {stream or 'its table'} than the recordings before. Train on "
                    f"recordings of one kind of sensor."
                )
            raw[name][stream] = RawStream.from_table(table, channels)
        if not raw[name]:
            raise TacpipeError(
                f"{name} has no input channel to learn from. Run `tacpipe extract markers` on videos of gels, or choose "
                f"other channels."
            )
    if not schemas:
        raise TacpipeError("There is no training recording. Make a split with `tacpipe split` that has some.")
    for name, streams in raw.items():
        missing = sorted(set(schemas) - set(streams))
        if missing:
            raise TacpipeError(f"{name} has no input stream {missing[0]}. Leave it out, or choose other inputs.")
    inputs = tuple(
        _input_stream(stream, channels, layout, [streams[stream] for streams in raw.values()], rest_ns, window_rows)
        for stream, (channels, layout) in sorted(schemas.items())
    )
    return Inputs(inputs, rest_ns), raw


def _input_stream(
    stream: str,
    channels: tuple[str, ...],
    layout: tuple[Mapping[str, str], ...],
    raw: Sequence[RawStream],
    rest_ns: int,
    window_rows: Callable[[float, Sequence[RawStream]], int],
) -> InputStream:
    """Return an input stream with the rate and the scales of its training recordings."""
    rates = [1e9 / max(1.0, float(np.median(np.diff(part.t_ns)))) for part in raw if len(part.t_ns) > 1]
    rate_hz = float(f"{np.median(rates) if rates else 1.0:.9g}")
    squares = [
        np.square(np.nan_to_num(part.values - measured[0])).mean(axis=0)
        for part in raw
        if len(part.t_ns) and (measured := measure_rest(part.t_ns, part.values, rest_ns)) is not None
    ]
    mean_square = np.mean(squares, axis=0) if squares else np.ones(len(channels))
    return InputStream(stream, channels, layout, window_rows(rate_hz, raw), rate_hz, _scale(mean_square, layout))


def _scale(mean_square: Floats, layout: Layout) -> Floats:
    """Return the divisor of each channel: the root mean square of all channels along the skin, or of those normal to it."""
    normal = np.array([channel.get("axis") == "z" for channel in layout])
    scale = np.ones(len(layout))
    for group in (normal, ~normal):
        if group.any():
            scale[group] = float(np.sqrt(mean_square[group].mean())) or 1.0
    return scale


def _input_tables(recording: Recording, choose: Chooser) -> list[tuple[str, pa.Table]]:
    """Return name and table of each input stream; those of a synchronized recording by the metadata of its columns."""
    tables = []
    for stored_stream in recording.streams:
        schema = recording.columns(stored_stream).schema
        by_stream: dict[str, list[str]] = {}
        for name in choose(stored_stream, schema):
            stream = stored_stream or field_metadata(schema.field(name)).get("stream", "")
            by_stream.setdefault(stream, []).append(name)
        tables += [(stream, recording.table(stored_stream, ["t_ns", *names])) for stream, names in by_stream.items()]
    return tables
