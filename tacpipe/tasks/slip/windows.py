"""Read recordings as windows: for each row of the first finger, the last rows of every finger, and the plan ahead."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Floats, Indices, Int64s, Times
from tacpipe.channels.schema import field_metadata
from tacpipe.codecs import tactile
from tacpipe.errors import TacpipeError
from tacpipe.plugins.rows import NO_LABEL, NO_WINDOW, RowCounts, count_rows
from tacpipe.sensors.plan import NAME as PLAN
from tacpipe.signals.runs import rows_in_windows
from tacpipe.tasks.slip.features import FingerLayout, combine_fingers, feature_names, finger_features
from tacpipe.tasks.slip.labels import SlipLabels, read_labels
from tacpipe.tasks.slip.planned import (
    NAMES_OF_PLAN,
    NAMES_WITH_TOUCH,
    PlannedMotion,
    planned_features,
    predicted_ratios,
    sample_ahead,
)

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording
    from tacpipe.tasks.slip.params import FingerConfig, SlipModelParams

STABLE, BEFORE, DURING, UNCOUNTED = 0, 1, 2, -1  # states of a row
BLOCK = 256  # number of windows whose features are computed at once
TIME = "time since the start"  # last column of the features, which only the baseline time_only reads
MATCH_NS = 1_000_000_000  # width of the bins of time since the start in which windows are matched


@dataclass(frozen=True)
class Finger:
    """A tactile stream as a model reads it."""

    stream: str
    channels: tuple[str, ...]
    layout: tuple[Mapping[str, str], ...]
    rows: int  # number of rows of a window
    rate_hz: float
    scale: Floats  # (channel,)

    @classmethod
    def from_config(cls, config: FingerConfig) -> Finger:
        """Return a finger as `to_config` wrote it. Raises `ValueError` if its parts do not fit one another."""
        channels, scale = tuple(config["channels"]), np.array(config["scale"], np.float64)
        if not (0 < config["rows"] <= MAX_ROWS and len(config["layout"]) == len(channels) == len(scale) > 0):
            raise ValueError(f"the finger {config['stream']} has {config['rows']} rows and {len(scale)} scales")
        return cls(config["stream"], channels, tuple(config["layout"]), config["rows"], config["rate_hz"], scale)

    def to_config(self) -> FingerConfig:
        """Return the finger as ``config.json`` has it."""
        layout = [dict(place) for place in self.layout]
        return {
            "stream": self.stream,
            "channels": list(self.channels),
            "layout": layout,
            "rows": self.rows,
            "rate_hz": self.rate_hz,
            "scale": self.scale.tolist(),
        }

    @property
    def places(self) -> FingerLayout:
        """Indices of the channels along each axis."""
        return FingerLayout.from_layout(self.layout)


MAX_ROWS = 100_000  # maximum number of rows of a window


@dataclass(frozen=True)
class FingerRows:
    """The rows of a finger in one recording."""

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
class RawFinger:
    """The recorded values of a finger."""

    t_ns: Times  # (row,)
    values: AnyFloats  # (row, channel)

    @classmethod
    def from_table(cls, table: pa.Table, channels: Sequence[str]) -> RawFinger:
        """Return the channels of a table."""
        return cls(table.column("t_ns").to_numpy(), tactile.matrix(table, channels))

    def above_rest(self, finger: Finger, rest_ns: int) -> FingerRows:
        """Return the values above rest and scaled; no row begins if the recording is too short to measure the rest."""
        measured = measure_rest(self.t_ns, self.values, rest_ns)
        if measured is None:
            return FingerRows(self.t_ns, np.zeros_like(self.values), len(self.t_ns))
        rest, count = measured
        scaled = (self.values - rest) / finger.scale
        return FingerRows(self.t_ns, fill_missing(scaled, np.zeros(len(finger.scale))), count)


@dataclass(frozen=True)
class GraspTrack:
    """A recording as rows of its first finger."""

    name: str
    object: str  # grasped object; the name of the recording if it is unlabelled
    digest: str
    t_ns: Times  # (time,)
    start_ns: int  # time of the first sample of any finger
    fingers: tuple[FingerRows, ...]
    newest: Indices  # (time, finger), the newest row of each finger
    ready: Bools  # (time,), whether all windows are full
    labels: SlipLabels | None
    recording: Recording | None = None  # the recording of the track, if it was read from one
    plans: PlannedMotion | None = None  # planned motion; None if the model reads no plans, or the recording has none

    @property
    def since_s(self) -> Floats:
        """Seconds since the first sample (time,)."""
        return np.asarray((self.t_ns - self.start_ns) / 1e9)

    @property
    def events(self) -> Times:
        """First and last time of each slip (event, 2)."""
        return self.labels.events if self.labels is not None else np.zeros((0, 2), np.int64)

    @property
    def touched(self) -> Bools:
        """Whether an object is touched (time,); true where no label states it."""
        if self.labels is None or self.labels.contact is None:
            return np.ones(len(self.t_ns), bool)
        times, touched = self.labels.contact
        rows = np.searchsorted(times, self.t_ns, side="right") - 1
        return np.asarray(touched[np.maximum(rows, 0)] & (rows >= 0))

    def states(self, horizon_ns: int, recovery_ns: int) -> Int64s:
        """Return the state of each row (time,): `STABLE`, `BEFORE` or `DURING` a slip, or `UNCOUNTED`.

        Rows are not counted if a window is not full, nothing is touched, a slip has just ended, or the recording ends
        within the horizon, so that a later slip would be unknown.
        """
        states = np.where(self.touched, STABLE, UNCOUNTED)
        states[self.t_ns > self.t_ns[-1] - horizon_ns] = UNCOUNTED
        begins, ends = (self.events[:, column, None] for column in (0, 1))  # (event, 1)
        states[((self.t_ns > ends) & (self.t_ns <= ends + recovery_ns)).any(axis=0)] = UNCOUNTED
        near = ((self.t_ns >= begins - horizon_ns) & (self.t_ns < begins)).any(axis=0)
        states[near & self.touched] = BEFORE
        states[((self.t_ns >= begins) & (self.t_ns <= ends)).any(axis=0)] = DURING
        states[~self.ready] = UNCOUNTED
        return states

    def windows(self, rows: Indices, finger: int, length: int) -> AnyFloats:
        """Return the windows (window, time, channel) of a finger that end in these rows."""
        ends = self.newest[rows, finger]
        return np.asarray(self.fingers[finger].values[ends[:, None] + np.arange(1 - length, 1)])


@dataclass(frozen=True)
class FingerReader:
    """Reads recordings as tracks, for a model that reads some fingers."""

    fingers: tuple[Finger, ...]
    rest_ns: int
    reads_plans: bool = False

    def track(self, recording: Recording) -> GraspTrack:
        """Return a recording as a track. Raises `TacpipeError` if it lacks a stream or a channel."""
        return self.track_of(
            recording,
            {
                finger.stream: RawFinger.from_table(self.table(recording, finger), finger.channels)
                for finger in self.fingers
            },
        )

    def track_of(self, recording: Recording, raw: Mapping[str, RawFinger]) -> GraspTrack:
        """Return a recording as a track; ``raw`` contains the values of its fingers by stream."""
        fingers = tuple(raw[finger.stream].above_rest(finger, self.rest_ns) for finger in self.fingers)
        t_ns = fingers[0].t_ns
        newest = np.stack([np.searchsorted(signal.t_ns, t_ns, side="right") - 1 for signal in fingers], axis=1)
        first = [signal.begin + finger.rows - 1 for signal, finger in zip(fingers, self.fingers, strict=True)]
        ready = np.asarray((newest >= np.array(first)).all(axis=1))
        start_ns = min((int(signal.t_ns[0]) for signal in fingers if len(signal.t_ns)), default=0)
        label = str(recording.attributes.get("object") or recording.name)
        track = GraspTrack(
            recording.name,
            label,
            recording.digest,
            t_ns,
            start_ns,
            fingers,
            newest,
            ready,
            read_labels(recording),
            recording,
            PlannedMotion.from_recording(recording) if self.reads_plans else None,
        )
        self.count_rows(track, np.zeros(0, np.intp), NO_WINDOW if track.labels else NO_LABEL)
        return track

    def count_rows(self, track: GraspTrack, rows: Indices, otherwise: str = NO_WINDOW) -> None:
        """Count the samples in the windows that end in ``rows`` as used, with those that measure the rest level."""
        for index, (finger, samples) in enumerate(zip(self.fingers, track.fingers, strict=True)):
            starts = track.newest[rows, index] + 1 - finger.rows
            used = rows_in_windows(starts, finger.rows, len(samples.t_ns))
            used[: samples.begin if len(rows) else 0] = True
            stream = finger.stream if track.recording is None or finger.stream in track.recording.streams else ""
            count_rows(track.name, stream, RowCounts.from_masks(used, [], otherwise))

    def table(self, recording: Recording, finger: Finger) -> pa.Table:
        """Return the columns of a finger in a recording. Raises `TacpipeError` if a stream or column is missing."""
        names = ["t_ns", *finger.channels]
        stream = "" if set(recording.streams) == {""} else finger.stream
        if stream not in recording.streams:
            raise TacpipeError(
                f"{recording.name} has the streams {', '.join(recording.streams)}, and the model reads {finger.stream}. "
                f"Give recordings of the sensors that it was trained on."
            )
        missing = sorted(set(names) - set(recording.columns(stream).column_names))
        if missing:
            raise TacpipeError(
                f"{recording.name} has no column {missing[0]}, which the model reads. Give recordings that went "
                f"through the same stages as the training recordings."
            )
        return recording.table(stream, names)

    @property
    def names(self) -> list[str]:
        """The names of the features: those of windows, or the channels if windows have one row; then those of plans."""
        if self._reads_rows:
            names = [f"{finger.stream} {channel}" for finger in self.fingers for channel in finger.channels]
        else:
            names = feature_names(len(self.fingers))
        if self.reads_plans:
            names += [*NAMES_OF_PLAN, *([] if self._reads_rows else NAMES_WITH_TOUCH)]
        return names

    @property
    def feature_count(self) -> int:
        """The number of features."""
        return len(self.names)

    @property
    def _reads_rows(self) -> bool:
        return all(finger.rows == 1 for finger in self.fingers)

    def windows(self, track: GraspTrack, rows: Indices) -> list[AnyFloats]:
        """Return the windows that end in rows (window, time, channel): of each finger, and of the plan if it is read."""
        windows = [track.windows(rows, index, finger.rows) for index, finger in enumerate(self.fingers)]
        return [*windows, sample_ahead(track.plans, track.t_ns[rows])] if self.reads_plans else windows

    def window_features(self, windows: Sequence[AnyFloats]) -> Floats:
        """Return the features (window, feature) of `windows`: of each finger, then of the plan.

        If windows have one row, the features are the channels of that row.
        """
        touch = windows[: len(self.fingers)]
        if self._reads_rows:
            features: Floats = np.concatenate([part[:, -1] for part in touch], axis=1)
        else:
            features = combine_fingers(
                [finger_features(part, finger.places) for part, finger in zip(touch, self.fingers, strict=True)]
            )
        if not self.reads_plans:
            return features
        planned = planned_features(windows[-1])
        return np.concatenate(
            [features, planned, *([] if self._reads_rows else [predicted_ratios(features, planned)])], axis=1
        )

    def features(self, track: GraspTrack, rows: Indices) -> Floats:
        """Return the features of rows of a track (row, feature); the last column is the time since the start."""
        columns = self.feature_count
        features = np.empty((len(rows), columns + 1))
        for first in range(0, len(rows), BLOCK):
            block = slice(first, first + BLOCK)
            features[block, :columns] = self.window_features(self.windows(track, rows[block]))
        features[:, columns] = track.since_s[rows]
        return features


def read_training(recordings: Dataset, params: SlipModelParams) -> tuple[FingerReader, list[GraspTrack]]:
    """Return the reader for the tactile streams of the training recordings, and those with slip labels as tracks.

    Scales are the root mean square of each axis over all training recordings. Raises `TacpipeError` if a recording has
    no tactile channel, or other channels than the first one.
    """
    rest_ns = round(params.rest_s * 1e9)
    schemas: dict[str, tuple[tuple[str, ...], tuple[Mapping[str, str], ...]]] = {}
    raw: dict[str, dict[str, RawFinger]] = {}
    for name, recording in sorted(recordings.recordings.items()):
        raw[name] = {}
        for stream, table in _tactile_tables(recording, params.streams):
            channels = tuple(name for name in table.column_names if name != "t_ns")
            schemas.setdefault(stream, (channels, tuple(tactile.layout(table.schema, channels))))
            if channels != schemas[stream][0]:
                raise TacpipeError(
                    f"{name} has other tactile channels in {stream} than the recordings before. Train on recordings of one "
                    f"kind of sensor."
                )
            raw[name][stream] = RawFinger.from_table(table, channels)
    if not schemas:
        raise TacpipeError("There is no training recording. Make a split with `tacpipe split` that has some.")
    for name, streams in raw.items():
        missing = sorted(set(schemas) - set(streams))
        if missing:
            raise TacpipeError(f"{name} has no tactile stream {missing[0]}. Choose the streams with --streams.")
    fingers = tuple(
        _finger(stream, channels, layout, [streams[stream] for streams in raw.values()], params)
        for stream, (channels, layout) in sorted(schemas.items())
    )
    reader = FingerReader(fingers, rest_ns, params.reads_plans)
    tracks = (reader.track_of(recordings.recordings[name], streams) for name, streams in raw.items())
    labelled = [track for track in tracks if track.labels is not None]
    if reader.reads_plans and labelled and not any(track.plans for track in labelled):
        raise TacpipeError(
            f"None of {len(labelled)} training recordings has a stream {PLAN} of planned motion. Record the plans of the "
            f"controller, or train with --actions none."
        )
    return reader, labelled


def _finger(
    stream: str,
    channels: tuple[str, ...],
    layout: tuple[Mapping[str, str], ...],
    raw: Sequence[RawFinger],
    params: SlipModelParams,
) -> Finger:
    """Return a finger with the rate and the scales of its training recordings."""
    rest_ns = round(params.rest_s * 1e9)
    rates = [1e9 / max(1.0, float(np.median(np.diff(part.t_ns)))) for part in raw if len(part.t_ns) > 1]
    rate_hz = float(f"{np.median(rates) if rates else 1.0:.9g}")
    squares = [
        np.square(np.nan_to_num(part.values - measured[0])).mean(axis=0)
        for part in raw
        if len(part.t_ns) and (measured := measure_rest(part.t_ns, part.values, rest_ns)) is not None
    ]
    mean_square = np.mean(squares, axis=0) if squares else np.ones(len(channels))
    return Finger(
        stream, channels, layout, max(1, round(params.window_s * rate_hz)), rate_hz, _scale(mean_square, layout)
    )


def _scale(mean_square: Floats, layout: Sequence[Mapping[str, str]]) -> Floats:
    """Return the divisor of each channel: the root mean square of all channels along the skin, or of those normal to it."""
    normal = np.array([channel.get("axis") == "z" for channel in layout])
    scale = np.ones(len(layout))
    for group in (normal, ~normal):
        if group.any():
            scale[group] = float(np.sqrt(mean_square[group].mean())) or 1.0
    return scale


def _tactile_tables(recording: Recording, streams: str) -> Iterator[tuple[str, pa.Table]]:
    """Yield name and table of each tactile stream; those of a synchronized recording by the metadata of its columns.

    Raises `TacpipeError` if there is none.
    """
    patterns = [word.strip() for word in streams.split(",") if word.strip()]
    has_any = False
    for stored_stream in recording.streams:
        schema = recording.columns(stored_stream).schema
        by_stream: dict[str, list[str]] = {}
        for name in tactile.columns(schema, "tactile"):
            by_stream.setdefault(stored_stream or field_metadata(schema.field(name)).get("stream", ""), []).append(name)
        for stream, names in by_stream.items():
            if not patterns or any(fnmatchcase(stream, pattern) for pattern in patterns):
                has_any = True
                yield stream, recording.table(stored_stream, ["t_ns", *names])
    if not has_any:
        raise TacpipeError(
            f"{recording.name} has no tactile channel to learn from. Run `tacpipe extract markers` on videos of gels, or "
            f"choose others with --streams."
        )


@dataclass(frozen=True)
class TrainingWindows:
    """Windows to train on, with their labels."""

    reader: FingerReader
    tracks: tuple[GraspTrack, ...]
    params: SlipModelParams
    track: Indices  # (window,), index of the window's track
    rows: Indices  # (window,), row in the window's track
    features: Floats  # (window, feature); the last column is the time since the start
    slips: Bools  # (window,), whether the object slips within the horizon
    weights: Floats  # (window,)

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def groups(self) -> Indices:
        """The index of each window's object (window,)."""
        names = sorted({track.object for track in self.tracks})
        return np.array([names.index(track.object) for track in self.tracks], np.intp)[self.track]

    def select(self, chosen: Bools) -> TrainingWindows:
        """Return some of the windows."""
        return replace(
            self,
            track=self.track[chosen],
            rows=self.rows[chosen],
            features=self.features[chosen],
            slips=self.slips[chosen],
            weights=self.weights[chosen],
        )


