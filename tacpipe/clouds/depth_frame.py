"""What a depth camera sees at one moment: an image of distances, colours in register with it, and how its rays run."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Bytes, Counts, Float32s
from tacpipe.errors import TacpipeError

MAGIC = b"TPDF"
NEAREST, FARTHEST = 1e-3, 1e7  # of a focal length, and of the image's centre, in pixels
HEADER = struct.Struct("<4sHHBxxx5f")  # magic, width, height, whether colours follow; focal lengths, centre, unit


@dataclass(frozen=True)
class DepthFrame:
    """A depth image without distortion, and where its pixels look."""

    depth: Counts  # (row, column), along the optical axis in units of ``unit_m``; 0: nothing was measured
    focal: tuple[float, float]  # in pixels, along a row and along a column
    centre: tuple[float, float]  # the optical axis in the image: column, row
    unit_m: float  # metres a count of depth
    colours: Bytes | None = None  # (row, column, rgb)

    def points(self) -> tuple[Float32s, Bytes | None]:
        """Return the points that were measured (point, xyz), metres, and their colours (point, rgb).

        In the camera's frame: x to the right of the image, y down, z along the optical axis.
        """
        rows, columns = np.nonzero(self.depth)
        z = self.depth[rows, columns].astype(np.float64) * self.unit_m
        x = (columns - self.centre[0]) / self.focal[0] * z
        y = (rows - self.centre[1]) / self.focal[1] * z
        colours = None if self.colours is None else self.colours[rows, columns]
        return np.column_stack([x, y, z]).astype(np.float32), colours

    def to_bytes(self) -> bytes:
        """Return the frame as a link hands it on: a header, depth as u16 little-endian, colours as bytes."""
        height, width = self.depth.shape
        coloured = self.colours is not None
        head = HEADER.pack(MAGIC, width, height, coloured, *self.focal, *self.centre, self.unit_m)
        return head + self.depth.astype("<u2").tobytes() + (self.colours.tobytes() if self.colours is not None else b"")

    @classmethod
    def of_bytes(cls, content: bytes) -> DepthFrame:
        """Return the frame that `to_bytes` gave. Raises `TacpipeError` where it is none or was cut off."""
        if len(content) < HEADER.size or not content.startswith(MAGIC):
            raise TacpipeError(f"{len(content)} bytes are not a depth frame; it must begin with {MAGIC.decode()}.")
        _, width, height, coloured, *optics = HEADER.unpack_from(content)
        pixels = width * height
        if len(content) != HEADER.size + pixels * (5 if coloured else 2):
            raise TacpipeError(
                f"A depth frame of {width} x {height} pixels came with {len(content)} bytes; it was cut off."
            )
        if not (all(NEAREST <= one <= FARTHEST for one in optics[:2]) and max(map(abs, optics[2:4])) <= FARTHEST):
            raise TacpipeError(f"A depth frame has the optics {optics[:4]}, pixels; no camera has.")
        if not 0 < optics[4] <= 1:
            raise TacpipeError(f"A depth frame counts in units of {optics[4]:g} m; it must be above 0 and at most 1.")
        depth = np.frombuffer(content, "<u2", pixels, HEADER.size).reshape(height, width).astype(np.uint16)
        start = HEADER.size + 2 * pixels
        colours = np.frombuffer(content, np.uint8, 3 * pixels, start).reshape(height, width, 3) if coloured else None
        return cls(depth, (optics[0], optics[1]), (optics[2], optics[3]), optics[4], colours)
