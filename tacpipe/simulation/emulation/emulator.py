"""Emulate all streams of a rig without hardware, driven by one physical simulation.

One thread sends frames when they are due and receives from hosts; another plans frames ahead. This keeps the load low at
1 kHz, and the sent bytes do not depend on the timing of the threads.
"""

from __future__ import annotations

import contextlib
import select
import tempfile
import threading
import time
import zlib
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from tacpipe.errors import DeviceError
from tacpipe.plugins import params
from tacpipe.recording.rig import Rig, RigStream
from tacpipe.sensors.camera import Camera
from tacpipe.sensors.sensor import Sensor
from tacpipe.simulation import faults as clocks
from tacpipe.simulation import pick_and_move
from tacpipe.simulation.emulation.byte_faults import ClockSteps, Faults, no_steps
from tacpipe.simulation.emulation.endpoint import Endpoint, Folder, Peer
from tacpipe.simulation.emulation.ledger import Ledger
from tacpipe.simulation.emulation.source import CloudSource, Sampled, SampleSource, SlideSource, Timing
from tacpipe.simulation.emulation.transmission import FramePace, Transmission, TransmissionPlan
from tacpipe.simulation.emulation.world import World

PACKETS = ("udp", "tcp+udp", "ws", "hid", "can", "folder", "mjpeg", "v4l2")  # packet-based links


def endpoint(stream: RigStream, folder: Path) -> Endpoint:
    """Start the device's end of a stream's link. ``folder`` is for pseudo-terminals and files.

    Raises `DeviceError` if the link cannot be emulated.
    """
    scheme = stream.address.scheme
    if scheme == "serial":
        from tacpipe.simulation.emulation.serial_port import Pty

        return Pty(stream.sensor, _device(folder, stream.name))
    if scheme == "udp":
        return _udp_endpoint(stream)
    if scheme in ("tcp", "tcp+udp"):
        from tacpipe.simulation.emulation.network import Tcp, TcpUdp

        return TcpUdp(stream.sensor) if scheme == "tcp+udp" else Tcp(stream.sensor)
    if scheme == "ws":
        from tacpipe.simulation.emulation.network import Websocket

        return Websocket(stream.sensor)
    if scheme == "can":
        from tacpipe.simulation.emulation.can import Slcan, VirtualCan

        if stream.address.target.startswith("virtual:"):
            return VirtualCan(stream.sensor, stream.address.target.removeprefix("virtual:"))
        return Slcan(stream.sensor, _device(folder, stream.name))
    if scheme == "folder":
        return Folder(stream.sensor, folder / "files" / stream.name)
    if scheme in ("mjpeg", "v4l2"):
        from tacpipe.simulation.emulation.http_camera import HttpCamera

        return HttpCamera(stream.sensor)
    if scheme == "hid":
        from tacpipe.simulation.emulation.hid import Hid

        return Hid(stream.sensor, stream.address, folder / "hid")
    raise DeviceError(
        f"{stream.name}: {stream.address} cannot be emulated. Clouds can be emulated with folder:{folder / 'files'}."
    )


def _udp_endpoint(stream: RigStream) -> Endpoint:
    """Return a UDP endpoint, which sends to a free port if the sensor's host listens."""
    from tacpipe.simulation.emulation.network import HOST, Udp, free_port

    host = stream.address.target.partition("?")[0].rpartition(":")[0]
    host_listens = stream.sensor.listens or not host
    return Udp(stream.sensor, (HOST if host else "", free_port()) if host_listens else None)


def _device(folder: Path, name: str) -> Path:
    devices = (folder / "dev").absolute()
    devices.mkdir(parents=True, exist_ok=True)
    return devices / name


POLL_NS = 20_000_000  # period of polling for events without a descriptor
FILL_S = 0.1  # period of planning frames ahead
MAX_WAIT_S = 0.02  # maximum wait
CAMERA_HZ = 25.0  # default rate of cameras
DEFAULT_HZ = 2.0  # rate of sensors without a declared rate, such as clouds


