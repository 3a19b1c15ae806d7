"""Slides of a dataset as arrays, one bundle a sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import Bools, Float32s, Floats, Int64s
from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording

STREAM = "slide"
TACTILE = "tactile"
UNKNOWN = -1  # stands where a slide has no material


@dataclass(frozen=True)
class Layout:
    """What a sensor's slides look like: which channels, how many frames, how many a second, and how they are arranged."""

    sensor: str
    channels: tuple[str, ...]
    frames: int
    rate_hz: float
    layout: str = "time"  # frames in the order of time; authors: as published, in another one

    def to_json(self) -> dict[str, Any]:
        """Return what `from_json` reads."""
        named = {"frames": self.frames, "rate_hz": self.rate_hz, "layout": self.layout}
        return {"channels": list(self.channels), **named}

    @classmethod
    def from_json(cls, sensor: str, stored: dict[str, Any]) -> Layout:
        """Return the layout that `to_json` wrote."""
        return cls(sensor, tuple(stored["channels"]), int(stored["frames"]), float(stored["rate_hz"]), stored["layout"])


@dataclass(frozen=True)
class Slides:
    """The slides of one sensor."""

    layout: Layout
    names: tuple[str, ...]
    frames: Float32s  # (slide, time, channel), device counts
    materials: Int64s  # (slide,); UNKNOWN where none is labelled
    digests: tuple[str, ...]
    speeds_m_s: Floats  # (slide,); NaN where none is recorded

    def __len__(self) -> int:
        """Return how many slides there are."""
        return len(self.names)

    def some(self, chosen: Bools) -> Slides:
        """Return the slides that a mask (slide,) chooses."""
        at = np.flatnonzero(chosen)
        return Slides(
            self.layout,
            tuple(self.names[i] for i in at),
            self.frames[at],
            self.materials[at],
            tuple(self.digests[i] for i in at),
            self.speeds_m_s[at],
        )


def read(
    recordings: Dataset,
    *,
    only: Sequence[str] = (),
    quantities: Sequence[str] = (TACTILE,),
    labelled: bool = False,
) -> dict[str, Slides]:
    """Return the slides of each sensor, by name; ``only`` names the sensors to read, none being all.

    Columns of the ``quantities`` are read, as far as a sensor has them. ``labelled`` refuses slides without a material.
    Raises `TacpipeError` where a recording names no sensor, holds no channel or a value that is not finite, and where
    slides of one sensor differ in channels, frames or rate.
    """
    found: dict[str, list[tuple[Recording, Layout, Float32s]]] = {}
    there: set[str] = set()
    for name, shard in sorted(recordings.recordings.items()):
        sensor = shard.attributes.get("sensor")
        if not isinstance(sensor, str):
            raise TacpipeError(
                f"Recording {name} has no label sensor; set it with `tacpipe label RECORDINGS {name} "
                f"--set sensor=biotac`, or what it is."
            )
        there.add(sensor)
        if only and sensor not in only:
            continue
        found.setdefault(sensor, []).append((shard, *_frames(shard, sensor, quantities)))
    missing = sorted(set(only) - set(found))
    if missing:
        known = ", ".join(sorted(there)) or "none"
        raise TacpipeError(f"No recording is of the sensor {missing[0]}; there are {known}. Give others.")
    return {sensor: _bundle(several, labelled) for sensor, several in sorted(found.items())}


def _frames(shard: Recording, sensor: str, quantities: Sequence[str]) -> tuple[Layout, Float32s]:
    """Return the layout of a slide and its frames (time, channel)."""
    if STREAM not in shard.streams and "" not in shard.streams:
        raise TacpipeError(
            f"Recording {shard.name} has the streams {', '.join(shard.streams)} and none is a slide. "
            f"Run `tacpipe segment slides` first."
        )
    table = shard.table(STREAM if STREAM in shard.streams else "")
    wanted = {quantity.encode() for quantity in quantities}
    channels = [field.name for field in table.schema if (field.metadata or {}).get(b"quantity") in wanted]
    if not channels:
        wanted_quantity = " or ".join(quantities)
        raise TacpipeError(
            f"Recording {shard.name} has no {wanted_quantity} channel: no column's quantity is {wanted_quantity}."
        )
    values = _columns(table, channels)
    if not np.isfinite(values).all():
        row, column = np.argwhere(~np.isfinite(values))[0]
        raise TacpipeError(
            f"Recording {shard.name}, row {row}, {channels[column]} is not finite; a slide has a number in every frame. "
            f"Exclude the recording or segment it again."
        )
    rate_hz = float(shard.attributes.get("rate_hz") or 0.0)
    return Layout(sensor, tuple(channels), len(values), rate_hz, str(shard.attributes.get("layout") or "time")), values


def _columns(table: pa.Table, channels: Sequence[str]) -> Float32s:
    values = np.empty((table.num_rows, len(channels)), np.float32)
    for index, name in enumerate(channels):
        values[:, index] = table.column(name).to_numpy()
    return values


def _bundle(several: Sequence[tuple[Recording, Layout, Float32s]], labelled: bool) -> Slides:
    """Return the slides of one sensor, alike in layout."""
    first, layout, _ = several[0]
    for shard, other, _ in several:
        if other != layout:
            raise TacpipeError(
                f"{shard.name} {difference(layout, other)} as {first.name}; slides of a sensor are alike."
            )
    return Slides(
        layout,
        tuple(shard.name for shard, _, _ in several),
        np.stack([values for _, _, values in several]),
        np.array([_material(shard, labelled) for shard, _, _ in several], np.int64),
        tuple(shard.digest for shard, _, _ in several),
        np.array([shard.attributes.get("speed_m_s") or np.nan for shard, _, _ in several], np.float64),
    )


def difference(wanted: Layout, found: Layout) -> str:
    """Return in words how one layout differs from another.

    >>> difference(Layout("a", ("x",), 400, 100.0), Layout("a", ("x",), 75, 100.0))
    'has 75 frames, not 400'
    """
    if found.channels != wanted.channels:
        odd = [name for name in found.channels if name not in wanted.channels]
        more = f", among them {odd[0]}" if odd else ""
        return f"has {len(found.channels)} channels{more}, not the same {len(wanted.channels)}"
    if found.frames != wanted.frames:
        return f"has {found.frames} frames, not {wanted.frames}"
    if found.layout != wanted.layout:
        return f"has the layout {found.layout}, not {wanted.layout}"
    return f"has {found.rate_hz:g} frames a second, not {wanted.rate_hz:g}"


def _material(shard: Recording, labelled: bool) -> int:
    """Return the number of a slide's material."""
    material = shard.attributes.get("material")
    if isinstance(material, int) and not isinstance(material, bool) and material >= 0:
        return material
    if material is not None:
        raise TacpipeError(
            f"Recording {shard.name} has material {material!r}; materials are whole numbers from 0. Set it right with "
            f"`tacpipe label`."
        )
    if labelled:
        raise TacpipeError(
            f"Recording {shard.name} of the sensor {shard.attributes.get('sensor')} has no material to learn from; set it "
            f"with `tacpipe label RECORDINGS {shard.name} --set material=3`, or exclude it."
        )
    return UNKNOWN


def quantities(given: str) -> tuple[str, ...]:
    """Return the quantities that ``given`` names, with commas between.

    >>> quantities("tactile, vibration")
    ('tactile', 'vibration')
    """
    return tuple(part.strip() for part in given.split(",") if part.strip())
