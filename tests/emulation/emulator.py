"""Emulate all streams of a rig, driven by one physical simulation, with dialogues, faults and a ledger of what was sent.

One thread sends frames when they are due and receives from hosts; another plans frames ahead. This keeps the load low at
1 kHz, and the sent bytes do not depend on the timing of the threads.
"""

from __future__ import annotations

import threading
import time
import zlib
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from tacpipe.plugins import params
from tacpipe.recording.rig import Rig, RigStream
from tacpipe.sensors.camera import Camera
from tacpipe.sensors.sensor import Sensor
from tacpipe.simulation import faults as clocks
from tacpipe.simulation import pick_and_move
from tacpipe.simulation.emulation import emulator
from tacpipe.simulation.emulation.emulator import udp_listener
from tacpipe.simulation.emulation.endpoint import Endpoint
from tests.emulation.byte_faults import ClockSteps, Faults, no_steps
from tests.emulation.camera_source import CameraSource, complete_camera
from tests.emulation.can import Slcan, VirtualCan
from tests.emulation.folder import Folder
from tests.emulation.hid import Hid
from tests.emulation.ledger import Ledger
from tests.emulation.network import SilentUdp, TcpUdp
from tests.emulation.serial_port import BaudPty
from tests.emulation.source import CloudSource, Sampled, SampleSource, Timing
from tests.emulation.transmission import FramePace, Transmission, TransmissionPlan
from tests.emulation.world import World

PACKETS = ("udp", "tcp+udp", "ws", "hid", "can", "folder", "mjpeg", "v4l2")  # packet-based links
FILL_S = 0.1  # period of planning frames ahead
SWITCH_S = 0.0005  # maximum delay of the sending thread by the planning thread; Python's 5 ms would be visible at 1 kHz
CAMERA_HZ = 25.0  # default rate of cameras
DEFAULT_HZ = 2.0  # rate of sensors without a declared rate, such as clouds


