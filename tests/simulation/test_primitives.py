"""Bodies of the simulated table: where rays meet them, normals and curvatures, against equations and differences."""

import numpy as np
import pytest

from tacpipe.simulation.bodies import Bow, Frustum, principal_curvatures
from tests.simulation.solids import (
    BALL,
    BOW,
    BOX,
    CONE,
    CYLINDER,
    ELLIPSOID,
    SHAPES,
    level,
    rays,
    second_differences,
    surface,
)

EVERY = pytest.mark.parametrize("name", SHAPES)


@EVERY
def test_a_ray_ends_on_the_surface_and_has_not_been_within_before(name: str) -> None:
    origin, direction = rays(name, 150, 1)
    way = SHAPES[name].hit(origin, direction)
    met = np.isfinite(way)
    assert 30 < met.sum() < 150
    ends = origin + np.where(met, way, 0)[:, None] * direction
    assert np.abs(level(name, ends[met])).max() < 2e-7
    for start, end in zip(origin[met], ends[met], strict=True):
        before = start + np.linspace(0.5, 0.999, 200)[:, None] * (end - start)
        assert level(name, before).min() > 0


@EVERY
def test_a_ray_that_meets_nothing_is_nowhere_within(name: str) -> None:
    origin, direction = rays(name, 150, 2)
    missed = ~np.isfinite(SHAPES[name].hit(origin, direction))
    for start, way in zip(origin[missed], direction[missed], strict=True):
        along = start + np.linspace(0, 3, 1500)[:, None] * way
        near = along[np.linalg.norm(along, axis=1) < SHAPES[name].bound_m]
        assert not len(near) or level(name, near).min() > -1e-6


@EVERY
def test_normals_point_where_the_level_grows(name: str) -> None:
    at = surface(name, 60)
    at = at[SHAPES[name].margin_m(at) > 0.002]
    steps = 1e-5 * np.eye(3)
    gradient = np.column_stack([level(name, at + step) - level(name, at - step) for step in steps])
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    np.testing.assert_allclose(SHAPES[name].normal(at), gradient, atol=2e-3)


@EVERY
def test_curvatures_are_those_of_heights_over_the_tangent_plane(name: str) -> None:
    shape = SHAPES[name]
    at = surface(name, 40, seed=3)
    at = at[shape.margin_m(at) > 0.002]
    rng = np.random.default_rng(4)
    for point, normal, bending in zip(at, shape.normal(at), shape.bending(at), strict=True):
        if name == "bow" and abs(abs(np.arctan2(*(point + BOW.shift_m)[1::-1])) - 2.0) < 0.05:
            continue  # The curvature jumps between the tube and its round end.
        tangent = np.cross(normal, rng.normal(size=3))
        tangent /= np.linalg.norm(tangent)

        def fall(
            step: float, point: np.ndarray = point, normal: np.ndarray = normal, tangent: np.ndarray = tangent
        ) -> float:
            above = point + 0.01 * normal + step * tangent
            return float(shape.hit(above[None], -normal[None])[0])

        expected = second_differences(fall, 2e-4)
        assert tangent @ bending @ tangent == pytest.approx(expected, rel=0.02, abs=1.5)


def test_principal_curvatures_are_those_known_by_hand() -> None:
    def at(shape: object, *point: float) -> list[float]:
        points = np.array([point])
        return [float(curvature) for curvature in principal_curvatures(shape.bending(points), shape.normal(points))[0]]  # type: ignore[attr-defined]

    assert at(BALL, 0, 0.03, 0) == pytest.approx([1 / 0.03, 1 / 0.03])
    assert at(CYLINDER, 0.03, 0, 0.01) == pytest.approx([0, 1 / 0.03], abs=1e-9)
    assert at(CYLINDER, 0.01, 0, 0.04) == [0, 0]
    assert at(BOX, 0.02, 0, 0) == [0, 0]
    assert at(ELLIPSOID, 0.02, 0, 0) == pytest.approx([0.02 / 0.05**2, 0.02 / 0.03**2])
    slant = np.hypot(1, 0.2)
    assert at(CONE, 0.03, 0, 0) == pytest.approx([0, 1 / (0.03 * slant)], abs=1e-9)
    x = -BOW.shift_m[0]  # The arc's centre.
    assert at(BOW, x + 0.052, 0, 0) == pytest.approx([1 / 0.052, 1 / 0.012])  # outside
    assert at(BOW, x + 0.028, 0, 0) == pytest.approx([-1 / 0.028, 1 / 0.012])  # The inner side.


@EVERY
def test_a_body_at_rest_touches_the_table_and_nothing_of_it_is_below(name: str) -> None:
    at = surface(name, 3000, seed=5)
    for rest_pose in SHAPES[name].rests():
        assert np.linalg.norm(rest_pose.up) == pytest.approx(1)
        lowest = (at @ rest_pose.up).min()
        assert -rest_pose.height_m - 1e-7 <= lowest
        assert lowest == pytest.approx(-rest_pose.height_m, abs=0.002)


def test_what_is_too_tall_for_its_foot_only_lies() -> None:
    assert len(Frustum(0.01, 0.01, 0.06).rests()) == 1
    assert len(Frustum(0.03, 0.03, 0.06).rests()) == 2


@EVERY
def test_nothing_of_a_body_is_outside_of_its_bound(name: str) -> None:
    assert np.linalg.norm(surface(name, 500, seed=6), axis=1).max() <= SHAPES[name].bound_m + 1e-9


def test_margins_are_those_measured_by_hand() -> None:
    assert BOX.margin_m(np.array([[0.02, 0.025, 0.01]]))[0] == pytest.approx(0.005)
    assert CYLINDER.margin_m(np.array([[0.03, 0, 0.03]]))[0] == pytest.approx(0.01)
    assert CYLINDER.margin_m(np.array([[0.01, 0, 0.04]]))[0] == pytest.approx(0.02)
    assert CONE.margin_m(np.array([[0.03, 0, 0.0]]))[0] == pytest.approx(0.05 * np.hypot(1, 0.2))
    assert np.isinf(BALL.margin_m(np.array([[0.03, 0, 0.0]]))[0])


def test_the_distance_from_a_bow_is_that_from_the_balls_along_its_arc() -> None:
    at = np.random.default_rng(7).uniform(-0.08, 0.08, (200, 3))
    np.testing.assert_allclose(Bow(0.04, 0.012, 2.0).distance_m(at), level("bow", at), atol=1e-6)
