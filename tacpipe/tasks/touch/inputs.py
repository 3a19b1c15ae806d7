"""Build network inputs: points sampled from a grasp's cloud or near its contacts, and numeric features of the grasp."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tacpipe.arrays import Float32s, Floats, Indices
from tacpipe.clouds import geometry
from tacpipe.clouds import grasp as frame
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.geometry import (
    NORMALISATIONS,
    Extent,
    normalise,
    normalise_colours,
    random_rotation,
)
from tacpipe.clouds.grasp import Grasp, local_points
from tacpipe.errors import TacpipeError

Arrays = tuple[Float32s, Float32s]

MODES = ("xyz", "rgb", "xyzcont", "rgbcont", "xyzpose", "rgbpose")
WRISTS = ("given", "estimated")


@dataclass(frozen=True)
class CloudInputs:
    """Input options: one of the six modes of the letter, number of points, normalisation and rotation."""

    mode: str
    points: int
    normalisation: str
    rotation_deg: float = 0.0  # maximum angle of the random training rotation about each axis
    wrist: str = "given"

    def __post_init__(self) -> None:
        """Raise `TacpipeError` for invalid options."""
        for name, choices in (("mode", MODES), ("normalisation", NORMALISATIONS), ("wrist", WRISTS)):
            if getattr(self, name) not in choices:
                label = "inputs" if name == "mode" else name
                raise TacpipeError(f"{label} is {getattr(self, name)!r}; it must be one of {', '.join(choices)}.")
        if self.points < 1:
            raise TacpipeError(f"points is {self.points}; it must be 1 or more.")
        if not 0 <= self.rotation_deg <= 180:
            raise TacpipeError(f"rotation_deg is {self.rotation_deg}; it must lie between 0 and 180.")

    @property
    def coloured(self) -> bool:
        """Whether colours are read."""
        return self.mode.startswith("rgb")

    @property
    def channels(self) -> int:
        """Number of values per point."""
        return 6 if self.coloured else 3

    @property
    def posed(self) -> bool:
        """Whether the wrist rotation is read."""
        return self.mode.endswith("pose")

    @property
    def grasp_numbers(self) -> int:
        """Number of grasp features: 0, both contact points, or these and the wrist rotation."""
        return 15 if self.posed else 6 if self.mode.endswith("cont") else 0

    def sources(self, names: Sequence[str], clouds: Sequence[Cloud], grasps: Sequence[Grasp]) -> CloudSources:
        """Return a sampler of these clouds and grasps. Raises `TacpipeError` if one lacks an input."""
        return CloudSources(self, names, clouds, grasps)


class CloudSources:
    """Samples points of clouds with grasps."""

    def __init__(
        self, inputs: CloudInputs, names: Sequence[str], clouds: Sequence[Cloud], grasps: Sequence[Grasp]
    ) -> None:
        """Store clouds and grasps.

        Raises `TacpipeError` if a cloud has too few points or no colours, or a grasp has no wrist.
        """
        self.inputs, self.clouds, self.grasps = inputs, clouds, grasps
        for name, cloud, grasp in zip(names, clouds, grasps, strict=True):
            _check(inputs, name, cloud, grasp)

    @cached_property
    def extents(self) -> list[Extent]:
        """Extent of each cloud."""
        return [Extent.from_cloud(cloud) for cloud in self.clouds]

    @cached_property
    def wrists(self) -> list[Floats | None]:
        """The rotation (component, axis) of each grasp's wrist, or its estimate; None if the grasp has no wrist."""
        if self.inputs.wrist == "estimated":
            return [frame.estimate_wrist(grasp) for grasp in self.grasps]
        return [grasp.wrist for grasp in self.grasps]

    def draw(self, indices: Sequence[int], rng: np.random.Generator) -> Arrays:
        """Return sampled, randomly rotated points (cloud, point, channel) and grasp features (cloud, number)."""
        return self._arrays([(index, rng) for index in indices], self.inputs.rotation_deg)

    def fixed(self, indices: Sequence[int], visit: int) -> Arrays:
        """Return the same arrays without rotation; the sample depends only on the cloud and on ``visit``."""
        rngs = [np.random.default_rng([visit, zlib.crc32(self.clouds[index].points_m.tobytes())]) for index in indices]
        return self._arrays(list(zip(indices, rngs, strict=True)), 0.0)

    def _arrays(self, draws: Sequence[tuple[int, np.random.Generator]], largest_deg: float) -> Arrays:
        """Return the network's input for grasps, each given as an index and a random generator: points and numbers.

        Points (grasp, point, channel) are drawn, rotated by up to ``largest_deg`` and normalised.
        """
        inputs = self.inputs
        points = np.empty((len(draws), inputs.points, inputs.channels), np.float32)
        numbers = np.empty((len(draws), inputs.grasp_numbers), np.float32)
        for row, (index, rng) in enumerate(draws):
            cloud, grasp, extent = self.clouds[index], self.grasps[index], self.extents[index]
            rotation = random_rotation(rng, largest_deg)
            own_wrist = self.wrists[index]
            wrist = None if own_wrist is None else rotation @ own_wrist
            indices = rng.choice(len(cloud), inputs.points, replace=False, shuffle=False)
            positions = np.concatenate([cloud.points_m[indices], grasp.g1_m[None], grasp.g2_m[None]]) @ rotation.T
            positions = normalise(inputs.normalisation, positions, extent, rotation, wrist)
            points[row, :, :3] = positions[:-2]
            if inputs.coloured:
                assert cloud.colours is not None
                points[row, :, 3:] = normalise_colours(inputs.normalisation, cloud.colours[indices] / 255.0, extent)
            if inputs.grasp_numbers:
                numbers[row, :6] = positions[-2:].ravel()
            if inputs.posed:
                assert wrist is not None
                numbers[row, 6:] = wrist.ravel()
        return points, numbers


