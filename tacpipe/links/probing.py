"""Finding out what speaks at an address: listen first, and only then ask what the drivers ask when they open a stream."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from time import monotonic

from tacpipe.errors import DeviceError
from tacpipe.links import ports
from tacpipe.links.dialogue import hold
from tacpipe.links.link import Address, Link, parse
from tacpipe.links.opened import Arrived
from tacpipe.links.opening import open_link
from tacpipe.links.recognition import CERTAIN, Candidate, Finding, candidates, recognise
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Dialogue, Line, Sensor

BOOT_S = 2.5  # that an Arduino may be silent for when its port is opened
FIRST_S = 0.5  # that the first byte is awaited for, of a device that is awake
LISTEN_S = 1.0  # from the first byte on
REPLY_S = 0.5  # that a reply is awaited for
TEXT_BAUDS = (9600, 57_600, 38_400, 230_400, 250_000, 500_000)  # that boards which print lines are set to
REQUESTS = 20  # to a device that must be asked for each frame
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Report:
    """What was found out about an address."""

    address: str
    findings: list[Finding] = field(default_factory=list)
    baud: int | None = None  # at which it was found, of a serial port
    asked: bool = False  # whether it spoke only when it was asked
    heard: int = 0  # bytes in all
    error: str = ""  # why nothing could be found out

    @property
    def certain(self) -> bool:
        """Whether there is no doubt of what speaks there."""
        return bool(self.findings) and (self.findings[0].evidence >= CERTAIN)


def placeholder(baud: int, line: Line | None = None) -> Sensor:
    """Return a sensor of which nothing is known but how its port is set."""
    kind = type("StandIn", (Sensor,), {"baud": baud, "rate_hz": 0.0, "line": line or Line()})
    made: Sensor = kind()
    return made


def probe(address: Address, usb_id: str = "", *, passive: bool = False, progress: Progress = lambda _: None) -> Report:
    """Return what speaks at ``address``. ``usb_id`` moves the drivers that know it to the front; ``progress`` is called
    with a text at each step.

    With ``passive`` nothing is written. An error of opening becomes the report's.
    """
    try:
        report = _listened(address, usb_id, progress)
        if not report.certain and not passive:
            asked = _asked(address, usb_id, progress)
            if asked.findings and (not report.findings or asked.findings[0].evidence > report.findings[0].evidence):
                report = asked
        return report
    except DeviceError as error:
        return Report(str(address), error=str(error))


def _listened(address: Address, usb_id: str, progress: Progress) -> Report:
    """Return what is recognised without a word from us, at each likely rate of baud until there is no doubt."""
    best = Report(str(address))
    for number, baud in enumerate(_bauds(usb_id) if address.scheme == "serial" else [0]):
        progress(f"{address}: listening{f' at {baud:,} baud' if baud else ''}")
        with closing(open_link(address, placeholder(baud), "probe")) as link:
            chunks = _listen(link, FIRST_S if number else BOOT_S)
        report = _report(address, chunks, baud)
        if not chunks:  # a device that streams gives bytes at any rate, if wrong ones
            return best
        if not best.findings or (report.findings and report.findings[0].evidence > best.findings[0].evidence):
            best = report
        if best.certain:
            break
    return best


def _asked(address: Address, usb_id: str, progress: Progress) -> Report:
    """Return what is recognised after each driver's opening, the ones that know the device first."""
    best = Report(str(address))
    for candidate in _by_usb(candidates(Chunks.of([]), address.scheme), usb_id):
        sensor = candidate.sensor
        if not _speaks(sensor):
            continue
        progress(f"{address}: asking as {candidate.kind} does")
        try:
            with closing(open_link(address, _quick(sensor), "probe")) as link:
                chunks = _ask(link, sensor)
        except DeviceError as error:
            progress(f"{address}: {error}")
            continue
        report = _report(address, chunks, getattr(sensor, "baud", 0), only=candidate.kind)
        if report.findings and (not best.findings or report.findings[0].evidence > best.findings[0].evidence):
            best = replace(report, asked=True)
        if best.certain:
            break
    return best


def _ask(link: Link, sensor: Sensor) -> Arrived:
    """Return what a device states after a sensor's opening and requests; it is asked to stop at the end."""
    try:
        came = hold(link, _hasty(sensor.opening(link.local)), "probe")
        request = sensor.request()
        for _ in range(REQUESTS if request else 0):
            link.write(request)
            came += link.read(REPLY_S)
        return came if request else came + _listen(link, FIRST_S)
    finally:
        if farewell := sensor.closing():
            link.write(farewell)


def _listen(link: Link, first_s: float) -> Arrived:
    came = link.read(first_s)
    until = monotonic() + LISTEN_S
    while came and (left_s := until - monotonic()) > 0:
        came += link.read(left_s)
    return came


def _report(address: Address, chunks: Arrived, baud: int, only: str = "") -> Report:
    data = Chunks.of(chunks)
    tried = [candidate for candidate in candidates(data, address.scheme) if only in ("", candidate.kind)]
    findings = recognise(data, address.scheme, tried)
    return Report(str(address), findings, baud or None, heard=len(data.data))


def _bauds(usb_id: str) -> list[int]:
    """Return the rates of the serial drivers: of those that know the device first, then the commonest."""
    known = _by_usb(candidates(Chunks.of([]), "serial"), usb_id)
    counted = Counter(candidate.sensor.baud for candidate in {found.kind: found for found in known}.values())
    first = [candidate.sensor.baud for candidate in known if usb_id and usb_id in candidate.sensor.usb_ids]
    return list(dict.fromkeys([*first, *(baud for baud, _ in counted.most_common()), *TEXT_BAUDS]))


def _by_usb(found: list[Candidate], usb_id: str) -> list[Candidate]:
    """Return one candidate a driver, those first that know the USB device."""
    once = {candidate.kind: candidate for candidate in reversed(found)}
    return sorted(once.values(), key=lambda candidate: (usb_id not in candidate.sensor.usb_ids, candidate.kind))


def _speaks(sensor: Sensor) -> bool:
    """Whether a driver has anything to ask."""
    kind = type(sensor)
    return kind.opening is not Sensor.opening or kind.request is not Sensor.request


def _quick(sensor: Sensor) -> Sensor:
    """Return what opens a port as this sensor does, but for the time it settles: the device is awake by now."""
    return placeholder(getattr(sensor, "baud", 0), replace(sensor.line, settle_s=0.0))


def _hasty(dialogue: Dialogue) -> Dialogue:
    """Yield what a dialogue asks, with less patience."""
    try:
        ask = next(dialogue)
        while True:
            ask = dialogue.send((yield replace(ask, timeout_s=min(ask.timeout_s, REPLY_S))))
    except StopIteration:
        return


def found_ports() -> Iterator[tuple[Address, str]]:
    """Yield the address and the USB identity of each serial port and HID device that is there."""
    for port in [*ports.serial_ports(), *ports.hid_ports()]:
        yield parse(port.address), port.usb_id
