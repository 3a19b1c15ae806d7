"""Define sensors: decode bytes to samples, state the requests of a device, and emulate the device.

A product is one file with one frozen dataclass, a `Sensor`. Its fields are the options of the rig file, each with a
comment that is its help. Nothing here does input or output: a link carries the bytes, see `tacpipe.links`.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, TypedDict

from tacpipe.arrays import AnyArray, Int64s, Times
from tacpipe.errors import UsageError
from tacpipe.sensors.framing import Framer

if TYPE_CHECKING:
    import pyarrow as pa

Frames = Any  # NDArray[np.uint8] (frame, byte) of frames of one size, or list[bytes] where they are text


@dataclass(frozen=True)
class Samples:
    """The samples of frames. ``values`` are blocks (sample, channel), side by side in the order of the sensor's fields."""

    values: tuple[AnyArray, ...]
    seq: Int64s | None = None  # (sample,), the counter as the frame holds it; `Sensor.counter` is its modulus
    t_device_ns: Times | None = None  # (sample,), when the device states that the sample was taken
    device_seq: Int64s | None = None  # (sample,), a second counter, of samples taken rather than sent
    rows: Int64s | None = None  # (sample,), the frame that each is of; None: one a frame, in order

    def __len__(self) -> int:
        return len(self.values[0]) if self.values else 0


@dataclass(frozen=True)
class Ask:
    """A request to a device while a stream is opened or tared, and the awaited reply.

    ``until`` is given what came since and returns where the reply is: how many bytes it takes, or (start, stop) where
    samples may come before it, which are then no part of it and are kept; 0 while it is not whole. With (0, 0) the reply is
    there and nothing is taken: it is a sample itself. Without ``until`` nothing is waited for but ``pause_s``. It may raise
    `TacpipeError` for a reply that means no.
    """

    send: bytes
    until: Callable[[bytes], int | tuple[int, int]] | None = None
    timeout_s: float = 2.0
    pause_s: float = 0.0
    what: str = "a reply"  # name of the reply in errors

    def found(self, received: bytes) -> tuple[int, int] | None:
        """Return where the reply is in what came since, (start, stop), None while it is not whole or none is awaited."""
        end = self.until(received) if self.until is not None and received else 0
        return end if isinstance(end, tuple) else (0, end) if end else None


Dialogue = Generator[Ask, bytes, None]  # yields what is asked, is sent the reply


@dataclass(frozen=True)
class SerialLine:
    """How a serial port is set for a sensor; None leaves a control line as it is."""

    dtr: bool | None = None
    rts: bool | None = None
    settle_s: float = 0.0  # time of silence and boot text after opening, which is discarded


@dataclass
class Device:
    """The device's side of a protocol, as the emulator plays it: this one streams from the start and hears nothing."""

    streaming: bool = True
    rate_hz: float | None = None  # None: the sensor's own; a device that is given its rate sets it
    heard: bytearray = field(default_factory=bytearray)

    def hear(self, data: bytes) -> list[bytes]:
        """Take what the host wrote and return the replies to it, in order."""
        return []

    def polled(self) -> int:
        """Return how many frames the host has asked for since the last call; always 0 of a device that streams."""
        return 0


OptionValue = str | float | bool | Sequence[str] | Mapping[str, str | float | bool] | Sequence[Mapping[str, str]]
Options = Mapping[str, OptionValue]  # options of a sensor, as a rig file states them


class LocalAddress(TypedDict, total=False):
    """The address on which a link of this computer listens."""

    host: str
    port: int


