"""What a model answers, quantities or classes: how values are read, encoded for estimators, decoded and compared."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from tacpipe.arrays import AnyFloats, Floats, Indices, Times
from tacpipe.channels.schema import field_metadata, turn_of
from tacpipe.datasets.intervals import intervals_of
from tacpipe.errors import UsageError
from tacpipe.printable import listed
from tacpipe.scores import calibration
from tacpipe.tasks.learning.features import Kind
from tacpipe.tasks.learning.inputs import InputRows

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording

MAX_CLASSES = 1000  # maximum number of classes that can be learned


class ModelAnswers(ABC):
    """What a model answers."""

    kind: ClassVar[Kind]

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of the outputs."""

    @property
    @abstractmethod
    def value_names(self) -> tuple[str, ...]:
        """Names of the columns or labels whose values are read."""

    @abstractmethod
    def read(self, rows: InputRows, recording: Recording) -> Floats:
        """Return the values (time, target) at the rows of a recording; NaN where they are unknown."""

    @abstractmethod
    def encode(self, values: AnyFloats) -> Floats:
        """Return the outputs (example, output) that an estimator learns for values (example, target)."""

    @abstractmethod
    def losses(self, outputs: AnyFloats, values: AnyFloats) -> Floats:
        """Return the loss (example,) of outputs, by which estimators are compared."""

    @abstractmethod
    def to_config(self) -> dict[str, Any]:
        """Return the answers as ``config.json`` has them."""


@dataclass(frozen=True)
class Target:
    """A column, or a label of recordings, whose value is estimated."""

    name: str
    unit: str
    period: float = 0.0  # values wrap after it; 0 if they do not


