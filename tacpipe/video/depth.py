"""Compute the depth of a gel's surface from its slopes, and from frames the channels of depth.

Depth is the least-squares solution of its gradients. Frankot and Chellappa 1988 ("A method for enforcing integrability
in shape from shading algorithms") solve this in the Fourier domain; with free borders, as here, the equation of Poisson
is diagonal under the discrete cosine transform.
"""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Bytes, Floats
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.video.channels import UntouchedGel, cell_metadata
from tacpipe.video.decoding import cell_means
from tacpipe.video.gel_map import GelMap, map_path, read_map, relative_change

if TYPE_CHECKING:
    import pyarrow as pa

SUMMARIES = {  # columns next to the grid: unit, quantity
    "contact_area": ("mm^2", "area"),
    "contact_volume": ("mm^3", "volume"),
    "deepest": ("mm", "displacement"),
    "deepest_x": ("mm", "distance"),
    "deepest_y": ("mm", "distance"),
    "guessed_ratio": ("1", "quality"),
}


@cache
def _cosines(count: int) -> tuple[Floats, Floats]:
    """Return the orthonormal cosine transform (frequency, sample), and the eigenvalues of the second difference."""
    frequencies = np.arange(count)
    basis = np.cos(np.pi * np.outer(frequencies, np.arange(count) + 0.5) / count)
    basis /= np.linalg.norm(basis, axis=1, keepdims=True)
    return basis, 2 - 2 * np.cos(np.pi * frequencies / count)


def integrate(gradients: Floats) -> Floats:
    """Return the surface (row, column) of mean 0 whose gradients per cell are nearest to ``gradients`` (row, column, xy).

    The gradient between two cells is the mean of theirs.
    """
    rows, columns, _ = gradients.shape
    across = (gradients[:, 1:, 0] + gradients[:, :-1, 0]) / 2
    down = (gradients[1:, :, 1] + gradients[:-1, :, 1]) / 2
    divergence = np.zeros((rows, columns))  # transposed difference of the gradients
    divergence[:, 1:] += across
    divergence[:, :-1] -= across
    divergence[1:] += down
    divergence[:-1] -= down
    (row_basis, row_values), (column_basis, column_values) = _cosines(rows), _cosines(columns)
    values = row_values[:, None] + column_values
    values[0, 0] = np.inf
    surface: Floats = row_basis.T @ (row_basis @ divergence @ column_basis.T / values) @ column_basis
    return surface


def depth_from_normals(normals: Floats, cell_mm: float) -> Floats:
    """Return the depth in mm (row, column), given horizontal parts of unit normals (row, column, xy).

    Depth is positive where the gel is pressed in. Its zero is the median over the flatter half of the cells.
    """
    squares = (normals**2).sum(axis=-1)
    surface = cell_mm * integrate(-normals / np.sqrt(1 - squares)[..., None])
    depth: Floats = surface - np.median(surface[squares <= np.median(squares)])
    return depth


class DepthChannels:
    """The depth of a gel on a grid, its contact area and volume, and its deepest point.

    With 0 ``reference_frames``, the untouched gel is that of the map, else the mean of the first frames. ``place`` names
    the stream in errors.
    """

    grey = False

    def __init__(
        self, gel_map: GelMap, grid: tuple[int, int], reference_frames: int, contact_mm: float, place: str
    ) -> None:
        self._map, self._grid, self._contact_mm, self._place = gel_map, grid, contact_mm, place
        self._untouched = UntouchedGel(reference_frames, place) if reference_frames else None

    @classmethod
    def from_params(cls, params: Any, place: str) -> DepthChannels:
        """Return the channels for the params of `tacpipe extract depth`.

        Raises `UsageError` if they name no map, or a grid that is finer than the map's.
        """
        if not params.map:
            raise UsageError("map names no file. Give the result of `tacpipe extract gel-map` with --map.")
        gel_map = read_map(map_path(params.map))
        rows, columns = gel_map.is_covered.shape
        if params.rows > rows or params.columns > columns:
            raise UsageError(
                f"The map has {columns} x {rows} cells, and the grid {params.columns} x {params.rows}. Choose fewer with "
                f"--columns and --rows."
            )
        return cls(gel_map, (params.rows, params.columns), params.reference_frames, params.contact_mm, place)

    def fields(self) -> list[pa.Field]:
        """Return the fields ``taxel0101`` …, named by row and column from 1, as float32 mm, and those of `SUMMARIES`."""
        import pyarrow as pa

        rows, columns = self._grid
        cells = [
            pa.field(
                f"taxel{row:02d}{column:02d}",
                pa.float32(),
                metadata={"unit": "mm", **cell_metadata(row, column, columns), "component": "depth"},
            )
            for row, column in product(range(1, rows + 1), range(1, columns + 1))
        ]
        summaries = [
            pa.field(name, pa.float32(), metadata={"unit": unit, "quantity": quantity})
            for name, (unit, quantity) in SUMMARIES.items()
        ]
        return [*cells, *summaries]

    def values(self, image: Bytes) -> AnyFloats:
        """Return the depth of the next frame on the grid, row by row, and the values of `SUMMARIES` (field,).

        The place of the deepest point is NaN without contact. Raises `TacpipeError` if images have another size than
        those of the map.
        """
        if image.shape[:2] != (self._map.height_px, self._map.width_px):
            raise TacpipeError(
                f"{self._place}: frames have {image.shape[1]} x {image.shape[0]} pixels, and the map was fitted to "
                f"{self._map.width_px} x {self._map.height_px}. Fit a map to presses that this camera recorded."
            )
        means = cell_means(image, *self._map.background.shape[:2])
        background = self._untouched.update(means) if self._untouched else self._map.background
        normals, is_guess = self._map.normals(relative_change(means, background))
        depth_mm = depth_from_normals(normals, self._map.cell_mm)
        return np.append(cell_means(depth_mm[..., None], *self._grid), self._summarize(depth_mm, is_guess))

    def skip(self) -> None:
        """Leave out the next frame. Raises `TacpipeError` if all frames that show the untouched gel are damaged."""
        if self._untouched:
            self._untouched.skip()

    def _summarize(self, depth_mm: Floats, is_guess: Bools) -> Floats:
        """Return the values of `SUMMARIES` for a depth (row, column)."""
        is_contact = depth_mm >= max(self._contact_mm, self._map.rim_ratio * depth_mm.max())
        cell_mm = self._map.cell_mm
        row, column = np.unravel_index(depth_mm.argmax(), depth_mm.shape)
        place_mm = cell_mm * (np.array([column, row]) + 0.5) if is_contact.any() else np.full(2, np.nan)
        area_mm2 = cell_mm**2 * is_contact.sum()
        volume_mm3 = cell_mm**2 * depth_mm[is_contact].sum()
        guessed = is_guess[is_contact].mean() if is_contact.any() else 0.0
        return np.array([area_mm2, volume_mm3, depth_mm.max(), *place_mm, guessed])
