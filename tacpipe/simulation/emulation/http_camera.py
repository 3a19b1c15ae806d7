"""Emulate a camera that serves JPEG images by HTTP: its images, of the simulated gel or of a video file, and its server."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tacpipe.arrays import Floats, Int64s
from tacpipe.errors import UsageError
from tacpipe.links.link import Address
from tacpipe.plugins import extras
from tacpipe.sensors.camera import Camera, unpack_frame
from tacpipe.sensors.sensor import Samples, Sensor
from tacpipe.simulation import faults, gel
from tacpipe.simulation.emulation.network import HOST, Connection, Tcp
from tacpipe.simulation.emulation.source import Sampled, Timing
from tacpipe.simulation.emulation.world import Cycle, World
from tacpipe.video import files
from tacpipe.video.decoding import jpeg_images
from tacpipe.video.encoding import encode_images, jpeg_format
from tacpipe.video.images import read_shape

BOUNDARY = b"tacpipe-frame"
PATH = "/stream"
OPENED = (
    b"HTTP/1.0 200 OK\r\nCache-Control: no-store\r\nContent-Type: multipart/x-mixed-replace;boundary="
    + BOUNDARY
    + b"\r\n\r\n"
)
NO_STREAM = b"HTTP/1.0 404 Not Found\r\nContent-Type: text/plain\r\n\r\nThe stream is at /stream.\n"
MAX_REQUEST_BYTES = 1 << 14
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


class Viewer(Connection):
    """A host that is connected, and gets images after its request."""

    def __init__(self, connection: socket.socket, sensor: Sensor) -> None:
        super().__init__(connection, sensor)
        self.request = b""
        self.is_open = False

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Send each image as a part; invalid bytes of a fault are sent unchanged."""
        if not self.is_open:
            return [0] * len(pieces)
        sent = super().send([_part(piece) for piece in pieces])
        return [len(piece) if size else 0 for piece, size in zip(pieces, sent, strict=True)]


def _part(piece: bytes) -> bytes:
    """Return a packet of `tacpipe.sensors.camera` as a part of the response."""
    frame = unpack_frame(piece)
    image = piece if frame is None else frame.content
    head = b"--" + BOUNDARY + b"\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n" % len(image)
    if frame is not None:
        head += b"X-Timestamp: %d.%06d\r\n" % divmod(frame.t_device_ns // 1000, 10**6)
    return head + b"\r\n" + image + b"\r\n"


class HttpCamera(Tcp):
    """An image server that accepts any number of hosts."""

    scheme = "mjpeg"
    kind = Viewer

    def __init__(self, sensor: Sensor) -> None:
        extras.require("An emulated camera", "av")
        super().__init__(sensor)
        self.address = Address("mjpeg", f"http://{HOST}:{self._port}{PATH}")

    def from_wire(self, peer: Connection, data: bytes) -> list[tuple[Connection, bytes]]:
        """Answer a request for images; return the host with an empty message if it now gets images, else nothing."""
        assert isinstance(peer, Viewer)
        if peer.is_open:
            return []
        peer.request += data
        if b"\r\n\r\n" not in peer.request and len(peer.request) < MAX_REQUEST_BYTES:
            return []
        peer.is_open = peer.request.startswith(b"GET " + PATH.encode() + b" ")
        with contextlib.suppress(OSError):  # the host is gone, which the next read reports
            peer.socket.send(OPENED if peer.is_open else NO_STREAM)
            if not peer.is_open:
                peer.socket.shutdown(socket.SHUT_WR)
        return [(peer, b"")] if peer.is_open else []
