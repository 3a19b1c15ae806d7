"""Examples to learn from: windows that end in some rows of recordings, with the values that are to be answered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Floats, Indices
from tacpipe.errors import UsageError
from tacpipe.tasks.learning.features import FeatureKind
from tacpipe.tasks.learning.inputs import InputRows, Inputs

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Recording
    from tacpipe.plugins.stage import Attribute

BLOCK = 256  # number of windows whose features are computed at once


@dataclass(frozen=True)
class Examples:
    """Windows that end in rows of recordings."""

    inputs: Inputs
    recordings: tuple[InputRows, ...]
    groups: tuple[str, ...]  # group of each recording, which cross-validation leaves out as a whole
    owner: Indices  # (example,), index of the recording
    rows: Indices  # (example,), row of the recording
    values: Floats  # (example, target), the values to be answered; NaN if unknown
    # windows of each stream (example, time, channel); None: those of the rows
    stacked: Sequence[AnyFloats] | None = None
    weights: Floats | None = None  # (example,), how much each counts in training; None: all alike
    _features: dict[FeatureKind, Floats] = field(default_factory=dict, compare=False)  # features computed so far

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def example_groups(self) -> list[str]:
        """The group of each example."""
        return [self.groups[index] for index in self.owner.tolist()]

    @property
    def training_weights(self) -> Floats:
        """How much each example counts in training (example,)."""
        return np.ones(len(self)) if self.weights is None else self.weights

    @property
    def names(self) -> list[str]:
        """The recording of each example."""
        return [self.recordings[index].name for index in self.owner.tolist()]

    @property
    def since_s(self) -> Floats:
        """Seconds since the start of the recording (example,)."""
        times = [rows.since_s for rows in self.recordings]
        return np.array([times[owner][row] for owner, row in zip(self.owner.tolist(), self.rows.tolist(), strict=True)])

    def select(self, chosen: Bools | Indices) -> Examples:
        """Return some of the examples, with their features."""
        return replace(
            self,
            owner=self.owner[chosen],
            rows=self.rows[chosen],
            values=self.values[chosen],
            stacked=None if self.stacked is None else [part[chosen] for part in self.stacked],
            weights=None if self.weights is None else self.weights[chosen],
            _features={kind: values[chosen] for kind, values in self._features.items()},
        )

    def windows(self) -> Sequence[AnyFloats]:
        """Return the windows (example, time, channel) of each stream."""
        if self.stacked is not None:
            return self.stacked
        parts = [np.empty((len(self), *shape)) for shape in self.inputs.window_shapes]
        for number in np.unique(self.owner).tolist():
            chosen = np.flatnonzero(self.owner == number)
            read = self.inputs.windows(self.recordings[number], self.rows[chosen])
            for part, values in zip(parts, read, strict=True):
                part[chosen] = values
        return parts

    def with_windows(self, windows: Sequence[AnyFloats]) -> Examples:
        """Return the same examples with other windows (example, time, channel)."""
        return replace(self, stacked=windows, _features={})

    def with_columns(self, kind: FeatureKind, columns: Sequence[int]) -> Examples:
        """Return the same examples with some columns of their features alone."""
        return replace(self, _features={kind: self.features(kind)[:, list(columns)]})

    def features(self, kind: FeatureKind) -> Floats:
        """Return the features (example, feature); ``time`` is the time since the start of the recording."""
        if kind not in self._features:
            self._features[kind] = self.since_s[:, None] if kind == "time" else self._window_features(kind)
        return self._features[kind]

    def _window_features(self, kind: FeatureKind) -> Floats:
        blocks = [
            self.inputs.features(kind, self.select(np.arange(first, min(first + BLOCK, len(self)))).windows())
            for first in range(0, max(1, len(self)), BLOCK)
        ]
        return np.concatenate(blocks)


def join(inputs: Inputs, parts: Sequence[tuple[InputRows, str, Indices, Floats]]) -> Examples:
    """Return the examples of several recordings: their rows, their group, the chosen rows and the values of these."""
    owner = np.repeat(np.arange(len(parts)), [len(rows) for _, _, rows, _ in parts])
    width = parts[0][3].shape[1] if parts else 0
    return Examples(
        inputs,
        tuple(recording for recording, *_ in parts),
        tuple(group for _, group, *_ in parts),
        owner,
        np.concatenate([np.zeros(0, np.intp), *(rows for _, _, rows, _ in parts)]),
        np.concatenate([np.zeros((0, width)), *(values for *_, values in parts)]),
    )


def blank(inputs: Inputs) -> Examples:
    """Return an example of zeros, by which a loaded model proves that it fits its inputs."""
    return one_window(inputs, [np.zeros(shape) for shape in inputs.window_shapes], 0, 0)


def one_window(inputs: Inputs, windows: Sequence[AnyFloats], t_ns: int, start_ns: int) -> Examples:
    """Return the example of one window of each stream (time, channel), as a live session has it."""
    newest = np.zeros((1, len(windows)), np.intp)
    rows = InputRows("", "", np.array([t_ns]), start_ns, (), newest, np.ones(1, bool), None)
    stacked = [window[None] for window in windows]
    return Examples(inputs, (rows,), ("",), np.zeros(1, np.intp), np.zeros(1, np.intp), np.zeros((1, 0)), stacked)


def group_of(recording: Recording, labels: Sequence[str]) -> str:
    """Return the values of these labels of a recording as text; its name without labels.

    Raises `UsageError` if it lacks a label.
    """
    attributes: Mapping[str, Attribute] = recording.attributes
    for label in labels:
        if attributes.get(label) is None:
            raise UsageError(
                f"{recording.name} has no label {label}, by which recordings are grouped. Set it with `tacpipe label`, or "
                f"choose another one with --group."
            )
    return " ".join(str(attributes[label]) for label in labels) or recording.name


def recentre(recordings: Sequence[InputRows], label: str) -> list[InputRows]:
    """Return recordings without the median of each session, which is a value of ``label``, over all of its rows."""
    sessions: dict[str, list[int]] = {}
    for index, rows in enumerate(recordings):
        assert rows.recording is not None
        sessions.setdefault(group_of(rows.recording, [label]), []).append(index)
    centred = list(recordings)
    for members in sessions.values():
        for place in range(len(recordings[0].streams)):
            level = np.median(np.concatenate([recordings[index].streams[place].values for index in members]), axis=0)
            for index in members:
                streams = list(centred[index].streams)
                streams[place] = replace(streams[place], values=streams[place].values - level)
                centred[index] = replace(centred[index], streams=tuple(streams))
    return centred


def unlabelled(inputs: Inputs, rows: InputRows, group: Sequence[str], ends: Indices) -> Examples:
    """Return the windows of a recording that end in these rows, whose answer is not read; it may lack labels of groups."""
    labels = rows.recording.attributes if rows.recording is not None else {}
    own_group = group_of(rows.recording, group) if rows.recording and set(group) <= set(labels) else rows.name
    return join(inputs, [(rows, own_group, ends, np.zeros((len(ends), 0)))])
