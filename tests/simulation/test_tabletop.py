"""Neighbours of the object on the simulated table."""

import numpy as np
import pytest

from tacpipe.simulation import depth_camera
from tests.simulation import solids


def test_what_lies_beside_an_object_may_first_be_tried_where_the_camera_does_not_look(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    up = np.array([0.0, 0.0, -1.0])
    rest_pose = solids.BOX.rests()[0]
    placed = depth_camera.place_shape(solids.BOX, rest_pose, 0.0, (0.0, 0.0), up, 0.8)
    find_window, tried = depth_camera.window, []

    def window(candidate: depth_camera.Placed) -> tuple[range, range]:
        tried.append(candidate)
        return (range(0), range(0)) if len(tried) == 1 else find_window(candidate)

    monkeypatch.setattr(depth_camera, "window", window)
    neighbour = depth_camera._place_neighbour(placed, solids.BOX, up, 0.8, np.random.default_rng(0))

    assert len(tried) > 1 and neighbour is tried[-1]
    apart_m = np.linalg.norm(neighbour.origin_m - placed.origin_m)
    assert apart_m > solids.BOX.bound_m
