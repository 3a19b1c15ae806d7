"""Return positions of taxels: published ones, or a grid from row and column numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Floats
from tacpipe.channels import biotac_sp, schema

USKIN_PITCH_M = 0.0047  # pitch of the taxels of a XELA uSkin 4x4, an assumption
ROBOSKIN_PITCH_M = 0.0067  # pitch of the taxels of a RoboSkin triangle
ROBOSKIN_SIDE_M = 0.030  # side of a RoboSkin triangle
BIOTAC_M = 0.001 * np.array(  # (electrode, axis) of a BioTac; x points to the fingertip, z from the pad into the finger
    [
        [0.993, -4.855, -1.116],
        [-2.700, -3.513, -3.670],
        [-6.200, -3.513, -3.670],
        [-8.000, -4.956, -1.116],
        [-10.500, -3.513, -3.670],
        [-13.400, -4.956, -1.116],
        [4.763, 0.000, -2.330],
        [3.031, -1.950, -3.330],
        [3.031, 1.950, -3.330],
        [1.299, 0.000, -4.330],
        [0.993, 4.855, -1.116],
        [-2.700, 3.513, -3.670],
        [-6.200, 3.513, -3.670],
        [-8.000, 4.956, -1.116],
        [-10.500, 3.513, -3.670],
        [-13.400, 4.956, -1.116],
        [-2.800, 0.000, -5.080],
        [-9.800, 0.000, -5.080],
        [-13.600, 0.000, -5.080],
    ]
)


def uskin_m() -> Floats:
    """Return the positions of the taxels of a XELA uSkin 4x4 in metres (taxel, axis), relative to its centre."""
    line_m = (np.arange(4) - 1.5) * USKIN_PITCH_M
    return np.stack(np.meshgrid(line_m, line_m, indexing="ij"), axis=-1).reshape(-1, 2)


def roboskin_m() -> Floats:
    """Return the positions of the taxels of six RoboSkin triangles in metres (taxel, axis): along and across the strip.

    The layout is assumed from the iCub's documentation: a strip of triangles of 30 mm side with alternating direction,
    each with taxels in rows of 4, 3, 2 and 1, of which the fourth taxel is in the centre.
    """
    cells = [(row, column) for row, width in enumerate((4, 3, 2, 1)) for column in range(width)]
    module = (
        np.array([[column - (3 - row) / 2, (row - 1) * np.sqrt(3) / 2] for row, column in cells]) * ROBOSKIN_PITCH_M
    )
    module[[3, 5]] = module[[5, 3]]  # the fourth taxel is in the centre
    triangles = []
    for triangle in range(schema.TRIANGLES):
        sign = 1 - 2 * (triangle % 2)
        along = (triangle - (schema.TRIANGLES - 1) / 2) * ROBOSKIN_SIDE_M / 2
        triangles.append(module * sign + [along, -sign * ROBOSKIN_SIDE_M / 12 * np.sqrt(3)])
    return np.concatenate(triangles)


def unroll_m(places_m: Floats) -> Floats:
    """Unroll positions (electrode, xyz) on a BioTac's core to (electrode, axis) in metres: along, around."""
    along, across, depth = places_m.T
    return np.column_stack([along, np.hypot(across, depth) * np.arctan2(across, -depth)])


def grid(rows: Sequence[int], columns: Sequence[int]) -> Floats:
    """Return positions (taxel, axis) on a grid of unit pitch: x to the right by column, y up, row 1 at the top.

    >>> grid([1, 1, 2], [1, 2, 1]).tolist()
    [[1.0, -1.0], [2.0, -1.0], [1.0, -2.0]]
    """
    return np.column_stack([columns, -np.asarray(rows)]).astype(np.float64)


def square_grid(count: int) -> Floats:
    """Return positions (taxel, axis) row by row on an approximately square grid, for an unknown layout.

    >>> square_grid(3).tolist()
    [[1.0, -1.0], [2.0, -1.0], [1.0, -2.0]]
    """
    width = int(np.ceil(np.sqrt(count)))
    number = np.arange(count)
    return grid((number // width + 1).tolist(), (number % width + 1).tolist())


def taxel_positions(fields: Sequence[pa.Field]) -> tuple[Floats, str]:
    """Return positions (taxel, axis), right and up, and their unit, mm or grid. ``fields`` has one field per taxel.

    Row and column numbers in the field metadata have precedence. XELA uSkin, BioTac, BioTac SP and RoboSkin are
    recognised by the numbers of their columns. Other taxels are placed row by row on a grid of unit pitch.
    """
    metadata = [schema.field_metadata(entry) for entry in fields]
    if metadata and all(entry.get("row", "").isdigit() and entry.get("column", "").isdigit() for entry in metadata):
        return grid([int(entry["row"]) for entry in metadata], [int(entry["column"]) for entry in metadata]), "grid"
    layout = _sensor_layout(metadata)
    if layout is None:
        return square_grid(len(metadata)), "grid"
    places_m, numbers = layout
    if not numbers or min(numbers) < 1 or max(numbers) > len(places_m):
        return square_grid(len(metadata)), "grid"
    return places_m[np.array(numbers) - 1] * 1e3, "mm"


def _sensor_layout(metadata: Sequence[dict[str, str]]) -> tuple[Floats, list[int]] | None:
    """Return the layout of a known sensor (taxel, axis) in metres and the number of each taxel, from 1, or None."""
    if all("electrode" in entry for entry in metadata):
        if len(metadata) == biotac_sp.ELECTRODES:
            return biotac_sp.unrolled_positions_m()[:, ::-1], _numbers(metadata, "electrode")  # the tip is at the top
        return unroll_m(BIOTAC_M)[:, ::-1], _numbers(metadata, "electrode")
    if all("triangle" in entry and "taxel" in entry for entry in metadata):
        pairs = zip(_numbers(metadata, "triangle"), _numbers(metadata, "taxel"), strict=True)
        if len(metadata) != schema.TRIANGLES * schema.TRIANGLE_TAXELS:
            return None
        return roboskin_m(), [(triangle - 1) * schema.TRIANGLE_TAXELS + taxel for triangle, taxel in pairs]
    if len(metadata) == schema.TAXELS and all("taxel" in entry for entry in metadata):
        return uskin_m(), _numbers(metadata, "taxel")
    return None


def _numbers(metadata: Sequence[dict[str, str]], name: str) -> list[int]:
    return [int(entry[name]) if entry[name].isdigit() else 0 for entry in metadata]
