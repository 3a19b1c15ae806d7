"""Read recordings as windows: for each row of the first finger, the last rows of every finger, and the plan ahead."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Floats, Indices, Int64s, Times
from tacpipe.channels.schema import field_metadata
from tacpipe.codecs import tactile
from tacpipe.errors import TacpipeError
from tacpipe.plugins.constraints import CommaList
from tacpipe.plugins.rows import NO_LABEL, NO_WINDOW
from tacpipe.sensors.plan import NAME as PLAN
from tacpipe.tasks.learning.examples import Examples, join
from tacpipe.tasks.learning.features import (
    ChannelAxes,
    FeatureKind,
    combine_streams,
    feature_names,
    stream_features,
)
from tacpipe.tasks.learning.inputs import InputRows, Inputs, find_inputs
from tacpipe.tasks.slip.labels import SlipLabels, read_labels
from tacpipe.tasks.slip.planned import (
    CHANNELS,
    NAMES_OF_PLAN,
    NAMES_WITH_TOUCH,
    POINTS,
    PlannedMotion,
    planned_features,
    predicted_ratios,
    sample_ahead,
)

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording
    from tacpipe.tasks.slip.params import SlipParams

STABLE, BEFORE, DURING, UNCOUNTED = 0, 1, 2, -1  # states of a row
MATCH_NS = 1_000_000_000  # width of the bins of time since the start in which windows are matched


@dataclass(frozen=True)
class GraspTrack(InputRows):
    """A recording as rows of its first finger, with its labels."""

    object: str  # grasped object; the name of the recording if it is unlabelled
    labels: SlipLabels | None
    plans: PlannedMotion | None = None  # planned motion; None if the model reads no plans, or the recording has none

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


@dataclass(frozen=True)
class FingerReader(Inputs):
    """Reads recordings as tracks, for a model that reads some fingers, and possibly planned motion."""

    reads_plans: bool = False

    def track(self, recording: Recording) -> GraspTrack:
        """Return a recording as a track. Raises `TacpipeError` if it lacks a stream or a channel."""
        return self.label(self.read(recording), recording)

    def label(self, rows: InputRows, recording: Recording) -> GraspTrack:
        """Return rows of a recording as a track, with its labels and plans."""
        track = GraspTrack(
            **vars(rows),
            object=str(recording.attributes.get("object") or recording.name),
            labels=read_labels(recording),
            plans=PlannedMotion.from_recording(recording) if self.reads_plans else None,
        )
        self.count_rows(track, np.zeros(0, np.intp), NO_WINDOW if track.labels else NO_LABEL)
        return track

    @property
    def names(self) -> list[str]:
        """The names of the features: those of windows, or the channels if windows have one row; then those of plans."""
        if self._reads_rows:
            names = [f"{finger.stream} {channel}" for finger in self.streams for channel in finger.channels]
        else:
            names = feature_names(len(self.streams))
        if self.reads_plans:
            names += [*NAMES_OF_PLAN, *([] if self._reads_rows else NAMES_WITH_TOUCH)]
        return names

    @property
    def _reads_rows(self) -> bool:
        return all(finger.rows == 1 for finger in self.streams)

    @property
    def window_shapes(self) -> list[tuple[int, int]]:
        """Rows and channels of each of `windows`."""
        return [*super().window_shapes, *([(1 + POINTS, len(CHANNELS))] if self.reads_plans else [])]

    def windows(self, rows: InputRows, ends: Indices) -> list[AnyFloats]:
        """Return the windows that end in rows (window, time, channel): of each finger, and of the plan if it is read."""
        windows = super().windows(rows, ends)
        if self.reads_plans:
            windows.append(sample_ahead(rows.plans if isinstance(rows, GraspTrack) else None, rows.t_ns[ends]))
        return windows

    def features(self, kind: FeatureKind, windows: Sequence[AnyFloats]) -> Floats:
        """Return the features (window, feature) of `windows`, as `names`: of each finger, then of the plan.

        If windows have one row, the features are the channels of that row.
        """
        touch = windows[: len(self.streams)]
        if self._reads_rows:
            features: Floats = np.concatenate([part[:, -1] for part in touch], axis=1)
        else:
            features = combine_streams(
                [
                    stream_features(part, ChannelAxes.from_layout(finger.layout))
                    for part, finger in zip(touch, self.streams, strict=True)
                ]
            )
        if not self.reads_plans:
            return features
        planned = planned_features(windows[-1])
        return np.concatenate(
            [features, planned, *([] if self._reads_rows else [predicted_ratios(features, planned)])], axis=1
        )


def read_training(recordings: Dataset, params: SlipParams) -> tuple[FingerReader, list[GraspTrack]]:
    """Return the reader for the tactile streams of the training recordings, and those with slip labels as tracks.

    Scales are the root mean square of each axis over all training recordings. Raises `TacpipeError` if a recording has
    no tactile channel, or other channels than the first one.
    """
    inputs, raw = find_inputs(
        recordings,
        lambda stream, schema: _tactile_columns(stream, schema, params.streams),
        params.rest_s,
        lambda rate_hz, values: max(1, round(params.window_s * rate_hz)),
    )
    reader = FingerReader(inputs.streams, inputs.rest_ns, params.reads_plans)
    tracks = (
        reader.label(reader.place(recordings.recordings[name], streams), recordings.recordings[name])
        for name, streams in raw.items()
    )
    labelled = [track for track in tracks if track.labels is not None]
    if reader.reads_plans and labelled and not any(track.plans for track in labelled):
        raise TacpipeError(
            f"None of {len(labelled)} training recordings has a stream {PLAN} of planned motion. Record the plans of the "
            f"controller, or train with --actions none."
        )
    return reader, labelled


def _tactile_columns(stream: str, schema: pa.Schema, streams: str) -> list[str]:
    """Return the tactile columns of the streams that match patterns; all of them without patterns."""
    patterns = CommaList().items(streams)
    return [
        name
        for name in tactile.columns(schema, "tactile")
        if not patterns
        or any(
            fnmatchcase(stream or field_metadata(schema.field(name)).get("stream", ""), pattern) for pattern in patterns
        )
    ]


def read_examples(reader: FingerReader, tracks: Sequence[GraspTrack], params: SlipParams, stride: int = 1) -> Examples:
    """Return the counted windows of tracks, every ``stride``-th row; their values (window, 1) are `GraspTrack.states`."""
    horizon_ns, recovery_ns = round(params.horizon_s * 1e9), round(params.recovery_s * 1e9)
    parts = []
    for track in tracks:
        states = track.states(horizon_ns, recovery_ns)
        rows = np.flatnonzero(states != UNCOUNTED)[::stride]
        reader.count_rows(track, rows)
        parts.append((track, track.object, rows, states[rows, None].astype(np.float64)))
    examples = join(reader, parts)
    return (
        replace(examples, weights=match_time(examples.since_s, are_slips(examples))) if params.match_time else examples
    )


def are_slips(examples: Examples) -> Bools:
    """Return whether the object slips within the horizon (window,)."""
    return np.asarray(examples.values.reshape(-1) > STABLE)


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
