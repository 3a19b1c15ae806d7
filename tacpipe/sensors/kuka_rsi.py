"""KUKA arms by the Robot Sensor Interface (RSI): an XML text by UDP every 4 or 12 ms.

The controller sends ``<Rob Type="KUKA"><RIst X="…" …/>…<IPOC>n</IPOC></Rob>`` to the address in its configuration file, in
mm and degrees; IPOC is its clock in milliseconds. Unless that file states ONLYSEND, each text must be answered in time with
the same IPOC, or the controller stops; the answer here holds no correction, so the arm is not moved by it. Source: KUKA,
RobotSensorInterface 3.x, as read in the package rsipi 0.3.0.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar
from xml.etree import ElementTree

import numpy as np

from tacpipe.arrays import Floats, Indices
from tacpipe.errors import UsageError
from tacpipe.sensors import number_texts
from tacpipe.sensors.byte_framer import TextFramer
from tacpipe.sensors.framing import Framer
from tacpipe.sensors.sensor import Device, Samples, Sensor
from tacpipe.signals import kinematics

if TYPE_CHECKING:
    import pyarrow as pa


CYCLES_MS = (4, 12)  # cycles of the controller
FRAME, AXES = ("X", "Y", "Z", "A", "B", "C"), tuple(f"A{axis}" for axis in range(1, 7))
ATTRIBUTES = {
    "RIst": FRAME,
    "RSol": FRAME,
    "AIPos": AXES,
    "ASPos": AXES,
    "MACur": AXES,
}  # those with columns of their own
POSES, ANGLES = ("RIst", "RSol"), ("AIPos", "ASPos")
OTHER = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)?")  # an element, or an attribute of one
TRUTH = {"true": "1", "false": "0"}
AT_HAND = 1024  # texts whose numbers are kept between the framer's look at them and their decoding
BATCHES_AT_HAND = 4  # likewise, of texts that were looked at together
IPOC = re.compile(rb"<IPOC>\s*(\d+)\s*</IPOC>")


@dataclass(frozen=True)
class KukaRsi(Sensor):
    """The arm of a KUKA controller with RSI."""

    summary: ClassVar[str] = "KUKA arms by the Robot Sensor Interface (RSI)."
    links: ClassVar[tuple[str, ...]] = ("udp",)
    listens: ClassVar[bool] = True
    counter: ClassVar[int | None] = 1 << 32
    exclusive: ClassVar[str] = (
        "The controller sends to the one address in its RSI configuration: a program that corrects the arm and this one "
        "cannot both be there; let that program send what it gets to a tap."
    )

    outputs: tuple[str, ...] = ("RIst", "AIPos")  # elements that the controller sends, or their attributes, as Tech.C11
    only_send: bool = False  # the configuration states ONLYSEND TRUE: nothing is answered, which is best for recording
    sen_type: str = "ImFree"  # SENTYPE of the configuration
    rate_hz: float = 250.0  # 250 for a cycle of 4 ms, 83.33 for 12 ms

    def __post_init__(self) -> None:
        if self.cycle_ms not in CYCLES_MS:
            raise UsageError(
                f"kuka-rsi: rate_hz is {self.rate_hz:g}; the controller sends 250 a second, or 83.33 at a cycle of 12 ms."
            )
        wrong = [name for name in self.outputs if not OTHER.fullmatch(name) or name == "IPOC"]
        if wrong or not self.outputs or len(set(self.outputs)) < len(self.outputs):
            raise UsageError(
                f"kuka-rsi: outputs are {', '.join(self.outputs) or 'none'}; name each element or attribute of the SEND "
                f"part of the controller's configuration once, as RIst or Tech.C11; IPOC comes by itself."
            )
        if not re.fullmatch(r"\w+", self.sen_type):
            raise UsageError(f"kuka-rsi: sen_type is {self.sen_type!r}; it must be the SENTYPE of the configuration.")
        object.__setattr__(self, "step", self.cycle_ms)  # increment of IPOC, which an option sets

    @property
    def cycle_ms(self) -> int:
        """The controller's cycle in milliseconds."""
        return round(1000 / self.rate_hz) if self.rate_hz > 0 else 0

    def fields(self) -> list[pa.Field]:
        """Return the fields of the outputs, float64: pose and angles of the arm in m and rad, others as they are sent."""
        return [field for name in self.outputs for field in _fields(name)]

    def framer(self) -> Framer:
        """Return a framer that takes whole texts with an IPOC and every output."""
        return TextFramer(
            lambda packet: _numbers(self.outputs, packet) is not None,
            check_all=lambda packets: _table(self.outputs, tuple(packets)) is not None,
        )

    def decode(self, frames: Sequence[bytes]) -> Samples:
        """Return the outputs, with the controller's clock for counter and time."""
        table = _table(self.outputs, tuple(frames))
        if table is None:
            numbers = [_numbers(self.outputs, frame) or () for frame in frames]
            table = np.array(numbers, dtype=np.float64).reshape(len(frames), 1 + sum(map(_width, self.outputs)))
        blocks, place = [], 1
        for name in self.outputs:
            blocks.append(_columns(name, table[:, place : place + _width(name)]))
            place += _width(name)
        ipoc_ms = table[:, 0].astype(np.int64)
        return Samples(tuple(blocks), seq=ipoc_ms, t_device_ns=ipoc_ms * 1_000_000)

    def encode(self, samples: Samples) -> list[bytes]:
        """Return the texts that hold these samples, numbers with four digits as the controller writes them."""
        assert samples.seq is not None
        blocks = [_sent(name, block).tolist() for name, block in zip(self.outputs, samples.values, strict=True)]
        return [
            _text(self.outputs, [block[row] for block in blocks], ipoc) for row, ipoc in enumerate(samples.seq.tolist())
        ]

    def answer(self, chunk: bytes) -> bytes:
        """Return the reply to a text: its IPOC and no correction; nothing if the controller only sends."""
        match = None if self.only_send else IPOC.search(chunk)
        if match is None:
            return b""
        return b'<Sen Type="%b"><IPOC>%b</IPOC></Sen>' % (self.sen_type.encode(), match[1])

    def device(self) -> Device:
        """Return a controller, which sends from the start; it minds no answers."""
        return Device()


