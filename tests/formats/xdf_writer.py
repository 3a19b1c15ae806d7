"""XDF files written from the specification of the format, chunk by chunk."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tacpipe.arrays import AnyArray

BOUNDARY = bytes.fromhex("43A546DCCBF5410FB30ED5467383CBE4")
KINDS = {"float32": "<f4", "double64": "<f8", "int8": "<i1", "int16": "<i2", "int32": "<i4", "int64": "<i8"}


def length(size: int, width: int | None = None) -> bytes:
    """Return a length as the format writes it, in the fewest bytes or in ``width``."""
    width = width or (1 if size < 256 else 4)
    return bytes([width]) + size.to_bytes(width, "little")


def chunk(tag: int, content: bytes, stream: int | None = None) -> bytes:
    body = struct.pack("<H", tag) + (b"" if stream is None else struct.pack("<I", stream)) + content
    return length(len(body)) + body


@dataclass
class Writer:
    """The chunks of a file in the order in which they are written."""

    parts: list[bytes] = field(default_factory=list)

    def __post_init__(self) -> None:
        header = (
            b"<?xml version='1.0'?><info><version>1.0</version><datetime>2026-05-04T10:00:00+0200</datetime></info>"
        )
        self.parts = [b"XDF:" + chunk(1, header)]

    def stream(
        self,
        number: int,
        name: str,
        kind: str = "float32",
        channels: int = 1,
        rate_hz: float = 100.0,
        labels: Sequence[tuple[str, str, str]] = (),
        type_: str = "Force",
        host: str = "",
    ) -> None:
        """Describe a stream; ``labels`` are label, unit and type of each channel."""
        described = "".join(
            f"<channel><label>{label}</label><unit>{unit}</unit><type>{value}</type></channel>"
            for label, unit, value in labels
        )
        text = (
            "<?xml "
            f"version='1.0'?><info><name>{name}</name><type>{type_}</type><channel_count>{channels}</channel_count><nominal_srate>{rate_hz:g}</nominal_srate><channel_format>{kind}</channel_format><source_id>s{number}</source_id><hostname>{host}</hostname><desc><channels>{described}</channels></desc></info>"
        )
        self.parts.append(chunk(2, text.encode(), number))

    def numbers(
        self, number: int, kind: str, stamps: Sequence[float | None], values: AnyArray | Sequence[Sequence[float]]
    ) -> None:
        """Write samples (sample, channel); a stamp that is None is left out."""
        rows = [
            (b"\0" if stamp is None else b"\x08" + struct.pack("<d", stamp)) + row.astype(KINDS[kind]).tobytes()
            for stamp, row in zip(stamps, np.asarray(values), strict=True)
        ]
        self.parts.append(chunk(3, length(len(rows)) + b"".join(rows), number))

    def texts(self, number: int, stamps: Sequence[float], words: Sequence[str]) -> None:
        """Write markers of one channel."""
        rows = [
            b"\x08" + struct.pack("<d", stamp) + length(len(word.encode())) + word.encode()
            for stamp, word in zip(stamps, words, strict=True)
        ]
        self.parts.append(chunk(3, length(len(rows), 4) + b"".join(rows), number))

    def offset(self, number: int, collected: float, value: float) -> None:
        """Write that ``value`` was to be added to the sender's clock when that showed ``collected``."""
        self.parts.append(chunk(4, struct.pack("<dd", collected, value), number))

    def boundary(self) -> None:
        self.parts.append(chunk(5, BOUNDARY))

    def footer(self, number: int, count: int) -> None:
        text = f"<?xml version='1.0'?><info><sample_count>{count}</sample_count></info>"
        self.parts.append(chunk(6, text.encode(), number))

    @property
    def bytes(self) -> bytes:
        return b"".join(self.parts)

    def write(self, path: Path) -> Path:
        path.write_bytes(self.bytes)
        return path
