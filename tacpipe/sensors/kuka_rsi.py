"""KUKA arms with the Robot Sensor Interface (RSI): an XML message by UDP every 4 or 12 ms.

The controller sends ``<Rob Type="KUKA"><RIst X="…" …/>…<IPOC>n</IPOC></Rob>`` to the address in its configuration file, in
mm and degrees; IPOC is its clock in milliseconds. Unless that file sets ONLYSEND, each message must be answered in time with
the same IPOC, or the controller stops. The answers of this driver contain no correction, so they do not move the arm.
Source: KUKA, RobotSensorInterface 3.x, from the package rsipi 0.3.0.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar
from xml.etree import ElementTree

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Floats, Indices
from tacpipe.channels import schema
from tacpipe.errors import UsageError
from tacpipe.sensors import number_texts
from tacpipe.sensors.byte_framer import TextFramer
from tacpipe.sensors.framing import Framer
from tacpipe.sensors.sensor import Samples, Sensor
from tacpipe.signals import kinematics

CYCLES_MS = (4, 12)
FRAME, AXES = ("X", "Y", "Z", "A", "B", "C"), tuple(f"A{axis}" for axis in range(1, 7))
# elements whose attributes become columns
ATTRIBUTES = {"RIst": FRAME, "RSol": FRAME, "AIPos": AXES, "ASPos": AXES, "MACur": AXES}
POSES, ANGLES = ("RIst", "RSol"), ("AIPos", "ASPos")
OUTPUT = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)?")  # an element, or ELEMENT.ATTRIBUTE
TRUTH = {"true": "1", "false": "0"}
CACHED = 1024  # number of cached messages, because the framer and the decoder parse the same messages
CACHED_BATCHES = 4  # number of cached batches of messages
IPOC = re.compile(rb"<IPOC>\s*(\d+)\s*</IPOC>")


@dataclass(frozen=True)
class KukaRsi(Sensor):
    """An arm of a KUKA controller with RSI."""

    summary: ClassVar[str] = "KUKA arms with the Robot Sensor Interface (RSI)."
    links: ClassVar[tuple[str, ...]] = ("udp",)
    listens: ClassVar[bool] = True
    counter: ClassVar[int | None] = 1 << 32
    exclusive: ClassVar[str] = (
        "The controller sends to the one address in its RSI configuration, so it cannot serve a program that corrects the "
        "arm at the same time. Let that program forward the messages to a tap."
    )

    # elements that the controller sends, or their attributes, such as Tech.C11
    outputs: tuple[str, ...] = ("RIst", "AIPos")
    only_send: bool = False  # the configuration sets ONLYSEND TRUE: no answers are sent, which is best for recording
    sen_type: str = "ImFree"  # SENTYPE of the configuration
    rate_hz: float = 250.0  # messages per second: 250 for a cycle of 4 ms, 83.33 for 12 ms

    def __post_init__(self) -> None:
        if self.cycle_ms not in CYCLES_MS:
            raise UsageError(
                f"kuka-rsi: rate_hz is {self.rate_hz:g}; it must be 250 for a cycle of 4 ms, or 83.33 for 12 ms."
            )
        invalid = [name for name in self.outputs if not OUTPUT.fullmatch(name) or name == "IPOC"]
        if invalid or not self.outputs or len(set(self.outputs)) < len(self.outputs):
            raise UsageError(
                f"kuka-rsi: outputs are {', '.join(self.outputs) or 'none'}; list elements or attributes of the SEND "
                f"part of the controller's configuration, each once, such as RIst or Tech.C11; IPOC is always included."
            )
        if not re.fullmatch(r"\w+", self.sen_type):
            raise UsageError(f"kuka-rsi: sen_type is {self.sen_type!r}; it must be the SENTYPE of the configuration.")
        object.__setattr__(self, "step", self.cycle_ms)  # increment of IPOC

    @property
    def cycle_ms(self) -> int:
        """The controller's cycle in milliseconds."""
        return round(1000 / self.rate_hz) if self.rate_hz > 0 else 0

    def fields(self) -> list[pa.Field]:
        """Return the fields of the outputs, float64: pose and joint angles in m and rad, other values as sent."""
        return [field for name in self.outputs for field in _fields(name)]

    def framer(self) -> Framer:
        """Return a framer for complete messages with an IPOC and all outputs."""
        return TextFramer(
            lambda packet: _numbers(self.outputs, packet) is not None,
            check_all=lambda packets: _table(self.outputs, tuple(packets)) is not None,
        )

    def decode(self, frames: Sequence[bytes]) -> Samples:
        """Return the outputs. The controller's clock is both counter and time."""
        table = _table(self.outputs, tuple(frames))
        if table is None:
            numbers = [_numbers(self.outputs, frame) or () for frame in frames]
            table = np.array(numbers, dtype=np.float64).reshape(len(frames), 1 + sum(map(_width, self.outputs)))
        blocks, column = [], 1
        for name in self.outputs:
            blocks.append(_to_columns(name, table[:, column : column + _width(name)]))
            column += _width(name)
        ipoc_ms = table[:, 0].astype(np.int64)
        return Samples(tuple(blocks), seq=ipoc_ms, t_device_ns=ipoc_ms * 1_000_000)

    def encode(self, samples: Samples) -> list[bytes]:
        """Return the messages of these samples, with four decimals like the controller's."""
        assert samples.seq is not None
        blocks = [_to_wire(name, block).tolist() for name, block in zip(self.outputs, samples.values, strict=True)]
        return [
            _to_xml(self.outputs, [block[row] for block in blocks], ipoc)
            for row, ipoc in enumerate(samples.seq.tolist())
        ]

    def answer(self, chunk: bytes) -> bytes:
        """Return the reply to a message, with its IPOC and no correction. Returns b"" if the controller only sends."""
        match = None if self.only_send else IPOC.search(chunk)
        if match is None:
            return b""
        return b'<Sen Type="%b"><IPOC>%b</IPOC></Sen>' % (self.sen_type.encode(), match[1])


