"""What a hand-made eye sees of an object about to be grasped: sizes, shapes and colours as numbers.

All lengths are in metres and in the axes of the grasp (`tacpipe.clouds.frame`), with the middle between the fingers as
origin: they do not change when object, grasp and wrist are moved together, and they keep the sizes and curvatures on
which contact depends, which scaling a cloud to a unit box throws away.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations_with_replacement

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.clouds import quadric
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.frame import local_points, wrist_of
from tacpipe.clouds.grasp import Grasp

QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9)
RADII_M = (0.015, 0.025, 0.04)  # of the patches about each contact: a fingertip's pad, and what lies next to it
SLICE_M = 0.01  # half the thickness of the slice that the fingers close in
BINS = 10  # of that slice, from finger to finger
NEAREST = 50  # points whose mean colour is that of a contact
FEWEST = 6  # points of a patch below which its shape is not stated
NEAR_M = 0.05  # about a contact, within which a quadric is fitted
FEWEST_FITTED = 30  # points below which none is
AXES = ("approach", "closing", "third")
PAIRS = tuple(combinations_with_replacement(range(3), 2))
PAIR_NAMES = tuple(f"{AXES[one]}_{AXES[other]}" for one, other in PAIRS)


def features(cloud: Cloud, grasp: Grasp) -> dict[str, float]:
    """Return the features of a grasp on a cloud by name; those of colours only where the cloud has them.

    Lengths are metres, colours 0 to 255. The cloud must have two points or more.
    """
    points = local_points(cloud.points_m, grasp)  # (point, axis)
    found = {"opening_m": grasp.opening_m, "points": float(len(cloud))}
    found |= _extent(points)
    found |= _principal_axes(points)
    found |= _profile(points, grasp.opening_m)
    for name, place_m in (("g1", -grasp.opening_m / 2), ("g2", grasp.opening_m / 2)):
        away = np.linalg.norm(points - np.array([0.0, place_m, 0.0]), axis=1)  # (point,)
        for radius_m in RADII_M:
            found |= _patch(f"{name}_{radius_m * 1000:.0f}mm", points[away < radius_m], place_m, len(points))
        found |= _fitted(f"{name}_whole", points, place_m) | _fitted(f"{name}_near", points[away < NEAR_M], place_m)
        if cloud.colours is not None:
            nearest = np.argsort(away, kind="stable")[:NEAREST]
            found |= _named(f"{name}_colour", cloud.colours[nearest].mean(axis=0), "rgb")
    if cloud.colours is not None:
        found |= _colours(cloud.colours.astype(np.float64))
    return found


def place(grasp: Grasp) -> dict[str, float]:
    """Return where the grasp is and how it is turned in the frame of its cloud: these change when all is moved."""
    wrist = wrist_of(grasp)
    found = _named("g1_m", grasp.g1_m, "xyz") | _named("g2_m", grasp.g2_m, "xyz")
    return found | _named("approach", wrist[:, 0], "xyz") | _named("closing", wrist[:, 1], "xyz")


def table(
    clouds: Sequence[Cloud], grasps: Sequence[Grasp], *, coloured: bool, placed: bool = False
) -> tuple[Floats, tuple[str, ...]]:
    """Return the features of many grasps (grasp, feature) and their names.

    There must be one grasp or more. Without ``coloured`` those of colour are left out, else every cloud must have
    colours; with ``placed`` those of `place` are added.
    """
    rows = []
    for cloud, grasp in zip(clouds, grasps, strict=True):
        found = features(cloud if coloured else Cloud(cloud.points_m), grasp)
        rows.append(found | place(grasp) if placed else found)
    names = tuple(rows[0])
    return np.array([[row[name] for name in names] for row in rows]), names


def _named(name: str, values: Sequence[float] | Floats, parts: Sequence[str]) -> dict[str, float]:
    return {f"{name}_{part}": float(value) for part, value in zip(parts, values, strict=True)}


def _extent(points: Floats) -> dict[str, float]:
    """Return where the object lies about the grasp: mean, bounds and quantiles along each axis."""
    low, high = points.min(axis=0), points.max(axis=0)
    found = _named("mean_m", points.mean(axis=0), AXES)
    for name, values in (("low_m", low), ("high_m", high), ("extent_m", high - low)):
        found |= _named(name, values, AXES)
    for share, values in zip(QUANTILES, np.quantile(points, QUANTILES, axis=0), strict=True):
        found |= _named(f"quantile{share * 100:.0f}_m", values, AXES)
    return found


def _principal_axes(points: Floats) -> dict[str, float]:
    """Return the object's principal sizes, how its axes lie to the grasp, and where along the longest the grasp is.

    An axis has two ends and no sign, so that products of its components are given.
    """
    centre = points.mean(axis=0)
    variances, directions = np.linalg.eigh(np.cov(points.T))
    longest = directions[:, -1]
    along = (points - centre) @ longest
    length = max(float(np.ptp(along)), 1e-9)
    at = float(-centre @ longest)
    found = _named("spread_m", np.sqrt(np.maximum(variances[::-1], 0)), ("first", "second", "third"))
    for name, axis in (("first_axis", longest), ("second_axis", directions[:, 1])):
        found |= _named(name, [axis[one] * axis[other] for one, other in PAIRS], PAIR_NAMES)
    found |= {"length_m": length, "along_m": abs(at), "along": abs(at) / length}
    widths = [float(np.ptp(points @ directions[:, index])) for index in (1, 0)]
    return found | _named("width_m", widths, ("second", "third"))


def _profile(points: Floats, opening_m: float) -> dict[str, float]:
    """Return the height of the slice between the fingers, from the first to the second; 0 where nothing is seen."""
    inside = points[np.abs(points[:, 2]) < SLICE_M]
    bins = np.floor((inside[:, 1] / opening_m + 0.5) * BINS).astype(int)
    heights = [float(np.median(at)) if len(at := inside[bins == index, 0]) else 0.0 for index in range(BINS)]
    return _named("profile_m", heights, [str(index) for index in range(BINS)])


def _patch(name: str, points: Floats, place_m: float, total: int) -> dict[str, float]:
    """Return the shape of the surface about a contact: how much of it is seen, its spreads, flatness and normal."""
    parts = (
        "share",
        "spread3_m",
        "spread2_m",
        "spread1_m",
        "flatness",
        *(f"normal_{axis}" for axis in AXES),
        "offset_m",
    )
    if len(points) < FEWEST:
        return _named(name, np.zeros(len(parts)), parts)
    variances, directions = np.linalg.eigh(np.cov(points.T))
    variances = np.maximum(variances, 0)
    normal = _outwards(directions[:, 0], place_m)
    offset = (points.mean(axis=0) - (0.0, place_m, 0.0)) @ normal
    flatness = variances[0] / max(variances.sum(), 1e-18)
    return _named(name, [len(points) / total, *np.sqrt(variances), flatness, *normal, offset], parts)


def _fitted(name: str, points: Floats, place_m: float) -> dict[str, float]:
    """Return how well a quadric fits the points, and which way it faces at a contact, whether that is seen or not."""
    parts = ("misfit_m", *(f"faces_{axis}" for axis in AXES))
    if len(points) < FEWEST_FITTED:
        return _named(name, np.zeros(len(parts)), parts)
    misfit_m, surface = quadric.fitted(points)
    normal = _outwards(surface.normal(np.array([0.0, place_m, 0.0])), place_m)
    return _named(name, [misfit_m, *normal], parts)


def _outwards(normal: Floats, place_m: float) -> Floats:
    """Return a normal at a contact with the sign that points away from the object: up, and to the finger's side."""
    return normal if np.sign(place_m) * normal[1] - normal[0] > 0 else -normal


def _colours(colours: Floats) -> dict[str, float]:
    """Return mean, spread and quantiles of the colours, and of their shares, which shade leaves as they are."""
    proportions = colours / (colours.sum(axis=1, keepdims=True) + 1)
    found = _named("colour_mean", colours.mean(axis=0), "rgb") | _named("colour_spread", colours.std(axis=0), "rgb")
    for share, values in zip((10, 50, 90), np.quantile(colours, (0.1, 0.5, 0.9), axis=0), strict=True):
        found |= _named(f"colour_quantile{share}", values, "rgb")
    return (
        found
        | _named("share_mean", proportions.mean(axis=0), "rgb")
        | _named("share_spread", proportions.std(axis=0), "rgb")
    )