def _check(inputs: CloudInputs, name: str, cloud: Cloud, grasp: Grasp) -> None:
    """Raise `TacpipeError` if a cloud lacks points or required colours, or a grasp a required wrist."""
    if len(cloud) < inputs.points:
        raise TacpipeError(
            f"{name} has a cloud of {len(cloud)} points, and {inputs.points} are to be drawn of each. Leave it out, or "
            f"train with fewer points."
        )
    if inputs.coloured and cloud.colours is None:
        raise TacpipeError(
            f"{name} has a cloud without colours, which the inputs {inputs.mode} need. Train with inputs of xyz."
        )
    if (inputs.posed or inputs.normalisation == "wrist") and inputs.wrist == "given" and grasp.wrist is None:
        raise TacpipeError(
            f"{name} has no rotation of the wrist, which inputs {inputs.mode} with normalisation "
            f"{inputs.normalisation} need. Choose others, or --wrist estimated, which makes it of the closing axis and the "
            f"camera's line of sight."
        )


UNIT_M = 0.05  # length that is scaled to 1
PATCH_COUNT = 3  # patch about g1, patch about g2, whole cloud


@dataclass(frozen=True)
class PatchOptions:
    """Patch options: radius, number of points per patch, and whether colours and grasp position are read."""

    points: int
    radius_m: float
    coloured: bool
    placed: bool

    def __post_init__(self) -> None:
        """Raise `TacpipeError` for invalid options."""
        if self.points < 1:
            raise TacpipeError(f"points is {self.points}; it must be 1 or more.")
        if not self.radius_m > 0:
            raise TacpipeError(f"radius_mm is {self.radius_m * 1000:g}; it must be above 0.")

    @property
    def channels(self) -> int:
        """Number of values per point."""
        return 6 if self.coloured else 3

    @property
    def grasp_numbers(self) -> int:
        """Number of grasp features: the opening and, with position, both points, approach and closing direction."""
        return 13 if self.placed else 1

    def sources(self, names: Sequence[str], clouds: Sequence[Cloud], grasps: Sequence[Grasp]) -> PatchSources:
        """Return a sampler of patches of these clouds. Raises `TacpipeError` if a cloud lacks required colours."""
        return PatchSources(self, names, clouds, grasps)


