"""Map the change of a gel's colours to the slope of its surface.

The colour of a gel under lights of several directions depends on the slope of its surface (Johnson and Adelson 2009,
"Retrographic sensing for the measurement of surface texture and shape"). Yuan, Dong and Adelson 2017 ("GelSight:
high-resolution robot tactile sensors for estimating geometry and force") tabulate slopes by colour change from presses
of a ball. Here a polynomial of the relative change and of the place in the image takes the place of the table, because
the light differs from place to place.
"""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any

import numpy as np

from tacpipe.arrays import Bools, Floats
from tacpipe.errors import UsageError

FILE = "gel_map.npz"  # file of a map in the result of `tacpipe extract gel-map`
CELLS_ACROSS = 160  # approximate number of columns of the grid on which colours are averaged
COLOUR_DEGREES, PLACE_DEGREES = (1, 2), (0, 1, 2, 3)  # degrees of the polynomial among which the fit chooses
COLOUR_COUNTS, PLACE_COUNTS = (3, 9), (1, 3, 6, 10)  # number of terms up to each of these degrees


def grid_shape(height_px: int, width_px: int) -> tuple[int, int]:
    """Return the rows and columns of the grid of square cells on which the colours of an image are averaged.

    >>> grid_shape(240, 320), grid_shape(48, 64)
    ((120, 160), (48, 64))
    """
    step = max(1, round(width_px / CELLS_ACROSS))
    return height_px // step, width_px // step


def relative_change(means: Floats, background: Floats) -> Floats:
    """Return the change of each cell and colour as a fraction of the untouched gel; all have the shape (…, colour)."""
    change: Floats = (means - background) / np.maximum(background, 1)
    return change


def colour_terms(change: Floats) -> Floats:
    """Return the products of one and two colours (…, term) of ``change`` (…, colour); those of one colour come first."""
    indices = [pair for degree in COLOUR_DEGREES for pair in combinations_with_replacement(range(3), degree)]
    return np.stack([np.prod(change[..., list(pair)], axis=-1) for pair in indices], axis=-1)


def place_terms(rows: int, columns: int) -> Floats:
    """Return the products of powers of x and y (row, column, term), by degree; x and y are from -1 to 1."""
    y, x = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij")
    powers = [(power, degree - power) for degree in PLACE_DEGREES for power in range(degree + 1)]
    return np.stack([x**along * y**down for along, down in powers], axis=-1)


def cell_coefficients(shape: tuple[int, ...], weights: Floats) -> Floats:
    """Return the weight of each colour term in each cell (row, column, colour term, xy) of a grid with this shape."""
    coefficients: Floats = np.tensordot(place_terms(*shape[:2]), weights, axes=(2, 1))
    return coefficients


def polynomial_normals(change: Floats, coefficients: Floats) -> Floats:
    """Return normals (row, column, xy) for a relative change (row, column, colour), without limits."""
    normals: Floats = np.einsum("rct,rctk->rck", colour_terms(change), coefficients)
    return normals


@dataclass(frozen=True)
class GelMap:
    """The slope of a gel by relative colour change and place, as fitted to presses of balls."""

    width_px: int  # size of the images
    height_px: int
    mm_per_px: float
    background: Floats  # (row, column, colour), grey levels of the untouched gel
    weights: Floats  # (colour term, place term, xy)
    is_covered: Bools  # (row, column), whether a ball touched the cell in at least one press
    max_sine: float  # largest sine of the slopes in the presses
    rim_ratio: (
        float  # depth at the rim of a contact, as a fraction of the largest depth, because gel around it sinks too
    )

    @property
    def cell_mm(self) -> float:
        """The width of a cell."""
        return float(self.mm_per_px * self.width_px / self.background.shape[1])

    @cached_property
    def coefficients(self) -> Floats:
        """The weight of each colour term in each cell (row, column, colour term, xy)."""
        return cell_coefficients(self.background.shape, self.weights)

    def normals(self, change: Floats) -> tuple[Floats, Bools]:
        """Return normals (row, column, xy) for the relative change (row, column, colour), and whether each is a guess.

        A normal is the horizontal part of the unit normal that points out of the gel; its length is the sine of the
        slope. Sines beyond ``max_sine`` are limited to it. The result is a guess (row, column) there, and where no ball
        touched the gel.
        """
        normals = polynomial_normals(change, self.coefficients)
        sines = np.linalg.norm(normals, axis=-1)
        limited: Floats = normals * (self.max_sine / np.maximum(sines, self.max_sine))[..., None]
        return limited, (sines > self.max_sine) | ~self.is_covered

    def to_bytes(self) -> bytes:
        """Return the content of a file; equal maps give equal bytes."""
        content = io.BytesIO()
        arrays: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(self)}
        np.savez(content, **arrays)
        return content.getvalue()


def map_path(path: str) -> Path:
    """Return the file of a map, given the file or the result of `tacpipe extract gel-map`."""
    return Path(path) / FILE if Path(path).is_dir() else Path(path)


def read_map(path: Path) -> GelMap:
    """Return the map in a file that `GelMap.to_bytes` wrote. Raises `UsageError` for another file."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as content:
            arrays = {field.name: content[field.name] for field in fields(GelMap)}
        gel_map = GelMap(
            width_px=int(arrays["width_px"]),
            height_px=int(arrays["height_px"]),
            mm_per_px=float(arrays["mm_per_px"]),
            background=arrays["background"].astype(np.float64),
            weights=arrays["weights"].astype(np.float64),
            is_covered=arrays["is_covered"].astype(bool),
            max_sine=float(arrays["max_sine"]),
            rim_ratio=float(arrays["rim_ratio"]),
        )
        grid = grid_shape(gel_map.height_px, gel_map.width_px)
        shapes = (gel_map.background.shape, gel_map.weights.shape, gel_map.is_covered.shape)
        if shapes != ((*grid, 3), (COLOUR_COUNTS[-1], PLACE_COUNTS[-1], 2), grid) or not 0 < gel_map.max_sine < 1:
            raise ValueError("its arrays do not fit together")
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise UsageError(
            f"{path} is not the map of a gel ({error}). Give the folder that `tacpipe extract gel-map` wrote."
        ) from error
    return gel_map
