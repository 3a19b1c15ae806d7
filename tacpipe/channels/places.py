"""Place the taxels of a sensor: at published positions, or on a grid by row and column numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.channels import biotac_sp, schema

if TYPE_CHECKING:
    import pyarrow as pa

USKIN_PITCH_M = 0.0047  # distance of the taxels of a XELA uSkin 4x4, an assumption
ROBOSKIN_PITCH_M = 0.0067  # distance of the taxels of a RoboSkin triangle
ROBOSKIN_SIDE_M = 0.030  # side of a RoboSkin triangle
BIOTAC_M = (
    0.001
    * np.array(  # (electrode, axis) of a BioTac; x along the finger to its tip, z from the pad into the finger
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
)


def uskin_m() -> Floats:
    """Return where the taxels of a XELA uSkin 4x4 lie, metres (taxel, axis), around its centre."""
    line_m = (np.arange(4) - 1.5) * USKIN_PITCH_M
    return np.stack(np.meshgrid(line_m, line_m, indexing="ij"), axis=-1).reshape(-1, 2)


def roboskin_m() -> Floats:
    """Return where the taxels of a patch of six RoboSkin triangles lie, metres (taxel, axis): along the strip and across it.

    An assumption after the iCub's documentation: triangles of 30 mm side, in a strip, of which every other one points the
    other way; in each, taxels in rows of 4, 3, 2 and 1, the fourth being the one in the centre.
    """
    rows = [(row, place) for row, width in enumerate((4, 3, 2, 1)) for place in range(width)]
    module = np.array([[place - (3 - row) / 2, (row - 1) * np.sqrt(3) / 2] for row, place in rows]) * ROBOSKIN_PITCH_M
    module[[3, 5]] = module[[5, 3]]  # the fourth is the one in the centre
    triangles = []
    for triangle in range(schema.TRIANGLES):
        sign = 1 - 2 * (triangle % 2)
        along = (triangle - (schema.TRIANGLES - 1) / 2) * ROBOSKIN_SIDE_M / 2
        triangles.append(module * sign + [along, -sign * ROBOSKIN_SIDE_M / 12 * np.sqrt(3)])
    return np.concatenate(triangles)


def unrolled_m(places_m: Floats) -> Floats:
    """Return places (electrode, xyz) of a BioTac's core rolled out flat, metres (electrode, axis): along, around."""
    along, across, depth = places_m.T
    return np.column_stack([along, np.hypot(across, depth) * np.arctan2(across, -depth)])


def grid(rows: Sequence[int], columns: Sequence[int]) -> Floats:
    """Return places (taxel, axis) on a grid of unit pitch, x to the right by column and y up, row 1 at the top.

    >>> grid([1, 1, 2], [1, 2, 1]).tolist()
    [[1.0, -1.0], [2.0, -1.0], [1.0, -2.0]]
    """
    return np.column_stack([columns, -np.asarray(rows)]).astype(np.float64)


def near_square(count: int) -> Floats:
    """Return places (taxel, axis) of taxels of which nothing is known: row by row on a grid about as wide as high.

    >>> near_square(3).tolist()
    [[1.0, -1.0], [2.0, -1.0], [1.0, -2.0]]
    """
    width = int(np.ceil(np.sqrt(count)))
    number = np.arange(count)
    return grid((number // width + 1).tolist(), (number % width + 1).tolist())


def of_taxels(fields: Sequence[pa.Field]) -> tuple[Floats, str]:
    """Return where taxels lie (taxel, axis), right and up, and the unit: mm, or grid. ``fields`` has a column of each.

    Row and column numbers in the field metadata come first, then the layouts of the sensors that are known by how their
    columns are numbered: XELA uSkin, BioTac, BioTac SP, RoboSkin. All others lie row by row on a grid of unit pitch.
    """
    about = [{key.decode(): value.decode() for key, value in (entry.metadata or {}).items()} for entry in fields]
    if about and all(entry.get("row", "").isdigit() and entry.get("column", "").isdigit() for entry in about):
        return grid([int(entry["row"]) for entry in about], [int(entry["column"]) for entry in about]), "grid"
    layout = _sensor_layout(about)
    if layout is None:
        return near_square(len(about)), "grid"
    places_m, numbers = layout
    if not numbers or min(numbers) < 1 or max(numbers) > len(places_m):
        return near_square(len(about)), "grid"
    return places_m[np.array(numbers) - 1] * 1e3, "mm"


def _sensor_layout(about: Sequence[dict[str, str]]) -> tuple[Floats, list[int]] | None:
    """Return the layout of a known sensor and the number of each taxel in it, from 1; None for an unknown one."""
    if all("electrode" in entry for entry in about):
        if len(about) == biotac_sp.ELECTRODES:
            return biotac_sp.unrolled_m()[:, ::-1], _numbers(about, "electrode")  # the tip is at the top
        return unrolled_m(BIOTAC_M)[:, ::-1], _numbers(about, "electrode")
    if all("triangle" in entry and "taxel" in entry for entry in about):
        pairs = zip(_numbers(about, "triangle"), _numbers(about, "taxel"), strict=True)
        complete = len(about) == schema.TRIANGLES * schema.TRIANGLE_TAXELS
        return (roboskin_m(), [(t - 1) * schema.TRIANGLE_TAXELS + n for t, n in pairs]) if complete else None
    if len(about) == schema.TAXELS and all("taxel" in entry for entry in about):
        return uskin_m(), _numbers(about, "taxel")
    return None


def _numbers(about: Sequence[dict[str, str]], name: str) -> list[int]:
    return [int(entry[name]) if entry[name].isdigit() else 0 for entry in about]