class PatchSources:
    """Samples patches of clouds with grasps."""

    def __init__(
        self, patches: PatchOptions, names: Sequence[str], clouds: Sequence[Cloud], grasps: Sequence[Grasp]
    ) -> None:
        """Store clouds and grasps. Raises `TacpipeError` if a cloud lacks required colours."""
        self.patches = patches
        self.clouds: list[Float32s] = []  # each of shape (point, channel)
        self.near: list[list[Indices]] = []  # indices of points near g1 and near g2
        if patches.coloured:
            require_colours(names, clouds)
        for cloud, grasp in zip(clouds, grasps, strict=True):
            points = local_points(cloud.points_m, grasp)
            self.near.append(
                [_contact_indices(points, sign * grasp.opening_m / 2, patches.radius_m) for sign in (-1, 1)]
            )
            parts = [points / UNIT_M]
            if patches.coloured and cloud.colours is not None:
                parts.append(cloud.colours / 127.5 - 1.0)
            self.clouds.append(np.concatenate(parts, axis=1).astype(np.float32))
        self.numbers = _grasp_features(grasps, patches.placed)

    def draw(self, indices: Sequence[int], rng: np.random.Generator) -> Arrays:
        """Return sampled patches (cloud, patch, point, channel) and grasp features (cloud, number)."""
        return self._arrays([(index, rng) for index in indices])

    def fixed(self, indices: Sequence[int], visit: int) -> Arrays:
        """Return the same arrays; the sample depends only on the cloud, in the grasp's axes, and on ``visit``."""
        rngs = [np.random.default_rng([visit, zlib.crc32(self.clouds[index].tobytes())]) for index in indices]
        return self._arrays(list(zip(indices, rngs, strict=True)))

    def _arrays(self, draws: Sequence[tuple[int, np.random.Generator]]) -> Arrays:
        """Return the drawn points of the patches (grasp, patch, point, channel), and the numbers of the grasps."""
        count = self.patches.points
        points = np.empty((len(draws), PATCH_COUNT, count, self.patches.channels), np.float32)
        for row, (index, rng) in enumerate(draws):
            cloud = self.clouds[index]
            for patch, indices in enumerate((*self.near[index], np.arange(len(cloud)))):
                points[row, patch] = cloud[indices[_random_indices(len(indices), count, rng)]]
        return points, self.numbers[[index for index, _ in draws]]


def require_colours(names: Sequence[str], clouds: Sequence[Cloud]) -> None:
    """Raise `TacpipeError` with the name of the first cloud that has no colours."""
    for name, cloud in zip(names, clouds, strict=True):
        if cloud.colours is None:
            raise TacpipeError(
                f"{name} has a cloud without colours, and the model reads colours. Train with inputs of xyz."
            )


def _contact_indices(points: Floats, contact_m: float, radius_m: float) -> Indices:
    """Return the indices of the points (point, xyz) within a radius of a contact, or of the nearest point.

    ``contact_m`` is the contact's position along y, the closing axis.
    """
    distances = np.linalg.norm(points - np.array([0.0, contact_m, 0.0]), axis=1)
    near = np.flatnonzero(distances <= radius_m)
    return near if len(near) else np.array([int(distances.argmin())])


def _random_indices(total: int, count: int, rng: np.random.Generator) -> Indices:
    """Return ``count`` random indices below ``total``; an index repeats only after all have been used."""
    if count <= total:
        return rng.choice(total, count, replace=False, shuffle=False)
    return np.concatenate([np.arange(total), rng.integers(0, total, count - total)])


def _grasp_features(grasps: Sequence[Grasp], with_position: bool) -> Float32s:
    """Return the opening of each grasp and, with its position, `geometry.pose_features` (grasp, number)."""
    rows = [
        [grasp.opening_m / UNIT_M] + (list(geometry.pose_features(grasp).values()) if with_position else [])
        for grasp in grasps
    ]
    return np.array(rows, np.float32)
