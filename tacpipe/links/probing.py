"""Identify the sensor at an address: listen first, then send the drivers' opening requests."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from time import monotonic

import numpy as np

from tacpipe.errors import DeviceError, TacpipeError
from tacpipe.links import ports, v4l2
from tacpipe.links.link import Address, Arrived, Link, parse
from tacpipe.links.opening import open_link, run_dialogue
from tacpipe.plugins import params, registry
from tacpipe.sensors import variants
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Dialogue, Options, Sensor, SerialLine

# Kinds of links with packets, whose sizes are also evidence
PACKETS = ("udp", "tcp+udp", "ws", "hid", "can", "folder", "camera", "lsl", "v4l2", "mjpeg")
MAX_EXAMINED = 1 << 18  # bytes
CERTAIN = 0.8  # evidence at which a sensor counts as identified
POSSIBLE = 0.2  # smallest fraction of bytes in frames that is evidence for a sensor
MIN_FRAMES = 3


@dataclass(frozen=True)
class SensorCandidate:
    """A sensor that may have sent the bytes, with its options."""

    kind: str  # registered name of the sensor
    sensor: Sensor
    options: Options = field(default_factory=dict)

    def __str__(self) -> str:
        """Return the kind with its options, lists by their length."""
        options = ", ".join(
            f"{len(value)} {name}" if isinstance(value, list) else f"{name} = {value}"
            for name, value in self.options.items()
            if not isinstance(value, dict)
        )
        return f"{self.kind} ({options})" if options else self.kind


@dataclass(frozen=True)
class Finding:
    """The evidence for a candidate."""

    candidate: SensorCandidate
    frames: int
    rate_hz: float  # rate of frames; 0 with fewer than two arrival times
    bytes: int  # number of bytes that were examined
    explained: float  # fraction of the bytes that are in frames
    chance: float  # fraction of bytes that would be in frames by chance

    @property
    def name(self) -> str:
        """The registered name of the sensor."""
        return self.candidate.kind

    @property
    def evidence(self) -> float:
        """The fraction of the bytes explained beyond chance, 0 to 1."""
        return max(0.0, self.explained - self.chance)

    def __str__(self) -> str:
        """Return the candidate with its evidence: frames, rate, and fractions of bytes in frames."""
        rate = f" at {self.rate_hz:.4g} Hz" if self.rate_hz else ""
        by_size = "only by the size of the packets"
        chance = by_size if self.chance > POSSIBLE else f"{100 * self.chance:.1f} % by chance"
        part = f"{100 * self.explained:.1f} % of {self.bytes:,} bytes"
        return f"{self.candidate}: {self.frames:,} frames{rate}, {part} ({chance})"


def candidates(data: Chunks, scheme: str) -> list[SensorCandidate]:
    """Return the sensors that use links of this kind, with options guessed from the bytes."""
    sensors = []
    for kind in registry.sensors():
        try:
            loaded = registry.load_sensor(kind)
        except TacpipeError:  # a plug-in that cannot be imported does not stop the others
            continue
        if scheme not in loaded.links:
            continue
        for options in variants.guess_options(kind, data):
            try:
                sensors.append(SensorCandidate(kind, params.build_dataclass(loaded, options, kind, "option"), options))
            except TacpipeError:  # options that cannot be guessed, such as the columns of a generic driver
                continue
    return sensors


def recognise(data: Chunks, scheme: str, sensors: Iterable[SensorCandidate] | None = None) -> list[Finding]:
    """Return the findings for ``sensors``, most likely first. Sensors without evidence are skipped.

    ``data`` was received over a link of the kind ``scheme``. By default all sensors for such links are tried.
    """
    if not data.data:
        return []
    sample = _truncate(data)
    shuffled, noise = _shuffle(sample), _noise(sample)
    findings = []
    for candidate in candidates(sample, scheme) if sensors is None else sensors:
        frames, explained, rate_hz = _count_frames(candidate.sensor, sample)
        if frames < MIN_FRAMES or explained < POSSIBLE:
            continue
        # Shuffled digits are still lines of numbers, so sensors that are described by the bytes use random bytes.
        _, chance, _ = _count_frames(candidate.sensor, noise if candidate.sensor.described else shuffled)
        finding = Finding(candidate, frames, rate_hz, len(sample.data), explained, chance)
        if scheme in PACKETS or finding.evidence >= POSSIBLE:
            findings.append(finding)
    return sorted(findings, key=_rank)


def _rank(finding: Finding) -> tuple[float, bool, float, float, int]:
    """Return the sort key of a finding, best first: evidence, explained bytes, then how well the rate fits.

    Values are rounded, because one incomplete frame is not significant. Products come before boards whose bytes describe
    themselves.
    """
    expected_hz = finding.candidate.sensor.rate_hz
    rate_ratio = abs(np.log(finding.rate_hz / expected_hz)) if finding.rate_hz > 0 and expected_hz > 0 else np.inf
    return (
        -round(finding.evidence, 1),
        finding.candidate.sensor.described,
        -round(finding.explained, 1),
        round(float(rate_ratio), 1),
        len(finding.candidate.options),
    )


def _count_frames(sensor: Sensor, data: Chunks) -> tuple[int, float, float]:
    """Return the number of a sensor's frames in ``data``, the fraction of the bytes in them, and their rate in Hz."""
    framer = sensor.framer()
    runs = [*framer.feed(data)[0], *framer.flush()[0]]
    stamps = [run.t_ns for run in runs if len(run.t_ns)]
    frames = sum(map(len, stamps))
    span_ns = int(stamps[-1][-1] - stamps[0][0]) if stamps else 0
    rate_hz = (frames - 1) * 1e9 / span_ns if span_ns > 0 else 0.0
    return frames, framer.account.framed / max(1, framer.account.received), rate_hz


