"""Find the printed markers of a gel in images, order them into a grid, and track them from frame to frame.

Markers are dark dots on a brighter gel. They are detected in every frame, with centroids weighted by darkness. Between
frames, pyramidal Lucas-Kanade (Bouguet 2001, OpenCV) predicts where each marker is; the detection next to this prediction
is its position, so positions do not drift. A marker that is not detected keeps the predicted position for a few frames
and is missing after them, until a detection is where its neighbours suggest. OpenCV is imported when it is needed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from tacpipe.arrays import Bools, Bytes, Floats, Int64s
from tacpipe.plugins import extras

NEEDED_BY = "Tracking markers"  # start of the error about a missing extra
MIN_DARKNESS = 0.12  # minimum fraction by which a marker is darker than the surrounding gel
MIN_AREA_PX = 12  # minimum area of a marker
AREA_RATIO = 3.0  # maximum ratio of a marker's area to the median area
NEIGHBOURHOOD = 8  # the gel around a marker is a square of the image's width divided by this
NEXT = 0.4  # maximum distance in pitches between a detection and a marker's expected position
CONFIRMED_PX = 0.5  # maximum distance after tracking a marker forwards and backwards
UNCONFIRMED_FRAMES = 5  # number of frames for which a marker is tracked without a detection
WINDOW_PX, LEVELS = 21, 3  # Lucas-Kanade: side of the window, and pyramid levels


@dataclass(frozen=True)
class MarkerGrid:
    """Undisplaced markers of a gel: a grid of rows and columns, row by row."""

    rows: int
    columns: int
    positions_px: Floats  # (marker, xy), or NaN if no marker was detected
    pitch_px: float  # distance between neighbours


def use_one_thread() -> None:
    """Make OpenCV compute in the calling thread in this process."""
    with extras.explain_missing(NEEDED_BY):
        import cv2
    cv2.setNumThreads(1)


def detect(grey: Bytes) -> Floats:
    """Return the centroids in px (marker, xy) of the dark dots in an image (height, width), except at its border.

    Raises `MissingModuleError` if OpenCV is not installed.
    """
    with extras.explain_missing(NEEDED_BY):
        import cv2
    side = max(3, grey.shape[1] // NEIGHBOURHOOD | 1)
    smooth = cv2.GaussianBlur(grey, (5, 5), 0).astype(np.float32)
    surroundings = cv2.boxFilter(smooth, -1, (side, side), borderType=cv2.BORDER_REPLICATE)
    excess = np.clip(1 - smooth / np.maximum(surroundings, 1) - MIN_DARKNESS, 0, None)  # (height, width)
    count, labels, stats, _ = cv2.connectedComponentsWithStats((excess > 0).astype(np.uint8), connectivity=4)
    left, top, width, height, area = stats.T
    inside = (left > 0) & (top > 0) & (left + width < grey.shape[1]) & (top + height < grey.shape[0])
    is_dot = inside & (area >= MIN_AREA_PX) & (np.maximum(width, height) < 2.5 * np.minimum(width, height))
    is_dot[0] = False  # the gel
    if not is_dot.any():
        return np.empty((0, 2))
    median_area = np.median(area[is_dot])
    is_dot &= (area < AREA_RATIO * median_area) & (area > median_area / AREA_RATIO)
    flat, weights = labels.ravel(), excess.ravel().astype(np.float64)
    sums = np.bincount(flat, weights, count)
    y, x = np.indices(grey.shape)
    centroids = [np.bincount(flat, weights * axis.ravel(), count) / np.maximum(sums, 1e-12) for axis in (x, y)]
    dots_px: Floats = np.column_stack(centroids)[is_dot]
    return dots_px


def find_grid(grey: Bytes, rows: int, columns: int) -> MarkerGrid | None:
    """Return the markers of an image as a grid of ``rows`` and ``columns``, or None if no dots are neighbours.

    For a larger grid, the part with the most markers is used, and of several the one nearest to the image's centre.
    Rows are within 30 degrees of the x axis.
    """
    detections = detect(grey)
    if len(detections) < 4:
        return None
    centre = np.array(grey.shape[::-1]) / 2
    steps = _steps(detections)
    if steps is None:
        return None
    cells = _cells(detections, steps, int(np.argmin(np.linalg.norm(detections - centre, axis=1))))
    row_first, column_first = min(index[0] for index in cells), min(index[1] for index in cells)
    row_last, column_last = max(index[0] for index in cells), max(index[1] for index in cells)

    def rank(corner: tuple[int, int]) -> tuple[int, float]:
        """Rank a part of the grid by its markers and its distance from the centre of the image."""
        part = [
            detections[marker]
            for (row, column), marker in cells.items()
            if 0 <= row - corner[0] < rows and 0 <= column - corner[1] < columns
        ]
        return -len(part), float(np.linalg.norm(np.mean(part, axis=0) - centre)) if part else np.inf

    tops = range(row_first, max(row_first, row_last - rows + 1) + 1)
    lefts = range(column_first, max(column_first, column_last - columns + 1) + 1)
    top, left = min(product(tops, lefts), key=rank)
    positions = np.full((rows * columns, 2), np.nan)
    for (row, column), marker in cells.items():
        if 0 <= row - top < rows and 0 <= column - left < columns:
            positions[(row - top) * columns + column - left] = detections[marker]
    return MarkerGrid(rows, columns, positions, float(np.linalg.norm(steps, axis=1).mean()))


@dataclass
class MarkerTracker:
    """Tracks the markers of a grid frame by frame. A position does not depend on later frames."""

    grid: MarkerGrid
    previous: Bytes  # image for which `positions_px` are valid
    positions_px: Floats = field(init=False)  # (marker, xy); NaN if missing
    unconfirmed: Int64s = field(init=False)  # (marker,), number of frames since the last detection

    def __post_init__(self) -> None:
        self.positions_px = self.grid.positions_px.copy()
        self.unconfirmed = np.zeros(len(self.positions_px), np.int64)

    def step(self, grey: Bytes) -> tuple[Floats, Bools]:
        """Return positions in the next image in px (marker, xy), NaN if missing, and whether each was detected (marker,)."""
        expected, is_confirmed = self._predict(grey)
        detections = detect(grey)
        detected = self._match(expected, detections, np.full(len(expected), -1))
        lost = (detected < 0) & ~np.isnan(self.grid.positions_px[:, 0])
        suggested = np.where(lost[:, None], self._suggest(detected, detections), np.nan)
        detected = self._match(suggested, detections, detected)
        is_detected = detected >= 0
        self.unconfirmed = np.where(is_detected, 0, self.unconfirmed + 1)
        keeps = ~is_detected & is_confirmed & (self.unconfirmed <= UNCONFIRMED_FRAMES)
        positions = np.where(keeps[:, None], expected, np.nan)
        positions[is_detected] = detections[detected[is_detected]]
        self.positions_px, self.previous = positions, grey
        return positions, is_detected

    def _predict(self, grey: Bytes) -> tuple[Floats, Bools]:
        """Return the positions predicted by Lucas-Kanade (marker, xy), and whether backward tracking agrees (marker,)."""
        import cv2

        expected, is_confirmed = np.full_like(self.positions_px, np.nan), np.zeros(len(self.positions_px), bool)
        tracked = np.flatnonzero(~np.isnan(self.positions_px[:, 0]))
        if not len(tracked):
            return expected, is_confirmed
        track: Any = partial(cv2.calcOpticalFlowPyrLK, winSize=(WINDOW_PX, WINDOW_PX), maxLevel=LEVELS)
        start = self.positions_px[tracked].astype(np.float32)[:, None]
        moved, is_tracked, _ = track(self.previous, grey, start, None)
        returned, is_returned, _ = track(grey, self.previous, moved, None)
        agrees = np.linalg.norm((returned - start)[:, 0], axis=1) < CONFIRMED_PX
        usable = is_tracked.ravel().astype(bool)
        expected[tracked[usable]] = moved[usable, 0]
        is_confirmed[tracked] = usable & is_returned.ravel().astype(bool) & agrees
        return expected, is_confirmed

    def _match(self, expected: Floats, detections: Floats, detected: Int64s) -> Int64s:
        """Return the detection of each marker (marker,), -1 for none; markers in ``detected`` keep theirs."""
        matched = detected.copy()
        free = np.setdiff1d(np.arange(len(detections)), detected)
        undetected = np.flatnonzero((detected < 0) & ~np.isnan(expected[:, 0]))
        if len(free) and len(undetected):
            distances = np.linalg.norm(expected[undetected][:, None] - detections[free], axis=2)  # (marker, detection)
            nearest, nearest_marker = distances.argmin(axis=1), distances.argmin(axis=0)
            mutual = nearest_marker[nearest] == np.arange(len(undetected))
            close = distances.min(axis=1) < NEXT * self.grid.pitch_px
            matched[undetected[mutual & close]] = free[nearest[mutual & close]]
        return matched

    def _suggest(self, detected: Int64s, detections: Floats) -> Floats:
        """Return positions of markers (marker, xy) from the displacements of detected neighbours, NaN without any."""
        shape = (self.grid.rows, self.grid.columns, 2)
        displacements = np.full_like(self.grid.positions_px, np.nan)
        is_detected = detected >= 0
        displacements[is_detected] = detections[detected[is_detected]] - self.grid.positions_px[is_detected]
        padded = np.pad(displacements.reshape(shape), ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
        shifted = [
            padded[row : row + shape[0], column : column + shape[1]]
            for row, column in product(range(3), repeat=2)
            if (row, column) != (1, 1)
        ]
        stack = np.array(shifted).reshape(8, -1, 2)  # (neighbour, marker, xy)
        count = (~np.isnan(stack)).sum(axis=0)
        mean = np.nansum(stack, axis=0) / np.where(count, count, np.nan)
        suggested: Floats = self.grid.positions_px + mean
        return suggested


def _steps(detections: Floats) -> Floats | None:
    """Return the median offsets to the next column and row in px (2, xy), or None if no markers are neighbours."""
    offsets = detections[None] - detections[:, None]  # (marker, other, xy)
    distances = np.linalg.norm(offsets, axis=2) + np.diag(np.full(len(detections), np.inf))
    steps = []
    for along, across in ((0, 1), (1, 0)):
        is_along = (offsets[..., along] > 0) & (np.abs(offsets[..., across]) < 0.6 * offsets[..., along])
        ranked = np.where(is_along, distances, np.inf)
        nearest = ranked.argmin(axis=1)
        has_neighbour = np.isfinite(ranked.min(axis=1))
        if not has_neighbour.any():
            return None
        steps.append(np.median(offsets[np.flatnonzero(has_neighbour), nearest[has_neighbour]], axis=0))
    return np.array(steps)


def _cells(detections: Floats, steps: Floats, first: int) -> dict[tuple[int, int], int]:
    """Return the index of the detection in each cell (row, column), spreading from the detection ``first`` in cell (0, 0).

    ``steps`` are those that `_steps` returns.
    """
    pitch = float(np.linalg.norm(steps, axis=1).mean())
    cells = {(0, 0): first}
    assigned = {first}
    pending = [(0, 0)]
    while pending:
        row, column = pending.pop(0)
        position = detections[cells[row, column]]
        for row_step, column_step in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            cell = (row + row_step, column + column_step)
            if cell in cells:
                continue
            distances = np.linalg.norm(detections - (position + column_step * steps[0] + row_step * steps[1]), axis=1)
            nearest = int(distances.argmin())
            if distances[nearest] < NEXT * pitch and nearest not in assigned:
                cells[cell] = nearest
                assigned.add(nearest)
                pending.append(cell)
    return cells
