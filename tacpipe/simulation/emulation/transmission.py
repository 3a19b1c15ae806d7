"""Send a stream of an emulated rig: samples are planned ahead, changed by the faults, and sent when they are due.

Deadlines are absolute: a frame that is late takes nothing away from the next ones, so that a stream does not drift.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Times
from tacpipe.errors import UsageError
from tacpipe.sensors.sensor import Sensor
from tacpipe.simulation.emulation import byte_faults
from tacpipe.simulation.emulation.byte_faults import REPLUG, UNPLUG, Faults, Harm, SentItem, one_by_one
from tacpipe.simulation.emulation.endpoint import Endpoint, Peer
from tacpipe.simulation.emulation.ledger import Ledger
from tacpipe.simulation.emulation.source import Sampled


@dataclass(frozen=True)
class FramePace:
    """How a stream's frames come; in a rig file the keys of ``emulate``, for the whole rig or one stream."""

    jitter_ms: float = 0.2  # mean delay of a frame, exponentially distributed
    burst_ms: float = 0.0  # frames are collected for so long and sent together, as USB bridges do; 0: each alone
    skew_ppm: float | None = None  # excess rate of the device's clock; None: random within 50
    offset_ms: float | None = None  # lead of the device's clock; None: random within 80
    slides: bool = False  # a biotac sends the slides of `tacpipe simulate material` instead of the rig's grasps
    video: str = ""  # video file that a camera shows again and again; empty: the gel of its finger
    finger: int | None = None  # finger of the gripper with the sensor, 1 or 2; None: the last digit of its name, or 1

    def __post_init__(self) -> None:
        if self.jitter_ms < 0 or self.burst_ms < 0:
            raise UsageError(
                f"emulate: jitter_ms is {self.jitter_ms:g} and burst_ms {self.burst_ms:g}; neither can be below 0."
            )
        if self.finger not in (None, 1, 2):
            raise UsageError(f"emulate: finger is {self.finger}; the gripper has finger 1 and finger 2.")


