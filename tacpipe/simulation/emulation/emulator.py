"""Emulate the devices of a rig without hardware: open their ends of the links, and send frames when they are due.

Due times are absolute, so a late frame does not delay the next ones, and streams do not drift.
"""

from __future__ import annotations

import contextlib
import select
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self

from tacpipe.errors import DeviceError
from tacpipe.recording.rig import Rig, RigStream
from tacpipe.simulation.emulation.endpoint import Endpoint, Peer
from tacpipe.simulation.emulation.http_camera import HttpCamera
from tacpipe.simulation.emulation.network import HOST, Tcp, Udp, Websocket, free_port
from tacpipe.simulation.emulation.replay import DueFrame, Replay
from tacpipe.simulation.emulation.serial_port import Pty

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Recording

POLL_NS = 20_000_000  # period of polling for events without a descriptor
MAX_WAIT_S = 0.02  # maximum wait


class Transmission(Protocol):
    """A stream that is being sent. Only the sending thread calls its methods."""

    endpoint: Endpoint

    @property
    def next_ns(self) -> int:
        """The time at which the next frame is due, on the monotonic clock."""

    def run(self, now_ns: int) -> None:
        """Send what is due at ``now_ns`` on the monotonic clock."""

    def receive(self, peer: Peer, data: bytes, now_ns: int) -> None:
        """Process bytes from a host; they are empty if the host has just connected."""


class Emulator:
    """An emulated rig, which runs during a ``with`` statement. Subclasses provide the transmissions.

    ``rig`` is the rig with the addresses of the emulated devices, ``folder`` contains pseudo-terminals.
    """

    def __init__(self, rig: Rig, folder: Path | None = None) -> None:
        """Prepare a rig; the ``with`` statement starts it. Without a ``folder`` it uses a temporary one."""
        self.rig_file, self.folder = rig, folder or Path()
        self._temporary = folder is None
        self._resources = contextlib.ExitStack()
        self._transmissions: dict[str, Transmission] = {}
        self.stopped = threading.Event()
        self._errors: list[BaseException] = []
        self.epoch_ns = 0  # start of the rig on the monotonic clock

    @property
    def rig(self) -> Rig:
        """The rig with the addresses for hosts. Recordings are labelled as simulated."""
        streams = {
            name: replace(stream, address=self._transmissions[name].endpoint.address)
            for name, stream in self.rig_file.streams.items()
        }
        return replace(self.rig_file, streams=streams, labels={**self.rig_file.labels, "simulated": True})

    def endpoint(self, stream: RigStream) -> Endpoint:
        """Start the device's end of a stream's link. Raises `DeviceError` if the link cannot be emulated."""
        scheme = stream.address.scheme
        if scheme == "serial":
            return Pty((self.folder / "dev" / stream.name).absolute())
        if scheme == "udp":
            return Udp(udp_listener(stream))
        if scheme in ("mjpeg", "v4l2"):
            return HttpCamera()
        if scheme in ("tcp", "ws"):
            return Tcp() if scheme == "tcp" else Websocket()
        raise DeviceError(f"{stream.name}: {stream.address} cannot be emulated; remove the stream.")

    def transmission(self, stream: RigStream, endpoint: Endpoint) -> Transmission:
        """Return the transmission of a stream to the hosts of ``endpoint``."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        """Start all streams. Raises `DeviceError` or `UsageError` if one cannot be emulated."""
        with contextlib.ExitStack() as resources:
            if self._temporary:
                self.folder = Path(resources.enter_context(tempfile.TemporaryDirectory(prefix="tacpipe-")))
            self.folder.mkdir(parents=True, exist_ok=True)
            endpoints: dict[str, Endpoint] = {}
            for name, stream in self.rig_file.streams.items():
                endpoints[name] = self.endpoint(stream)
                resources.callback(endpoints[name].close)
            self._resources = resources.pop_all()
        self.epoch_ns = time.monotonic_ns()
        for name, stream in self.rig_file.streams.items():
            self._transmissions[name] = self.transmission(stream, endpoints[name])
        self._thread = threading.Thread(target=self.run_thread, args=(self._send_due,), daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop all streams. Raises an error of the thread."""
        self.stopped.set()
        self._thread.join()
        self._resources.close()
        if self._errors and error is None:
            raise self._errors[0]

    def run_thread(self, work: Callable[[], None]) -> None:
        """Do the work of a thread; store its error and stop the emulator."""
        try:
            work()
        except BaseException as error:  # the ``with`` statement raises errors of the thread
            self._errors.append(error)
            self.stopped.set()

    def _send_due(self) -> None:
        """Send due frames and receive what hosts write until the emulator is stopped; the work of a thread."""
        transmissions, poll_ns = list(self._transmissions.values()), 0
        while not self.stopped.is_set():
            owners = {
                descriptor: transmission
                for transmission in transmissions
                for descriptor in transmission.endpoint.descriptors()
            }
            next_ns = min(transmission.next_ns for transmission in transmissions)
            wait_s = min(MAX_WAIT_S, max(0.0, (next_ns - time.monotonic_ns()) / 1e9))
            ready, _, _ = select.select(owners, [], [], wait_s)
            now_ns = time.monotonic_ns()
            for descriptor in ready:
                self._receive(owners[descriptor], owners[descriptor].endpoint.ready(descriptor), now_ns)
            for transmission in transmissions:
                if transmission.next_ns <= now_ns:
                    transmission.run(now_ns)
            if now_ns >= poll_ns:
                poll_ns = now_ns + POLL_NS
                self.poll(now_ns)
                for transmission in transmissions:
                    self._receive(transmission, transmission.endpoint.look(), now_ns)

    def poll(self, now_ns: int) -> None:
        """Do further work, every 20 ms."""

    def _receive(self, transmission: Transmission, heard: Iterable[tuple[Peer, bytes]], now_ns: int) -> None:
        for peer, data in heard:
            transmission.receive(peer, data, now_ns)


