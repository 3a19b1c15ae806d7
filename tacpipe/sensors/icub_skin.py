"""The skin of iCub on CAN: boards of up to 16 triangles with 12 taxels of 8 bits.

A board sends each triangle in two CAN frames, in the order of their numbers: identifier class << 8 | board << 4 |
triangle, the first byte ``40`` before taxels 1 to 7, ``C0`` before 8 to 12 and two bytes of diagnostics. The class is
4, of boards with the older configuration 3. Taxels 7 and 11 are thermal pads, which measure no pressure. A taxel rests at
240 and falls when it is pressed.
Diagnostics, big-endian: bit 0 the triangle does not answer, bits 4 to 15 one of its 12 taxels is stuck.
Source: canBusSkin of icub-main, for messages and identifiers. Which taxels are thermal and the order of the bytes of
the diagnostics were not at hand in a source, and nothing here was checked against a board.

There is no counter, and a scan of 16 triangles is 32 CAN frames, which `ScanFramer` puts together; one with a pause as
long as half a period in it is torn. A frame is a scan: its CAN frames one behind the other, 13 bytes each.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from tacpipe.arrays import Bytes
from tacpipe.errors import UsageError
from tacpipe.sensors.framing import Framer
from tacpipe.sensors.scans import CAN, DATA, HEAD, TAIL, ScanFramer, can_frame
from tacpipe.sensors.sensor import Ask, Device, Dialogue, Samples, Sensor

if TYPE_CHECKING:
    import pyarrow as pa

MOST_TRIANGLES, TAXELS, HEAD_TAXELS = 16, 12, 7
THERMAL = (7, 11)
PERIODIC, OLD_PERIODIC, POLLING = 4, 3, 2  # classes of identifiers
BOARD, TRIANGLE, TRANSMIT, OLD_TIMING, OLD_TRIANGLES = 0x4D, 0x50, 0x07, 0x4C, 0x4E  # commands
NO_LOAD, SHIFT, OFFSET = (
    0xF0,
    2,
    0x2200,
)  # taxel at rest, gain and offset of the converter, as the robot's files have them


@dataclass(frozen=True)
class IcubSkin(Sensor):
    """One board of iCub's skin."""

    summary: ClassVar[str] = "iCub skin on CAN: one board of up to 16 triangles."
    links: ClassVar[tuple[str, ...]] = ("can",)

    board: int = 8  # the board's address on the bus, 1 to 14
    triangles: tuple[int, ...] = tuple(range(MOST_TRIANGLES))  # numbers of the triangles that are there, from 0
    old: bool = False  # the board has the older configuration: messages 4C and 4E, class 3
    rate_hz: float = 50.0  # scans a second: 1000 divided by whole milliseconds

    def __post_init__(self) -> None:
        if not 1 <= self.board <= 14:
            raise UsageError(f"icub-skin: board is {self.board}; addresses go from 1 to 14.")
        if (
            not self.triangles
            or list(self.triangles) != sorted(set(self.triangles))
            or not set(self.triangles) <= set(range(MOST_TRIANGLES))
        ):
            raise UsageError(
                f"icub-skin: triangles is {list(self.triangles)}; it must list numbers from 0 to 15, each once, in order."
            )
        if not 1000 / 255 <= self.rate_hz <= 1000 or abs(1000 / self.rate_hz - self.period_ms) > 0.01:
            raise UsageError(
                f"icub-skin: rate_hz is {self.rate_hz:g}; it must be 1000 divided by whole milliseconds up to 255."
            )

    @property
    def period_ms(self) -> int:
        """How long it is from one scan to the next."""
        return round(1000 / self.rate_hz)

    def fields(self) -> list[pa.Field]:
        """Return ``triangle1_taxel01``, … uint8 counts, and ``triangle1_diagnostics``, … uint16, by triangle number + 1.

        The two thermal pads of a triangle have the quantity ``temperature``.
        """
        import pyarrow as pa

        taxels = [
            pa.field(
                f"triangle{triangle + 1}_taxel{taxel:02d}",
                pa.uint8(),
                metadata={
                    "unit": "count",
                    "quantity": "temperature" if taxel in THERMAL else "tactile",
                    "triangle": str(triangle + 1),
                    "taxel": str(taxel),
                },
            )
            for triangle in self.triangles
            for taxel in range(1, TAXELS + 1)
        ]
        status = {"unit": "1", "quantity": "status"}
        return taxels + [
            pa.field(
                f"triangle{triangle + 1}_diagnostics", pa.uint16(), metadata={**status, "triangle": str(triangle + 1)}
            )
            for triangle in self.triangles
        ]

    @property
    def identifiers(self) -> list[int]:
        """The identifier of each triangle's CAN frames."""
        kind = OLD_PERIODIC if self.old else PERIODIC
        return [kind << 8 | self.board << 4 | triangle for triangle in self.triangles]

    def framer(self) -> Framer:
        """Return a framer that puts scans together."""
        return ScanFramer(self.identifiers, round(0.5e9 / self.rate_hz))

    def decode(self, frames: Bytes) -> Samples:
        """Return taxels (scan, 12 a triangle) and diagnostics (scan, triangle)."""
        data = frames.reshape(len(frames), len(self.triangles), 2, CAN)[..., DATA:]  # (scan, triangle, half, byte)
        taxels = np.concatenate([data[:, :, 0, 1:8], data[:, :, 1, 1:6]], axis=2).reshape(
            len(frames), TAXELS * len(self.triangles)
        )
        diagnostics = np.ascontiguousarray(data[:, :, 1, 6:8]).view(">u2")[..., 0].astype(np.uint16)
        return Samples((taxels, diagnostics))

    def encode(self, samples: Samples) -> Bytes:
        """Return the scans of these samples, the CAN frames of each behind one another."""
        taxels, diagnostics = samples.values
        scans = np.zeros((len(taxels), len(self.triangles), 2, CAN), dtype=np.uint8)
        scans[..., :4] = np.array(self.identifiers, "<u4").view(np.uint8).reshape(-1, 1, 4)
        scans[..., 4] = 8
        scans[:, :, 0, DATA], scans[:, :, 1, DATA] = HEAD, TAIL
        taxels = taxels.reshape(len(taxels), -1, TAXELS)
        scans[:, :, 0, DATA + 1 :] = taxels[..., :HEAD_TAXELS]
        scans[:, :, 1, DATA + 1 : DATA + 6] = taxels[..., HEAD_TAXELS:]
        scans[:, :, 1, DATA + 6 :] = np.ascontiguousarray(diagnostics, ">u2")[..., None].view(np.uint8)
        return scans.reshape(len(taxels), 2 * CAN * len(self.triangles))

    def opening(self, local: Mapping[str, Any]) -> Dialogue:
        """Configure board and triangles, and let the board send."""
        if self.old:
            yield self._command(OLD_TIMING, 1, 1, 1, 0, OFFSET >> 8, 0, 0, pause_s=0.01)
            yield self._command(OLD_TRIANGLES, SHIFT, 0x22, NO_LOAD, 0, 0xFF, 0xFF, 0x0A)
            return
        yield self._command(BOARD, 0, self.period_ms, NO_LOAD)
        last = MOST_TRIANGLES - 1
        yield self._command(TRIANGLE, 0, last, SHIFT, 1, OFFSET & 0xFF, OFFSET >> 8, pause_s=0.5)
        yield self._command(TRANSMIT, 0)

    def closing(self) -> bytes:
        """Have the board send no more; one with the older configuration cannot be determined so."""
        return b"" if self.old else self._command(TRANSMIT, 1).send

    def _command(self, *data: int, pause_s: float = 0.0) -> Ask:
        return Ask(can_frame(POLLING << 8 | self.board, bytes(data)), pause_s=pause_s)

    def device(self) -> Device:
        """Return a board that waits to be asked to send."""
        return _Board(self)


class _Board(Device):
    """The board's side."""

    def __init__(self, sensor: IcubSkin) -> None:
        super().__init__(streaming=False)
        self.sensor = sensor

    def hear(self, data: bytes) -> list[bytes]:
        self.heard += data
        while len(self.heard) >= CAN:
            message = bytes(self.heard[:CAN])
            del self.heard[:CAN]
            if int.from_bytes(message[:4], "little") != POLLING << 8 | self.sensor.board:
                continue
            if message[DATA] == TRANSMIT and not self.sensor.old:
                self.streaming = message[DATA + 1] == 0
            elif message[DATA] == BOARD and message[DATA + 2]:
                self.rate_hz = 1000 / message[DATA + 2]
            elif message[DATA] == OLD_TIMING and self.sensor.old:
                self.streaming = True
        return []
