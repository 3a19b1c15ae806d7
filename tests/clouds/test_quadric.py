from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tacpipe.clouds import geometry

RNG_POINTS = 400


def on_ellipsoid(rng: np.random.Generator, radii_m: np.ndarray) -> np.ndarray:
    directions = rng.normal(size=(RNG_POINTS, 3))
    points: np.ndarray = directions / np.linalg.norm(directions, axis=1)[:, None] * radii_m
    return points


@settings(max_examples=30, deadline=None)
@given(radii_mm=st.tuples(*[st.floats(20, 60)] * 3), seed=st.integers(0, 10_000))
def test_an_ellipsoids_normals_are_found_also_on_the_side_that_was_not_seen(
    radii_mm: tuple[float, float, float], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    radii_m = np.array(radii_mm) / 1000
    points = on_ellipsoid(rng, radii_m)
    visible = points[points[:, 2] > 0]  # Seen from above
    turn, shift_m = Rotation.random(rng=rng), rng.uniform(-1, 1, 3)
    misfit_m, surface = geometry.fit_quadric(turn.apply(visible) + shift_m)
    assert misfit_m < 1e-6
    hidden = points[points[:, 2] < 0][0]
    truth = turn.apply(hidden / radii_m**2)
    truth /= np.linalg.norm(truth)
    assert abs(surface.normal(turn.apply(hidden) + shift_m) @ truth) == pytest.approx(1, abs=1e-4)


def test_the_misfit_is_the_noise_of_the_points() -> None:
    rng = np.random.default_rng(0)
    points = on_ellipsoid(rng, np.array([0.05, 0.05, 0.05])) * (1 + rng.normal(0, 0.02, (RNG_POINTS, 1)))
    misfit_m, _ = geometry.fit_quadric(points)
    assert misfit_m == pytest.approx(0.001, rel=0.15)  # 2 % of 50 mm


def test_points_of_a_plane_face_along_its_normal() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.05, 0.05, (RNG_POINTS, 2)), rng.normal(0, 1e-5, RNG_POINTS)])
    _, surface = geometry.fit_quadric(points)
    assert abs(surface.normal(points[0])[2]) == pytest.approx(1, abs=1e-2)
