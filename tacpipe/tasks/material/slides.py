"""Load the slides of a dataset as arrays by sensor, and parse the materials held out of a sensor's labels."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Bools, Float32s, Floats, Int64s
from tacpipe.channels.schema import field_metadata, is_truth
from tacpipe.channels.streams import missing_channel_error
from tacpipe.datasets.dataset import Dataset, Recording
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins.constraints import Assignments, CommaList
from tacpipe.plugins.rows import RowCounts, count_rows
from tacpipe.printable import listed
from tacpipe.tasks.material.headline import NUMBERS, UNKNOWN, Naming
from tacpipe.tasks.material.params import StoredLayout

STREAM = "slide"
TACTILE = "tactile"
MAX_RATE_DIFFERENCE = 0.02  # maximum relative difference between the rates of a sensor's slides


@dataclass(frozen=True)
class SlideLayout:
    """Layout of a sensor's slides: channels, number of frames, frames per second and order."""

    sensor: str
    channels: tuple[str, ...]
    frames: int
    rate_hz: float
    layout: str = "time"  # time: frames in time order; authors: in the published order

    def is_compatible(self, other: SlideLayout) -> bool:
        """Return whether both layouts are compatible: rates may differ slightly, as timestamps do, or be unknown."""
        difference_hz = abs(self.rate_hz - other.rate_hz)
        is_near = 0.0 in (self.rate_hz, other.rate_hz) or difference_hz <= MAX_RATE_DIFFERENCE * max(
            self.rate_hz, other.rate_hz
        )
        return is_near and dataclasses.replace(other, rate_hz=self.rate_hz) == self

    def to_json(self) -> StoredLayout:
        """Return the layout for `from_json`."""
        return {
            "channels": list(self.channels),
            "frames": self.frames,
            "rate_hz": self.rate_hz,
            "layout": self.layout,
        }

    @classmethod
    def from_json(cls, sensor: str, stored: StoredLayout) -> SlideLayout:
        """Return the layout stored by `to_json`."""
        return cls(sensor, tuple(stored["channels"]), int(stored["frames"]), float(stored["rate_hz"]), stored["layout"])


@dataclass(frozen=True)
class Slides:
    """The slides of one sensor."""

    layout: SlideLayout
    names: tuple[str, ...]
    frames: Float32s  # (slide, time, channel), device counts
    materials: Int64s  # (slide,), class numbers; UNKNOWN if unlabelled
    digests: tuple[str, ...]
    speeds_m_s: Floats  # (slide,), NaN if not recorded

    def __len__(self) -> int:
        """Return the number of slides."""
        return len(self.names)

    def select(self, mask: Bools) -> Slides:
        """Return the slides selected by a mask (slide,)."""
        rows = np.flatnonzero(mask)
        return Slides(
            self.layout,
            tuple(self.names[row] for row in rows),
            self.frames[rows],
            self.materials[rows],
            tuple(self.digests[row] for row in rows),
            self.speeds_m_s[rows],
        )


BySensor = Mapping[str, Slides]


