"""Render the camera's view before segmentation: a table, the grasped object, and another object next to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tacpipe.arrays import Floats
from tacpipe.channels import schema
from tacpipe.clouds.cloud import Cloud
from tacpipe.simulation import depth_camera
from tacpipe.simulation.depth_camera import Placed
from tacpipe.simulation.primitives import Shape

TABLE, OBJECT, CLUTTER = 0, 1, 2
GAP_M = (0.04, 0.10)  # gap between the bounding spheres of the two bodies
SIDES = 60  # number of directions tried for the other body
HALF_M = (0.45, 0.35)  # half the table's edges along x and y
EDGE_PX = 10  # margin of the other body to the edge of the image


@dataclass(frozen=True)
class View:
    """All points that the camera gives, and what each lies on: the table, the object or clutter (point,)."""

    cloud: Cloud
    surface: NDArray[np.int8]


def view(
    placed: Placed, neighbour: Shape, up: Floats, camera_m: float, noise_scale: float, rng: np.random.Generator
) -> View:
    """Return the camera's view of a body on the table, with a body ``neighbour`` set down next to it."""
    through = depth_camera.rays(range(depth_camera.HEIGHT), range(depth_camera.WIDTH))
    depth = _table(through, up, camera_m)
    surface = np.full(len(depth), TABLE, np.int8)
    bodies = [(OBJECT, placed), (CLUTTER, _place_neighbour(placed, neighbour, up, camera_m, rng))]
    for kind, body in bodies:
        rows, columns = depth_camera.window(body)
        pixels = (np.array(rows)[:, None] * depth_camera.WIDTH + np.array(columns)).ravel()
        deep = body.hit(np.zeros((1, 3)), through[pixels])
        nearer = deep < depth[pixels]
        depth[pixels[nearer]] = deep[nearer]
        surface[pixels[nearer]] = kind
    met = np.isfinite(depth)
    through, depth, surface = through[met], depth[met], surface[met]
    colours = depth_camera.painted(through * depth[:, None], rng)
    for kind, body in bodies:
        visible = surface == kind
        colours[visible] = depth_camera.painted(body.inward(through[visible] * depth[visible, None]), rng)
    return View(Cloud(depth_camera.measured(through, depth, noise_scale, rng), colours), surface)


def tables(view: View) -> dict[str, pa.Table]:
    """Return the stream ``scene``, and ``scene_truth`` with a row a point: 0 the table, 1 the object, 2 another one."""
    truth = pa.Table.from_arrays([pa.array(view.surface)], schema=pa.schema([schema.label_field("gt_surface")]))
    return {"scene": view.cloud.table(), "scene_truth": truth}


def _table(through: Floats, up: Floats, camera_m: float) -> Floats:
    """Return how deep rays meet the table (ray,), inf beyond its edges."""
    depth = np.asarray(camera_m * up[2] / (through @ up))
    off = np.abs(through[:, :2] * depth[:, None]) <= HALF_M
    return np.where(off.all(axis=1) & (depth > 0), depth, np.inf)


def _place_neighbour(placed: Placed, neighbour: Shape, up: Floats, camera_m: float, rng: np.random.Generator) -> Placed:
    """Return a body put down next to another, where the camera sees all of it if there is such a place."""
    rests = neighbour.rests()
    pose = rests[int(rng.integers(len(rests)))]
    centre = placed.origin_m[:2] / placed.origin_m[2] * camera_m
    best = None
    for _ in range(SIDES):
        angle, gap = rng.uniform(0, 2 * np.pi), rng.uniform(*GAP_M)
        x, y = centre + (placed.shape.bound_m + neighbour.bound_m + gap) * np.array([np.cos(angle), np.sin(angle)])
        best = depth_camera.place_shape(
            neighbour, pose, float(rng.uniform(0, 2 * np.pi)), (float(x), float(y)), up, camera_m
        )
        rows, columns = depth_camera.window(best)
        visible = len(rows) and len(columns)  # it may lie next to the picture
        if visible and min(rows[0], columns[0]) > EDGE_PX and rows[-1] + EDGE_PX < depth_camera.HEIGHT:
            break
    assert best is not None
    return best
