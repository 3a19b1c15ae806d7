"""Propose grasps of two fingers on an object seen by one camera, best first.

The method is GeoGrasp (Zapata-Impata, Gil, Pomares, Torres: "Fast geometry-based computation of grasping points on
three-dimensional point clouds", 2019): a plane perpendicular to the object's first principal axis cuts the cloud, and
the fingers close on the two edges of the cut that are farthest apart across the view. As in the letter (RA-L 2020, data
collection), the plane is shifted along the axis at random. Among the pairs of points of both edges, the best pair has a
line that is normal to both surfaces, perpendicular to the axis and the view, and close to the plane.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import Floats, Indices
from tacpipe.clouds.cloud import CAMERA_M, Cloud, normals
from tacpipe.clouds.grasp import Grasp, axes
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io.files import readable_errors, write_whole
from tacpipe.plugins import extras

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

COUNT = 10
SHIFT = 0.4  # fraction of the object's length; 90 % of the published grasps are within 0.33 of its middle
OPENING_M = (0.020, 0.130)  # minimum and maximum opening; the published grasps have 0.026 to 0.121
MIN_POINTS = 50  # minimum number of points for estimating a shape; published clouds have 814 or more
MAX_POINTS = 20_000  # larger clouds are subsampled: more points cost time and do not change the shape
MIN_CUT_POINTS = 6  # minimum number of points in a cut
FLAT_M = 0.003  # thickness below which a cloud is a plane with noise; the thinnest published cloud has 0.026
HALF_CUT_M = 0.007  # half the thickness of a cut, as in GeoGrasp
TRIM_FRACTION = 0.02  # fraction of a cut's points at either end that is ignored as stray
EDGE_FRACTION = 0.2  # fraction of a cut's width that counts as an edge
TRIES = 3  # cuts tried for each candidate; the best one is used
MAX_VIEW_COSINE = 0.9  # cosine to the view above which the object points at the camera, so its axis is not used
OFF_PLANE_WEIGHT = 0.4  # weight of the mean distance to the plane (each cosine has 1); chosen on the published grasps
# weight of the distance to the centroid: an object that is gripped far from it rotates in the hand
OFF_CENTRE_WEIGHT = 0.5
# g1 to g2 points right and down in the picture in all published grasps
G1_TO_G2 = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)


@dataclass(frozen=True)
class Candidate:
    """A possible grasp and its score."""

    grasp: Grasp
    score: float  # at most 1; each deviation from the ideal lowers it
    off_deg: float  # angle between the closing axis and the surface normal, at the finger where it is larger
    shift_m: float  # distance from the centroid to the cut along the first axis


@dataclass(frozen=True)
class _Frame:
    """A cloud's axes: along the object, across it as the camera sees it, and the viewing direction."""

    centre_m: Floats  # (xyz)
    along: Floats
    across: Floats
    view: Floats
    length_m: float


def candidates(
    cloud: Cloud,
    count: int = COUNT,
    seed: int = 0,
    shift: float = SHIFT,
    opening_m: tuple[float, float] = OPENING_M,
    camera_m: Sequence[float] = CAMERA_M,
) -> list[Candidate]:
    """Return up to ``count`` grasps spread along the object, best first. The result is deterministic.

    The cuts are within ``shift`` of the object's length from its centroid, one in each of ``count`` equal intervals. An
    interval without a pair that is ``opening_m`` apart has no candidate. Grasp points are points of the cloud. The
    wrist's axes are the approach (the line of sight to the middle of the pair, made perpendicular to the closing axis),
    the closing axis, and their cross product. Raises `TacpipeError` if the cloud is too small or flat, the camera is
    inside it, or no cut fits between the fingers; `UsageError` if an argument is out of range.
    """
    _validate_arguments(count, shift, opening_m)
    sampled = _subsample(cloud, seed)
    frame = _frame(sampled, camera_m)
    cuts = _Cuts(sampled, frame, camera_m, opening_m)
    bounds = np.linspace(-shift, shift, count + 1) * frame.length_m
    cut_positions = np.random.default_rng(seed).uniform(size=(count, TRIES))
    chosen = []
    for low, high, fractions in zip(bounds[:-1], bounds[1:], cut_positions, strict=True):
        tried = [cuts.best(low + fraction * (high - low)) for fraction in (fractions if shift else fractions[:1])]
        feasible = [candidate for candidate in tried if candidate is not None]
        if feasible:
            chosen.append(max(feasible, key=lambda candidate: candidate.score))
        if not shift:
            break  # all intervals are the same point
    if not chosen:
        raise TacpipeError(_explain_no_grasp(cuts.widths_m, opening_m))
    return sorted(chosen, key=lambda candidate: -candidate.score)