def read(
    recordings: Dataset,
    *,
    only: Sequence[str] = (),
    quantities: Sequence[str] = (TACTILE,),
    naming: Naming = NUMBERS,
    labelled: bool = False,
    advance: Callable[..., None] | None = None,
) -> dict[str, Slides]:
    """Return the slides by sensor; ``only`` contains the sensors to read, or is empty for all.

    ``naming`` maps labels to numbers. Columns of the ``quantities`` are read if a sensor has them. With ``labelled``, a
    slide without material raises an error. ``advance`` is called after each recording.

    Raises `TacpipeError` if a recording has no sensor or channel, or a value is not finite, and if slides of one sensor
    differ in channels, frames or rate.
    """
    by_sensor: dict[str, list[tuple[Recording, SlideLayout, Float32s]]] = {}
    present_sensors: set[str] = set()
    for shard in recordings.recordings.values() if labelled else ():  # check labels before reading any frame
        if not only or shard.attributes.get("sensor") in only:
            _require_label(shard, naming.key)
    for name, shard in sorted(recordings.recordings.items()):
        sensor = shard.attributes.get("sensor")
        if not isinstance(sensor, str):
            raise TacpipeError(
                f"Recording {name} has no label sensor; set it with `tacpipe label RECORDINGS {name} "
                f"--set sensor=biotac`, or what it is."
            )
        present_sensors.add(sensor)
        if not only or sensor in only:
            by_sensor.setdefault(sensor, []).append((shard, *frames(shard, sensor, quantities)))
        if advance is not None:
            advance(note=name)
    missing = sorted(set(only) - set(by_sensor))
    if missing:
        listed_sensors = ", ".join(sorted(present_sensors)) or "none"
        raise TacpipeError(f"No recording is of the sensor {missing[0]}; there are {listed_sensors}. Give others.")
    return {
        sensor: _stack_slides(sensor_slides, naming, labelled) for sensor, sensor_slides in sorted(by_sensor.items())
    }


def absent_quantities(recordings: Dataset, quantities: Sequence[str]) -> list[str]:
    """Return the quantities that no sensor has, checked on each sensor's first recording."""
    first = {shard.attributes.get("sensor"): shard for _, shard in sorted(recordings.recordings.items(), reverse=True)}
    present_quantities: set[str] = set()
    for shard in first.values():
        schema = shard.table(STREAM if STREAM in shard.streams else "").schema
        present_quantities |= {field_metadata(field).get("quantity", "") for field in schema if not is_truth(field)}
    return [quantity for quantity in quantities if quantity not in present_quantities]


def frames(shard: Recording, sensor: str, quantities: Sequence[str]) -> tuple[SlideLayout, Float32s]:
    """Return the layout of a slide and its frames (time, channel) in device counts. Raises the errors of `read`."""
    if STREAM not in shard.streams and "" not in shard.streams:
        raise TacpipeError(
            f"Recording {shard.name} has the streams {', '.join(shard.streams)} and none is a slide. "
            f"Run `tacpipe segment slides` first."
        )
    table = shard.table(STREAM if STREAM in shard.streams else "")
    channels = [
        field.name
        for field in table.schema
        if field_metadata(field).get("quantity") in quantities and not is_truth(field)
    ]
    if not channels:
        raise missing_channel_error(shard.name, " or ".join(quantities), table.schema)
    values = _columns(table, channels)
    count_rows(shard.name, STREAM if STREAM in shard.streams else "", RowCounts.all_used(len(values)))
    if not np.isfinite(values).all():
        row, column = np.argwhere(~np.isfinite(values))[0]
        raise TacpipeError(
            f"Recording {shard.name}, row {row}, {channels[column]} is not finite; a slide has a number in every frame. "
            f"Exclude the recording or segment it again."
        )
    rate_hz = float(shard.attributes.get("rate_hz") or _nominal_hz(table))
    return SlideLayout(
        sensor, tuple(channels), len(values), rate_hz, str(shard.attributes.get("layout") or "time")
    ), values


def _nominal_hz(table: pa.Table) -> float:
    """Return the rate of the rows from their median step; 0 without timestamps."""
    if "t_ns" not in table.column_names or table.num_rows < 2:
        return 0.0
    step_ns = float(np.median(np.diff(table.column("t_ns").to_numpy())))
    return round(1e9 / step_ns, 1) if step_ns > 0 else 0.0


def _columns(table: pa.Table, channels: Sequence[str]) -> Float32s:
    values = np.empty((table.num_rows, len(channels)), np.float32)
    for index, name in enumerate(channels):
        values[:, index] = table.column(name).to_numpy()
    return values