@dataclass(frozen=True)
class Quantities(ModelAnswers):
    """Several quantities at once."""

    kind: ClassVar[Kind] = "quantity"
    targets: tuple[Target, ...]
    horizon_ns: int = 0
    scales: tuple[float, ...] = ()  # mean absolute error of the median of each target in training

    @classmethod
    def find(cls, recordings: Dataset, patterns: Sequence[str], horizon_s: float) -> Quantities:
        """Return the columns, or the labels of recordings, that match patterns.

        Raises `UsageError` if a pattern matches none, or a target has several units or is missing in a recording.
        """
        if not patterns:
            raise UsageError("--target names no column to estimate. Give its name or a pattern, as in --target 'ft_*'.")
        targets: dict[str, Target] = {}
        for name, recording in sorted(recordings.recordings.items()):
            own = _targets_of(recording, patterns)
            for target in own.values():
                known = targets.setdefault(target.name, target)
                if known.unit != target.unit:
                    raise UsageError(
                        f"{name} states {target.name} in {target.unit}, and other recordings in {known.unit}. Give "
                        f"recordings with one unit."
                    )
            missing = sorted(set(targets) - set(own))
            if missing:
                raise UsageError(f"{name} has no {missing[0]}, which other recordings have. Leave one of them out.")
        for pattern in patterns:
            if not any(fnmatchcase(name, pattern) for name in targets):
                raise UsageError(
                    f"--target {pattern} matches no column and no label of numbers. The recordings have "
                    f"{listed(_target_names(recordings), 12)}."
                )
        return cls(tuple(targets.values()), round(horizon_s * 1e9))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the targets."""
        return tuple(target.name for target in self.targets)

    @property
    def value_names(self) -> tuple[str, ...]:
        """Names of the targets."""
        return self.names

    @property
    def periods(self) -> Floats:
        """The period of each target (target,); infinite for values that do not wrap."""
        return np.array([target.period or np.inf for target in self.targets])

    def read(self, rows: InputRows, recording: Recording) -> Floats:
        """Return the targets at the rows of a recording, or the horizon later; NaN where they are unknown.

        Raises `UsageError` if the rows of a target are not those of the inputs.
        """
        values = np.full((len(rows.t_ns), len(self.targets)), np.nan)
        streams = {name: stream for stream in recording.streams for name in recording.columns(stream).column_names}
        for index, target in enumerate(self.targets):
            stream = streams.get(target.name)
            if stream is None:
                values[:, index] = float(recording.attributes[target.name])  # type: ignore[arg-type]
                continue
            table = recording.table(stream, ["t_ns", target.name])
            t_ns, column = table["t_ns"].to_numpy(), table[target.name].to_numpy(zero_copy_only=False)
            if not np.array_equal(t_ns, rows.t_ns):
                raise UsageError(
                    f"{recording.name} has {target.name} at other times than the inputs. Run `tacpipe synchronize "
                    f"RECORDINGS --truth {target.name}` first."
                )
            values[:, index] = _ahead(t_ns, column.astype(np.float64), self.horizon_ns)
        return values

    def scaled(self, values: AnyFloats) -> Quantities:
        """Return the same targets with the scales of training values. Raises `UsageError` for a constant target."""
        scales = np.abs(self.difference(values, np.median(values, axis=0))).mean(axis=0)
        for target, scale, column in zip(self.targets, scales.tolist(), values.T, strict=True):
            if not scale > 0:
                raise UsageError(
                    f"The target {target.name} is {column[0]:g} in all training rows. There is nothing to learn."
                )
        return Quantities(self.targets, self.horizon_ns, tuple(scales.tolist()))

    def encode(self, values: AnyFloats) -> Floats:
        """Return values, and cosine and sine of those that wrap."""
        parts: list[AnyFloats] = []
        for target, column in zip(self.targets, values.T, strict=True):
            angle = column * (2 * np.pi / target.period) if target.period else column
            parts += [np.cos(angle), np.sin(angle)] if target.period else [column]
        return np.stack(parts, axis=1)

    def decode(self, outputs: AnyFloats) -> Floats:
        """Return the values (example, target) of outputs (example, output)."""
        parts: list[AnyFloats] = []
        place = 0
        for target in self.targets:
            if target.period:
                turn = np.arctan2(outputs[:, place + 1], outputs[:, place]) / (2 * np.pi)
                parts.append(turn * target.period)
            else:
                parts.append(outputs[:, place])
            place += 2 if target.period else 1
        return np.stack(parts, axis=1)

    @property
    def output_count(self) -> int:
        """Number of outputs."""
        return sum(2 if target.period else 1 for target in self.targets)

    def difference(self, values: AnyFloats, others: AnyFloats) -> Floats:
        """Return values minus others (example, target), the shorter way around for values that wrap."""
        differences = np.asarray(values - others, np.float64)
        wraps = np.isfinite(self.periods)
        periods = np.where(wraps, self.periods, 1.0)
        return np.where(wraps, differences - periods * np.round(differences / periods), differences)

    def losses(self, outputs: AnyFloats, values: AnyFloats) -> Floats:
        """Return the absolute error (example,), the mean over targets of the error relative to that of the median."""
        errors = np.abs(self.difference(self.decode(outputs), values))
        return np.asarray((errors / np.array(self.scales)).mean(axis=1))

    def to_config(self) -> dict[str, Any]:
        """Return the targets as ``config.json`` has them."""
        return {
            "targets": [vars(target) for target in self.targets],
            "horizon_ns": self.horizon_ns,
            "scales": list(self.scales),
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Quantities:
        """Return the targets that `to_config` wrote. Raises `ValueError` if their parts do not fit one another."""
        targets = tuple(Target(**target) for target in config["targets"])
        if not targets or len(config["scales"]) != len(targets):
            raise ValueError(f"{len(targets)} targets with {len(config['scales'])} scales")
        return cls(targets, int(config["horizon_ns"]), tuple(map(float, config["scales"])))


@dataclass(frozen=True)
class Classes(ModelAnswers):
    """One of several classes: the value of a label, of a column, or whether a row is in a labelled interval."""

    kind: ClassVar[Kind] = "class"
    label: str
    classes: tuple[str, ...]

    @classmethod
    def find(cls, recordings: Dataset, label: str) -> Classes:
        """Return the classes of the recordings. Raises `UsageError` if fewer than two have a recording."""
        if not label:
            raise UsageError("--label names no label to learn. Give one, as in --label object.")
        values = {
            value
            for recording in recordings.recordings.values()
            for value in _class_values(recording, label)
            if value is not None
        }
        if not values:
            raise UsageError(
                f"None of {len(recordings.recordings)} training recordings has the label {label}. Set it with `tacpipe "
                f"label`, or choose another one with --label."
            )
        if not 1 < len(values) <= MAX_CLASSES:
            raise UsageError(
                f"The label {label} has {len(values)} {'value' if len(values) == 1 else 'values'} in the training "
                f"recordings, {listed(sorted(values), 3)}. Two to {MAX_CLASSES} classes can be learned."
            )
        return cls(label, tuple(sorted(values, key=_class_order)))

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the classes."""
        return self.classes

    @property
    def value_names(self) -> tuple[str, ...]:
        """The name of the label."""
        return (self.label,)

    @property
    def output_count(self) -> int:
        """Number of outputs."""
        return len(self.classes)

    def read(self, rows: InputRows, recording: Recording) -> Floats:
        """Return the number of the class (time, 1), NaN where the class is unknown; -1 for a class without a number."""
        numbers = {name: float(number) for number, name in enumerate(self.classes)}
        texts = class_texts(rows.t_ns, rows.start_ns, recording, self.label)
        return np.array([[math.nan if text is None else numbers.get(text, -1.0)] for text in texts]).reshape(-1, 1)

    def encode(self, values: AnyFloats) -> Floats:
        """Return 1 for the class and 0 for the others."""
        return np.asarray(values[:, :1] == np.arange(len(self.classes)), np.float64)

    def losses(self, outputs: AnyFloats, values: AnyFloats) -> Floats:
        """Return the negative log probability of the class (example,), at the best temperature for these outputs."""
        labels = values[:, 0].astype(np.intp)
        probabilities = calibration.probabilities(outputs, calibration.temperature(outputs, labels))
        likelihoods = probabilities[np.arange(len(labels)), labels]
        return np.asarray(-np.log(np.maximum(likelihoods, calibration.MIN_PROBABILITY)))

    def to_config(self) -> dict[str, Any]:
        """Return the classes as ``config.json`` has them."""
        return {"label": self.label, "classes": list(self.classes)}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Classes:
        """Return the classes that `to_config` wrote. Raises `ValueError` if there are fewer than two."""
        classes = tuple(map(str, config["classes"]))
        if not 1 < len(set(classes)) == len(classes) <= MAX_CLASSES:
            raise ValueError(f"{len(classes)} classes")
        return cls(str(config["label"]), classes)