class Emulator(emulator.Emulator):
    """An emulated rig, which runs during a ``with`` statement.

    ``ledger`` has the sent and faulty frames of each stream, ``folder`` contains pseudo-terminals and files. With
    ``patient``, no frame is lost because a host reads too late.
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
        super().__init__(rig, folder)
        self.patient, self.seed, self.faults = patient, seed, faults or Faults()
        self.world = world or World(seed)
        self.ledger = {name: Ledger(name) for name in rig.streams}
        self._sent: dict[str, Transmission] = {}
        self._commands: list[tuple[str, bool]] = []
        self._filling = threading.Thread(target=self.run_thread, args=(self._fill,), daemon=True)

    def __enter__(self) -> Self:
        """Start all streams. Raises `DeviceError` or `UsageError` if one cannot be emulated."""
        self._paces = {name: frame_pace(self.rig_file, name) for name in self.rig_file.streams}
        super().__enter__()
        self._filling.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop all streams. Raises an error of their threads."""
        self.stopped.set()
        self._filling.join()
        super().__exit__(kind, error, trace)

    def unplug(self, name: str) -> None:
        """Unplug the device of a stream."""
        self._commands.append((name, False))

    def replug(self, name: str) -> None:
        """Plug the device of a stream in again, at the same address."""
        self._commands.append((name, True))

    def endpoint(self, stream: RigStream) -> Endpoint:
        """Start the device's end of a stream's link. Raises `DeviceError` if the link cannot be emulated."""
        scheme, device = stream.address.scheme, (self.folder / "dev" / stream.name).absolute()
        if scheme == "serial":
            return BaudPty(device, stream.sensor.baud)
        if scheme == "udp":
            return SilentUdp(udp_listener(stream))
        if scheme == "tcp+udp":
            return TcpUdp()
        if scheme == "can":
            if stream.address.target.startswith("virtual:"):
                return VirtualCan(stream.address.target.removeprefix("virtual:"))
            return Slcan(device)
        if scheme == "folder":
            return Folder(self.folder / "files" / stream.name, str(getattr(stream.sensor, "suffix", "")) or ".bin")
        if scheme == "hid":
            return Hid(stream.sensor, stream.address, self.folder / "hid")
        return super().endpoint(stream)

    def transmission(self, stream: RigStream, endpoint: Endpoint) -> Transmission:
        """Return the transmission of a stream to the hosts of ``endpoint``."""
        pace, packets = self._paces[stream.name], stream.address.scheme in PACKETS
        rate_hz = stream.sensor.rate_hz or (CAMERA_HZ if isinstance(stream.sensor, Camera) else DEFAULT_HZ)

        def make_plan(rate: float, start_ns: int) -> TransmissionPlan:
            source = self.source(stream.name, pace, rate, start_ns)
            seed = [*self._seed(stream.name), start_ns]
            return TransmissionPlan(source, pace, self.faults, seed, packets=packets)

        ledger, patient = self.ledger[stream.name], self.patient
        self._sent[stream.name] = Transmission(
            endpoint, stream.sensor, ledger, make_plan, rate_hz, self.epoch_ns, patient=patient
        )
        return self._sent[stream.name]

    def source(self, name: str, stream_pace: FramePace, rate_hz: float, start_ns: int = 0) -> Sampled:
        """Return the source of samples of a stream."""
        seed, sensor = self._seed(name), self.rig_file.streams[name].sensor
        steps = (
            ClockSteps(self.faults.clock_step, self.faults.clock_step_ms, seed) if self.faults.clock_step else no_steps
        )
        timing = Timing(rate_hz, start_ns, clock(stream_pace, seed), steps, self.faults.wrap_s)
        last = name[-1] if name[-1] in "12" else "1"
        finger = (stream_pace.finger or int(last)) - 1
        if isinstance(sensor, Camera):
            camera = complete_camera(sensor, stream_pace.video)
            return CameraSource(camera, self.world, timing, seed, finger, stream_pace.video)
        if has_points(sensor):
            return CloudSource(sensor, timing, seed)
        return SampleSource(sensor, self.world, timing, seed, finger)

    def _seed(self, name: str) -> list[int]:
        return [self.seed, zlib.crc32(name.encode())]

    def _fill(self) -> None:
        """Plan frames ahead; the work of a thread."""
        while not self.stopped.wait(FILL_S):
            for transmission in self._sent.values():
                transmission.fill(time.monotonic_ns() - self.epoch_ns)

    def poll(self, now_ns: int) -> None:
        """Unplug and replug devices."""
        while self._commands:
            name, is_replugged = self._commands.pop(0)
            self._sent[name].plug(is_replugged, now_ns)


def has_points(sensor: Sensor) -> bool:
    """Return whether a sensor's samples are points of clouds."""
    return [field.name for field in sensor.fields()][:3] == ["x_m", "y_m", "z_m"]


def frame_pace(rig: Rig, name: str) -> FramePace:
    """Return the pace of a stream from ``emulate`` in the rig file."""
    source = f"stream {name}, emulate"
    pace: FramePace = params.build_dataclass(FramePace, dict(rig.streams[name].emulate), source, "key")
    return pace


def clock(stream_pace: FramePace, seed: list[int]) -> clocks.DeviceClock:
    """Return a device's clock with the offset and skew of its pace, or random ones as in the simulated rig."""
    rng, default_rig = np.random.default_rng([*seed, 8]), pick_and_move.PickRig()
    offset, skew = rng.uniform(-1, 1, 2)
    offset_ms = stream_pace.offset_ms if stream_pace.offset_ms is not None else offset * default_rig.clock_offset_ms
    skew_ppm = stream_pace.skew_ppm if stream_pace.skew_ppm is not None else skew * default_rig.clock_skew_ppm
    return clocks.DeviceClock(round(offset_ms * 1e6), float(skew_ppm * 1e-6))