class Sensor:
    """A product. Subclasses are frozen dataclasses, registered under the entry-point group ``tacpipe.sensors``."""

    summary: ClassVar[str] = ""  # one sentence: what it is
    product: ClassVar[str] = ""  # name in the attribute ``sensor`` of recordings; empty: the registered name
    links: ClassVar[tuple[str, ...]] = ("serial",)  # schemes of addresses it can be reached by
    line: ClassVar[SerialLine] = SerialLine()
    counter: ClassVar[int | None] = None  # modulus of ``seq``; None: the device does not count
    device_counter: ClassVar[int | None] = None  # modulus of ``device_seq``
    step: ClassVar[int] = 1  # increment of ``seq`` between two samples
    device_wrap_ns: ClassVar[int | None] = None  # period of the device's clock
    listens: ClassVar[bool] = False  # True where the device sends by UDP to an address that is set at the device
    steady: ClassVar[bool] = True  # it sends at its rate all the time; False: only when something happens
    exclusive: ClassVar[str] = ""  # sentence on programs that cannot use the device meanwhile; empty: none
    usb_ids: ClassVar[tuple[str, ...]] = ()  # "16d0:14cc": vendor and product, where the product has its own
    usage_page: ClassVar[int | None] = None  # usage page of the HID interface with samples, where a device has several
    described: ClassVar[bool] = False  # its frames are what the rig file states, so that those of any board may fit
    guesses: ClassVar[Mapping[str, str]] = {}  # evidence for a probe's guess of each option

    incomplete: ClassVar[bool] = False  # options are missing that the device itself states when it is opened

    rate_hz: float  # samples a second; 0: none is known
    baud: int  # baud rate of a serial port

    @property
    def awaited(self) -> bool:
        """True where samples come continuously, so that silence is a fault."""
        return self.steady and self.rate_hz > 0

    def fields(self) -> list[pa.Field]:
        """Return the arrow field of each channel: name, native type, unit, quantity and layout."""
        raise NotImplementedError

    def framer(self) -> Framer:
        """Return a new framer, which cuts what a link gives into frames."""
        raise NotImplementedError

    def decode(self, frames: Frames) -> Samples:
        """Return the samples of frames of one size; frames that hold none (replies, messages) are not in ``rows``."""
        raise NotImplementedError

    def encode(self, samples: Samples) -> Frames:
        """Return the frames that hold these samples: the inverse of `decode`."""
        raise NotImplementedError

    def opening(self, local: LocalAddress) -> Dialogue:
        """Yield the requests that the device needs before it streams; ``local`` holds what the link knows (``port``)."""
        yield from ()

    def closing(self) -> bytes:
        """Return what is written when a stream ends."""
        return b""

    def taring(self) -> Dialogue:
        """Yield what makes the device take its present reading for zero; nothing where it has no such command."""
        yield from ()

    def request(self) -> bytes:
        """Return what is written to have one frame sent, of a device that must be asked for each; empty: it streams."""
        return b""

    def answer(self, chunk: bytes) -> bytes:
        """Return what must be written at once in reply to a packet; empty: nothing."""
        return b""

    def accepts(self, packet: bytes) -> bool:
        """Return whether a packet is recorded. The others are left out and counted, so that nobody can fill a disk."""
        return True

    def device(self) -> Device:
        """Return the device's side, for the emulator."""
        return Device()


def positive(sensor: str, **values: float) -> None:
    """Raise `UsageError` for an option of ``sensor`` that is not above 0."""
    for name, value in values.items():
        if not 0 < value < float("inf"):
            raise UsageError(f"{sensor}: {name} is {value:g}; it must be above 0.")


def within(sensor: str, name: str, value: float, least: float, most: float) -> None:
    """Raise `UsageError` for an option of ``sensor`` that is not between ``least`` and ``most``, these included."""
    if not least <= value <= most:
        raise UsageError(f"{sensor}: {name} is {value:g}; it must be between {least:g} and {most:g}.")


def known(sensor: str, name: str, value: Any, among: Iterable[Any]) -> None:
    """Raise `UsageError` for an option of ``sensor`` that is none of those ``among`` which it must be."""
    allowed = list(among)
    if value not in allowed:
        raise UsageError(f"{sensor}: {name} is {value!r}; it must be one of {', '.join(map(str, allowed))}.")


def numbered(name: str, count: int) -> list[str]:
    """Return ``name`` with numbers from 1, of two digits at least.

    >>> numbered("taxel", 2)
    ['taxel01', 'taxel02']
    """
    digits = max(2, len(str(count)))
    return [f"{name}{number:0{digits}d}" for number in range(1, count + 1)]


def fields(count: int, kind: pa.DataType, unit: str, axes: str = "", prefix: str = "", **layout: str) -> list[pa.Field]:
    """Return the fields ``taxel01`` to the last, or ``taxel01_x``, … where a taxel has ``axes``, each of this type.

    ``prefix`` goes before each name, and ``layout`` into the metadata of each, next to ``taxel`` and ``axis``.
    """
    import pyarrow as pa

    fields_of_taxels = []
    for number, name in enumerate(numbered("taxel", count), start=1):
        metadata = {"unit": unit, "quantity": "tactile", **layout, "taxel": str(number)}
        fields_of_taxels += [
            pa.field(f"{prefix}{name}_{axis}", kind, metadata={**metadata, "axis": axis}) for axis in axes
        ]
        fields_of_taxels += [] if axes else [pa.field(f"{prefix}{name}", kind, metadata=metadata)]
    return fields_of_taxels


def grid(rows: int, columns: int, kind: pa.DataType, unit: str, prefix: str = "", **layout: str) -> list[pa.Field]:
    """Return the fields of taxels that stand in rows, row by row, with ``row`` and ``column`` from 1 in the metadata."""
    return [
        field.with_metadata(
            {**field.metadata, b"row": b"%d" % (place // columns + 1), b"column": b"%d" % (place % columns + 1)}
        )
        for place, field in enumerate(fields(rows * columns, kind, unit, prefix=prefix, **layout))
    ]
