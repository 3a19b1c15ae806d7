"""Ray-traced camera views of a tilted table with a grasped ball and a box."""

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Bools, Floats
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.clouds.segmentation import SegmentationLimits

STEP = 0.003  # Spacing of the rays, as tangents: 3.3 mm on the table
DEPTH_M = 1.1  # Depth of the table's middle
LIMITS = SegmentationLimits(
    plane_m=0.006,
    plane_fraction=0.2,
    plane_trials=1000,
    cluster_m=0.012,
    cluster_points=6,
    object_points=50,
    near_m=0.020,
    outlier_neighbours=20,
    outlier_deviations=5.0,
)


@dataclass(frozen=True)
class Scene:
    """A view of the camera, masks of the points of each object, and the grasp of the ball."""

    cloud: Cloud
    ball: Bools  # (point,)
    box: Bools  # (point,)
    grasp: Grasp
    normal: Floats  # Normal of the table (xyz), to the camera's side


def scene(
    seed: int = 0, radius_m: float = 0.035, beside_m: float = 0.12, noise: float = 1.5e-3, tilt_rad: float = 0.5
) -> Scene:
    """Return a ball of ``radius_m`` on a table and a box of 60 x 80 x 100 mm ``beside_m`` from its middle.

    Noise of the depth is ``noise`` x depth² metres, and of 200 points one hangs in the air before what it shows.
    The grasp's fingers touch the ball from both sides, on its equator.
    """
    rng = np.random.default_rng(seed)
    tangents = np.arange(-0.3, 0.3, STEP)
    across, down = (axis.ravel() for axis in np.meshgrid(tangents, tangents))
    rays = np.column_stack([across, down, np.ones(len(across))])  # (ray, xyz), depth 1
    turn = rng.uniform(0, 2 * np.pi)
    normal = np.array([0.0, -np.sin(tilt_rad), -np.cos(tilt_rad)])
    first = np.array([1.0, 0.0, 0.0]) * np.cos(turn) + np.cross(normal, [1.0, 0.0, 0.0]) * np.sin(turn)
    axes = np.stack([first, np.cross(normal, first), normal])  # (axis, xyz), of the table
    foot_m = np.array([0.0, 0.0, DEPTH_M]) + axes[:2].T @ rng.uniform(-0.05, 0.05, 2)
    centre_m = foot_m + radius_m * normal
    direction = axes[:2].T @ _unit(rng.normal(size=2))
    depth_m = np.stack(
        [
            (foot_m @ normal) / (rays @ normal),
            _ball_depth(rays, centre_m, radius_m),
            _box_depth(rays, foot_m + beside_m * direction + 0.05 * normal, axes, np.array([0.03, 0.04, 0.05])),
        ]
    )  # (thing, ray): table, ball, box
    nearest_shape, nearest_m = depth_m.argmin(axis=0), depth_m.min(axis=0)
    nearest_m += noise * nearest_m**2 * rng.normal(size=len(rays))
    stray = rng.random(len(rays)) < 0.005
    nearest_m[stray] *= rng.uniform(0.7, 1.0, np.count_nonzero(stray))
    cloud = Cloud((rays * nearest_m[:, None]).astype(np.float32), rng.integers(0, 256, (len(rays), 3)).astype(np.uint8))
    closing = axes[:2].T @ _unit(rng.normal(size=2))
    grasp = Grasp(centre_m - radius_m * closing, centre_m + radius_m * closing)
    return Scene(cloud, (nearest_shape == 1) & ~stray, (nearest_shape == 2) & ~stray, grasp, normal)


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector))


def _ball_depth(rays: Floats, centre_m: Floats, radius_m: float) -> Floats:
    """Return at which depth each ray meets a ball first, infinite where it does not (ray,)."""
    square, half = np.einsum("rx,rx->r", rays, rays), rays @ centre_m
    inside = half**2 - square * (centre_m @ centre_m - radius_m**2)
    return np.where(inside > 0, (half - np.sqrt(np.maximum(inside, 0))) / square, np.inf)


def _box_depth(rays: Floats, centre_m: Floats, axes: Floats, half_m: Floats) -> Floats:
    """Return the depth at which each ray meets a box first, infinite where it misses, shape (ray,)."""
    across, start_m = rays @ axes.T, -axes @ centre_m  # Coordinates along the box's axes
    ends = (np.stack([-half_m, half_m])[:, None] - start_m) / across  # (side, ray, axis)
    entered, exited = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
    return np.where(entered < exited, entered, np.inf)
