"""Generate the samples of emulated sensors from a common simulated world: fields and clouds.

uSkin and proximity counts come from the models of the simulated rig, with noise, drift and repeated frames. The values of
other fields follow from their quantity and unit. Samples are generated in blocks, so that long streams need little memory,
and any block can be generated again: the same seed gives the same values.

Each cloud is a new scene with a table and two objects.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyArray, Bytes, Counts, Float32s, Floats, Int64s, Times
from tacpipe.channels import schema
from tacpipe.sensors.encoding import value_blocks
from tacpipe.sensors.sensor import Samples, Sensor
from tacpipe.simulation import depth_camera, faults, grasp_scene, pick_and_move, taxels
from tacpipe.simulation.grasp_scene import GraspRig
from tests.emulation import quantities
from tests.emulation.byte_faults import no_steps
from tests.emulation.quantities import SensorView
from tests.emulation.world import World

if TYPE_CHECKING:
    import pyarrow as pa

Columns = dict[int, AnyArray]  # values (time,) by number of the field

BLOCK_S = 0.5
CACHED = 3  # blocks
PARTS = {"report": (1, 2)}  # alternating values of fields that identify the part of a state in a frame
UNUSED_MODULUS = 1 << 32  # modulus of a counter that the sensor does not send
USKIN = 48  # channels of a 4x4 uSkin


@dataclass(frozen=True)
class Timing:
    """The sample times of an emulated sensor, and the values of its clock and counters."""

    rate_hz: float
    start_ns: int = 0  # time of the first sample in the world
    clock: faults.DeviceClock = field(default_factory=faults.DeviceClock)  # its skew also changes the sample rate
    steps: Callable[[Times], Times] = no_steps  # returns the total of clock steps so far (time,) in ns
    wrap_s: float | None = None  # time after the start at which counters wrap; None: random initial values

    def sample_ns(self, number: Int64s) -> Times:
        """Return the times in ns of samples ``number`` (sample,) in the world."""
        sample_ns: Times = self.start_ns + np.rint(number * (1e9 / self.rate_hz / (1 + self.clock.skew))).astype(
            np.int64
        )
        return sample_ns

    def first_after(self, t_ns: int) -> int:
        """Return the number of the first sample after ``t_ns``."""
        return max(0, int(np.floor((t_ns - self.start_ns) * (1 + self.clock.skew) * self.rate_hz / 1e9)) + 1)


class Sampled:
    """A source of samples of an emulated sensor, in blocks. The latest blocks stay in memory."""

    def __init__(self, sensor: Sensor, timing: Timing, cached_blocks: int = CACHED) -> None:
        self.sensor, self.timing = sensor, timing
        self.rows = max(1, round(timing.rate_hz * BLOCK_S))  # frames per block
        self._samples = functools.lru_cache(cached_blocks)(self._generate)

    def block(self, number: int) -> Samples:
        """Return the samples of block ``number``."""
        return self._samples(number)

    def numbers(self, block: int) -> Int64s:
        """Return the numbers of a block's frames (frame,), counted from 0 at the start of the stream."""
        return block * self.rows + np.arange(self.rows, dtype=np.int64)

    def _generate(self, block: int) -> Samples:
        raise NotImplementedError