def udp_listener(stream: RigStream) -> tuple[str, int] | None:
    """Return host and port to which a UDP device sends, a free port; None if it sends to the host that writes to it."""
    host = stream.address.target.partition("?")[0].rpartition(":")[0]
    return (HOST if host else "", free_port()) if stream.sensor.listens or not host else None


class ReplayTransmission:
    """A stream of frames to all hosts that are connected when they are due. What hosts write is ignored."""

    def __init__(self, endpoint: Endpoint, frames: Iterator[DueFrame], epoch_ns: int) -> None:
        """Send ``frames``, whose times count from ``epoch_ns`` on the monotonic clock, to the hosts of ``endpoint``."""
        self.endpoint, self._frames, self._epoch_ns = endpoint, frames, epoch_ns
        self._next = next(frames)

    @property
    def next_ns(self) -> int:
        """The time at which the next frame is due, on the monotonic clock."""
        return self._epoch_ns + self._next.due_ns

    def run(self, now_ns: int) -> None:
        """Send the frames that are due."""
        due = []
        while self.next_ns <= now_ns:
            due.append(self._next.data)
            self._next = next(self._frames)
        for peer in self.endpoint.peers:
            peer.send(due)

    def receive(self, peer: Peer, data: bytes, now_ns: int) -> None:
        """Ignore bytes from a host."""


class ReplayEmulator(Emulator):
    """An emulated rig that replays recordings."""

    def __init__(
        self, rig: Rig, recordings: Iterable[Recording], folder: Path | None = None, lead_s: float = 0.0
    ) -> None:
        """Prepare a rig that sends ``recordings`` again and again, after each first sample for ``lead_s``.

        Raises `UsageError` if no recording has all streams of the rig, or a stream cannot be replayed.
        """
        self.replay = Replay(rig, recordings, lead_s)
        super().__init__(self.replay.rig, folder)

    def transmission(self, stream: RigStream, endpoint: Endpoint) -> ReplayTransmission:
        """Return the transmission of a recorded stream."""
        return ReplayTransmission(endpoint, self.replay.frames(stream.name), self.epoch_ns)