def _validate_arguments(count: int, shift: float, opening_m: tuple[float, float]) -> None:
    """Raise `UsageError` if an argument of `candidates` is out of range."""
    if count < 1:
        raise UsageError(f"{count} candidates are requested; the number must be 1 or more.")
    if not 0 <= shift <= 0.5:
        raise UsageError(f"The shift is {shift:g} of the object's length; it must be between 0 and 0.5, its end.")
    if not 0 < opening_m[0] < opening_m[1]:
        raise UsageError(
            f"The opening is {opening_m[0] * 1e3:g} to {opening_m[1] * 1e3:g} mm; the first must be above 0 and below "
            f"the second."
        )


def _explain_no_grasp(widths_m: list[float], opening_m: tuple[float, float]) -> str:
    """Return why no cut has a candidate: no cut has enough points, or all are too wide or narrow for the fingers."""
    limits = f"{opening_m[0] * 1e3:g} to {opening_m[1] * 1e3:g} mm"
    if not widths_m:
        return (
            f"No cut through the cloud has {MIN_CUT_POINTS} points within {HALF_CUT_M * 1e3:g} mm; the cloud is too "
            f"sparse to locate its edges. Use a cloud with more points."
        )
    return (
        f"The object is {min(widths_m) * 1e3:.0f} to {max(widths_m) * 1e3:.0f} mm wide where it was cut, and the fingers "
        f"open {limits}. Turn the object, or give the limits of your hand."
    )


def _subsample(cloud: Cloud, seed: int) -> Cloud:
    """Return a cloud, or random points of a large one. Raises `TacpipeError` if it has too few points."""
    if len(cloud) < MIN_POINTS:
        raise TacpipeError(
            f"The cloud has {len(cloud)} points; {MIN_POINTS} or more are needed. Is it the object's cloud?"
        )
    if len(cloud) <= MAX_POINTS:
        return cloud
    rows = np.random.default_rng(seed).choice(len(cloud), MAX_POINTS, replace=False)
    return Cloud(cloud.points_m[rows])


def _frame(cloud: Cloud, camera_m: Sequence[float]) -> _Frame:
    """Return the axes of the cloud as seen from the camera.

    Raises `TacpipeError` if it is flat or the camera is inside.
    """
    points = cloud.points_m.astype(np.float64)
    centre = points.mean(axis=0)
    centred = points - centre
    principal_axes = np.linalg.eigh(centred.T @ centred)[1].T[::-1]  # (axis, xyz), longest first
    extents = np.ptp(np.quantile(centred @ principal_axes.T, [0.01, 0.99], axis=0), axis=0)  # (axis,), metres
    if extents.min() < FLAT_M:
        raise TacpipeError(
            f"The cloud is {extents[0] * 1e3:.0f} by {extents[1] * 1e3:.0f} mm and {extents[2] * 1e3:.1f} mm thick: it is "
            f"flat, so it has no sides to grasp. The camera must see the object's sides; is this the table?"
        )
    view = centre - np.asarray(camera_m, np.float64)
    if np.linalg.norm(view) < extents.max() / 2:
        raise TacpipeError(
            f"The camera, at {', '.join(f'{value:g}' for value in camera_m)} m, is inside the cloud, whose centroid is "
            f"{np.linalg.norm(view) * 1e3:.0f} mm away. Give the camera's position in the cloud's frame."
        )
    view /= np.linalg.norm(view)
    along = principal_axes[0]
    if abs(along @ view) > MAX_VIEW_COSINE:
        across_view = centred - np.outer(centred @ view, view)
        along = np.linalg.eigh(across_view.T @ across_view)[1][:, -1]
    positions = centred @ along
    along = along * np.sign((positions**3).sum() or 1.0)  # the skew of the cloud determines the sign of the axis
    across = np.cross(view, along)
    across *= np.sign(across @ G1_TO_G2 or 1.0) / np.linalg.norm(across)
    length_m = float(np.ptp(np.quantile(positions, [0.01, 0.99])))
    return _Frame(centre, along, across, view, length_m)


