"""Simulate a depth camera above a table: the visible points of bodies, with depth noise and colours.

In the camera frame, x points right in the image, y down, and z along the optical axis. The rays are those of the pixels
of an Intel RealSense D415 at 640 x 480. Depth noise is 1.5 mm at 1 m and increases with the square of the distance, as
for stereo. Colours are random and independent of the object.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tacpipe.arrays import Bytes, Float32s, Floats
from tacpipe.channels import schema
from tacpipe.clouds.cloud import Cloud
from tacpipe.simulation.bodies import Rest, Shape

WIDTH, HEIGHT, FOCAL = 640, 480, 615.0  # pixels
DEPTH_NOISE_M = 0.0015  # standard deviation of the depth at a distance of 1 m
COLOUR_NOISE = 6.0  # standard deviation of a colour value from 0 to 255
RIPPLES = 3  # number of waves in a texture
WAVE_M = (0.01, 0.08)  # range of the wavelengths of ripples


@dataclass(frozen=True)
class Placed:
    """A body in the camera frame: the rotation from its own frame (3, 3), and the position of its origin (xyz) in metres."""

    shape: Shape
    rotation: Floats
    origin_m: Floats

    def to_body_frame(self, at_m: Floats) -> Floats:
        """Transform points (point, xyz) in metres from the camera frame to the body frame."""
        return np.asarray((at_m - self.origin_m) @ self.rotation)

    def hit(self, origin_m: Floats, direction: Floats) -> Floats:
        """Return the distance of the first intersection of rays in the camera frame (ray,); inf if there is none."""
        return self.shape.hit(self.to_body_frame(origin_m), direction @ self.rotation)

    def normal(self, at_m: Floats) -> Floats:
        """Return the outward unit normals at points of the surface (point, xyz)."""
        return np.asarray(self.shape.normal(self.to_body_frame(at_m)) @ self.rotation.T)

    def bending(self, at_m: Floats) -> Floats:
        """Return the curvature matrices (point, xyz, xyz) in 1/m."""
        return np.asarray(self.rotation @ self.shape.bending(self.to_body_frame(at_m)) @ self.rotation.T)


def sample_camera(rng: np.random.Generator, height_m: tuple[float, float], tilt_rad: float) -> tuple[Floats, float]:
    """Return the table's upward normal in the camera frame (xyz), and its distance along the optical axis in metres.

    The camera looks straight down, with a random tilt of up to ``tilt_rad``.
    """
    tilt, turn = tilt_rad * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
    up = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)])
    return up, float(rng.uniform(*height_m))


def place_shape(
    shape: Shape, pose: Rest, yaw_rad: float, at_m: tuple[float, float], up: Floats, height_m: float
) -> Placed:
    """Return a body on the table in a stable ``pose``, rotated by ``yaw_rad`` around the vertical.

    ``at_m`` is the apparent position of its origin in metres: x and y in the plane at ``height_m`` on the optical axis.
    """
    ray = np.array([*at_m, height_m]) / height_m
    ground = ray * height_m * up[2] / (ray @ up)
    basis, target_basis = _basis(pose.up), _basis(up)
    turn = np.array([[np.cos(yaw_rad), -np.sin(yaw_rad), 0], [np.sin(yaw_rad), np.cos(yaw_rad), 0], [0, 0, 1.0]])
    return Placed(shape, target_basis @ turn @ basis.T, ground + pose.height_m * up)


def rays(rows: range, columns: range) -> Floats:
    """Return the ray directions of a window of pixels (ray, xyz), row by row, with a depth of 1 m."""
    y, x = np.meshgrid(rows, columns, indexing="ij")
    return (
        np.column_stack([(x.ravel() - WIDTH / 2 + 0.5), (y.ravel() - HEIGHT / 2 + 0.5), np.full(x.size, FOCAL)]) / FOCAL
    )


def window(placed: Placed) -> tuple[range, range]:
    """Return the rows and columns of the pixels that may see a body, from its bounding sphere."""
    x, y, z = placed.origin_m
    reach = placed.shape.bound_m / (z - placed.shape.bound_m) * FOCAL * 1.1

    def clip_range(centre: float, size: int) -> range:
        middle = centre * FOCAL + size / 2
        return range(max(0, int(middle - reach)), min(size, int(middle + reach) + 2))

    return clip_range(y / z, HEIGHT), clip_range(x / z, WIDTH)


def visible_rays(placed: Placed) -> tuple[Floats, Floats]:
    """Return the directions (ray, xyz), with a depth of 1 m, and depths (ray,) in metres of the rays that reach a body."""
    direction = rays(*window(placed))
    depth = placed.hit(np.zeros((1, 3)), direction)
    is_visible = np.isfinite(depth)
    return direction[is_visible], depth[is_visible]


def noisy_points(direction: Floats, depth_m: Floats, noise_scale: float, rng: np.random.Generator) -> Float32s:
    """Return the measured points (point, xyz) in metres: the true points, shifted along their rays by noise."""
    noise = noise_scale * DEPTH_NOISE_M * depth_m**2 * rng.normal(size=len(depth_m))
    return (direction * (depth_m + noise)[:, None]).astype(np.float32)


def random_colours(own_m: Floats, rng: np.random.Generator) -> Bytes:
    """Return random colours (point, rgb) of points in the body frame: a base colour, waves of other colours, and noise."""
    colours = np.tile(rng.uniform(50, 205, 3), (len(own_m), 1))
    for _ in range(RIPPLES):
        along = rng.normal(size=3)
        along *= 2 * np.pi / rng.uniform(*WAVE_M) / np.linalg.norm(along)
        colours += np.outer(np.sin(own_m @ along + rng.uniform(0, 2 * np.pi)), rng.normal(0, 20, 3))
    colours += rng.normal(0, COLOUR_NOISE, colours.shape)
    return np.rint(colours).clip(0, 255).astype(np.uint8)


def _basis(third: Floats) -> Floats:
    """Return a right-handed basis (component, axis) with the given third axis."""
    helper = np.eye(3)[int(np.argmin(np.abs(third)))]
    first = np.cross(helper, third)
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(third, first), third])


TABLE, OBJECT, CLUTTER = 0, 1, 2
GAP_M = (0.04, 0.10)  # range of the gap between the bounding spheres of the two bodies
SIDES = 60  # number of positions tried for the other body
HALF_M = (0.45, 0.35)  # half the table's edges along x and y
EDGE_PX = 10  # smallest distance of the other body from the edge of the image


@dataclass(frozen=True)
class CameraView:
    """A cloud, and the surface of each of its points (point,): table, object or clutter."""

    cloud: Cloud
    surface: NDArray[np.int8]


def view(
    placed: Placed, neighbour: Shape, up: Floats, camera_m: float, noise_scale: float, rng: np.random.Generator
) -> CameraView:
    """Return the camera's view of a body on the table, with the body ``neighbour`` next to it."""
    direction = rays(range(HEIGHT), range(WIDTH))
    depth = _table_depth(direction, up, camera_m)
    surface = np.full(len(depth), TABLE, np.int8)
    bodies = [(OBJECT, placed), (CLUTTER, _place_neighbour(placed, neighbour, up, camera_m, rng))]
    for kind, body in bodies:
        rows, columns = window(body)
        pixels = (np.array(rows)[:, None] * WIDTH + np.array(columns)).ravel()
        body_depth = body.hit(np.zeros((1, 3)), direction[pixels])
        nearer = body_depth < depth[pixels]
        depth[pixels[nearer]] = body_depth[nearer]
        surface[pixels[nearer]] = kind
    is_visible = np.isfinite(depth)
    direction, depth, surface = direction[is_visible], depth[is_visible], surface[is_visible]
    colours = random_colours(direction * depth[:, None], rng)
    for kind, body in bodies:
        visible = surface == kind
        colours[visible] = random_colours(body.to_body_frame(direction[visible] * depth[visible, None]), rng)
    return CameraView(Cloud(noisy_points(direction, depth, noise_scale, rng), colours), surface)


