"""Send a stream of an emulated rig: frames are planned ahead, changed by faults, and sent when they are due.

Due times are absolute, so a late frame does not delay the next ones, and the stream does not drift.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from tacpipe.arrays import Times
from tacpipe.errors import UsageError
from tacpipe.sensors.encoding import split_frames
from tacpipe.sensors.sensor import Sensor
from tacpipe.simulation.emulation.endpoint import Endpoint, Peer
from tacpipe.testing.dialogues import Device
from tests.emulation import byte_faults
from tests.emulation.byte_faults import REPLUG, UNPLUG, Faults, Harm, SentItem
from tests.emulation.devices import device_for
from tests.emulation.ledger import Ledger
from tests.emulation.network import Registration, is_queue_full
from tests.emulation.source import Sampled


@dataclass(frozen=True)
class FramePace:
    """The timing of a stream's frames: the keys of ``emulate`` in a rig file, for the rig or a stream."""

    jitter_ms: float = 0.2  # mean of the exponentially distributed delay of a frame
    burst_ms: float = 0.0  # interval in which frames are collected and sent together, as by USB bridges; 0: separately
    skew_ppm: float | None = None  # rate error of the device's clock; None: random within ±50
    offset_ms: float | None = None  # offset of the device's clock; None: random within ±80
    video: str = ""  # video file that a camera shows again and again; empty: the gel of its finger
    finger: int | None = None  # finger with the sensor, 1 or 2; None: the last digit of the stream's name, or 1

    def __post_init__(self) -> None:
        """Raise `UsageError` for a negative delay or burst, or a finger that does not exist."""
        if self.jitter_ms < 0 or self.burst_ms < 0:
            raise UsageError(
                f"emulate: jitter_ms is {self.jitter_ms:g} and burst_ms {self.burst_ms:g}; both must be at least 0."
            )
        if self.finger not in (None, 1, 2):
            raise UsageError(f"emulate: finger is {self.finger}; it must be 1 or 2.")


