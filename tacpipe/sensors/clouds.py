"""Clouds of points: what a depth camera sees, or the files that its program leaves in a folder, one cloud at a time.

A chunk is one cloud: the content of a PLY or PCD file, or a `tacpipe.clouds.cloud.DepthFrame`. Each of its points is
a row of the stream, all with the stamp of the cloud, in the columns of the stream ``scene`` that `tacpipe segment grasps`
reads.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from tacpipe.arrays import Bytes, Float32s
from tacpipe.clouds import point_files
from tacpipe.clouds.cloud import MAGIC, Cloud, DepthFrame
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.sensors.byte_framer import TextFramer
from tacpipe.sensors.framing import Framer
from tacpipe.sensors.sensor import Samples, Sensor

if TYPE_CHECKING:
    import pyarrow as pa

NAMED = Path("a cloud")  # name in errors, as the file name is not known any more
AT_HAND = 4  # clouds that are kept between the framer's look at them and their decoding


@dataclass(frozen=True)
class Clouds(Sensor):
    """A source of clouds. Points that were not seen (NaN, or no depth) are left out."""

    summary: ClassVar[str] = "Depth cameras, and folders that clouds are saved to (PLY, PCD)."
    links: ClassVar[tuple[str, ...]] = ("folder", "camera")

    colour: bool = True  # clouds have colours; one without is then refused, as is one with where this is false
    unit_m: float = 1.0  # metres a unit of the files: 0.001 where they are in millimetres
    rate_hz: float = 0.0  # clouds a second; 0: they come when they come

    def __post_init__(self) -> None:
        if not self.unit_m > 0:
            raise UsageError(
                f"clouds: unit_m is {self.unit_m:g}; it must be above 0: 1 for metres, 0.001 for millimetres."
            )

    def fields(self) -> list[pa.Field]:
        """Return ``x_m``, ``y_m``, ``z_m``, float32, and with ``colour`` ``red``, ``green``, ``blue``, uint8."""
        colours = np.zeros((0, 3), np.uint8) if self.colour else None
        return list(Cloud(np.zeros((0, 3), np.float32), colours).table().schema)

    def framer(self) -> Framer:
        """Return a framer that takes chunks which are clouds, with colours as the options state."""
        return TextFramer(self._is_right)

    def decode(self, frames: Sequence[bytes]) -> Samples:
        """Return a row for each point; ``rows`` states of which cloud it is."""
        clouds = [self._points(frame) for frame in frames]
        points = [xyz for xyz, _ in clouds] or [np.zeros((0, 3), np.float32)]
        rows = np.repeat(np.arange(len(clouds)), [len(xyz) for xyz, _ in clouds]).astype(np.int64)
        values: tuple[Float32s | Bytes, ...] = (np.concatenate(points),)
        if self.colour:
            values += (np.concatenate([rgb for _, rgb in clouds if rgb is not None] or [np.zeros((0, 3), np.uint8)]),)
        return Samples(values, rows=rows)

    def encode(self, samples: Samples) -> list[bytes]:
        """Return the PLY files that hold these points, one for each cloud."""
        assert samples.rows is not None
        points = (samples.values[0] / np.float32(self.unit_m)).astype(np.float32)
        edges = np.flatnonzero(np.diff(samples.rows)) + 1
        groups = np.split(np.arange(len(samples)), edges)
        return [point_files.pack_ply(points[rows], samples.values[1][rows] if self.colour else None) for rows in groups]

    def _points(self, content: bytes) -> tuple[Float32s, Bytes | None]:
        """Return the points that were seen (point, xyz), metres, and their colours (point, rgb)."""
        xyz, colours = _parsed(content)
        is_finite = np.isfinite(xyz).all(axis=1)
        scale = np.float32(1.0 if content.startswith(MAGIC) else self.unit_m)
        return xyz[is_finite] * scale, None if colours is None else colours[is_finite]

    def _is_right(self, content: bytes) -> bool:
        try:
            _, colours = _parsed(content)
        except TacpipeError:
            return False
        return (colours is not None) == self.colour


@functools.lru_cache(maxsize=AT_HAND)
def _parsed(content: bytes) -> tuple[Float32s, Bytes | None]:
    """Return points and colours as they stand in a chunk. Raises `TacpipeError` where it is not a cloud."""
    if content.startswith(MAGIC):
        return DepthFrame.of_bytes(content).points()
    if content.startswith(b"ply"):
        return point_files.parse_ply(NAMED, content)
    return point_files.parse_pcd(NAMED, content)