class Emulator:
    """An emulated rig, which runs during a ``with`` statement.

    ``rig`` is the rig with the addresses of the emulated devices, ``ledger`` has the sent and faulty frames of each stream,
    ``folder`` contains pseudo-terminals and files. With ``patient``, no frame is lost because a host reads too late.
    """

    def __init__(
        self,
        rig: Rig,
        seed: int = 0,
        faults: Faults | None = None,
        folder: Path | None = None,
        world: World | None = None,
        *,
        patient: bool = False,
    ) -> None:
        """Prepare a rig; the ``with`` statement starts it. Without a ``folder`` it uses a temporary one.

        If ``patient``, streams wait instead of losing bytes while a host's buffer is full.
        """
        self.patient = patient
        self.rig_file, self.seed, self.faults = rig, seed, faults or Faults()
        self.folder = folder or Path()
        self._temporary = folder is None
        self._resources = contextlib.ExitStack()
        self.world = world or World(seed)
        self.ledger = {name: Ledger(name) for name in rig.streams}
        self._transmissions: dict[str, Transmission] = {}
        self._stopped = threading.Event()
        self._errors: list[BaseException] = []
        self._commands: list[tuple[str, bool]] = []

    @property
    def rig(self) -> Rig:
        """The rig with the addresses for hosts. Recordings are labelled as simulated."""
        streams = {
            name: replace(stream, address=self._transmissions[name].endpoint.address)
            for name, stream in self.rig_file.streams.items()
        }
        return replace(self.rig_file, streams=streams, labels={**self.rig_file.labels, "simulated": True})

    def __enter__(self) -> Self:
        """Start all streams. Raises `DeviceError` or `UsageError` if one cannot be emulated."""
        paces = {name: frame_pace(self.rig_file, name) for name in self.rig_file.streams}
        with contextlib.ExitStack() as resources:
            if self._temporary:
                self.folder = Path(resources.enter_context(tempfile.TemporaryDirectory(prefix="tacpipe-")))
            self.folder.mkdir(parents=True, exist_ok=True)
            endpoints: dict[str, Endpoint] = {}
            for name, stream in self.rig_file.streams.items():
                endpoints[name] = endpoint(stream, self.folder)
                resources.callback(endpoints[name].close)
            self._resources = resources.pop_all()
        self.epoch_ns = time.monotonic_ns()
        for name, stream in self.rig_file.streams.items():
            self._transmissions[name] = self._create_transmission(stream, paces[name], endpoints[name])
        self._threads = [
            threading.Thread(target=self._run_thread, args=(work,), daemon=True)
            for work in (self._send_due, self._fill)
        ]
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop all streams. Raises an error of their threads."""
        self._stopped.set()
        for thread in self._threads:
            thread.join()
        self._resources.close()
        if self._errors and error is None:
            raise self._errors[0]

    def _run_thread(self, work: Callable[[], None]) -> None:
        """Do the work of a thread; store its error and stop the others."""
        try:
            work()
        except BaseException as error:  # the ``with`` statement raises errors of the thread
            self._errors.append(error)
            self._stopped.set()

    def unplug(self, name: str) -> None:
        """Unplug the device of a stream."""
        self._commands.append((name, False))

    def replug(self, name: str) -> None:
        """Plug the device of a stream in again, at the same address."""
        self._commands.append((name, True))

    def _create_transmission(self, stream: RigStream, stream_pace: FramePace, endpoint: Endpoint) -> Transmission:
        """Return the transmission of a stream to the hosts of ``endpoint``."""
        packets = stream.address.scheme in PACKETS
        rate_hz = stream.sensor.rate_hz or (CAMERA_HZ if isinstance(stream.sensor, Camera) else DEFAULT_HZ)

        def make_plan(rate: float, start_ns: int) -> TransmissionPlan:
            source = self.source(stream.name, stream_pace, rate, start_ns)
            seed = [*self._seed(stream.name), start_ns]
            return TransmissionPlan(source, stream_pace, self.faults, seed, packets=packets)

        ledger, patient = self.ledger[stream.name], self.patient
        return Transmission(endpoint, stream.sensor, ledger, make_plan, rate_hz, self.epoch_ns, patient=patient)

    def source(self, name: str, stream_pace: FramePace, rate_hz: float, start_ns: int = 0) -> Sampled:
        """Return the source of samples of a stream."""
        seed, sensor = self._seed(name), self.rig_file.streams[name].sensor
        steps = (
            ClockSteps(self.faults.clock_step, self.faults.clock_step_ms, seed) if self.faults.clock_step else no_steps
        )
        timing = Timing(rate_hz, start_ns, clock(stream_pace, seed), steps, self.faults.wrap_s)
        if stream_pace.slides:
            return SlideSource(sensor, timing, self.seed)
        last = name[-1] if name[-1] in "12" else "1"
        finger = (stream_pace.finger or int(last)) - 1
        if isinstance(sensor, Camera):
            from tacpipe.simulation.emulation.http_camera import CameraSource, complete_camera

            camera = complete_camera(sensor, stream_pace.video)
            return CameraSource(camera, self.world, timing, seed, finger, stream_pace.video)
        if has_points(sensor):
            return CloudSource(sensor, timing, seed)
        return SampleSource(sensor, self.world, timing, seed, finger)

    def _seed(self, name: str) -> list[int]:
        return [self.seed, zlib.crc32(name.encode())]

    def _fill(self) -> None:
        while not self._stopped.wait(FILL_S):
            for transmission in self._transmissions.values():
                transmission.fill(time.monotonic_ns() - self.epoch_ns)

    def _send_due(self) -> None:
        """Send due items and receive what hosts write until the emulator is stopped; the work of a thread."""
        transmissions = list(self._transmissions.values())
        owners: dict[int, Transmission] = {}  # transmissions by descriptor
        poll_ns, changed = 0, True
        while not self._stopped.is_set():
            if changed:
                owners = {}
                for transmission in transmissions:
                    owners |= dict.fromkeys(transmission.endpoint.descriptors(), transmission)
            now_ns = time.monotonic_ns()
            next_ns = min([transmission.next_ns for transmission in transmissions])
            wait_s = min(MAX_WAIT_S, max(0.0, (next_ns - now_ns) / 1e9))
            ready, _, _ = select.select(owners, [], [], wait_s)
            now_ns = time.monotonic_ns()
            for number in ready:
                self._receive(owners[number], owners[number].endpoint.ready(number), now_ns)
            changed = bool(ready)
            for transmission in transmissions:
                if transmission.next_ns <= now_ns:
                    changed |= transmission.run(now_ns)
            if now_ns >= poll_ns:
                poll_ns, changed = now_ns + POLL_NS, True
                self._run_commands(now_ns)
                for transmission in transmissions:
                    self._receive(transmission, transmission.endpoint.look(), now_ns)

    def _receive(self, transmission: Transmission, heard: Iterable[tuple[Peer, bytes]], now_ns: int) -> None:
        for peer, data in heard:
            transmission.receive(peer, data, now_ns)

    def _run_commands(self, now_ns: int) -> None:
        while self._commands:
            name, is_replugged = self._commands.pop(0)
            self._transmissions[name].plug(is_replugged, now_ns)


def has_points(sensor: Sensor) -> bool:
    """Return whether a sensor's samples are points of clouds."""
    return [field.name for field in sensor.fields()][:3] == ["x_m", "y_m", "z_m"]


def frame_pace(rig: Rig, name: str) -> FramePace:
    """Return the pace of a stream from ``emulate`` in the rig file. Keys of the stream override those of the rig."""
    source = f"stream {name}, emulate"
    pace: FramePace = params.build_dataclass(FramePace, {**rig.emulate, **rig.streams[name].emulate}, source, "key")
    return pace


def clock(stream_pace: FramePace, seed: list[int]) -> clocks.DeviceClock:
    """Return a device's clock with the offset and skew of its pace, or random ones as in the simulated rig."""
    rng, default_rig = np.random.default_rng([*seed, 8]), pick_and_move.PickRig()
    offset, skew = rng.uniform(-1, 1, 2)
    offset_ms = stream_pace.offset_ms if stream_pace.offset_ms is not None else offset * default_rig.clock_offset_ms
    skew_ppm = stream_pace.skew_ppm if stream_pace.skew_ppm is not None else skew * default_rig.clock_skew_ppm
    return clocks.DeviceClock(round(offset_ms * 1e6), float(skew_ppm * 1e-6))