def next_due_ns(sample_ns: Times, pace: FramePace, after_ns: int, rng: np.random.Generator) -> Times:
    """Return the ascending due times (frame,) in ns of frames with samples at ``sample_ns``, not before ``after_ns``."""
    late_ns = np.rint(rng.exponential(pace.jitter_ms * 1e6, len(sample_ns))).astype(np.int64)
    arrival_ns = np.maximum(np.maximum.accumulate(sample_ns + late_ns), after_ns)
    burst_ns = round(pace.burst_ms * 1e6)
    return -(-arrival_ns // burst_ns) * burst_ns if burst_ns else arrival_ns


AHEAD_NS = 1_500_000_000  # time by which frames are planned ahead
IDLE_NS = 20_000_000  # additional delay of a stream without a receiver
MAX_MESSAGES = 1000  # messages of hosts in the ledger
RETRY_NS = 2_000_000  # pause between two attempts of a patient device


class TransmissionPlan:
    """The items of a stream in order, with due times and faults, in blocks of its source."""

    def __init__(self, source: Sampled, pace: FramePace, faults: Faults, seed: Sequence[int], *, packets: bool) -> None:
        """Plan frames of ``source`` with faults; ``packets``: whether the link sends packets."""
        self.source, self.pace = source, pace
        self._harm = Harm(faults, source.sensor, seed, packets=packets)
        self._rng = np.random.default_rng([*seed, 7])
        self._block = 0
        self.planned_ns = source.timing.start_ns  # all planned items are due before this time

    def skip(self, t_ns: int) -> None:
        """Continue with the block that contains the first sample after ``t_ns``, if it is later."""
        self._block = max(self._block, self.source.timing.first_after(t_ns) // self.source.rows)

    def next_items(self) -> list[SentItem]:
        """Return the items of the next block, with faults."""
        source = self.source
        numbers = source.numbers(self._block)
        frames = split_frames(source.sensor, source.sensor.encode(source.block(self._block)))
        due_ns = next_due_ns(source.timing.sample_ns(numbers), self.pace, self.planned_ns, self._rng)
        self._block += 1
        self.planned_ns = int(due_ns[-1]) + 1
        return self._harm.apply(frames, due_ns.tolist(), int(numbers[0]))


@dataclass
class Host:
    """What the device knows about a connected host."""

    device: Device
    pending_frames: int = 0  # number of requested frames that were not sent yet


class Transmission:
    """An emulated stream: its plan, its end of the link, and its ledger. `fill` may be called by another thread."""

    def __init__(
        self,
        endpoint: Endpoint,
        sensor: Sensor,
        ledger: Ledger,
        make_plan: Callable[[float, int], TransmissionPlan],  # arguments: rate in Hz, start in ns since the rig's start
        rate_hz: float,
        epoch_ns: int,
        *,
        patient: bool = False,  # wait, instead of losing bytes, while a host's buffer is full
    ) -> None:
        """Start a plan at ``rate_hz``. ``epoch_ns`` is the rig's start on the monotonic clock."""
        self._patient = patient
        # items, or None for replies, and their unsent bytes
        self._unsent: deque[tuple[SentItem | None, bytes]] = deque()
        self._unsent_peer: Peer | None = None  # the host of the unsent items
        self._retry_ns = 0
        self.endpoint, self.sensor, self.ledger = endpoint, sensor, ledger
        self._make_plan, self._epoch_ns = make_plan, epoch_ns
        self._rate_hz = rate_hz
        self._lock = threading.Lock()
        self._items: deque[SentItem] = deque()
        self._latest: SentItem | None = None  # the last due frame, for hosts that request one
        self._on_request = bool(sensor.request())
        self._hosts: WeakKeyDictionary[Peer, Host] = WeakKeyDictionary()
        self._start_plan(rate_hz, 0)

    def _start_plan(self, rate_hz: float, start_ns: int) -> None:
        """Replace the plan by one with another rate that starts at ``start_ns`` since the rig's start, and fill it."""
        plan = self._make_plan(rate_hz, start_ns)
        with self._lock:
            self._rate_hz, self._plan, self._latest = rate_hz, plan, None
            self._items.clear()
            self.ledger.sources.append(plan.source)
        self.fill(start_ns)

    def fill(self, now_ns: int) -> None:
        """Plan frames ahead of ``now_ns``, the time since the rig's start."""
        with self._lock:
            self._plan.skip(now_ns - AHEAD_NS)
            while self._plan.planned_ns < now_ns + AHEAD_NS:
                self._items.extend(self._plan.next_items())

    @property
    def next_ns(self) -> int:
        """The time at which the next item is due, on the monotonic clock. Without a receiver it is delayed."""
        if self._unsent:
            return self._retry_ns
        if not self._items:
            return self._epoch_ns + self._plan.planned_ns
        due_ns = self._epoch_ns + self._items[0].due_ns
        return due_ns if self._on_request or self._receivers() else due_ns + IDLE_NS

    def run(self, now_ns: int) -> None:
        """Send the items due at ``now_ns`` on the monotonic clock, and unplug or replug the device."""
        elapsed_ns, items, due = now_ns - self._epoch_ns, self._items, list[SentItem]()
        if self._unsent:
            self._flush_unsent(now_ns)
        if not items:  # the planning thread is late
            self.fill(elapsed_ns)
        while items and items[0].due_ns <= elapsed_ns:
            item = items.popleft()
            if item.number < 0 and item.cause in (UNPLUG, REPLUG):
                self._send(due, now_ns)
                due = []
                self.plug(item.cause == REPLUG, now_ns)
            else:
                due.append(item)
        self._send(due, now_ns)

    def plug(self, is_replugged: bool, now_ns: int) -> None:
        """Unplug or replug the device."""
        endpoint: Any = self.endpoint
        if is_replugged:
            (endpoint.replug if hasattr(endpoint, "replug") else endpoint.start)()
        else:
            (endpoint.unplug if hasattr(endpoint, "unplug") else endpoint.close)()
        self._hosts.clear()
        self.ledger.add_event(now_ns, REPLUG if is_replugged else UNPLUG)

    def _host(self, peer: Peer) -> Host:
        if peer not in self._hosts:
            self._hosts[peer] = Host(device_for(self.sensor))
        return self._hosts[peer]

    def _is_streaming(self, peer: Peer) -> bool:
        return self._host(peer).device.streaming

    def _receivers(self) -> list[Peer]:
        return [peer for peer in self.endpoint.peers if self._is_streaming(peer) or self._host(peer).pending_frames]

    def _fault(self, peer: Peer) -> str:
        """Return the cause in `byte_faults.CAUSES` that damages bytes to a host; empty if there is none."""
        if getattr(peer, "is_gone", False):
            return byte_faults.GONE
        return byte_faults.BAUD if getattr(self.endpoint, "is_garbled", False) else byte_faults.SOUND

    def _send(self, items: Sequence[SentItem], now_ns: int) -> None:
        """Send items to all hosts. A patient stream queues them for its first streaming host instead."""
        if not items:
            return
        self._latest = next((item for item in reversed(items) if item.data and item.number >= 0), self._latest)
        receivers = self._receivers()
        streaming = next((peer for peer in receivers if self._is_streaming(peer)), None)
        if self._patient and streaming is not None:
            self._queue_unsent(items, streaming, now_ns)
        else:
            self._send_to_all(items, receivers, now_ns)

    def _send_to_all(self, items: Sequence[SentItem], receivers: Sequence[Peer], now_ns: int) -> None:
        """Send items to all ``receivers``, and add to the ledger what the first receiver accepted.

        A host that does not stream gets only the frames that it requested.
        """
        frames = [item.data for item in items]
        for peer in receivers:
            host = self._host(peer)
            allowed = frames if host.device.streaming else frames[: host.pending_frames]
            sizes = self._post(peer, allowed)
            host.pending_frames = 0 if host.device.streaming else host.pending_frames - len(allowed)
            if peer is receivers[0]:
                self._add_to_ledger(items[: len(sizes)], sizes, self._fault(peer), now_ns)

    def _queue_unsent(self, items: Sequence[SentItem], peer: Peer, now_ns: int) -> None:
        """Queue items for ``peer``, and send what it accepts. Items queued for another host are dropped."""
        if peer is not self._unsent_peer:
            self._unsent.clear()
        self._unsent_peer = peer
        self._unsent.extend((item, item.data) for item in items)
        self._flush_unsent(now_ns)

    def _post(self, peer: Peer, frames: Sequence[bytes]) -> list[int]:
        """Send frames, some of which may be empty, and return how many bytes of each the host accepted."""
        post: Callable[[Sequence[bytes]], list[int]] = getattr(peer, "post", peer.send)
        if isinstance(peer, Registration):
            post = partial(peer.post, port=getattr(self._host(peer).device, "port", None) or 0)
        non_empty = [frame for frame in frames if frame]
        sizes = iter(post(non_empty) if non_empty else [])
        return [next(sizes) if frame else 0 for frame in frames]

    def _flush_unsent(self, now_ns: int) -> None:
        """Send unsent items in order while the host accepts them. They are dropped if their host has disconnected."""
        peer = next(iter(self._receivers()), None)
        if peer is None or peer is not self._unsent_peer:
            self._unsent.clear()
        while self._unsent and peer is not None and not is_queue_full(peer):
            item, remaining = self._unsent[0]
            remaining = remaining[self._post(peer, [remaining])[0] :]
            if remaining:
                self._unsent[0] = (item, remaining)
                break
            self._unsent.popleft()
            if item is not None:
                self._add_to_ledger([item], [len(item.data)], self._fault(peer), now_ns)
        self._retry_ns = now_ns + RETRY_NS

    def _add_to_ledger(self, items: Iterable[SentItem], sizes: Sequence[int], fault: str, now_ns: int) -> None:
        """Add items with their sent ``sizes`` in bytes. If the host lost or garbled bytes, that is the cause of the item."""
        for item, size in zip(items, sizes, strict=True):
            cause = item.cause
            if size < len(item.data):
                cause = fault if fault == byte_faults.GONE else byte_faults.OVERRUN
            elif fault and item.data:
                cause = fault
            self.ledger.add(item, self._epoch_ns + item.due_ns, now_ns, size, cause)

    def receive(self, peer: Peer, data: bytes, now_ns: int) -> None:
        """Pass bytes from a host to the device, and send its replies, then the frames that the host requested."""
        if not data:
            self.ledger.add_event(now_ns, "connected")
        elif len(self.ledger.events) < MAX_MESSAGES:
            self.ledger.add_event(now_ns, "heard", data.hex())
        host = self._host(peer)
        replies = [reply for reply in host.device.hear(data) if reply]
        if replies and self._unsent and peer is self._unsent_peer:
            # the replies follow the frame that is partly sent
            for reply in reversed(replies):
                self._unsent.insert(1, (None, reply))
        elif replies:
            peer.send(replies)
        rate_hz = host.device.rate_hz
        if rate_hz and rate_hz != self._rate_hz:
            self.ledger.add_event(now_ns, "rate", f"{rate_hz:g}")
            self._start_plan(rate_hz, now_ns - self._epoch_ns)
        requested = host.device.polled()
        if requested:
            host.pending_frames += requested
            self._send_requested(peer, now_ns)

    def _send_requested(self, peer: Peer, now_ns: int) -> None:
        """Send the latest frame to a host that requested it. Further requested frames are sent when they are due."""
        host = self._host(peer)
        pending, host.pending_frames = host.pending_frames, 0
        self.run(now_ns)  # due frames are for other hosts
        host.pending_frames = pending
        if self._latest is not None and peer in self.endpoint.peers:  # the device may have been unplugged in `run`
            sizes = self._post(peer, [self._latest.data])
            host.pending_frames -= 1
            self._add_to_ledger([self._latest], sizes, self._fault(peer), now_ns)
