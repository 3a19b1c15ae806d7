"""Generate the images of an emulated camera: of the simulated gel, or of a video file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tacpipe.arrays import Floats, Int64s
from tacpipe.errors import UsageError
from tacpipe.sensors.camera import Camera
from tacpipe.sensors.sensor import Samples
from tacpipe.simulation import faults, gel
from tacpipe.video import files
from tacpipe.video.decoding import jpeg_images
from tacpipe.video.encoding import encode_images, jpeg_format
from tacpipe.video.images import read_shape
from tests.emulation.source import Sampled, Timing
from tests.emulation.world import Cycle, World

EPOCH_NS = 1_600_000_000_000_000_000  # time of the server's clock when the rig starts


def complete_camera(sensor: Camera, video: str) -> Camera:
    """Return the sensor with the settings that the emulated camera reports, so that its frames can be encoded.

    Raises `UsageError` if the rig file declares another image size.
    """
    width_px, height_px, pixel_format = gel.WIDTH_PX, gel.HEIGHT_PX, "yuvj422p"
    if video:
        shape = read_shape(next(iter(_video_images(video))))
        assert shape is not None, "images of a video are JPEG images"
        width_px, height_px, pixel_format = shape
    sizes = (sensor.width_px or width_px, sensor.height_px or height_px)
    if sizes != (width_px, height_px):
        raise UsageError(
            f"emulate: the camera shows {width_px} x {height_px} pixels, and the rig file states {sizes[0]} x {sizes[1]}. "
            f"Leave width_px and height_px out."
        )
    return replace(sensor, width_px=width_px, height_px=height_px, pixel_format=pixel_format, stamps="server")


class CameraSource(Sampled):
    """The images of one camera, from its start on: of the gel of a finger in the rig's world, or of a video, repeated."""

    def __init__(
        self, sensor: Camera, world: World, timing: Timing, seed: Sequence[int], finger: int, video: str
    ) -> None:
        """Create the source of a camera that shows the images of ``video``, or without one the gel of ``finger`` 0 or 1."""
        super().__init__(sensor, timing)
        self.world, self.finger = world, finger
        self._format = jpeg_format(sensor.width_px, sensor.height_px, None, sensor.pixel_format)
        self._images = list(_video_images(video)) if video else []
        self._camera = gel.GelCamera(np.random.default_rng([*seed, 1]))

    def _generate(self, block: int) -> Samples:
        """Return the images of a block with the times that the server's clock gives them."""
        numbers = self.numbers(block)
        taken_ns = self.timing.sample_ns(numbers)
        packets = np.empty((len(numbers), 1), object)
        if self._images:
            packets[:, 0] = [self._images[number % len(self._images)] for number in numbers.tolist()]
        else:
            states = gel_states(self.world, self.finger, taken_ns)
            images = (self._camera.render(states, row, number) for row, number in enumerate(numbers.tolist()))
            packets[:, 0] = list(encode_images(self._format, images))
        clock_ns = faults.device_stamps(taken_ns, self.timing.clock) + self.timing.steps(taken_ns)
        device_ns = EPOCH_NS + clock_ns // 1000 * 1000
        t_us = numbers + 1
        values = (packets, np.column_stack([t_us, t_us]), np.ones((len(numbers), 1), bool))
        return Samples(values, t_device_ns=device_ns)


def gel_states(world: World, finger: int, t_ns: Int64s) -> gel.GelStates:
    """Return the states of the gel of finger 0 or 1 of the rig's world at ``t_ns`` (time,)."""
    sigma_px = world.skins[finger].sigma_m * gel.PX_M

    def read_states(cycle: Cycle, local_ns: Int64s) -> Floats:
        states = gel.gel_states(cycle.scene, finger, local_ns)
        moved_px = states.displacement_px.reshape(len(local_ns), -1)
        return np.column_stack([moved_px, states.force_n, states.centre_px])

    joined = world.at(t_ns, read_states)
    return gel.GelStates(joined[:, :-3].reshape(len(t_ns), -1, 2), joined[:, -3], joined[:, -2:], sigma_px)


def _video_images(path: str) -> Iterator[bytes]:
    """Yield the frames of a video file as JPEG images, which are encoded unless they already are JPEG."""
    file = Path(path).expanduser()
    frames = files.scan(file)
    if frames.video_format.codec == "mjpeg":
        yield from files.read_packets(file, frames)
        return
    import pyarrow as pa

    stream = files.read_stream(file, frames, frames.times_ns(), None, [])
    batches = (pa.Table.from_batches([batch]) for batch in stream)
    yield from (image for _, image in jpeg_images(frames.video_format, batches))