def tables(view: CameraView) -> dict[str, pa.Table]:
    """Return the streams ``scene`` and ``scene_truth``, which has one row per point: 0 table, 1 object, 2 clutter."""
    truth = pa.Table.from_arrays([pa.array(view.surface)], schema=pa.schema([schema.label_field("gt_surface")]))
    return {"scene": view.cloud.table(), "scene_truth": truth}


def _table_depth(direction: Floats, up: Floats, camera_m: float) -> Floats:
    """Return the depths at which rays reach the table (ray,), or inf beyond its edges."""
    depth = np.asarray(camera_m * up[2] / (direction @ up))
    on_table = np.abs(direction[:, :2] * depth[:, None]) <= HALF_M
    return np.where(on_table.all(axis=1) & (depth > 0), depth, np.inf)


def _place_neighbour(placed: Placed, neighbour: Shape, up: Floats, camera_m: float, rng: np.random.Generator) -> Placed:
    """Return a body next to another one, fully visible if one of `SIDES` random positions allows it."""
    rests = neighbour.rests()
    pose = rests[int(rng.integers(len(rests)))]
    centre = placed.origin_m[:2] / placed.origin_m[2] * camera_m
    best = None
    for _ in range(SIDES):
        angle, gap = rng.uniform(0, 2 * np.pi), rng.uniform(*GAP_M)
        x, y = centre + (placed.shape.bound_m + neighbour.bound_m + gap) * np.array([np.cos(angle), np.sin(angle)])
        best = place_shape(neighbour, pose, float(rng.uniform(0, 2 * np.pi)), (float(x), float(y)), up, camera_m)
        rows, columns = window(best)
        visible = len(rows) and len(columns)  # the body may be outside of the image
        if visible and min(rows[0], columns[0]) > EDGE_PX and rows[-1] + EDGE_PX < HEIGHT:
            break
    assert best is not None
    return best
