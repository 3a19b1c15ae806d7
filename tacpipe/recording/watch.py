"""What can be determined of a stream while it comes: rate, losses, jitter, latency, the newest values."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from tacpipe.arrays import Floats, Int64s
from tacpipe.errors import TacpipeError
from tacpipe.recording.reading import Batch, Reading
from tacpipe.recording.rig import Stream
from tacpipe.recording.spool_blocks import Note
from tacpipe.recording.station import LOST
from tacpipe.sensors.framing import Chunks

SPAN_NS = 2_000_000_000  # over which rate and jitter are given
REST_S = 0.5  # over which the level of a tactile channel at rest is taken


@dataclass(frozen=True)
class Figures:
    """What a stream does now."""

    rate_hz: float
    jitter_ms: float  # standard deviation of the time between arrivals
    latency_ms: (
        float | None
    )  # median of how much later samples came than the fastest, by the device's clock; None: has none
    samples: int  # in all
    lost: int  # in all
    bytes_lost: int  # in all


class Watch:
    """Follows one stream; what it sees is not kept."""

    def __init__(self, stream: Stream) -> None:
        self.stream = stream
        self.samples = 0
        self.error = ""  # what its driver could not make of what came
        self.newest: Floats | None = None  # (channel,)
        self.heard: deque[Chunks] = deque(maxlen=64)  # the last chunks, to state what speaks where no frame is found
        self.last_ns: int | None = None  # arrival of the newest sample
        self._reading = Reading(stream.sensor)
        self._recent: deque[tuple[Int64s, Int64s | None]] = deque()
        self._rest: list[Floats] = []
        self.rest: Floats | None = None  # (channel,), once it is known

    def feed(self, blocks: list[Chunks | Note]) -> None:
        """Take what came. What a driver raises is kept in ``error``: nothing that is looked at may end a recording."""
        for block in blocks:
            if isinstance(block, Chunks):
                self.heard.append(block)
            try:
                if isinstance(block, Chunks):
                    self._look(self._reading.feed(block))
                elif block.what == LOST:
                    self._look(self._reading.broken())
            except Exception as error:
                self.error = str(error) if isinstance(error, TacpipeError) else f"{type(error).__name__}: {error}"
                self._reading = Reading(self.stream.sensor)

    def figures(self, now_ns: int) -> Figures:
        """Return what the stream does at this moment of the monotonic clock."""
        self._forget(now_ns)
        t_ns = np.concatenate([stamps for stamps, _ in self._recent] or [np.zeros(0, dtype=np.int64)])
        steps_ns = np.diff(t_ns)
        rate_hz = float((len(t_ns) - 1) * 1e9 / (t_ns[-1] - t_ns[0])) if len(t_ns) > 1 and t_ns[-1] > t_ns[0] else 0.0
        jitter_ms = float(steps_ns.std() / 1e6) if len(steps_ns) else 0.0
        device = [stamps for _, stamps in self._recent if stamps is not None]
        latency_ms = None
        if device and len(device) == len(self._recent):
            late_ns = t_ns - np.concatenate(device)
            latency_ms = float(np.median(late_ns - late_ns.min()) / 1e6)
        lost = self._reading.lost
        return Figures(rate_hz, jitter_ms, latency_ms, self.samples, lost, self._reading.account.lost)

    def tare(self) -> None:
        """Take the level of the next samples for rest."""
        self._rest, self.rest = [], None

    def _look(self, batch: Batch) -> None:
        if not len(batch):
            return
        self.samples += len(batch)
        self.last_ns = int(batch.t_ns[-1])
        self._recent.append((batch.t_ns, batch.t_device_ns))
        self._forget(self.last_ns)
        numbers = [block[-1].astype(np.float64) for block in batch.values if block.dtype.kind in "iufb"]
        self.newest = np.concatenate(numbers) if numbers else None
        if self.rest is None and self.newest is not None:
            self._rest.append(self.newest)
            enough = REST_S * (self.stream.sensor.rate_hz or 1.0)
            if len(self._rest) >= min(10.0, max(1.0, enough)):
                self.rest = np.mean(self._rest, axis=0)

    def _forget(self, now_ns: int) -> None:
        while self._recent and self._recent[0][0][-1] < now_ns - SPAN_NS:
            self._recent.popleft()


def tactile_channels(stream: Stream) -> list[tuple[int, Any]]:
    """Return position among the numeric channels, and field, of each tactile channel of a stream."""
    import pyarrow as pa

    numeric = [
        kind
        for kind in stream.sensor.fields()
        if pa.types.is_integer(kind.type) or pa.types.is_floating(kind.type) or pa.types.is_boolean(kind.type)
    ]
    return [(place, kind) for place, kind in enumerate(numeric) if (kind.metadata or {}).get(b"quantity") == b"tactile"]
