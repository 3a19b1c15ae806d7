"""Find the printed markers of a gel in images, and track them from frame to frame.

Markers are dots that are darker or lighter than the gel. They are detected in every frame, with centroids weighted by
their contrast, so positions do not drift. A marker is the dot next to its last position. Dots that contradict the order
of the grid are not assigned, and `tacpipe.video.lattice` assigns them again from the rest of the grid. OpenCV is imported
when it is needed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from typing import Literal

import numpy as np

from tacpipe.arrays import Bools, Bytes, Floats, Int64s
from tacpipe.plugins import extras
from tacpipe.video.lattice import Lattice, order_dots

Polarity = Literal["auto", "dark", "light"]

NEEDED_BY = "Tracking markers"  # start of the error about a missing extra
MIN_DARKNESS = 0.12  # minimum fraction by which a marker is darker than the surrounding gel
MIN_AREA_PX = 12  # minimum area of a marker
AREA_RATIO = 3.0  # maximum ratio of a marker's area to the median area
NEIGHBOURHOOD = 8  # the gel around a marker is a square of the image's width divided by this
MIN_SHARE = 0.5  # minimum fraction of the requested markers that a grid must have
MAX_DOTS = 3  # maximum ratio of dots to markers; an image with more shows no markers
RECALLED_FRAMES = 5  # number of frames for which the last position of a lost marker is used
MIN_ANCHORS = 0.25  # minimum fraction of the markers that are followed from earlier frames to find the others
FAST = 0.25  # displacement between two frames in pitches; if most markers exceed it, all may be mistaken for neighbours
# distance from the position at rest in pitches, and the minimum fraction of markers that are closer
AT_REST = (0.1, 0.8)
NEAR_REST = (0.25, 0.5)


@dataclass(frozen=True)
class MarkerGrid:
    """The requested markers of a gel, row by row, and the lattice of all markers to which they belong."""

    rows: int
    columns: int
    lattice: Lattice
    first_row: int  # row of the lattice that is the first of the grid
    first_column: int
    is_light: bool

    @cached_property
    def markers(self) -> Int64s:
        """The markers of the lattice (marker,), -1 beyond its border."""
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns) + np.array(
            [[self.first_row], [self.first_column]]
        )
        is_inside = (row < self.lattice.rows) & (column < self.lattice.columns)
        return np.where(is_inside, row * self.lattice.columns + column, -1)

    @property
    def pitch_px(self) -> float:
        """The distance between neighbours."""
        return self.lattice.pitch_px

    @cached_property
    def exists(self) -> Bools:
        """True for each marker that was detected (marker,)."""
        return ~np.isnan(self.positions_px[:, 0])

    @cached_property
    def positions_px(self) -> Floats:
        """The undisplaced positions (marker, xy), NaN if a marker was not detected."""
        return self.select(self.lattice.rest_px)

    def select(self, positions_px: Floats) -> Floats:
        """Return the positions of the requested markers (marker, xy) from those of the lattice."""
        return np.where(self.markers[:, None] >= 0, positions_px[self.markers], np.nan)


def use_one_thread() -> None:
    """Make OpenCV compute in the calling thread in this process."""
    with extras.explain_missing(NEEDED_BY):
        import cv2
    cv2.setNumThreads(1)


def detect(grey: Bytes, *, is_light: bool = False) -> Floats:
    """Return the centroids in px (dot, xy) of the dark or light dots in an image (height, width), except at its border.

    Raises `MissingModuleError` if OpenCV is not installed.
    """
    with extras.explain_missing(NEEDED_BY):
        import cv2
    side = max(3, grey.shape[1] // NEIGHBOURHOOD | 1)
    smooth = cv2.GaussianBlur(255 - grey if is_light else grey, (5, 5), 0)
    surroundings = cv2.boxFilter(smooth, cv2.CV_32F, (side, side), borderType=cv2.BORDER_REPLICATE)
    is_marked = smooth < (1 - MIN_DARKNESS) * surroundings  # (height, width)
    count, labels = cv2.connectedComponents(is_marked.view(np.uint8), connectivity=4)
    marked = np.flatnonzero(is_marked)  # (pixel,)
    places = np.array(np.divmod(marked, grey.shape[1]))[::-1]  # (xy, pixel)
    dot = labels.ravel()[marked].astype(np.int64) - 1
    area = np.bincount(dot, minlength=count - 1)
    first, last = np.full((2, count - 1), max(grey.shape)), np.zeros((2, count - 1), np.int64)  # (xy, dot)
    for axis in (0, 1):
        np.minimum.at(first[axis], dot, places[axis])
        np.maximum.at(last[axis], dot, places[axis])
    is_inside = ((first > 0) & (last + 1 < np.array([grey.shape[::-1]]).T)).all(axis=0)
    sides = last - first + 1
    is_dot = is_inside & (area >= MIN_AREA_PX) & (sides.max(axis=0) < 2.5 * sides.min(axis=0))
    if not is_dot.any():
        return np.empty((0, 2))
    median_area = np.median(area[is_dot])
    is_dot &= (area < AREA_RATIO * median_area) & (area > median_area / AREA_RATIO)
    weights = 1 - MIN_DARKNESS - smooth.ravel()[marked] / surroundings.ravel()[marked]
    sums = np.maximum(np.bincount(dot, weights), 1e-12)
    centroids = [np.bincount(dot, weights * along) / sums for along in places]
    dots_px: Floats = np.column_stack(centroids)[is_dot]
    return dots_px


def find_grid(dots: Floats, centre_px: Floats, rows: int, columns: int, *, is_light: bool = False) -> MarkerGrid | None:
    """Return detected dots as a grid of ``rows`` and ``columns``, or None if no dots are neighbours.

    For a larger lattice, the part with the most markers is used, and of several the one nearest to the image's centre.
    """
    lattice = order_dots(dots, centre_px)
    if lattice is None:
        return None

    def rank(grid: MarkerGrid) -> tuple[int, float]:
        """Rank a part of the lattice by its markers and its distance from the centre of the image."""
        part = grid.positions_px[grid.exists]
        return -len(part), float(np.linalg.norm(part.mean(axis=0) - centre_px)) if len(part) else np.inf

    corners = product(range(max(1, lattice.rows - rows + 1)), range(max(1, lattice.columns - columns + 1)))
    return min((MarkerGrid(rows, columns, lattice, row, column, is_light) for row, column in corners), key=rank)


@dataclass
class GridSearch:
    """Looks for the grid of markers in the first frames, which show the untouched gel.

    The first frame with all markers is used, or else the one with the most markers.
    """

    rows: int
    columns: int
    polarity: Polarity
    frames_left: int
    best: MarkerGrid | None = field(default=None, init=False)
    frames: int = field(default=0, init=False)  # frames that were not damaged
    dots: int = field(default=0, init=False)  # largest number of dots in a frame

    def add(self, grey: Bytes | None) -> MarkerGrid | None:
        """Look at the next frame, None for a damaged one, and return the grid as soon as it is final.

        If it has less than `MIN_SHARE` of the markers, the result is None although ``frames_left`` is 0.
        """
        self.frames_left -= 1
        self.frames += grey is not None
        for is_light in (False, True):
            if grey is None or self.polarity == ("dark" if is_light else "light"):
                continue
            dots = detect(grey, is_light=is_light)
            self.dots = max(self.dots, len(dots))
            grid = find_grid(dots, np.array(grey.shape[::-1]) / 2, self.rows, self.columns, is_light=is_light)
            if grid is not None and grid.exists.sum() > self.marker_count:
                self.best = grid
        is_complete = self.marker_count == self.rows * self.columns
        has_enough = self.marker_count >= MIN_SHARE * self.rows * self.columns
        return self.best if is_complete or (has_enough and self.frames_left <= 0) else None

    @property
    def marker_count(self) -> int:
        """The number of markers of the best grid."""
        return 0 if self.best is None else int(self.best.exists.sum())


@dataclass
class MarkerTracker:
    """Tracks the markers of a grid frame by frame. A position does not depend on later frames."""

    grid: MarkerGrid
    _last_px: Floats = field(init=False)  # last position of each marker of the lattice (marker, xy)
    _frames_lost: Int64s = field(init=False)  # (marker,), number of frames since the last detection
    _is_doubtful: bool = field(default=False, init=False)  # true if all markers may be mistaken for their neighbours

    def __post_init__(self) -> None:
        self._last_px = self.grid.lattice.rest_px.copy()
        self._frames_lost = np.zeros(len(self._last_px), np.int64)

    def step(self, grey: Bytes) -> Floats:
        """Return the positions in the next image in px (marker, xy), NaN if a marker is missing."""
        dots = detect(grey, is_light=self.grid.is_light)
        if len(dots) > MAX_DOTS * self.grid.lattice.exists.sum():
            dots = dots[:0]
        assigned = self._assign(dots)
        is_found = assigned >= 0
        self._frames_lost = np.where(is_found, 0, self._frames_lost + 1)
        self._last_px[is_found] = dots[assigned[is_found]]
        return self.grid.select(np.where(is_found[:, None], self._last_px, np.nan))

    def _assign(self, dots: Floats) -> Int64s:
        """Return the dot of each marker of the lattice (marker,), -1 for none."""
        lattice = self.grid.lattice
        is_known = lattice.exists & (self._frames_lost <= RECALLED_FRAMES)
        assigned, contradicted = lattice.assign(np.where(is_known[:, None], self._last_px, np.nan), dots)
        if np.count_nonzero(assigned >= 0) < MIN_ANCHORS * np.count_nonzero(lattice.exists):
            self._is_doubtful = True
            near_rest = self._near_rest(dots, *NEAR_REST)
            return assigned if near_rest is None else near_rest
        assigned = lattice.complete(assigned, dots)
        has_lost = bool((is_known & (self._frames_lost == 0) & (assigned < 0)).any())
        if contradicted or (has_lost and np.count_nonzero(assigned >= 0) < len(dots)):
            assigned = lattice.rebuild(assigned, dots)
        is_found = assigned >= 0
        moved_px = np.linalg.norm(dots[assigned[is_found]] - self._last_px[is_found], axis=1)
        are_fast = 2 * np.count_nonzero(moved_px > FAST * lattice.pitch_px) > len(moved_px)
        are_lost = 2 * np.count_nonzero(is_found) < np.count_nonzero(is_known)
        self._is_doubtful = self._is_doubtful or bool(are_fast or are_lost)
        at_rest = self._near_rest(dots, *AT_REST) if self._is_doubtful else None
        if at_rest is not None and (at_rest >= 0).sum() >= is_found.sum():
            self._is_doubtful = False
            return at_rest
        return assigned

    def _near_rest(self, dots: Floats, limit: float, min_share: float) -> Int64s | None:
        """Return an assignment if at least a share of the markers is within a limit in pitches of their rest."""
        lattice = self.grid.lattice
        assigned, _ = lattice.assign(lattice.rest_px, dots, limit)
        if (assigned >= 0).sum() < min_share * lattice.exists.sum():
            return None
        return lattice.complete(assigned, dots)