class SampleSource(Sampled):
    """The samples of a sensor in the simulated world."""

    def __init__(
        self, sensor: Sensor, world: World, timing: Timing, seed: Sequence[int] = (0,), finger: int = 0
    ) -> None:
        """Create the source of a sensor on ``finger`` (0 or 1) of the world."""
        super().__init__(sensor, timing)
        self.world, self.finger = world, finger
        self.fields = sensor.fields()
        self._seed = list(seed)
        self._groups = _group_by_quantity(self.fields)
        self._drift: list[Floats] = [np.zeros((USKIN // 3, 3))]  # drift of a uSkin at the start of each block
        rng = np.random.default_rng([*seed, 0])
        self._first = [
            _first_count(timing, sensor.step, modulus or UNUSED_MODULUS, rng)
            for modulus in (sensor.counter, sensor.device_counter)
        ]

    def _generate(self, block: int) -> Samples:
        """Return the samples of a block: the values of all fields, counters and the device's times."""
        numbers = self.numbers(block)
        sample_ns = self.timing.sample_ns(numbers)
        rng = np.random.default_rng([*self._seed, 1, block])
        view = SensorView(self.world, sample_ns, self.finger)
        columns: Columns = {}
        for group in self._groups:
            columns |= self._quantity_columns(group, view, block, rng)
        values = [columns[number] for number in range(len(self.fields))]
        step = self.sensor.step
        counts = [
            (first + step * numbers) % (modulus or UNUSED_MODULUS)
            for first, modulus in zip(self._first, (self.sensor.counter, self.sensor.device_counter), strict=True)
        ]
        device_ns = faults.device_stamps(sample_ns, self.timing.clock) + self.timing.steps(sample_ns)
        return Samples(value_blocks(self.sensor, values), counts[0], device_ns, counts[1])

    def _quantity_columns(
        self, group: Sequence[int], view: SensorView, block: int, rng: np.random.Generator
    ) -> Columns:
        """Return the columns of a group of fields with one quantity."""
        fields = [self.fields[number] for number in group]
        quantity = quantities.metadata_of(fields[0], "quantity") or ""
        if fields[0].name in PARTS:
            parts = np.array(PARTS[fields[0].name], dtype=fields[0].type.to_pandas_dtype())
            return {group[0]: parts[self.numbers(block) % len(parts)]}
        if quantity == "text":
            return {number: np.full(len(view.t_ns), "", dtype=object) for number in group}
        if quantity == "tactile" and _is_uskin(fields):
            counts = self._uskin(view, block, rng)
            return {number: counts[:, row] for row, number in enumerate(group)}
        if quantity == "proximity" and quantities.metadata_of(fields[0], "unit") == "count":
            up_m = view.world.contact(view.t_ns, lambda scene: scene.contact.displacement_m[:, 1])
            kinds = [channel.type.to_pandas_dtype() for channel in fields]
            return {
                number: pick_and_move.proximity_readings(up_m, 1.0, rng).astype(kind)
                for number, kind in zip(group, kinds, strict=True)
            }
        values = quantities.compute(quantity, view, fields)
        return dict(zip(group, quantities.to_device_units(quantity, values, fields, rng), strict=True))

    def _uskin(self, view: SensorView, block: int, rng: np.random.Generator) -> Counts:
        """Return the counts of a uSkin (time, channel) like `pick_and_move`, with a drift that continues between blocks."""
        skin = view.world.skins[view.finger]
        noise = taxels.draw_errors(view.t_ns / 1e9, 1.0, 0.0, rng)
        counts = skin.base_count + taxels.signal(skin, view.world.touch(view.finger, view.t_ns)) + noise
        digits = taxels.digitise(counts + self._drift_of_block(block))
        return faults.hold(digits, pick_and_move.PickRig().hold_probability, rng)[0]

    def _drift_of_block(self, block: int) -> Floats:
        """Return the drift of a uSkin in a block (time, taxel, axis): a random walk from the end of the previous block."""
        while True:
            number = min(block, len(self._drift) - 1)
            rng = np.random.default_rng([*self._seed, 2, number])
            at_s = self.timing.sample_ns(number * self.rows + np.arange(self.rows + 1)) / 1e9
            walk = self._drift[number] + taxels.draw_errors(at_s, 0.0, 1.0, rng)
            if number == len(self._drift) - 1:
                self._drift.append(walk[-1])
            if number == block:
                return walk[:-1]


def _first_count(timing: Timing, step: int, modulus: int, rng: np.random.Generator) -> int:
    """Return the initial value of a counter: random, or such that it wraps ``wrap_s`` after the start."""
    if timing.wrap_s is None:
        return int(rng.integers(max(1, min(modulus, UNUSED_MODULUS) // 2) // step + 1)) * step
    return (modulus - step * round(timing.wrap_s * timing.rate_hz)) % modulus


def _group_by_quantity(fields: Sequence[pa.Field]) -> list[list[int]]:
    """Return the numbers of the fields of each quantity. Forces of taxels and of sensors are separate groups."""
    groups: dict[tuple[str | None, bool, str | None], list[int]] = {}
    for number, channel in enumerate(fields):
        quantity = channel.name if channel.name in PARTS else quantities.metadata_of(channel, "quantity")
        key = quantity, bool(quantities.metadata_of(channel, "taxel")), quantities.metadata_of(channel, "unit")
        groups.setdefault(key, []).append(number)
    return list(groups.values())


def _is_uskin(fields: Sequence[pa.Field]) -> bool:
    return [channel.name for channel in fields] == [channel.name for channel in schema.uskin_fields()]


CLOUD_STEP = 16  # every n-th of the camera's 300,000 points is used


class CloudSource(Sampled):
    """The clouds of a camera, with many rows per frame: ``rows`` of the samples has the index of each point's cloud."""

    def __init__(self, sensor: Sensor, timing: Timing, seed: Sequence[int]) -> None:
        super().__init__(sensor, timing, 2)
        self._seed = seed[0]
        self._coloured = len(sensor.fields()) > 3

    def _generate(self, block: int) -> Samples:
        points, colours = zip(*(self._generate_cloud(int(number)) for number in self.numbers(block)), strict=True)
        rows = np.repeat(np.arange(self.rows, dtype=np.int64), [len(cloud) for cloud in points])
        values = (np.concatenate(points), np.concatenate(colours)) if self._coloured else (np.concatenate(points),)
        return Samples(values, rows=rows)

    def _generate_cloud(self, number: int) -> tuple[Float32s, Bytes]:
        """Return points (point, xyz) in m and colours (point, rgb) of the cloud with this number."""
        scene = grasp_scene.perform(self._seed, number)
        neighbour = grasp_scene.draw_object(self._seed, number + 1)
        rng = np.random.default_rng([self._seed, 9, number])
        cloud = depth_camera.view(
            scene.placed, neighbour.shape, scene.up, scene.camera_m, GraspRig().noise_scale, rng
        ).cloud
        assert cloud.colours is not None
        return cloud.points_m[::CLOUD_STEP].astype(np.float32), cloud.colours[::CLOUD_STEP]
