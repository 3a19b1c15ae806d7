"""Fit the map of a gel to presses of balls of known diameter.

The contact of a ball is a circle, in which the normals of the gel are those of the ball: their horizontal part is the
offset from the centre divided by the radius of the ball. At the rim of the circle, the slope stops to increase. Circles
and map are fitted in turn: first to the size of the colour change, then to the slopes that the map gives.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

from tacpipe.arrays import Bools, Floats
from tacpipe.errors import TacpipeError
from tacpipe.video.depth import depth_from_normals
from tacpipe.video.gel_map import (
    COLOUR_COUNTS,
    PLACE_COUNTS,
    cell_coefficients,
    colour_terms,
    place_terms,
    polynomial_normals,
)

# radii, as fractions of a circle's, at which slopes are compared: halfway, at the rim, and outside
INSIDE, RIM, OUTSIDE = (0.55, 0.65, 0.75), (0.9, 0.97, 1.04), (1.25, 1.35, 1.45)
ANGLES = np.linspace(0, 2 * np.pi, 48, endpoint=False)
MIN_VISIBLE = 0.3  # minimum fraction of a circle's rim that the image shows
MIN_CHANGE = 0.03  # minimum relative change of colours at the rim of a contact, above that inside and outside
RADII = np.arange(8, 36, 3)  # radii of the first search, in cells of a grid with 160 columns
STEPS = (2.0, 1.0, 0.5, 0.25)  # steps of the search that follows, in cells
FITTED = 0.95  # fraction of a circle's radius within which cells are fitted
RIDGE = 1e-5  # penalty of the squared weights, per cell
MAX_SLOPE_DEG = 15.0  # maximum root mean square angle between the gel and the ball in a contact
MAX_RADIUS_ERROR = 0.3  # maximum error of the ball's radius, as a fraction of it
MIN_PRESSES = 3


@dataclass(frozen=True)
class Press:
    """The frame of a recording in which a ball is pressed into the gel."""

    diameter_mm: float
    change: Floats  # (row, column, colour), relative to the untouched gel


@dataclass(frozen=True)
class PressError:
    """Errors of one press with the map that is fitted to the others."""

    slope_deg: float  # root mean square angle between the normals of the map and those of the ball
    radius_mm: float  # error of the ball's radius
    depth_mm: (
        float  # error of the depth of the ball below the rim of the contact; NaN if the image does not show its centre
    )
    true_depth_mm: float
    rim_ratio: float  # depth of the gel at the rim, as a fraction of the largest depth


@dataclass(frozen=True)
class GelFit:
    """Weights of a map, and what is known about them."""

    weights: Floats  # (colour term, place term, xy)
    is_covered: Bools  # (row, column)
    max_sine: float
    rim_ratio: float  # median over the presses
    circles: Mapping[str, Floats]  # contact of each press: x, y and radius in cells
    errors: Mapping[str, PressError]  # by press
    refused: Mapping[str, str]  # reason by press without a contact of its ball


def fit_presses(presses: Mapping[str, Press], cell_mm: float) -> GelFit:
    """Return the map of a gel and its leave-one-press-out errors.

    The circle of a press is found with a map that was fitted to all presses. The degrees of the polynomial are the
    smallest whose leave-one-press-out error exceeds the lowest one by at most a standard error. Raises `TacpipeError` if
    fewer than three presses show a contact.
    """
    first = {name: find_contact(press.change) for name, press in presses.items()}
    refused = {name: "no contact is seen" for name, circle in first.items() if circle is None}
    circles = {name: circle for name, circle in first.items() if circle is not None}
    for terms in ((COLOUR_COUNTS[0], PLACE_COUNTS[2]), (COLOUR_COUNTS[1], PLACE_COUNTS[2])):
        fit = _Equations(presses, circles, cell_mm)
        weights = fit.solve(terms)
        for name in circles:
            circles[name] = _climb(_predict(presses[name].change, weights), circles[name])
        too_wide = [name for name in circles if circles[name][2] * cell_mm >= presses[name].diameter_mm / 2]
        refused |= dict.fromkeys(too_wide, "its contact is wider than the ball")
        circles = {name: circle for name, circle in circles.items() if name not in too_wide}
    while True:
        weights = _Equations(presses, circles, cell_mm).solve((COLOUR_COUNTS[-1], PLACE_COUNTS[-1]))
        centred = {name: _centre(presses[name], weights, circle, cell_mm) for name, circle in circles.items()}
        fit = _Equations(presses, centred, cell_mm)
        terms = fit.choose_terms()
        errors = {name: fit.press_error(name, terms) for name in centred}
        unlike = [name for name, error in errors.items() if not _is_ball(presses[name], error)]
        if not unlike:
            break
        refused |= dict.fromkeys(unlike, "its surface is not that of the ball")
        circles = {name: circle for name, circle in circles.items() if name not in unlike}
    covered = [_is_inside(presses[name].change, circle) for name, circle in centred.items()]
    max_sine = max(circle[2] * cell_mm * 2 / presses[name].diameter_mm for name, circle in centred.items())
    rim_ratio = float(np.clip(np.median([error.rim_ratio for error in errors.values()]), 0, 1))
    return GelFit(fit.solve(terms), np.any(covered, axis=0), max_sine, rim_ratio, centred, errors, refused)


def _is_ball(press: Press, error: PressError) -> bool:
    """Return whether the surface in a contact is that of the ball."""
    return error.slope_deg < MAX_SLOPE_DEG and abs(error.radius_mm) < MAX_RADIUS_ERROR * press.diameter_mm / 2


def find_contact(change: Floats) -> Floats | None:
    """Return x, y and radius of the contact in cells, or None if a relative change (row, column, colour) shows none."""
    size = np.linalg.norm(change, axis=-1, keepdims=True)
    rows, columns = size.shape[:2]
    step = max(1, columns // 32)
    grid = product(range(0, columns, step), range(0, rows, step), RADII * columns / 160)
    circles = np.array(list(grid), np.float64)
    scores = np.concatenate([_rim_score(size, block) for block in np.array_split(circles, len(circles) // 1000 + 1)])
    return circles[scores.argmax()] if scores.max() >= MIN_CHANGE else None


def _rim_score(field: Floats, circles: Floats) -> Floats:
    """Return how much larger a field is at the rim of circles (…, xyr) than inside and outside (…,), -1 if out of range.

    ``field`` is a size (row, column, 1), or vectors (row, column, xy), whose part away from the centre counts.
    """
    rows, columns, parts = field.shape
    directions = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=-1)  # (angle, xy)
    fractions = np.array([*INSIDE, *RIM, *OUTSIDE])
    points = circles[..., None, None, :2] + circles[..., 2, None, None, None] * fractions[:, None, None] * directions
    last = np.array([columns - 1, rows - 1])
    is_visible = ((points >= 0) & (points <= last)).all(axis=-1)  # (…, fraction, angle)
    corner = np.clip(points.astype(np.int64), 0, last - 1)
    x, y = corner[..., 0], corner[..., 1]
    across, down = np.moveaxis(np.clip(points - corner, 0, 1)[..., None], -2, 0)
    upper = field[y, x] * (1 - across) + field[y, x + 1] * across
    lower = field[y + 1, x] * (1 - across) + field[y + 1, x + 1] * across
    vectors = upper * (1 - down) + lower * down
    values = vectors[..., 0] if parts == 1 else (vectors * directions).sum(axis=-1)
    inside, rim, outside = (values[..., part, :].mean(axis=-2) for part in (slice(0, 3), slice(3, 6), slice(6, 9)))
    is_whole = is_visible.all(axis=-2)  # (…, angle)
    visible = is_whole.mean(axis=-1)
    excess = np.where(is_whole, rim - (inside + outside) / 2, 0).sum(axis=-1) / np.maximum(is_whole.sum(axis=-1), 1)
    is_possible = (visible > MIN_VISIBLE) & (circles[..., 2] > 2) & (circles[..., 2] < columns / 3)
    scores: Floats = np.where(is_possible, excess * np.sqrt(visible), -1.0)
    return scores


def _climb(field: Floats, circle: Floats) -> Floats:
    """Return the circle near ``circle`` with the largest score."""
    neighbours = np.array(list(product((0, -1, 1), repeat=3)), np.float64)  # the first is no step
    for step in STEPS:
        for _ in range(20):
            candidates = circle + step * neighbours
            best = int(_rim_score(field, candidates).argmax())
            circle = candidates[best]
            if best == 0:
                break
    return circle


def _offsets(change: Floats, circle: Floats) -> Floats:
    """Return the offset of each cell from the centre of a circle (row, column, xy)."""
    y, x = np.indices(change.shape[:2])
    return np.stack([x - circle[0], y - circle[1]], axis=-1)


def _is_inside(change: Floats, circle: Floats, fraction: float = 1.0) -> Bools:
    """Return whether each cell is in a circle (row, column)."""
    is_inside: Bools = np.linalg.norm(_offsets(change, circle), axis=-1) < fraction * circle[2]
    return is_inside


def _predict(change: Floats, weights: Floats) -> Floats:
    """Return the normals (row, column, xy) of a map without limits."""
    return polynomial_normals(change, cell_coefficients(change.shape, weights))


def _centre(press: Press, weights: Floats, circle: Floats, cell_mm: float) -> Floats:
    """Return a circle whose centre is the mean of those that the normals in it point away from."""
    is_inside = _is_inside(press.change, circle, FITTED)
    misfit = _offsets(press.change, circle) - _predict(press.change, weights) * press.diameter_mm / 2 / cell_mm
    return np.append(circle[:2] + misfit[is_inside].mean(axis=0), circle[2])


def _terms_of(counts: tuple[int, int]) -> Bools:
    """Return which terms of the largest polynomial (colour term * place term,) one with ``counts`` terms has."""
    is_used = np.zeros((COLOUR_COUNTS[-1], PLACE_COUNTS[-1]), bool)
    is_used[: counts[0], : counts[1]] = True
    return is_used.ravel()


class _Equations:
    """The normal equations of the largest polynomial for each press."""

    def __init__(self, presses: Mapping[str, Press], circles: Mapping[str, Floats], cell_mm: float) -> None:
        if len(circles) < MIN_PRESSES:
            raise TacpipeError(
                f"A contact is seen in {len(circles)} of {len(presses)} presses, and a map needs {MIN_PRESSES}. Press the "
                f"ball in at more places, and check the untouched gel (--background)."
            )
        self._presses, self._circles, self._cell_mm = presses, circles, cell_mm
        products, targets, squares, counts = zip(*(self._press_equations(name) for name in circles), strict=True)
        self._products, self._targets = np.array(products), np.array(targets)  # (press, term, term), (press, term, xy)
        self._squares, self._counts = np.array(squares), np.array(counts)  # (press,)

    def _press_equations(self, name: str) -> tuple[Floats, Floats, float, int]:
        """Return products of terms, products of terms and normals, the sum of squared normals, and the number of cells."""
        press, circle = self._presses[name], self._circles[name]
        is_inside = _is_inside(press.change, circle, FITTED)
        normals = self._ball_normals(name)[is_inside]
        colours, places = colour_terms(press.change[is_inside]), place_terms(*press.change.shape[:2])[is_inside]
        terms = (colours[:, :, None] * places[:, None, :]).reshape(len(colours), -1)  # (cell, term)
        return terms.T @ terms, terms.T @ normals, float((normals**2).sum()), len(terms)

    def _ball_normals(self, name: str) -> Floats:
        """Return the normals of the ball of a press (row, column, xy), which hold in its circle."""
        press = self._presses[name]
        return _offsets(press.change, self._circles[name]) * self._cell_mm * 2 / press.diameter_mm

    def solve(self, counts: tuple[int, int], without: int | None = None) -> Floats:
        """Return the weights (colour term, place term, xy) of a polynomial with ``counts`` terms, 0 for other terms.

        ``without`` is the index of a press that is left out.
        """
        used = np.flatnonzero(_terms_of(counts))
        is_fitted = np.arange(len(self._counts)) != (-1 if without is None else without)
        products, targets = self._products[is_fitted].sum(axis=0), self._targets[is_fitted].sum(axis=0)
        penalty = RIDGE * self._counts[is_fitted].sum() * np.eye(len(used))
        weights = np.zeros(targets.shape)
        weights[used] = np.linalg.solve(products[np.ix_(used, used)] + penalty, targets[used])
        return weights.reshape(COLOUR_COUNTS[-1], PLACE_COUNTS[-1], 2)

    def choose_terms(self) -> tuple[int, int]:
        """Return the numbers of colour and place terms, chosen by leave-one-press-out error (`fit_presses`)."""
        candidates = sorted(product(COLOUR_COUNTS, PLACE_COUNTS), key=np.prod)
        losses = np.array([list(self._losses(counts)) for counts in candidates])  # (candidate, press)
        excess = losses - losses[losses.mean(axis=1).argmin()]
        tolerance = excess.std(axis=1) / np.sqrt(excess.shape[1])
        return candidates[int(np.argmax(excess.mean(axis=1) <= tolerance))]

    def _losses(self, counts: tuple[int, int]) -> Iterator[float]:
        """Yield the mean squared error of the normals in each press, with weights that are fitted to the others."""
        for press, (products, targets) in enumerate(zip(self._products, self._targets, strict=True)):
            weights = self.solve(counts, without=press).reshape(len(targets), 2)
            error = np.sum(weights * (products @ weights)) - 2 * np.sum(weights * targets) + self._squares[press]
            yield float(error / self._counts[press])

    def press_error(self, name: str, counts: tuple[int, int]) -> PressError:
        """Return the errors of a press with weights that are fitted to the others."""
        press, circle = self._presses[name], self._circles[name]
        radius_mm, rim_mm = press.diameter_mm / 2, circle[2] * self._cell_mm
        normals = _predict(press.change, self.solve(counts, without=list(self._circles).index(name)))
        normals *= 0.99 / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 0.99)
        is_inside = _is_inside(press.change, circle)
        slope_deg = angles_deg(normals[is_inside], self._ball_normals(name)[is_inside])
        depth_mm = depth_from_normals(normals, self._cell_mm)
        distance = np.linalg.norm(_offsets(press.change, circle), axis=-1)
        top, rim = depth_mm[distance < 2], depth_mm[np.abs(distance - circle[2]) < 1]
        true_depth_mm = radius_mm - np.sqrt(radius_mm**2 - rim_mm**2)
        return PressError(
            float(np.sqrt((slope_deg**2).mean())),
            fit_radius_mm(depth_mm, is_inside, self._cell_mm) - radius_mm,
            float(top.mean() - rim.mean() - true_depth_mm) if len(top) else float("nan"),
            float(true_depth_mm),
            float(rim.mean() / depth_mm[is_inside].max()),
        )


def angles_deg(normals: Floats, true_normals: Floats) -> Floats:
    """Return the angle in degrees (cell,) between unit normals, given horizontal parts (cell, xy)."""
    heights, other_heights = (np.sqrt(np.maximum(1 - (part**2).sum(axis=-1), 0)) for part in (normals, true_normals))
    cosines = (normals * true_normals).sum(axis=-1) + heights * other_heights
    angles: Floats = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    return angles


def fit_radius_mm(depth_mm: Floats, is_inside: Bools, cell_mm: float) -> float:
    """Return the radius of the sphere that fits a depth (row, column) best in some cells, by algebraic least squares."""
    rows, columns = np.nonzero(is_inside)
    points = np.column_stack([columns * cell_mm, rows * cell_mm, depth_mm[is_inside]])
    design = np.column_stack([2 * points, np.ones(len(points))])
    centre_x, centre_y, centre_z, constant = np.linalg.lstsq(design, (points**2).sum(axis=1), rcond=None)[0]
    return float(np.sqrt(max(constant + centre_x**2 + centre_y**2 + centre_z**2, 0)))
