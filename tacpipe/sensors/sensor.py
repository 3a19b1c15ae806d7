"""Define sensors, which decode bytes to samples, encode samples, and provide the requests to a device.

A product is one module with one frozen dataclass, a `Sensor`. Its fields are the options in the rig file, and the comment of
each is its help text. Sensors do no input or output: links transport the bytes, see `tacpipe.links`.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, TypedDict

from tacpipe.arrays import AnyArray, Int64s, Times
from tacpipe.errors import UsageError
from tacpipe.sensors.framing import Framer

if TYPE_CHECKING:
    import pyarrow as pa

Frames = Any  # NDArray[np.uint8] (frame, byte) for frames of one size, or list[bytes] for text frames


@dataclass(frozen=True)
class Samples:
    """The samples of frames. ``values`` are blocks (sample, channel) that together have the order of the sensor's fields."""

    values: tuple[AnyArray, ...]
    seq: Int64s | None = None  # (sample,), the counter in the frame, modulo `Sensor.counter`
    t_device_ns: Times | None = None  # (sample,), the device's time of the sample in ns
    device_seq: Int64s | None = None  # (sample,), a second counter, of measured rather than sent samples
    rows: Int64s | None = None  # (sample,), index of the frame of each sample; None: one sample per frame, in order

    def __len__(self) -> int:
        return len(self.values[0]) if self.values else 0


@dataclass(frozen=True)
class Ask:
    """A request to a device while a stream is opened or tared, and the awaited reply.

    ``until`` finds the reply in the bytes received since the request. It returns the size of the reply, or (start, stop) if
    samples may precede it, which are retained; 0 means that the reply is incomplete, and (0, 0) that it is a sample, which
    is not consumed. It may raise `TacpipeError` if the reply is a refusal. Without ``until``, no reply is awaited. A pause
    of ``pause_s`` follows.
    """

    send: bytes
    until: Callable[[bytes], int | tuple[int, int]] | None = None
    timeout_s: float = 2.0
    pause_s: float = 0.0
    what: str = "a reply"  # the reply's name in errors

    def find_reply(self, received: bytes) -> tuple[int, int] | None:
        """Return (start, stop) of the reply in ``received``, or None if it is incomplete or no reply is awaited."""
        end = self.until(received) if self.until is not None and received else 0
        return end if isinstance(end, tuple) else (0, end) if end else None


Dialogue = Generator[Ask, bytes, None]  # yields requests and is sent their replies


@dataclass(frozen=True)
class SerialLine:
    """The serial port settings of a sensor. None leaves a control line unchanged."""

    dtr: bool | None = None
    rts: bool | None = None
    settle_s: float = 0.0  # time after opening in which the device boots; its bytes are discarded


OptionValue = (
    str
    | float
    | bool
    | Sequence[str]
    | Sequence[float]
    | Mapping[str, str | float | bool]
    | Sequence[Mapping[str, str]]
)
Options = Mapping[str, OptionValue]  # options of a sensor in a rig file


class LocalAddress(TypedDict, total=False):
    """The address on which a link of this computer listens."""

    host: str
    port: int


class Sensor:
    """A product. Subclasses are frozen dataclasses, registered in the entry-point group ``tacpipe.sensors``."""

    summary: ClassVar[str] = ""  # one sentence that describes the product
    product: ClassVar[str] = ""  # name in the attribute ``sensor`` of recordings; empty: the registered name
    links: ClassVar[tuple[str, ...]] = ("serial",)  # supported schemes of addresses
    line: ClassVar[SerialLine] = SerialLine()
    counter: ClassVar[int | None] = None  # modulus of ``seq``; None: the device has no counter
    device_counter: ClassVar[int | None] = None  # modulus of ``device_seq``
    step: ClassVar[int] = 1  # increment of ``seq`` between two samples
    # time after which the device's clock wraps to 0; None: it does not wrap
    device_wrap_ns: ClassVar[int | None] = None
    listens: ClassVar[bool] = False  # True if the device sends by UDP to an address that is configured in the device
    # True if each chunk of the link is one datagram; the address in the rig file decides
    datagrams: ClassVar[bool] = False
    # True if the link repeats what is lost, so that a gap is a pause of the sender
    lossless: ClassVar[bool] = False
    steady: ClassVar[bool] = True  # True if it sends at its rate all the time; False: only on events
    exclusive: ClassVar[str] = ""  # sentence on programs that cannot use the device at the same time; empty: no limit
    usb_ids: ClassVar[tuple[str, ...]] = ()  # USB ids (vendor:product) of the product, such as "16d0:14cc"
    usage_page: ClassVar[int | None] = None  # usage page of the HID interface with samples, if a device has several
    described: ClassVar[bool] = False  # True if the rig file describes the frames, so that many boards may match
    guesses: ClassVar[Mapping[str, str]] = {}  # explanation of each option that probing guesses

    incomplete: ClassVar[bool] = False  # True if options are missing that the device reports when it is opened

    rate_hz: float  # samples per second; 0: unknown
    baud: int  # baud rate of a serial port

    @property
    def awaited(self) -> bool:
        """True if samples arrive continuously, so that silence is a fault."""
        return self.steady and self.rate_hz > 0

    def time_field(self) -> pa.Field:
        """Return the field of the arrivals of the samples, with the declared period if samples arrive continuously."""
        from tacpipe.channels import schema

        return schema.time_field(arrivals=True, period_ns=round(1e9 / self.rate_hz) if self.awaited else None)

    def fields(self) -> list[pa.Field]:
        """Return the Arrow field of each channel: name, native type, unit, quantity and layout."""
        raise NotImplementedError

    def framer(self) -> Framer:
        """Return a new framer, which splits the bytes of a link into frames."""
        raise NotImplementedError

    def decode(self, frames: Frames) -> Samples:
        """Return the samples of frames of one size. Frames without a sample, such as replies, are not in ``rows``."""
        raise NotImplementedError

    def encode(self, samples: Samples) -> Frames:
        """Return the frames of these samples: the inverse of `decode`."""
        raise NotImplementedError

    def opening(self, local: LocalAddress) -> Dialogue:
        """Yield the requests that the device needs before it streams. ``local`` has values of the link, such as ``port``."""
        yield from ()

    def closing(self) -> bytes:
        """Return the request that ends a stream."""
        return b""

    def taring(self) -> Dialogue:
        """Yield the requests that zero the device at its present reading; none if it has no such command."""
        yield from ()

    def request(self) -> bytes:
        """Return the request for one frame, for a device that must be polled. Empty if it streams."""
        return b""

    def answer(self, chunk: bytes) -> bytes:
        """Return the immediate answer to a packet. Empty if there is none."""
        return b""

    def accepts(self, packet: bytes) -> bool:
        """Return whether a packet is recorded. Others are dropped and counted, so that they cannot fill the disk."""
        return True


