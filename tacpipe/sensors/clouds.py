"""Point clouds from a depth camera, or from files that another program saves to a folder.

A chunk is one cloud: the content of a PLY or PCD file, or a `tacpipe.clouds.cloud.DepthFrame`. Each point is a row with the
timestamp of its cloud. The columns are those of the stream ``scene`` that `tacpipe segment grasps` reads.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Bytes, Float32s
from tacpipe.clouds import point_files
from tacpipe.clouds.cloud import MAGIC, Cloud, DepthFrame
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.sensors.byte_framer import TextFramer
from tacpipe.sensors.framing import Framer
from tacpipe.sensors.sensor import Samples, Sensor

NAME = Path("a cloud")  # name in errors, because the file name is not known here
CACHED = 4  # number of cached clouds, because the framer and the decoder parse the same clouds


@dataclass(frozen=True)
class Clouds(Sensor):
    """A source of point clouds. Points without a measurement (NaN, or no depth) are dropped."""

    summary: ClassVar[str] = "Depth cameras, and folders to which clouds are saved (PLY, PCD)."
    links: ClassVar[tuple[str, ...]] = ("folder", "camera")

    colour: bool = True  # True if the clouds have colours; clouds that differ are refused
    unit_m: float = 1.0  # metres per unit of the files: 0.001 for millimetres
    rate_hz: float = 0.0  # clouds per second; 0: irregular

    def __post_init__(self) -> None:
        if not self.unit_m > 0:
            raise UsageError(
                f"clouds: unit_m is {self.unit_m:g}; it must be above 0, such as 1 for metres or 0.001 for millimetres."
            )

    def fields(self) -> list[pa.Field]:
        """Return ``x_m``, ``y_m``, ``z_m`` (float32), and with ``colour`` also ``red``, ``green``, ``blue`` (uint8)."""
        colours = np.zeros((0, 3), np.uint8) if self.colour else None
        return list(Cloud(np.zeros((0, 3), np.float32), colours).table().schema)

    def framer(self) -> Framer:
        """Return a framer for chunks that are clouds, with or without colours as in the options."""
        return TextFramer(self._is_valid)

    def decode(self, frames: Sequence[bytes]) -> Samples:
        """Return one row per point; ``rows`` is the index of its cloud."""
        clouds = [self._points(frame) for frame in frames]
        points = [xyz for xyz, _ in clouds] or [np.zeros((0, 3), np.float32)]
        rows = np.repeat(np.arange(len(clouds)), [len(xyz) for xyz, _ in clouds]).astype(np.int64)
        values: tuple[Float32s | Bytes, ...] = (np.concatenate(points),)
        if self.colour:
            values += (np.concatenate([rgb for _, rgb in clouds if rgb is not None] or [np.zeros((0, 3), np.uint8)]),)
        return Samples(values, rows=rows)

    def encode(self, samples: Samples) -> list[bytes]:
        """Return these points as PLY files, one per cloud."""
        assert samples.rows is not None
        points = (samples.values[0] / np.float32(self.unit_m)).astype(np.float32)
        edges = np.flatnonzero(np.diff(samples.rows)) + 1
        groups = np.split(np.arange(len(samples)), edges)
        return [point_files.pack_ply(points[rows], samples.values[1][rows] if self.colour else None) for rows in groups]

    def _points(self, content: bytes) -> tuple[Float32s, Bytes | None]:
        """Return the points of a cloud (point, xyz) in metres, and their colours (point, rgb) or None.

        Points that were not measured are left out.
        """
        xyz, colours = _parse(content)
        is_finite = np.isfinite(xyz).all(axis=1)
        scale = np.float32(1.0 if content.startswith(MAGIC) else self.unit_m)
        return xyz[is_finite] * scale, None if colours is None else colours[is_finite]

    def _is_valid(self, content: bytes) -> bool:
        """Return whether a chunk is a cloud, with colours if they are expected."""
        try:
            _, colours = _parse(content)
        except TacpipeError:
            return False
        return (colours is not None) == self.colour


@functools.lru_cache(maxsize=CACHED)
def _parse(content: bytes) -> tuple[Float32s, Bytes | None]:
    """Return the points (point, xyz) of a chunk, and their colours (point, rgb) or None.

    Raises `TacpipeError` if it is not a cloud.
    """
    if content.startswith(MAGIC):
        return DepthFrame.from_bytes(content).points()
    if content.startswith(b"ply"):
        return point_files.parse_ply(NAME, content)
    return point_files.parse_pcd(NAME, content)
