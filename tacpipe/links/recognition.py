"""Recognise a sensor by its bytes: each driver's framer tries them, and tries them shuffled to measure chance."""

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

# Kinds of links whose entries are packets, whose size is evidence too
PACKETS = ("udp", "tcp+udp", "ws", "hid", "can", "folder", "camera", "lsl")
MOST = 1 << 18  # number of bytes that are examined
CERTAIN = 0.8  # fraction of the bytes beyond chance above which there is no doubt
POSSIBLE = 0.2  # smallest fraction that is evidence for a driver
FEWEST = 3  # smallest number of frames


@dataclass(frozen=True)
class Candidate:
    """A sensor that may have sent the bytes, with its options."""

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
    """The evidence for a candidate."""

    candidate: Candidate
    frames: int
    rate_hz: float  # rate of frames, 0 with fewer than two arrivals
    bytes: int  # number of bytes that were examined
    explained: float  # fraction of the bytes that is in frames
    chance: float  # fraction of the same bytes in random order that would be

    @property
    def name(self) -> str:
        """The registered name of the sensor."""
        return self.candidate.kind

    @property
    def evidence(self) -> float:
        """The fraction of the bytes that it explains beyond chance, 0 to 1."""
        return max(0.0, self.explained - self.chance)

    def __str__(self) -> str:
        rate = f" at {self.rate_hz:.4g} Hz" if self.rate_hz else ""
        by_size = "by the size of the packets alone"
        chance = by_size if self.chance > POSSIBLE else f"{100 * self.chance:.1f} % by chance"
        part = f"{100 * self.explained:.1f} % of {self.bytes:,} bytes"
        return f"{self.candidate}: {self.frames:,} frames{rate}, {part} ({chance})"


def candidates(data: Chunks, scheme: str) -> list[Candidate]:
    """Return the sensors that use links of this kind, with the options that the bytes suggest."""
    sensors = []
    for kind in registry.sensors():
        try:
            loaded = registry.load_sensor(kind)
        except TacpipeError:  # a plug-in that cannot be imported does not stop the others
            continue
        if scheme not in loaded.links:
            continue
        for options in variants.of(kind, data):
            try:
                sensors.append(Candidate(kind, params.filled(loaded, options, kind, "option"), options))
            except TacpipeError:  # its options cannot be guessed, such as the columns of a generic driver
                continue
    return sensors


def recognise(data: Chunks, scheme: str, sensors: Iterable[Candidate] | None = None) -> list[Finding]:
    """Return the findings for ``sensors``, the likeliest first. Sensors without evidence are left out.

    ``data`` came over a link of the kind ``scheme``. By default all sensors of such links are tried.
    """
    if not data.data:
        return []
    data = _first(data)
    shuffled, noise = _shuffled(data), _noise(data)
    findings = []
    for candidate in candidates(data, scheme) if sensors is None else sensors:
        frames, part, rate_hz = _count_frames(candidate.sensor, data)
        if frames < FEWEST or part < POSSIBLE:
            continue
        # Shuffled digits are still lines of one number, so a sensor that the bytes describe is compared with random bytes.
        _, chance, _ = _count_frames(candidate.sensor, noise if candidate.sensor.described else shuffled)
        finding = Finding(candidate, frames, rate_hz, len(data.data), part, chance)
        if scheme in PACKETS or finding.evidence >= POSSIBLE:
            findings.append(finding)
    return sorted(findings, key=_rank)


def _rank(finding: Finding) -> tuple[float, bool, float, float, int]:
    """Return the sort key of a finding: evidence rounded, because one cut frame decides nothing, then the rate.

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


def _count_frames(sensor: Sensor, data: Chunks) -> tuple[int, float, float]:
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
