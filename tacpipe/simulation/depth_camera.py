"""A depth camera that looks down on a table: which points of bodies it sees, how exactly, and in what colours.

The camera's frame: x to the right of the image, y down, z along the optical axis. Its rays run through the pixels of an
Intel RealSense D415 at 640 x 480. Depth is noisy, the more the farther: 1.5 mm at 1 m, growing with the square, as
stereo errors do. Colours are random and state nothing of the object.
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
DEPTH_NOISE_M = 0.0015  # standard deviation at 1 m
COLOUR_NOISE = 6.0  # standard deviation, of 255
RIPPLES = 3  # waves in a texture
WAVE_M = (0.01, 0.08)  # their lengths


@dataclass(frozen=True)
class Placed:
    """A body in the camera's frame: the rotation from its own frame (3, 3), and where its origin is (xyz), metres."""

    shape: Shape
    rotation: Floats
    origin_m: Floats

    def inward(self, at_m: Floats) -> Floats:
        """Return points of the camera's frame in the body's (point, xyz), metres."""
        return np.asarray((at_m - self.origin_m) @ self.rotation)

    def hit(self, origin_m: Floats, direction: Floats) -> Floats:
        """Return how far along each ray of the camera's frame the body is first met (ray,); inf where never."""
        return self.shape.hit(self.inward(origin_m), direction @ self.rotation)

    def normal(self, at_m: Floats) -> Floats:
        """Return the outward unit normals at points of the surface (point, xyz)."""
        return np.asarray(self.shape.normal(self.inward(at_m)) @ self.rotation.T)

    def bending(self, at_m: Floats) -> Floats:
        """Return the matrices of the normal curvatures (point, xyz, xyz), 1/m."""
        return np.asarray(self.rotation @ self.shape.bending(self.inward(at_m)) @ self.rotation.T)


def camera(rng: np.random.Generator, height_m: tuple[float, float], tilt_rad: float) -> tuple[Floats, float]:
    """Return the table's upward normal in the camera's frame (xyz) and how far it is along the optical axis, metres.

    The camera looks straight down but for a tilt of up to ``tilt_rad``.
    """
    tilt, turn = tilt_rad * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
    up = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)])
    return up, float(rng.uniform(*height_m))


def place_shape(
    shape: Shape, pose: Rest, yaw_rad: float, at_m: tuple[float, float], up: Floats, height_m: float
) -> Placed:
    """Return a body lying on the table as ``pose`` states, turned by ``yaw_rad`` about the vertical.

    ``at_m`` is where the camera sees its origin: x and y on the optical axis' plane at ``height_m``, metres.
    """
    ray = np.array([*at_m, height_m]) / height_m
    ground = ray * height_m * up[2] / (ray @ up)
    basis, target_basis = _basis(pose.up), _basis(up)
    turn = np.array([[np.cos(yaw_rad), -np.sin(yaw_rad), 0], [np.sin(yaw_rad), np.cos(yaw_rad), 0], [0, 0, 1.0]])
    return Placed(shape, target_basis @ turn @ basis.T, ground + pose.height_m * up)


def rays(rows: range, columns: range) -> Floats:
    """Return the directions of a window of pixels (ray, xyz), row by row, each one metre deep."""
    y, x = np.meshgrid(rows, columns, indexing="ij")
    return (
        np.column_stack([(x.ravel() - WIDTH / 2 + 0.5), (y.ravel() - HEIGHT / 2 + 0.5), np.full(x.size, FOCAL)]) / FOCAL
    )


def window(placed: Placed) -> tuple[range, range]:
    """Return the rows and columns of the pixels that may see a body: those about its bounding sphere."""
    x, y, z = placed.origin_m
    reach = placed.shape.bound_m / (z - placed.shape.bound_m) * FOCAL * 1.1

    def clip_range(centre: float, size: int) -> range:
        middle = centre * FOCAL + size / 2
        return range(max(0, int(middle - reach)), min(size, int(middle + reach) + 2))

    return clip_range(y / z, HEIGHT), clip_range(x / z, WIDTH)


