"""Which sensor speaks: each driver's framer tries the bytes, and the same bytes shuffled state what it takes by chance."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tacpipe.errors import TacpipeError
from tacpipe.plugins import params, registry
from tacpipe.sensors import variants
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Sensor

PACKETS = (
    "udp",
    "tcp+udp",
    "ws",
    "hid",
    "can",
    "folder",
    "camera",
    "lsl",
)  # kinds of links whose chunks have a size that states
MOST = 1 << 18  # bytes that are looked at
CERTAIN = 0.8  # fraction of the bytes beyond chance from which on there is no doubt
POSSIBLE = 0.2  # below it, nothing speaks for a driver
FEWEST = 3  # frames


@dataclass(frozen=True)
class Candidate:
    """A sensor that might speak, with its options."""

    kind: str  # registered name
    sensor: Sensor
    options: Mapping[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        described = ", ".join(
            f"{len(value)} {name}" if isinstance(value, list) else f"{name} = {value}"
            for name, value in self.options.items()
            if not isinstance(value, dict)
        )
        return f"{self.kind} ({described})" if described else self.kind


@dataclass(frozen=True)
class Finding:
    """What speaks for a candidate."""

    candidate: Candidate
    frames: int
    rate_hz: float  # of frames, 0 where fewer than two arrivals state it
    bytes: int  # that were looked at
    explained: float  # fraction of them that is in frames
    chance: float  # fraction of the same bytes in random order that would be

    @property
    def name(self) -> str:
        """The registered name of the sensor."""
        return self.candidate.kind

    @property
    def evidence(self) -> float:
        """What it explains beyond chance: from 0 to 1."""
        return max(0.0, self.explained - self.chance)

    def __str__(self) -> str:
        rate = f" at {self.rate_hz:.4g} Hz" if self.rate_hz else ""
        alone = "by the size of the packets alone"
        chance = alone if self.chance > POSSIBLE else f"{100 * self.chance:.1f} % by chance"
        part = f"{100 * self.explained:.1f} % of {self.bytes:,} bytes"
        return f"{self.candidate}: {self.frames:,} frames{rate}, {part} ({chance})"


def candidates(data: Chunks, scheme: str) -> list[Candidate]:
    """Return the sensors that are reached by links of this kind, with the options that the bytes suggest."""
    found = []
    for kind in registry.sensors():
        try:
            loaded = registry.load_sensor(kind)
        except TacpipeError:  # a plug-in that cannot be imported spoils no other's recognition
            continue
        if scheme not in loaded.links:
            continue
        for options in variants.of(kind, data):
            try:
                found.append(Candidate(kind, params.filled(loaded, options, kind, "option"), options))
            except TacpipeError:  # it cannot be guessed, as a generic driver's columns
                continue
    return found


def recognise(data: Chunks, scheme: str, sensors: Iterable[Candidate] | None = None) -> list[Finding]:
    """Return what speaks for each of ``sensors``, the likeliest first; those for which nothing speaks are left out.

    ``data`` came over a link of the kind ``scheme``. By default all sensors are tried that such links reach.
    """
    if not data.data:
        return []
    data = _first(data)
    shuffled, noise = _shuffled(data), _noise(data)
    found = []
    for candidate in candidates(data, scheme) if sensors is None else sensors:
        frames, part, rate_hz = _tried(candidate.sensor, data)
        if frames < FEWEST or part < POSSIBLE:
            continue
        # Digits in any order are lines of one number: what is described by the bytes is compared with any bytes at all.
        _, chance, _ = _tried(candidate.sensor, noise if candidate.sensor.described else shuffled)
        finding = Finding(candidate, frames, rate_hz, len(data.data), part, chance)
        if scheme in PACKETS or finding.evidence >= POSSIBLE:
            found.append(finding)
    return sorted(found, key=_rank)


def _rank(finding: Finding) -> tuple[float, bool, float, float, int]:
    """Return what findings are sorted by: evidence in steps, because a cut frame decides nothing, then the rate.

    A product comes before a board that the bytes themselves describe.
    """
    expected_hz = finding.candidate.sensor.rate_hz
    off = abs(np.log(finding.rate_hz / expected_hz)) if finding.rate_hz > 0 and expected_hz > 0 else np.inf
    return (
        -round(finding.evidence, 1),
        finding.candidate.sensor.described,
        -round(finding.explained, 1),
        round(float(off), 1),
        len(finding.candidate.options),
    )


def _tried(sensor: Sensor, data: Chunks) -> tuple[int, float, float]:
    """Return how many frames a sensor finds, the fraction of the bytes in them, and their rate in hertz."""
    framer = sensor.framer()
    runs = [*framer.feed(data)[0], *framer.flush()[0]]
    stamps = [run.t_ns for run in runs if len(run.t_ns)]
    frames = sum(map(len, stamps))
    span_ns = int(stamps[-1][-1] - stamps[0][0]) if stamps else 0
    rate_hz = (frames - 1) * 1e9 / span_ns if span_ns > 0 else 0.0
    return frames, framer.account.framed / max(1, framer.account.received), rate_hz


def _first(data: Chunks) -> Chunks:
    if len(data.data) <= MOST:
        return data
    count = max(1, int(np.searchsorted(np.cumsum(data.size), MOST, side="right")))
    return Chunks(data.t_ns[:count], data.size[:count], data.data[: int(data.size[:count].sum())])


def _noise(data: Chunks) -> Chunks:
    return Chunks(data.t_ns, data.size, np.random.default_rng(0).bytes(len(data.data)))


def _shuffled(data: Chunks) -> Chunks:
    text = np.random.default_rng(0).permutation(np.frombuffer(data.data, np.uint8)).tobytes()
    return Chunks(data.t_ns, data.size, text)