def _truncate(data: Chunks) -> Chunks:
    if len(data.data) <= MAX_EXAMINED:
        return data
    count = max(MIN_FRAMES + 1, int(np.searchsorted(np.cumsum(data.size), MAX_EXAMINED, side="right")))
    return Chunks(data.t_ns[:count], data.size[:count], data.data[: int(data.size[:count].sum())])


def _noise(data: Chunks) -> Chunks:
    return Chunks(data.t_ns, data.size, np.random.default_rng(0).bytes(len(data.data)))


def _shuffle(data: Chunks) -> Chunks:
    text = np.random.default_rng(0).permutation(np.frombuffer(data.data, np.uint8)).tobytes()
    return Chunks(data.t_ns, data.size, text)


BOOT_S = 2.5  # an Arduino may be silent for this time after its port is opened
FIRST_S = 0.5  # timeout for the first byte of a device that has started
LISTEN_S = 1.0  # duration of listening after the first byte
REPLY_S = 0.5  # timeout for a reply
TEXT_BAUDS = (9600, 57_600, 38_400, 230_400, 250_000, 500_000)  # rates of boards that print lines
REQUESTS = 20  # number of requests to a device that sends one frame per request
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Report:
    """The result of probing an address."""

    address: str
    findings: list[Finding] = field(default_factory=list)
    baud: int | None = None  # baud rate of the serial port for the findings
    requested: bool = False  # True if the device sends only on request
    heard: int = 0  # number of bytes received
    error: str = ""  # why the address could not be probed

    @property
    def certain(self) -> bool:
        """True if the sensor is identified."""
        return bool(self.findings) and (self.findings[0].evidence >= CERTAIN)


def placeholder_sensor(baud: int, line: SerialLine | None = None) -> Sensor:
    """Return a sensor that has only port settings."""
    sensor_class = type("StandIn", (Sensor,), {"baud": baud, "rate_hz": 0.0, "line": line or SerialLine()})
    sensor: Sensor = sensor_class()
    return sensor


def probe(address: Address, usb_id: str = "", *, passive: bool = False, progress: Progress = lambda _: None) -> Report:
    """Identify the sensor at ``address``. Drivers with this ``usb_id`` are tried first; ``progress`` gets a text per step.

    With ``passive``, nothing is sent. If the address cannot be opened, the report has the error.
    """
    try:
        report = _probe_by_listening(address, usb_id, progress)
        if not report.certain and not passive:
            by_request = _probe_with_requests(address, usb_id, progress)
            if by_request.findings and (
                not report.findings or by_request.findings[0].evidence > report.findings[0].evidence
            ):
                report = by_request
        return report
    except DeviceError as error:
        return Report(str(address), error=str(error))


def _probe_by_listening(address: Address, usb_id: str, progress: Progress) -> Report:
    """Return the best report of listening only, at each likely baud rate until the sensor is identified."""
    best = Report(str(address))
    for number, baud in enumerate(_bauds(usb_id) if address.scheme == "serial" else [0]):
        progress(f"{address}: listening{f' at {baud:,} baud' if baud else ''}")
        with closing(open_link(address, placeholder_sensor(baud), "probe")) as link:
            chunks = _listen(link, FIRST_S if number else BOOT_S)
        report = _report(address, chunks, baud)
        if not chunks:  # a streaming device would send bytes at any baud rate, though wrong ones
            return best
        if not best.findings or (report.findings and report.findings[0].evidence > best.findings[0].evidence):
            best = report
        if best.certain:
            break
    return best