def read_windows(
    reader: FingerReader, tracks: Sequence[GraspTrack], params: SlipModelParams, stride: int = 1
) -> TrainingWindows:
    """Return the counted windows of tracks, every ``stride``-th row."""
    horizon_ns, recovery_ns = round(params.horizon_s * 1e9), round(params.recovery_s * 1e9)
    parts: list[tuple[Int64s, Int64s]] = []
    for track in tracks:
        states = track.states(horizon_ns, recovery_ns)
        rows = np.flatnonzero(states != UNCOUNTED)[::stride]
        reader.count_rows(track, rows)
        parts.append((rows, states[rows]))
    features = [reader.features(track, rows) for track, (rows, _) in zip(tracks, parts, strict=True)]
    owners = np.repeat(np.arange(len(tracks)), [len(rows) for rows, _ in parts])
    slips = _joined(states for _, states in parts) > STABLE
    stacked = np.concatenate(features) if features else np.zeros((0, reader.feature_count + 1))
    weights = match_time(stacked[:, -1], slips) if params.match_time else np.ones(len(slips))
    return TrainingWindows(
        reader, tuple(tracks), params, owners, _joined(rows for rows, _ in parts), stacked, slips, weights
    )


def match_time(since_s: Floats, slips: Bools) -> Floats:
    """Return weights (window,) that give windows with and without a slip the same distribution of time since the start.

    Windows with a slip have weight 1. Those without one get the total weight that they have in all bins with a slip,
    distributed over the bins as the windows with a slip are; a bin without a slip has no weight.

    >>> match_time(np.array([0.5, 0.5, 0.5, 1.5]), np.array([True, False, False, False])).tolist()
    [1.0, 1.0, 1.0, 0.0]
    """
    bins = np.floor(since_s * 1e9 / MATCH_NS).astype(np.int64)
    weights = np.where(slips, 1.0, 0.0)
    shared = set(bins[slips].tolist()) & set(bins[~slips].tolist())
    in_shared = np.isin(bins, list(shared))
    stable, slipping = int((in_shared & ~slips).sum()), int((in_shared & slips).sum())
    for shared_bin in shared:
        here = bins == shared_bin
        weights[here & ~slips] = stable * (here & slips).sum() / slipping / (here & ~slips).sum()
    weights[~in_shared] = 0.0
    return weights


def shuffle_labels(tracks: Sequence[GraspTrack], seed: int) -> list[GraspTrack]:
    """Return tracks with the slips of another one each, at the same time since the start.

    A slip that would begin after the end of its new track is left out.
    """
    order = np.random.default_rng(seed).permutation(len(tracks))
    shuffled = []
    for track, donor in zip(tracks, (tracks[number] for number in order), strict=True):
        events = donor.events - donor.start_ns + track.start_ns
        events = events[events[:, 0] < track.t_ns[-1]]
        contact = track.labels.contact if track.labels is not None else None
        shuffled.append(replace(track, labels=SlipLabels(events, contact)))
    return shuffled


def _joined(parts: Iterable[Int64s]) -> Int64s:
    """Return arrays joined to one, also if there is none."""
    return np.concatenate([np.zeros(0, np.int64), *parts])
