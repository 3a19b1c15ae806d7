"""The clouds that an emulated depth camera takes: a table with an object and another next to it, a new scene a cloud."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

from tacpipe.arrays import Bytes, Float32s, Int64s
from tacpipe.sensors.sensor import Samples, Sensor
from tacpipe.simulation import depth_camera, grasp_scene
from tacpipe.simulation.emulation.source import BLOCK_S, Timing
from tacpipe.simulation.grasp_scene import GraspRig

EVERY = 16  # one of so many of the camera's 300,000 points is kept


class CloudSource:
    """The clouds of one camera, from its start on; as `Source`, but with many rows a frame."""

    def __init__(self, sensor: Sensor, timing: Timing, seed: Sequence[int]) -> None:
        self.sensor, self.timing = sensor, timing
        self.rows = max(1, round(timing.rate_hz * BLOCK_S))  # clouds a block
        self._seed = seed[0]
        self._coloured = len(sensor.fields()) > 3
        self._samples = functools.lru_cache(2)(self._generate)

    def block(self, number: int) -> Samples:
        """Return the points of the clouds of block ``number``; ``rows`` reports on which each is."""
        return self._samples(number)

    def numbers(self, block: int) -> Int64s:
        """Return the numbers of a block's clouds, counted from 0 through the stream (cloud,)."""
        return block * self.rows + np.arange(self.rows, dtype=np.int64)

    def _generate(self, block: int) -> Samples:
        points, colours = zip(*(self._view(int(number)) for number in self.numbers(block)), strict=True)
        rows = np.repeat(np.arange(self.rows, dtype=np.int64), [len(cloud) for cloud in points])
        values = (np.concatenate(points), np.concatenate(colours)) if self._coloured else (np.concatenate(points),)
        return Samples(values, rows=rows)

    def _view(self, number: int) -> tuple[Float32s, Bytes]:
        scene = grasp_scene.perform(self._seed, number)
        neighbour = grasp_scene.draw_thing(self._seed, number + 1)
        rng = np.random.default_rng([self._seed, 9, number])
        cloud = depth_camera.view(
            scene.placed, neighbour.shape, scene.up, scene.camera_m, GraspRig().noise_scale, rng
        ).cloud
        assert cloud.colours is not None
        return cloud.points_m[::EVERY].astype(np.float32), cloud.colours[::EVERY]