class _Cuts:
    """The cuts through one cloud, and the widths of those that had enough points."""

    def __init__(self, cloud: Cloud, frame: _Frame, camera_m: Sequence[float], opening_m: tuple[float, float]) -> None:
        self._points = cloud.points_m.astype(np.float64)
        self._normals = normals(cloud, camera_m=camera_m)
        self._frame, self._opening_m = frame, opening_m
        self._camera_m = np.asarray(camera_m, np.float64)
        inner = self._points - frame.centre_m
        self._along_m, self._across_m = inner @ frame.along, inner @ frame.across  # (point,)
        self.widths_m: list[float] = []

    def best(self, shift_m: float) -> Candidate | None:
        """Return the best pair of points near the plane at ``shift_m``; None if no pair fits between the fingers."""
        cut = np.flatnonzero(np.abs(self._along_m - shift_m) < HALF_CUT_M)
        if len(cut) < MIN_CUT_POINTS:
            return None
        low, high = np.quantile(self._across_m[cut], [TRIM_FRACTION, 1 - TRIM_FRACTION])
        width = high - low
        self.widths_m.append(float(width))
        if width > self._opening_m[1]:
            return None  # narrower pairs are on top of the object, where the hand cannot reach around it
        position = self._across_m[cut]
        left_rows = cut[(position >= low) & (position <= low + EDGE_FRACTION * width)]
        right_rows = cut[(position >= high - EDGE_FRACTION * width) & (position <= high)]
        if not len(left_rows) or not len(right_rows):
            return None
        scores, cosines = self._score_pairs(left_rows, right_rows, shift_m)
        left, right = np.unravel_index(int(np.argmax(scores)), scores.shape)
        if not np.isfinite(scores[left, right]):
            return None
        grasp = _grasp(self._points[left_rows[left]], self._points[right_rows[right]], self._camera_m)
        off_deg = float(np.degrees(np.arccos(np.clip(cosines[left, right], -1, 1))))
        score = float(scores[left, right] - OFF_CENTRE_WEIGHT * abs(shift_m) / self._frame.length_m)
        return Candidate(grasp, score, off_deg, float(shift_m))

    def _score_pairs(self, lefts: Indices, rights: Indices, shift_m: float) -> tuple[Floats, Floats]:
        """Return the scores of all pairs, and the smaller cosine between closing axis and normals, both (left, right)."""
        offsets = self._points[rights][None] - self._points[lefts][:, None]  # (left, right, xyz)
        opening = np.linalg.norm(offsets, axis=2)
        closing = offsets / np.maximum(opening, 1e-9)[..., None]
        left_cosine = -(closing * self._normals[lefts][:, None]).sum(axis=2)
        right_cosine = (closing * self._normals[rights][None]).sum(axis=2)
        cosines = np.minimum(left_cosine, right_cosine)
        distance_to_plane = np.abs(self._along_m - shift_m) / HALF_CUT_M  # (point,), 1 at the edge of the cut
        off_plane = (distance_to_plane[lefts][:, None] + distance_to_plane[rights][None]) / 2
        misalignment = np.abs(closing @ self._frame.along) + np.abs(closing @ self._frame.view)
        fits = (opening >= self._opening_m[0]) & (opening <= self._opening_m[1])
        return np.where(fits, cosines - misalignment - OFF_PLANE_WEIGHT * off_plane, -np.inf), cosines


def _grasp(left: Floats, right: Floats, camera_m: Floats) -> Grasp:
    """Return the grasp at two points with the wrist along the line of sight, as in `estimate_wrist`."""
    sight = (left + right) / 2 - camera_m
    return Grasp(left, right, axes(sight / np.linalg.norm(sight), (right - left) / np.linalg.norm(right - left)))


G1, G2 = "#d55e00", "#0072b2"  # distinguishable with red-green colour blindness
# points without colours, and the background, on which white points are visible
GREY, BACKGROUND = "#707070", "#ececec"