def _stack_slides(
    sensor_slides: Sequence[tuple[Recording, SlideLayout, Float32s]], naming: Naming, labelled: bool
) -> Slides:
    """Return the slides of one sensor. Raises `TacpipeError` for incompatible layouts, and the errors of `_material`."""
    first, layout, _ = sensor_slides[0]
    for shard, compared, _ in sensor_slides:
        if not layout.is_compatible(compared):
            raise TacpipeError(
                f"{shard.name} {describe_difference(layout, compared)} as {first.name}; slides of a sensor are alike. "
                f"`tacpipe segment slides` keeps as many frames of each (--frames, and --trigger load without static "
                f"pressure)."
            )
    return Slides(
        layout,
        tuple(shard.name for shard, _, _ in sensor_slides),
        np.stack([values for _, _, values in sensor_slides]),
        np.array([_material(shard, naming, labelled) for shard, _, _ in sensor_slides], np.int64),
        tuple(shard.digest for shard, _, _ in sensor_slides),
        np.array([shard.attributes.get("speed_m_s") or np.nan for shard, _, _ in sensor_slides], np.float64),
    )


def describe_difference(expected: SlideLayout, layout: SlideLayout) -> str:
    """Return a description of the difference between two layouts.

    >>> describe_difference(SlideLayout("a", ("x",), 400, 100.0), SlideLayout("a", ("x",), 75, 100.0))
    'has 75 frames, not 400'
    """
    if layout.channels != expected.channels:
        odd = [name for name in layout.channels if name not in expected.channels]
        detail = f", among them {odd[0]}" if odd else ""
        return f"has {len(layout.channels)} channels{detail}, not the same {len(expected.channels)}"
    if layout.frames != expected.frames:
        return f"has {layout.frames} frames, not {expected.frames}"
    if layout.layout != expected.layout:
        return f"has the layout {layout.layout}, not {expected.layout}"
    return f"has {layout.rate_hz:g} frames a second, not {expected.rate_hz:g}"


def _require_label(shard: Recording, key: str) -> None:
    """Raise `TacpipeError` if a slide has no label of its class."""
    if shard.attributes.get(key) is None:
        raise TacpipeError(
            f"Recording {shard.name} of the sensor {shard.attributes.get('sensor')} has no label {key} to learn from; set "
            f"it with `tacpipe label RECORDINGS {shard.name} --label {key}=…` or `tacpipe label RECORDINGS --from TABLE`, "
            f"or exclude it."
        )


def _material(shard: Recording, naming: Naming, labelled: bool) -> int:
    """Return the class number of a slide; `UNKNOWN` without a label or, unless ``labelled``, for an unlisted label.

    Raises `TacpipeError` for an unlisted label if ``labelled``.
    """
    label = shard.attributes.get(naming.key)
    try:
        return naming.number(label)
    except TacpipeError as error:
        if not labelled:
            return UNKNOWN
        raise TacpipeError(
            f"Recording {shard.name}: {error}. Correct it with `tacpipe label`, or exclude the recording."
        ) from error


def held_out_materials(
    assignments: str, classes: Sequence[int], sensors: Iterable[str], naming: Naming = NUMBERS
) -> dict[str, set[int]]:
    """Return the held-out materials of each sensor, from ``assignments`` like ``roboskin=17,18,19,20``.

    Raises `UsageError` for an unknown sensor or class.

    >>> held_out_materials("b=3,4", [1, 2, 3, 4], ["a", "b"])
    {'a': set(), 'b': {3, 4}}
    """
    by_sensor: dict[str, set[int]] = {name: set() for name in sensors}
    for name, numbers in Assignments(str, between=";").items(assignments).items():
        try:
            sensor_materials = {naming.read(word) for word in CommaList().items(numbers)}
        except ValueError:
            sensor_materials = {UNKNOWN}
        if name not in by_sensor or not sensor_materials <= set(classes):
            raise UsageError(
                f"hold_out names {name}={numbers}; the sensors are {', '.join(by_sensor)} and the classes "
                f"{listed(map(naming.name, classes), 20)}."
            )
        by_sensor[name] |= sensor_materials
    return by_sensor