def check_positive(sensor: str, **values: float) -> None:
    """Raise `UsageError` if an option of ``sensor`` is not above 0."""
    for name, value in values.items():
        if not 0 < value < float("inf"):
            raise UsageError(f"{sensor}: {name} is {value:g}; it must be above 0.")


def check_range(sensor: str, name: str, value: float, minimum: float, maximum: float) -> None:
    """Raise `UsageError` if an option of ``sensor`` is not between ``minimum`` and ``maximum`` (inclusive)."""
    if not minimum <= value <= maximum:
        raise UsageError(f"{sensor}: {name} is {value:g}; it must be between {minimum:g} and {maximum:g}.")


def check_choice(sensor: str, name: str, value: Any, choices: Iterable[Any]) -> None:
    """Raise `UsageError` if an option of ``sensor`` is not one of ``choices``."""
    allowed = list(choices)
    if value not in allowed:
        raise UsageError(f"{sensor}: {name} is {value!r}; it must be one of {', '.join(map(str, allowed))}.")


def numbered_names(name: str, count: int) -> list[str]:
    """Return ``name`` with the numbers 1 to ``count``, with at least two digits.

    >>> numbered_names("taxel", 2)
    ['taxel01', 'taxel02']
    """
    digits = max(2, len(str(count)))
    return [f"{name}{number:0{digits}d}" for number in range(1, count + 1)]


def quantity_of(name: str, stated: str) -> str:
    """Return the ``stated`` quantity of a channel; if it is empty, tactile for a name with taxel, and state for others.

    >>> quantity_of("taxel{1..4}", ""), quantity_of("joint1", ""), quantity_of("joint1", "angle")
    ('tactile', 'state', 'angle')
    """
    return stated or ("tactile" if "taxel" in name else "state")


def taxel_fields(
    count: int, kind: pa.DataType, unit: str, axes: str = "", prefix: str = "", **layout: str
) -> list[pa.Field]:
    """Return the fields ``taxel01``, …, or ``taxel01_x``, … if ``axes`` are given, with type ``kind``.

    ``prefix`` precedes each name. ``layout`` is added to the metadata of each field, next to ``taxel`` and ``axis``.
    """
    import pyarrow as pa

    fields = []
    for number, name in enumerate(numbered_names("taxel", count), start=1):
        metadata = {"unit": unit, "quantity": "tactile", **layout, "taxel": str(number)}
        fields += [pa.field(f"{prefix}{name}_{axis}", kind, metadata={**metadata, "axis": axis}) for axis in axes]
        fields += [] if axes else [pa.field(f"{prefix}{name}", kind, metadata=metadata)]
    return fields


def grid_fields(
    rows: int, columns: int, kind: pa.DataType, unit: str, prefix: str = "", **layout: str
) -> list[pa.Field]:
    """Return the fields of a grid of taxels, row by row, with ``row`` and ``column``, counted from 1, in the metadata."""
    return [
        field.with_metadata(
            {**field.metadata, b"row": b"%d" % (index // columns + 1), b"column": b"%d" % (index % columns + 1)}
        )
        for index, field in enumerate(taxel_fields(rows * columns, kind, unit, prefix=prefix, **layout))
    ]