def _probe_with_requests(address: Address, usb_id: str, progress: Progress) -> Report:
    """Return the best report after each driver's opening requests. Drivers with this USB id are tried first."""
    best = Report(str(address))
    for candidate in _sort_by_usb_id(candidates(Chunks.from_pairs([]), address.scheme), usb_id):
        sensor = candidate.sensor
        if not _has_requests(sensor):
            continue
        progress(f"{address}: sending the requests of {candidate.kind}")
        try:
            with closing(open_link(address, _placeholder_sensor(sensor), "probe")) as link:
                chunks = _request_frames(link, sensor)
        except DeviceError as error:
            progress(f"{address}: {error}")
            continue
        report = _report(address, chunks, getattr(sensor, "baud", 0), only=candidate.kind)
        if report.findings and (not best.findings or report.findings[0].evidence > best.findings[0].evidence):
            best = replace(report, requested=True)
        if best.certain:
            break
    return best


def _request_frames(link: Link, sensor: Sensor) -> Arrived:
    """Return the bytes of a device after a sensor's opening and requests. The closing request is sent at the end."""
    try:
        entries = run_dialogue(link, _shorten_timeouts(sensor.opening(link.local)), "probe")
        request = sensor.request()
        for _ in range(REQUESTS if request else 0):
            link.write(request)
            entries += link.read(REPLY_S)
        return entries if request else entries + _listen(link, FIRST_S)
    finally:
        if closing_request := sensor.closing():
            link.write(closing_request)


def _listen(link: Link, first_s: float) -> Arrived:
    """Return what arrives within `LISTEN_S`, or nothing if no byte arrives within ``first_s``."""
    entries = link.read(first_s)
    deadline = monotonic() + LISTEN_S
    while entries and (left_s := deadline - monotonic()) > 0:
        entries += link.read(left_s)
    return entries


def _report(address: Address, chunks: Arrived, baud: int, only: str = "") -> Report:
    data = Chunks.from_pairs(chunks)
    sensors = [candidate for candidate in candidates(data, address.scheme) if only in ("", candidate.kind)]
    findings = recognise(data, address.scheme, sensors)
    return Report(str(address), findings, baud or None, heard=len(data.data))


def _bauds(usb_id: str) -> list[int]:
    """Return the baud rates of the serial drivers: first those of drivers with this USB id, then the most common."""
    drivers = _sort_by_usb_id(candidates(Chunks.from_pairs([]), "serial"), usb_id)
    counts = Counter(candidate.sensor.baud for candidate in {driver.kind: driver for driver in drivers}.values())
    first = [candidate.sensor.baud for candidate in drivers if usb_id and usb_id in candidate.sensor.usb_ids]
    return list(dict.fromkeys([*first, *(baud for baud, _ in counts.most_common()), *TEXT_BAUDS]))


def _sort_by_usb_id(sensors: list[SensorCandidate], usb_id: str) -> list[SensorCandidate]:
    """Return one candidate per driver. Drivers with this USB id come first."""
    by_kind = {candidate.kind: candidate for candidate in reversed(sensors)}
    return sorted(by_kind.values(), key=lambda candidate: (usb_id not in candidate.sensor.usb_ids, candidate.kind))


def _has_requests(sensor: Sensor) -> bool:
    """Return whether a driver sends requests."""
    driver = type(sensor)
    return driver.opening is not Sensor.opening or driver.request is not Sensor.request


def _placeholder_sensor(sensor: Sensor) -> Sensor:
    """Return a placeholder with this sensor's port settings, but without the wait: the device has already started."""
    return placeholder_sensor(getattr(sensor, "baud", 0), replace(sensor.line, settle_s=0.0))


def _shorten_timeouts(dialogue: Dialogue) -> Dialogue:
    """Yield the requests of a dialogue with timeouts of at most `REPLY_S`."""
    try:
        ask = next(dialogue)
        while True:
            ask = dialogue.send((yield replace(ask, timeout_s=min(ask.timeout_s, REPLY_S))))
    except StopIteration:
        return


def list_addresses() -> Iterator[tuple[Address, str]]:
    """Yield (address, USB id) of each serial port, HID device and camera."""
    for port in [*ports.serial_ports(), *ports.hid_ports(), *v4l2.cameras()]:
        yield parse(port.address), port.usb_id