def draw(cloud: Cloud, grasp_candidates: Sequence[Candidate], path: Path) -> None:
    """Draw the coloured cloud from two sides, with each grasp as a line and its rank next to g1, and write it to ``path``.

    The suffix determines the format: .pdf, .png or .svg. Raises `TacpipeError` if matplotlib is not installed or the
    file cannot be written.
    """
    with extras.explain_missing("A picture"):
        import matplotlib
        from matplotlib.figure import Figure

    with matplotlib.rc_context({"svg.hashsalt": "candidates"}):
        figure = Figure(figsize=(11, 6), layout="constrained", dpi=150)
        above, side = figure.subplots(1, 2)
        _draw_panel(above, cloud, grasp_candidates, (0, 1), ranks=True)
        above.set_title("as the camera sees it", loc="left")
        _draw_panel(side, cloud, grasp_candidates, (_closing_axis(grasp_candidates), 2), ranks=False)
        side.set_title("from the side", loc="left")
        figure.legend(*_legend(), loc="outside lower center", ncols=2, frameon=False)
        content, kind = io.BytesIO(), path.suffix.lower()[1:]
        omitted_metadata = {
            "png": ("Software",),
            "svg": ("Date", "Creator"),
            "pdf": ("CreationDate", "Creator", "Producer"),
        }[kind]
        figure.savefig(
            content, format=kind, metadata=dict.fromkeys(omitted_metadata)
        )  # the same grasps give the same bytes
    with readable_errors(path.parent):
        write_whole(str(path), content.getvalue(), f"{path}.draft")


def _closing_axis(grasp_candidates: Sequence[Candidate]) -> int:
    """Return the axis (0: x, 1: y) along which the best grasp closes more; the view along the other axis shows its depth."""
    return int(np.argmax(np.abs(grasp_candidates[0].grasp.closing[:2]))) if grasp_candidates else 0


def _draw_panel(
    axes: Axes, cloud: Cloud, grasp_candidates: Sequence[Candidate], plotted_axes: tuple[int, int], *, ranks: bool
) -> None:
    """Draw a cloud and its grasps on two of the axes x, y, z, in millimetres; the second axis points down as in an image."""
    right, down = plotted_axes
    depth_axis = 3 - right - down  # the axis along which the picture is seen
    order = np.argsort(-cloud.points_m[:, depth_axis], kind="stable")  # near points are drawn last
    axes.set_facecolor(BACKGROUND)
    points_mm = cloud.points_m[order] * 1e3
    colours = GREY if cloud.colours is None else cloud.colours[order] / 255
    axes.scatter(points_mm[:, right], points_mm[:, down], c=colours, s=3, linewidths=0, rasterized=True)
    for rank, candidate in reversed(list(enumerate(grasp_candidates, 1))):  # the best is drawn on top
        ends_mm = np.stack([candidate.grasp.g1_m, candidate.grasp.g2_m]) * 1e3  # (finger, xyz)
        _draw_grasp(axes, ends_mm[:, [right, down]], rank, with_legend=ranks)
    axes.set_aspect("equal")
    axes.invert_yaxis()
    axes.set_xlabel(f"{'xyz'[right]} (mm)")
    axes.set_ylabel(f"{'xyz'[down]} (mm)")


def _draw_grasp(axes: Axes, ends_mm: Floats, rank: int, *, with_legend: bool) -> None:
    """Draw a grasp as a line with an outline and its ends, thicker for the best; with its rank for a panel with a legend."""
    alpha = 1.0 if rank == 1 else 0.75
    axes.plot(*ends_mm.T, color="white", linewidth=3.5 if rank == 1 else 2.5, alpha=alpha)  # an outline
    axes.plot(*ends_mm.T, color="black", linewidth=2 if rank == 1 else 1, alpha=alpha)
    for end, colour in zip(ends_mm, (G1, G2), strict=True):
        axes.plot(*end, "o", color=colour, markeredgecolor="white", markersize=8 if rank == 1 else 6)
    if not with_legend:
        return
    axes.annotate(
        str(rank), ends_mm[0], (-9, 0), textcoords="offset points", ha="right", va="center", fontsize=9,
        bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
    )  # fmt: skip


def _legend() -> tuple[list[Artist], list[str]]:
    from matplotlib.lines import Line2D

    return [Line2D([], [], marker="o", linestyle="", color=colour) for colour in (G1, G2)], ["g1", "g2"]