@functools.lru_cache(maxsize=AT_HAND)
def _numbers(outputs: tuple[str, ...], packet: bytes) -> tuple[float, ...] | None:
    """Return IPOC and the numbers of the outputs, None where the text is none of the controller's."""
    try:
        root = ElementTree.fromstring(packet)
        ipoc = int(root.findtext("IPOC", ""))
        numbers = [ipoc, *(float(text) for name in outputs for text in _texts(root, name))]
    except (ElementTree.ParseError, ValueError):
        return None
    is_valid = len(numbers) == 1 + sum(map(_width, outputs)) and 0 <= ipoc < 1 << 32
    return tuple(numbers) if root.tag == "Rob" and is_valid and all(map(math.isfinite, numbers)) else None


@functools.lru_cache(maxsize=BATCHES_AT_HAND)
def _table(outputs: tuple[str, ...], packets: tuple[bytes, ...]) -> Floats | None:
    """Return IPOC and the numbers of the outputs (packet, number); None where packets differ in more than their numbers."""
    layout = _pattern(outputs, number_texts.numbered(packets[0])) if packets else None
    if layout is None:
        return None
    pattern, columns = layout
    parsed = pattern.written(packets)
    numbers = None if parsed is None else number_texts.floats(parsed)
    if parsed is None or numbers is None or not np.isfinite(numbers).all():
        return None
    wide = len(pattern.before)
    clock = number_texts.wholes(number_texts.taken(parsed, range(columns[0], len(parsed), wide)))
    if clock is None or clock.min() < 0 or clock.max() >= 1 << 32:
        return None
    table = numbers.reshape(len(packets), wide)[:, columns]
    table.flags.writeable = False  # it is kept
    return table


@functools.lru_cache(maxsize=BATCHES_AT_HAND)
def _pattern(outputs: tuple[str, ...], text: bytes) -> tuple[number_texts.Pattern, Indices] | None:
    """Return the pattern of a text in which each number represents itself, and which ones are IPOC and the outputs."""
    pattern, content = number_texts.pattern(text), _numbers(outputs, text)
    if pattern is None or content is None:
        return None
    columns = np.array(content) - number_texts.FIRST
    is_number = (columns >= 0) & (columns < len(pattern.before))
    return (pattern, columns.astype(np.intp)) if is_number.all() else None


def _width(name: str) -> int:
    return len(ATTRIBUTES.get(name, ("",)))


def _texts(root: ElementTree.Element, name: str) -> list[str]:
    """Return what a text states of an output, number by number; what is missing is left out."""
    tag, _, attribute = name.partition(".")
    element = root.find(tag)
    if element is None:
        return []
    if name not in ATTRIBUTES and not attribute:
        content = (element.text or "").strip()
        return [TRUTH.get(content.lower(), content)]
    texts = [element.get(part) for part in ATTRIBUTES.get(name, (attribute,))]
    return [TRUTH.get(text.lower(), text) for text in texts if text is not None]


def _fields(name: str) -> list[pa.Field]:
    from tacpipe.channels import schema

    if name == "RIst":
        return schema.pose_fields()
    if name == "RSol":
        return schema.target_pose_fields()
    if name == "AIPos":
        return schema.joint_fields(len(AXES))[0]
    if name == "ASPos":
        return [schema.float_field(f"joint{n}_target_rad", "rad", "target_joint_position") for n in range(1, 7)]
    if name == "MACur":
        return [schema.float_field(f"joint{n}_current", "1", "current") for n in range(1, 7)]
    return [schema.float_field(name.replace(".", "_").lower(), "1", "state")]


def _columns(name: str, numbers: Floats) -> Floats:
    """Return what an output's numbers (sample, number) are in m, rad and quaternions."""
    if name in POSES:
        return np.hstack([numbers[:, :3] / 1000, kinematics.quaternions_of_angles(np.radians(numbers[:, 3:]))])
    return np.radians(numbers) if name in ANGLES else numbers


def _sent(name: str, columns: Floats) -> Floats:
    """Return the numbers (sample, number) that the controller sends for columns, in mm and degrees."""
    if name in POSES:
        return np.hstack([columns[:, :3] * 1000, np.degrees(kinematics.angles_of(columns[:, 3:]))])
    return np.degrees(columns) if name in ANGLES else columns


def _text(outputs: Sequence[str], values: Sequence[Sequence[float]], ipoc: int) -> bytes:
    root = ElementTree.Element("Rob", Type="KUKA")
    for name, numbers in zip(outputs, values, strict=True):
        tag, _, attribute = name.partition(".")
        existing = root.find(tag)
        element = ElementTree.SubElement(root, tag) if existing is None else existing
        write: Callable[[float], str] = "{:.4f}".format
        if name in ATTRIBUTES or attribute:
            for part, number in zip(ATTRIBUTES.get(name, (attribute,)), numbers, strict=True):
                element.set(part, write(number))
        else:
            element.text = write(numbers[0])
    ElementTree.SubElement(root, "IPOC").text = str(ipoc)
    return ElementTree.tostring(root)
