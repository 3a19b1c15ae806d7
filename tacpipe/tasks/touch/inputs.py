"""The inputs of a PointNet: points drawn from the cloud of a grasp, and numbers of the grasp."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tacpipe.arrays import Float32s, Floats
from tacpipe.clouds import frame
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.clouds.normalisation import (
    NORMALISATIONS,
    Extent,
    colours_normalised,
    normalised,
    random_rotation,
)
from tacpipe.errors import TacpipeError

Arrays = tuple[Float32s, Float32s]

MODES = ("xyz", "rgb", "xyzcont", "rgbcont", "xyzpose", "rgbpose")
WRISTS = ("given", "estimated")


@dataclass(frozen=True)
class Inputs:
    """Options of the inputs: one of the letter's six modes, how many points are drawn, their scale and rotation."""

    mode: str
    points: int
    normalisation: str
    rotation_deg: float = 0.0  # largest angle of the random turn about each axis, in training
    wrist: str = "given"

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
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
        """True if colours are read."""
        return self.mode.startswith("rgb")

    @property
    def channels(self) -> int:
        """Numbers of a point."""
        return 6 if self.coloured else 3

    @property
    def posed(self) -> bool:
        """True if the wrist's rotation is read."""
        return self.mode.endswith("pose")

    @property
    def grasp_numbers(self) -> int:
        """Numbers of the grasp: none, both contact points, or these and the wrist's rotation."""
        return 15 if self.posed else 6 if self.mode.endswith("cont") else 0


class Sources:
    """Clouds and grasps to draw from."""

    def __init__(self, inputs: Inputs, names: Sequence[str], clouds: Sequence[Cloud], grasps: Sequence[Grasp]) -> None:
        """Take clouds and grasps; raises `TacpipeError` where one has too few points, no colours or no wrist."""
        self.inputs, self.clouds, self.grasps = inputs, clouds, grasps
        for name, cloud, grasp in zip(names, clouds, grasps, strict=True):
            _check(inputs, name, cloud, grasp)

    @cached_property
    def extents(self) -> list[Extent]:
        """How far each cloud reaches."""
        return [Extent.of(cloud) for cloud in self.clouds]

    @cached_property
    def wrists(self) -> list[Floats | None]:
        """Each wrist's rotation, or its estimate."""
        if self.inputs.wrist == "estimated":
            return [frame.estimated_wrist(grasp) for grasp in self.grasps]
        return [grasp.wrist for grasp in self.grasps]

    def draw(self, indices: Sequence[int], rng: np.random.Generator) -> Arrays:
        """Return points (cloud, point, channel) and the grasps' numbers (cloud, number), drawn and turned anew."""
        return self._arrays([(index, rng) for index in indices], self.inputs.rotation_deg)

    def fixed(self, indices: Sequence[int], visit: int) -> Arrays:
        """Return the same without turns; which points are drawn depends on the cloud's points and on ``visit`` alone."""
        rngs = [np.random.default_rng([visit, zlib.crc32(self.clouds[index].points_m.tobytes())]) for index in indices]
        return self._arrays(list(zip(indices, rngs, strict=True)), 0.0)

    def _arrays(self, draws: Sequence[tuple[int, np.random.Generator]], largest_deg: float) -> Arrays:
        inputs = self.inputs
        points = np.empty((len(draws), inputs.points, inputs.channels), np.float32)
        numbers = np.empty((len(draws), inputs.grasp_numbers), np.float32)
        for row, (index, rng) in enumerate(draws):
            cloud, grasp, extent = self.clouds[index], self.grasps[index], self.extents[index]
            rotation = random_rotation(rng, largest_deg)
            wrist = self.wrists[index]
            wrist = None if wrist is None else rotation @ wrist
            chosen = rng.choice(len(cloud), inputs.points, replace=False, shuffle=False)
            places = np.concatenate([cloud.points_m[chosen], grasp.g1_m[None], grasp.g2_m[None]]) @ rotation.T
            places = normalised(inputs.normalisation, places, extent, rotation, wrist)
            points[row, :, :3] = places[:-2]
            if inputs.coloured:
                assert cloud.colours is not None
                points[row, :, 3:] = colours_normalised(inputs.normalisation, cloud.colours[chosen] / 255.0, extent)
            if inputs.grasp_numbers:
                numbers[row, :6] = places[-2:].ravel()
            if inputs.posed:
                assert wrist is not None
                numbers[row, 6:] = wrist.ravel()
        return points, numbers


def _check(inputs: Inputs, name: str, cloud: Cloud, grasp: Grasp) -> None:
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