def depths(placed: Placed) -> tuple[Floats, Floats]:
    """Return the directions of the rays that meet a body (ray, xyz), one metre deep, and how deep they do (ray,), metres."""
    through = rays(*window(placed))
    deep = placed.hit(np.zeros((1, 3)), through)
    met = np.isfinite(deep)
    return through[met], deep[met]


def measured(direction: Floats, depth_m: Floats, noise_scale: float, rng: np.random.Generator) -> Float32s:
    """Return the points that the camera gives (point, xyz), metres: true ones, shifted along their rays by noise."""
    noise = noise_scale * DEPTH_NOISE_M * depth_m**2 * rng.normal(size=len(depth_m))
    return (direction * (depth_m + noise)[:, None]).astype(np.float32)


def painted(own_m: Floats, rng: np.random.Generator) -> Bytes:
    """Return colours (point, rgb) of points in a body's own frame: a random colour, random waves of others, and noise."""
    colours = np.tile(rng.uniform(50, 205, 3), (len(own_m), 1))
    for _ in range(RIPPLES):
        along = rng.normal(size=3)
        along *= 2 * np.pi / rng.uniform(*WAVE_M) / np.linalg.norm(along)
        colours += np.outer(np.sin(own_m @ along + rng.uniform(0, 2 * np.pi)), rng.normal(0, 20, 3))
    colours += rng.normal(0, COLOUR_NOISE, colours.shape)
    return np.rint(colours).clip(0, 255).astype(np.uint8)


def _basis(third: Floats) -> Floats:
    """Return a right-handed basis (component, axis) whose third axis is given."""
    helper = np.eye(3)[int(np.argmin(np.abs(third)))]
    first = np.cross(helper, third)
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(third, first), third])


TABLE, OBJECT, CLUTTER = 0, 1, 2
GAP_M = (0.04, 0.10)  # gap between the bounding spheres of the two bodies
SIDES = 60  # number of directions tried for the other body
HALF_M = (0.45, 0.35)  # half the table's edges along x and y
EDGE_PX = 10  # margin of the other body to the edge of the image


@dataclass(frozen=True)
class CameraView:
    """All points that the camera gives, and what each lies on: the table, the object or clutter (point,)."""

    cloud: Cloud
    surface: NDArray[np.int8]


def view(
    placed: Placed, neighbour: Shape, up: Floats, camera_m: float, noise_scale: float, rng: np.random.Generator
) -> CameraView:
    """Return the camera's view of a body on the table, with a body ``neighbour`` set down next to it."""
    through = rays(range(HEIGHT), range(WIDTH))
    depth = _table(through, up, camera_m)
    surface = np.full(len(depth), TABLE, np.int8)
    bodies = [(OBJECT, placed), (CLUTTER, _place_neighbour(placed, neighbour, up, camera_m, rng))]
    for kind, body in bodies:
        rows, columns = window(body)
        pixels = (np.array(rows)[:, None] * WIDTH + np.array(columns)).ravel()
        deep = body.hit(np.zeros((1, 3)), through[pixels])
        nearer = deep < depth[pixels]
        depth[pixels[nearer]] = deep[nearer]
        surface[pixels[nearer]] = kind
    met = np.isfinite(depth)
    through, depth, surface = through[met], depth[met], surface[met]
    colours = painted(through * depth[:, None], rng)
    for kind, body in bodies:
        visible = surface == kind
        colours[visible] = painted(body.inward(through[visible] * depth[visible, None]), rng)
    return CameraView(Cloud(measured(through, depth, noise_scale, rng), colours), surface)


def tables(view: CameraView) -> dict[str, pa.Table]:
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
        best = place_shape(neighbour, pose, float(rng.uniform(0, 2 * np.pi)), (float(x), float(y)), up, camera_m)
        rows, columns = window(best)
        visible = len(rows) and len(columns)  # it may lie next to the picture
        if visible and min(rows[0], columns[0]) > EDGE_PX and rows[-1] + EDGE_PX < HEIGHT:
            break
    assert best is not None
    return best
