"""Assign the dots of an image to the markers of a lattice so that neighbours stay neighbours.

A lattice has two steps: the offsets to the next column and to the next row. The offset between two neighbours may differ
from its step by at most `MAX_STRAIN` pitches. Below 0.71 this keeps the order of neighbours and the orientation of each
cell. An assignment (marker,) contains the index of each marker's dot, or -1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np

from tacpipe.arrays import Bools, Floats, Int64s

MIN_DOTS = 4  # minimum number of dots of a lattice
NEXT = 0.4  # maximum distance in pitches between a dot and a marker's expected position
NEXT_BY_PASS = (0.15, 0.25, NEXT)  # the same for each pass of `Lattice.rebuild`
MAX_STRAIN = 0.7  # maximum difference in pitches between the offset of two neighbours and the step of the lattice
SOUND_STRAIN = 0.3  # the same for markers from which an assignment is rebuilt


@dataclass(frozen=True)
class Lattice:
    """Undisplaced markers in rows and columns, row by row."""

    rows: int
    columns: int
    rest_px: Floats  # (marker, xy), or NaN if no dot was found
    steps_px: Floats  # (2, xy), offsets to the next column and to the next row

    @cached_property
    def pitch_px(self) -> float:
        """The mean length of the two steps."""
        return float(np.linalg.norm(self.steps_px, axis=1).mean())

    @cached_property
    def exists(self) -> Bools:
        """True for each marker for which a dot was found (marker,)."""
        return ~np.isnan(self.rest_px[:, 0])

    @cached_property
    def _points_px(self) -> Floats:
        """The points of a regular lattice (marker, xy)."""
        indices = np.column_stack(np.divmod(np.arange(self.rows * self.columns), self.columns))
        points: Floats = indices[:, ::-1] @ self.steps_px
        return points

    @cached_property
    def _edges(self) -> Int64s:
        """Pairs of existing neighbours in a row or a column (edge, 2)."""
        index = np.arange(self.rows * self.columns).reshape(self.rows, self.columns)
        pairs = [(index[:, :-1], index[:, 1:]), (index[:-1], index[1:])]
        edges = np.concatenate([np.column_stack([first.ravel(), second.ravel()]) for first, second in pairs])
        existing: Int64s = edges[self.exists[edges].all(axis=1)]
        return existing

    @cached_property
    def _neighbours(self) -> Int64s:
        """The eight neighbours of each marker (8, marker); beyond the border, the number of markers."""
        size = self.rows * self.columns
        index = np.pad(np.arange(size).reshape(self.rows, self.columns), 1, constant_values=size)
        places = [place for place in product(range(3), repeat=2) if place != (1, 1)]
        return np.array(
            [index[row : row + self.rows, column : column + self.columns].ravel() for row, column in places]
        )

    def assign(self, expected_px: Floats, dots: Floats, limit: float = NEXT) -> tuple[Int64s, bool]:
        """Return the dots (marker,) next to expected positions (marker, xy), and whether neighbours contradicted.

        ``limit`` is the maximum distance in pitches. Markers that contradict their neighbours have no dot.
        """
        return self._without_contradictions(self._match(self._empty(), expected_px, dots, limit), dots)

    def complete(self, assigned: Int64s, dots: Floats, limits: Sequence[float] = (NEXT,)) -> Int64s:
        """Return an assignment with further markers where their neighbours suggest them, with one pass per limit."""
        for limit in limits:
            while (missing := self.exists & (assigned < 0)).any() and np.count_nonzero(assigned >= 0) < len(dots):
                suggested = np.where(missing[:, None], self._suggest(self._offsets(assigned, dots)), np.nan)
                extended, _ = self._without_contradictions(self._match(assigned, suggested, dots, limit), dots)
                if np.count_nonzero(extended >= 0) <= np.count_nonzero(assigned >= 0):
                    break
                assigned = extended
        return assigned

    def rebuild(self, assigned: Int64s, dots: Floats) -> Int64s:
        """Return the better of an assignment and one that grows from its largest part with little strain.

        An assignment is better if it has more markers, or as many with less strain.
        """
        strain = self._strain(self._offsets(assigned, dots))
        is_sound = assigned >= 0
        is_sound[self._edges[strain > SOUND_STRAIN].ravel()] = False
        rebuilt = self.complete(self._largest_part(assigned, is_sound), dots, NEXT_BY_PASS)
        return max(assigned, rebuilt, key=lambda candidate: self._rank(candidate, dots))

    def _empty(self) -> Int64s:
        """Return an assignment without dots."""
        return np.full(len(self.rest_px), -1)

    def _rank(self, assigned: Int64s, dots: Floats) -> tuple[int, float]:
        """Return the number of markers, and the negative sum of squared strains."""
        strain = self._strain(self._offsets(assigned, dots))
        return int(np.count_nonzero(assigned >= 0)), -float(np.nansum(strain**2))

    def _offsets(self, assigned: Int64s, dots: Floats) -> Floats:
        """Return offsets from the regular lattice (marker + 1, xy), NaN without a dot; the last stands for the border."""
        offsets = np.full((len(assigned) + 1, 2), np.nan)
        markers = np.flatnonzero(assigned >= 0)
        offsets[markers] = dots[assigned[markers]] - self._points_px[markers]
        return offsets

    def _strain(self, offsets: Floats) -> Floats:
        """Return the difference of each edge from its step in pitches (edge,), NaN if an end has no dot."""
        difference = offsets[self._edges[:, 0]] - offsets[self._edges[:, 1]]
        strain: Floats = np.sqrt((difference**2).sum(axis=1)) / self.pitch_px
        return strain

    def _suggest(self, offsets: Floats) -> Floats:
        """Return the positions that the neighbours of each marker suggest (marker, xy), NaN without any."""
        nearby = offsets[self._neighbours]  # (neighbour, marker, xy)
        is_known = ~np.isnan(nearby[..., 0])
        count = is_known.sum(axis=0)
        total = np.where(is_known[..., None], nearby, 0).sum(axis=0)
        suggested: Floats = self._points_px + total / np.where(count, count, np.nan)[:, None]
        return suggested

    def _match(self, assigned: Int64s, expected_px: Floats, dots: Floats, limit: float) -> Int64s:
        """Return an assignment with the free dots that are mutually nearest to expected positions."""
        is_free = np.ones(len(dots), bool)
        is_free[assigned[assigned >= 0]] = False
        free = np.flatnonzero(is_free)
        missing = np.flatnonzero((assigned < 0) & self.exists & ~np.isnan(expected_px[:, 0]))
        if not len(free) or not len(missing):
            return assigned
        along_x, along_y = (expected_px[missing, axis][:, None] - dots[free, axis] for axis in (0, 1))
        squares = along_x**2 + along_y**2  # (marker, dot)
        nearest, order = squares.argmin(axis=1), np.arange(len(missing))
        is_match = squares.argmin(axis=0)[nearest] == order
        is_match &= squares[order, nearest] < (limit * self.pitch_px) ** 2
        matched = assigned.copy()
        matched[missing[is_match]] = free[nearest[is_match]]
        return matched

    def _without_contradictions(self, assigned: Int64s, dots: Floats) -> tuple[Int64s, bool]:
        """Return an assignment in which no edge exceeds `MAX_STRAIN`, and whether one did.

        The markers with the largest sum of such strains lose their dots, and then those outside the largest part.
        """
        strain = self._strain(self._offsets(assigned, dots))
        if not (is_torn := strain > MAX_STRAIN).any():
            return assigned, False
        is_kept = assigned >= 0
        while is_torn.any():
            ends = self._edges[is_torn]
            sums = np.bincount(ends.ravel(), np.repeat(strain[is_torn], 2), len(assigned))
            worst = sums.argmax()
            is_kept[worst] = False
            is_torn &= (self._edges != worst).all(axis=1)
        return self._largest_part(assigned, is_kept), True

    def _largest_part(self, assigned: Int64s, is_kept: Bools) -> Int64s:
        """Return an assignment with the largest connected part of the kept markers only."""
        part = np.where(is_kept, np.arange(len(assigned)), -1)  # smallest marker of the part (marker,)
        first, second = self._edges[is_kept[self._edges].all(axis=1)].T
        while (part[first] != part[second]).any():
            smallest = np.minimum(part[first], part[second])
            np.minimum.at(part, first, smallest)
            np.minimum.at(part, second, smallest)
        sizes = np.bincount(part[is_kept], minlength=1)
        return np.where(is_kept & (part == sizes.argmax()), assigned, -1)


def order_dots(dots: Floats, centre_px: Floats) -> Lattice | None:
    """Return the lattice of dots (dot, xy) around the dot that is nearest to a point, or None if no dots are neighbours.

    Rows are within 30 degrees of the x axis. In a hexagonal layout, columns run diagonally.
    """
    if len(dots) < MIN_DOTS or (steps := _steps(dots)) is None:
        return None
    cells = _cells(dots, steps, int(np.argmin(np.linalg.norm(dots - centre_px, axis=1))))
    places = np.array(list(cells))  # (dot, row and column)
    places -= places.min(axis=0)
    rows, columns = (int(last) + 1 for last in places.max(axis=0))
    rest_px = np.full((rows, columns, 2), np.nan)
    rest_px[places[:, 0], places[:, 1]] = dots[list(cells.values())]
    return Lattice(rows, columns, rest_px.reshape(-1, 2), steps)


def _steps(dots: Floats) -> Floats | None:
    """Return the most frequent offsets to the next column and row in px (2, xy), or None if no dots are neighbours."""
    offsets = dots[None] - dots[:, None]  # (dot, other, xy)
    distances = np.linalg.norm(offsets, axis=2) + np.diag(np.full(len(dots), np.inf))
    steps = []
    for along, across in ((0, 1), (1, 0)):
        is_along = (offsets[..., along] > 0) & (np.abs(offsets[..., across]) < 0.8 * offsets[..., along])
        # the second term prefers the lower right of two equally near dots in a hexagonal layout
        ranked = np.where(is_along, distances - 0.1 * offsets[..., across], np.inf)
        nearest = ranked.argmin(axis=1)
        has_neighbour = np.isfinite(ranked.min(axis=1))
        if not has_neighbour.any():
            return None
        candidates = offsets[np.flatnonzero(has_neighbour), nearest[has_neighbour]]  # (dot, xy)
        gaps = np.linalg.norm(candidates[:, None] - candidates, axis=2)
        is_similar = gaps < NEXT * np.median(np.linalg.norm(candidates, axis=1))
        steps.append(np.median(candidates[is_similar[is_similar.sum(axis=1).argmax()]], axis=0))
    return np.array(steps)


def _cells(dots: Floats, steps: Floats, first: int) -> dict[tuple[int, int], int]:
    """Return the index of the dot in each cell (row, column), spreading from the dot ``first`` in cell (0, 0).

    ``steps`` are those that `_steps` returns.
    """
    pitch = float(np.linalg.norm(steps, axis=1).mean())
    cells = {(0, 0): first}
    assigned = {first}
    pending = [(0, 0)]
    while pending:
        row, column = pending.pop(0)
        position = dots[cells[row, column]]
        for row_step, column_step in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            cell = (row + row_step, column + column_step)
            if cell in cells:
                continue
            distances = np.linalg.norm(dots - (position + column_step * steps[0] + row_step * steps[1]), axis=1)
            nearest = int(distances.argmin())
            if distances[nearest] < NEXT * pitch and nearest not in assigned:
                cells[cell] = nearest
                assigned.add(nearest)
                pending.append(cell)
    return cells