def answers_of(config: Mapping[str, Any]) -> Quantities | Classes:
    """Return the answers that `to_config` wrote. Raises `ValueError` or `LookupError` if their parts do not fit."""
    return (Quantities if "targets" in config else Classes).from_config(config)


def class_texts(t_ns: Times, start_ns: int, recording: Recording, label: str) -> list[str | None]:
    """Return the class at each time of a recording as text, or None where it is unknown."""
    attribute = recording.attributes.get(label)
    if attribute is not None:
        return [_text(attribute)] * len(t_ns)
    intervals = intervals_of(recording.attributes, label)
    if intervals is not None:
        since_s = (t_ns - start_ns) / 1e9
        inside = np.zeros(len(t_ns), bool)
        for begin, end in intervals:
            inside |= (since_s >= begin) & (since_s <= end)
        return [label if is_inside else f"no {label}" for is_inside in inside.tolist()]
    stream = _stream_of(recording, label)
    if stream is None:
        return [None] * len(t_ns)
    table = recording.table(stream, ["t_ns", label])
    places = np.searchsorted(table["t_ns"].to_numpy(), t_ns, side="right") - 1
    values = table[label].to_pylist()
    return [None if place < 0 or values[place] is None else _text(values[place]) for place in places.tolist()]


def _class_values(recording: Recording, label: str) -> set[str | None]:
    """Return the classes of a recording."""
    if recording.attributes.get(label) is not None:
        return {_text(recording.attributes[label])}
    if intervals_of(recording.attributes, label) is not None:
        return {label, f"no {label}"}
    stream = _stream_of(recording, label)
    return (
        set()
        if stream is None
        else {
            _text(value) for value in recording.table(stream, [label])[label].unique().to_pylist() if value is not None
        }
    )


def _text(value: Any) -> str:
    """Return a class as text; booleans are written as in YAML, and whole numbers without a point."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


def _class_order(name: str) -> tuple[bool, float, str]:
    """Return what classes are sorted by: numbers by value, then text."""
    try:
        return False, float(name), name
    except ValueError:
        return True, 0.0, name


def _targets_of(recording: Recording, patterns: Sequence[str]) -> dict[str, Target]:
    """Return the targets of a recording that match patterns: columns of numbers, else labels that are numbers."""
    targets = {}
    for stream in recording.streams:
        schema = recording.columns(stream).schema
        for name in schema.names:
            if name == "t_ns" or not any(fnmatchcase(name, pattern) for pattern in patterns):
                continue
            field = schema.field(name)
            if is_number(field.type):
                about = field_metadata(field)
                # a joint has a range, and its values outside of a turn are others
                period = 0.0 if about.get("quantity") == "joint_position" else turn_of(field)
                targets[name] = Target(name, about.get("unit", ""), period)
    for name, value in recording.attributes.items():
        holds_number = isinstance(value, int | float) and not isinstance(value, bool)
        if name not in targets and holds_number and any(fnmatchcase(name, pattern) for pattern in patterns):
            targets[name] = Target(name, "")
    return targets


def _target_names(recordings: Dataset) -> list[str]:
    """Return the names of the columns of the first recording that can be a target, or else of its labels of numbers."""
    first = min(recordings.recordings.items())[1]
    columns = [name for stream in first.streams for name in first.columns(stream).column_names]
    targets = _targets_of(first, ["*"])
    return [name for name in columns if name in targets] or sorted(targets)


def _stream_of(recording: Recording, column: str) -> str | None:
    """Return the stream that has a column, or None."""
    return next((stream for stream in recording.streams if column in recording.columns(stream).column_names), None)


def is_number(kind: pa.DataType) -> bool:
    """Return whether a column of this type contains numbers."""
    import pyarrow as pa

    return bool(pa.types.is_floating(kind) or pa.types.is_integer(kind))


def _ahead(t_ns: Times, values: Floats, horizon_ns: int) -> Floats:
    """Return the values (time,) at the row nearest to the horizon later; NaN where the recording ends before."""
    if not horizon_ns or len(t_ns) < 2:
        return values
    places: Indices = np.searchsorted(t_ns, t_ns + horizon_ns - np.median(np.diff(t_ns)) / 2)
    return np.where(places < len(t_ns), values[np.minimum(places, len(t_ns) - 1)], np.nan)