def next_due_ns(taken_ns: Times, pace: FramePace, after_ns: int, rng: np.random.Generator) -> Times:
    """Return when frames of samples taken at ``taken_ns`` (frame,) go out: none before ``after_ns``, and in order."""
    late_ns = np.rint(rng.exponential(pace.jitter_ms * 1e6, len(taken_ns))).astype(np.int64)
    due = np.maximum(np.maximum.accumulate(taken_ns + late_ns), after_ns)
    burst_ns = round(pace.burst_ms * 1e6)
    burst_due_ns: Times = -(-due // burst_ns) * burst_ns if burst_ns else due
    return burst_due_ns


AHEAD_NS = 1_500_000_000  # frames are planned so long before they are due
IDLE_NS = 20_000_000  # period of checks of a stream without a receiver
MAX_MESSAGES = 1000  # messages of the host that the ledger keeps
PAUSE_NS = 2_000_000  # pause between two tries of a patient device


class TransmissionPlan:
    """The items of a stream, in order, a block of its source at a time: what goes out, when, and what was harmed."""

    def __init__(self, source: Sampled, pace: FramePace, faults: Faults, seed: Sequence[int], *, packets: bool) -> None:
        self.source, self.pace = source, pace
        self._harm = Harm(faults, source.sensor, seed, packets=packets)
        self._rng = np.random.default_rng([*seed, 7])
        self._block = 0
        self.until_ns = source.timing.start_ns  # time at which all earlier items are sent

    def skip(self, t_ns: int) -> None:
        """Begin with the block that holds the first sample after ``t_ns``."""
        self._block = max(self._block, self.source.timing.first_after(t_ns) // self.source.rows)

    def next_items(self) -> list[SentItem]:
        """Return the items of the next block."""
        source = self.source
        numbers = source.numbers(self._block)
        frames = one_by_one(source.sensor, source.sensor.encode(source.block(self._block)))
        due_ns = next_due_ns(source.timing.taken_ns(numbers), self.pace, self.until_ns, self._rng)
        self._block += 1
        self.until_ns = int(due_ns[-1]) + 1
        return self._harm.apply(frames, due_ns.tolist(), int(numbers[0]))


class Transmission:
    """A stream that is served: its plan, its end of the link, its ledger. `fill` may come from another thread."""

    def __init__(
        self,
        endpoint: Endpoint,
        sensor: Sensor,
        ledger: Ledger,
        planned: Callable[
            [float, int], TransmissionPlan
        ],  # returns due times, ns from the rig's start, of a rate and a start
        rate_hz: float,
        epoch_ns: int,
        *,
        patient: bool = False,  # bytes wait, and are not lost, where a host has no room
    ) -> None:
        self._patient = patient
        self._late: deque[tuple[SentItem | None, bytes]] = (
            deque()
        )  # items, or replies, and what of them is still to be sent
        self._awaited: Peer | None = None  # the host that they are for
        self._again_ns = 0
        self.endpoint, self.sensor, self.ledger = endpoint, sensor, ledger
        self._planned, self._epoch_ns = planned, epoch_ns
        self._rate_hz = rate_hz
        self._lock = threading.Lock()
        self._items: deque[SentItem] = deque()
        self._latest: SentItem | None = None  # the last frame that was due, for hosts that ask
        self._on_request = bool(sensor.request())
        self._begin(rate_hz, 0)

    def _begin(self, rate_hz: float, start_ns: int) -> None:
        plan = self._planned(rate_hz, start_ns)
        with self._lock:
            self._rate_hz, self._plan, self._latest = rate_hz, plan, None
            self._items.clear()
            self.ledger.sources.append(plan.source)
        self.fill(start_ns)

    def fill(self, now_ns: int) -> None:
        """Plan ahead of ``now_ns``, the time since the rig's start."""
        with self._lock:
            self._plan.skip(now_ns - AHEAD_NS)
            while self._plan.until_ns < now_ns + AHEAD_NS:
                self._items.extend(self._plan.next_items())

    @property
    def next_ns(self) -> int:
        """When something is due, on the monotonic clock; a stream that nobody receives can wait."""
        if self._late:
            return self._again_ns
        if not self._items:
            return self._epoch_ns + self._plan.until_ns
        due_ns = self._epoch_ns + self._items[0].due_ns
        return due_ns if self._on_request or self._receivers() else due_ns + IDLE_NS

    def run(self, now_ns: int) -> bool:
        """Send what is due at ``now_ns`` on the monotonic clock; return whether the device was unplugged or came back."""
        since_ns, items, due = now_ns - self._epoch_ns, self._items, list[SentItem]()
        plugged = False
        if self._late:
            self._push(now_ns)
        if not items:  # the planning thread came too late
            self.fill(since_ns)
        while items and items[0].due_ns <= since_ns:
            item = items.popleft()
            if item.number < 0 and item.cause in (UNPLUG, REPLUG):
                self._send(due, now_ns)
                due, plugged = [], True
                self.plug(item.cause == REPLUG, now_ns)
            else:
                due.append(item)
        self._send(due, now_ns)
        return plugged

    def plug(self, back: bool, now_ns: int) -> None:
        """Unplug the device, or bring it back."""
        if back:
            self.endpoint.replug()
        else:
            self.endpoint.unplug()
        self.ledger.enter(now_ns, REPLUG if back else UNPLUG)

    def _receivers(self) -> list[Peer]:
        return [peer for peer in self.endpoint.peers if peer.device.streaming or peer.pending_frames]

    def _send(self, items: Sequence[SentItem], now_ns: int) -> None:
        if not items:
            return
        self._latest = next((item for item in reversed(items) if item.data and item.number >= 0), self._latest)
        streaming = next((peer for peer in self._receivers() if peer.device.streaming), None)
        if self._patient and streaming is not None:
            if streaming is not self._awaited:
                self._late.clear()
            self._awaited = streaming
            self._late.extend((item, item.data) for item in items)
            self._push(now_ns)
            return
        sizes: list[int] | None = None
        fault = byte_faults.SOUND
        pieces = [item.data for item in items]
        for peer in self._receivers():
            part = pieces if peer.device.streaming else pieces[: peer.pending_frames]
            sent = self._post(peer, part)
            peer.pending_frames = max(0, peer.pending_frames - len(part)) if not peer.device.streaming else 0
            if sizes is None:
                sizes, fault = sent, peer.fault
        if sizes is not None:
            self._enter(items[: len(sizes)], sizes, fault, now_ns)

    def _post(self, peer: Peer, pieces: Sequence[bytes]) -> list[int]:
        post: Callable[[Sequence[bytes]], list[int]] = getattr(peer, "post", peer.send)
        full = [piece for piece in pieces if piece]
        sent = iter(post(full) if full else [])
        return [next(sent) if piece else 0 for piece in pieces]

    def _push(self, now_ns: int) -> None:
        """Send what waits, in order, as far as the host has room for it; what waited for a host that left is forgotten."""
        peer = next(iter(self._receivers()), None)
        if peer is None or peer is not self._awaited:
            self._late.clear()
        while self._late and peer is not None and not getattr(peer, "full", bool)():
            item, remaining = self._late[0]
            remaining = remaining[self._post(peer, [remaining])[0] :]
            if remaining:
                self._late[0] = (item, remaining)
                break
            self._late.popleft()
            if item is not None:
                self._enter([item], [len(item.data)], peer.fault, now_ns)
        self._again_ns = now_ns + PAUSE_NS

    def _enter(self, items: Iterable[SentItem], sizes: Sequence[int], fault: str, now_ns: int) -> None:
        for item, size in zip(items, sizes, strict=True):
            cause = item.cause
            if size < len(item.data):
                cause = fault if fault == byte_faults.GONE else byte_faults.OVERRUN
            elif fault and item.data:
                cause = fault
            self.ledger.add(item, self._epoch_ns + item.due_ns, now_ns, size, cause)

    def heard(self, peer: Peer, data: bytes, now_ns: int) -> None:
        """Have the device take what a host wrote: replies go first, then the frames that were asked for."""
        if not data:
            self.ledger.enter(now_ns, "connected")
        elif len(self.ledger.events) < MAX_MESSAGES:
            self.ledger.enter(now_ns, "heard", data.hex())
        replies = [reply for reply in peer.device.hear(data) if reply]
        if replies and self._late and peer is self._awaited:  # after the frame that is half sent
            for reply in reversed(replies):
                self._late.insert(1, (None, reply))
        elif replies:
            peer.send(replies)
        rate_hz = peer.device.rate_hz
        if rate_hz and rate_hz != self._rate_hz:
            self.ledger.enter(now_ns, "rate", f"{rate_hz:g}")
            self._begin(rate_hz, now_ns - self._epoch_ns)
        requested = peer.device.polled()
        if requested:
            peer.pending_frames += requested
            self._hand_over(peer, now_ns)

    def _hand_over(self, peer: Peer, now_ns: int) -> None:
        """Send the latest frame to a host that asked; more that it asked for follow as they become due."""
        before, peer.pending_frames = peer.pending_frames, 0
        self.run(now_ns)  # frames that are due are those of others
        peer.pending_frames = before
        if self._latest is not None and peer in self.endpoint.peers:  # it may have been unplugged just now
            sizes = self._post(peer, [self._latest.data])
            peer.pending_frames -= 1
            self._enter([self._latest], sizes, peer.fault, now_ns)