@functools.lru_cache(maxsize=CACHED)
def _numbers(outputs: tuple[str, ...], packet: bytes) -> tuple[float, ...] | None:
    """Return IPOC and the numbers of the outputs, or None if the message is invalid."""
    try:
        root = ElementTree.fromstring(packet)
        ipoc = int(root.findtext("IPOC", ""))
        values = [ipoc, *(float(text) for name in outputs for text in _texts(root, name))]
    except (ElementTree.ParseError, ValueError):
        return None
    is_valid = len(values) == 1 + sum(map(_width, outputs)) and 0 <= ipoc < 1 << 32
    return tuple(values) if root.tag == "Rob" and is_valid and all(map(math.isfinite, values)) else None


@functools.lru_cache(maxsize=CACHED_BATCHES)
def _table(outputs: tuple[str, ...], packets: tuple[bytes, ...]) -> Floats | None:
    """Return IPOC and the outputs (packet, number), or None if the packets differ in more than their numbers."""
    layout = _pattern(outputs, number_texts.replace_by_index(packets[0])) if packets else None
    if layout is None:
        return None
    pattern, columns = layout
    parsed = pattern.extract(packets)
    numbers = None if parsed is None else number_texts.floats(parsed)
    if parsed is None or numbers is None or not np.isfinite(numbers).all():
        return None
    width = len(pattern.before)
    clock = number_texts.integers(number_texts.select_range(parsed, range(columns[0], len(parsed), width)))
    if clock is None or clock.min() < 0 or clock.max() >= 1 << 32:
        return None
    table = numbers.reshape(len(packets), width)[:, columns]
    table.flags.writeable = False  # the table is cached
    return table


@functools.lru_cache(maxsize=CACHED_BATCHES)
def _pattern(outputs: tuple[str, ...], text: bytes) -> tuple[number_texts.Pattern, Indices] | None:
    """Return the pattern of a message, and the positions of IPOC and the outputs among its numbers, or None.

    In ``text``, each number has been replaced by its index.
    """
    pattern, content = number_texts.pattern(text), _numbers(outputs, text)
    if pattern is None or content is None:
        return None
    columns = np.array(content) - number_texts.FIRST
    is_number = (columns >= 0) & (columns < len(pattern.before))
    return (pattern, columns.astype(np.intp)) if is_number.all() else None


def _width(name: str) -> int:
    return len(ATTRIBUTES.get(name, ("",)))


def _texts(root: ElementTree.Element, name: str) -> list[str]:
    """Return the texts of an output's numbers. Missing attributes are skipped."""
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
    """Return the fields of an output of the controller."""
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


def _to_columns(name: str, numbers: Floats) -> Floats:
    """Convert an output's numbers (sample, number) to m, rad and quaternions."""
    if name in POSES:
        return np.hstack([numbers[:, :3] / 1000, kinematics.angles_to_quaternions(np.radians(numbers[:, 3:]))])
    return np.radians(numbers) if name in ANGLES else numbers


def _to_wire(name: str, columns: Floats) -> Floats:
    """Convert columns to the numbers (sample, number) that the controller sends, in mm and degrees."""
    if name in POSES:
        return np.hstack([columns[:, :3] * 1000, np.degrees(kinematics.quaternions_to_angles(columns[:, 3:]))])
    return np.degrees(columns) if name in ANGLES else columns


def _to_xml(outputs: Sequence[str], values: Sequence[Sequence[float]], ipoc: int) -> bytes:
    """Return the XML message with ``values`` of the outputs and the clock ``ipoc`` in ms."""
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
