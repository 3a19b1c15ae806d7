"""Convert timestamps of any unit, and text in a ``strptime`` format, to integer nanoseconds (int64).

Numbers keep the digits of the file: text is parsed as decimal numbers, never through float64, whose resolution at
today's Unix time is 238 ns.
"""

from __future__ import annotations

import datetime
import re
import zoneinfo
from decimal import Decimal
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tacpipe.arrays import Bools, Int64s, Times
from tacpipe.errors import UsageError
from tacpipe.formats.container import Time, TimeUnit
from tacpipe.printable import excerpt

if TYPE_CHECKING:
    import pyarrow as pa

_DIRECTIVES = {
    "Y": r"\d{4}",
    "y": r"\d{2}",
    **dict.fromkeys("mdHIMS", r"\d{1,2}"),
    "f": r"\d{1,9}",
    "p": r"[AaPp][Mm]",
    "b": r"[A-Za-z]{3}",
    "B": r"[A-Za-z]+",
}
_PART = re.compile(r"(?P<fraction>%S[.,]%f)|%(?P<letter>.)|(?P<text>[^%]+)", re.DOTALL)
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
DAY_NS = 86_400 * 10**9


def check_format(text: str, place: str) -> None:
    """Raise `UsageError` for a format with an unsupported directive, or without an hour."""
    letters = re.findall(r"%(.)", text.replace("%%", ""), re.DOTALL)
    unread = sorted({f"%{letter}" for letter in letters} - {f"%{letter}" for letter in _DIRECTIVES})
    if unread or not {"H", "I"} & set(letters):
        raise UsageError(
            f"{place}: format is {excerpt(text)}; it must name an hour (%H), and is made of "
            f"{', '.join(f'%{letter}' for letter in _DIRECTIVES)}."
        )


def has_date(text: str) -> bool:
    """Return whether timestamps of a format include a date.

    >>> has_date("%d.%m.%Y %H:%M"), has_date("%H:%M:%S.%f")
    (True, False)
    """
    return bool(re.search("%[Yy]", text))


def format_expression(text: str) -> str:
    """Return the regular expression of a ``strptime`` format, with a group for each directive.

    A fraction of a second is optional, because Python omits it if it is zero.
    """
    regex = ""
    for match in _PART.finditer(text):
        if match["fraction"]:
            regex += rf"(?P<S>\d{{1,2}})(?:{re.escape(match['fraction'][2])}(?P<f>\d{{1,9}}))?"
        elif match["letter"] == "%":
            regex += "%"
        elif match["letter"]:
            regex += f"(?P<{match['letter']}>{_DIRECTIVES[match['letter']]})"
        else:
            for letter in match["text"]:
                literal = r"\^" if letter == "^" else f"[{letter}]"
                regex += letter if letter.isalnum() or letter == " " else literal
    return f"^{regex}$"


def parse_stamps(column: pa.Array, time_format: str) -> tuple[Int64s, Bools]:
    """Return timestamps in ns (row,) since 1970 or since midnight, and whether each is valid (row,).

    ``column`` contains text in the ``strptime`` format ``time_format``; its time zone is ignored.

    >>> import pyarrow as pa
    >>> parse_stamps(pa.array(["01.02.1970 00:00:01.5", "31.02.1970 00:00:00", "x"]), "%d.%m.%Y %H:%M:%S.%f")
    (array([2678401500000000,                0,                0]), array([ True, False, False]))
    """
    import pyarrow.compute as pc

    groups = pc.extract_regex(pc.utf8_trim_whitespace(column), format_expression(time_format))  # by directive letter
    valid = groups.is_valid().to_numpy(zero_copy_only=False)
    texts = {field.name: pc.struct_field(groups, field.name).fill_null("") for field in groups.type}

    def number_of(letter: str, default: int = 0) -> Int64s:
        values = texts.get(letter)
        if values is None:
            return np.full(len(column), default, np.int64)
        filled = pc.if_else(pc.equal(values, ""), str(default), values)
        return np.asarray(filled.cast("int64").to_numpy(zero_copy_only=False))

    month = number_of("m", 1)
    for letter in {"b", "B"} & set(texts):
        names = pc.utf8_slice_codeunits(pc.utf8_lower(texts[letter]), 0, 3).to_pylist()
        month = np.array([_MONTHS.index(name) + 1 if name in _MONTHS else 0 for name in names], np.int64)
    year = number_of("Y", 1970) if "y" not in texts else number_of("y") + np.where(number_of("y") < 69, 2000, 1900)
    hour = number_of("H")
    if "I" in texts:
        afternoon = np.array([text[:1].lower() == "p" for text in texts["p"].to_pylist()]) if "p" in texts else False
        hour = number_of("I") % 12 + np.where(afternoon, 12, 0)
    day, minute, second = number_of("d", 1), number_of("M"), number_of("S")
    valid &= (month >= 1) & (month <= 12) & (year >= 1678) & (year < 2262) & (hour < 24) & (minute < 60) & (second < 61)
    months = (np.where(valid, year, 1970) - 1970) * 12 + np.where(valid, month, 1) - 1
    days = months.astype("datetime64[M]").astype("datetime64[D]").astype(np.int64) + day - 1
    valid &= (day >= 1) & (days.astype("datetime64[D]").astype("datetime64[M]").astype(np.int64) == months)
    fraction = np.zeros(len(column), np.int64)
    if "f" in texts:
        padded = pc.utf8_rpad(texts["f"], 9, "0")
        fraction = np.asarray(padded.cast("int64").to_numpy(zero_copy_only=False))
    t_ns = ((days * 24 + hour) * 60 + minute) * 60 + second
    return np.where(valid, t_ns * 10**9 + fraction, 0), valid


IN_RANGE = "a time before the year 2262"  # the limit of nanoseconds in 64 bits
DIGITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}  # number of decimals that are nanoseconds, by unit
MIN_UNIX_S = 1e8  # Unix time in seconds; smaller values count from the start of a recording
_UNIX_LIMITS: tuple[tuple[float, TimeUnit], ...] = ((1e11, "s"), (1e14, "ms"), (1e17, "us"), (float("inf"), "ns"))
DECIMAL = pa.decimal128(38, 18)  # type for parsing text
_UNIT = 10**9  # a nanosecond in units of the last digit of `DECIMAL` seconds
_USUAL = 450_000_000  # limit of the high word of seconds (year 2233) below which products fit in 64 bits
_BEYOND = 10**37 >> 64  # value of the high word above which a time is after 2262 in every unit
_MAX_STAMP = 1e19  # after 2262 in every unit, and below the smallest number that Arrow misreads as another decimal
_ZONED = re.compile(r".*(Z|[+-]\d\d:?\d\d)\s*", re.IGNORECASE)
_LOGGED = r"(\d{2}:\d{2}:\d{2}),(\d+)"  # seconds with a comma, as written by Python's logging


def unit_of_unix_time(size: float) -> TimeUnit | None:
    """Return the unit of a number since 1970 from its ``size``, or None for one that is too small.

    >>> unit_of_unix_time(1.7e9), unit_of_unix_time(1.7e18), unit_of_unix_time(12.5)
    ('s', 'ns', None)
    """
    return next((unit for limit, unit in _UNIX_LIMITS if MIN_UNIX_S <= size < limit), None)


class StampError(ValueError):
    """An invalid timestamp: the index of its row in the column, and its text."""

    def __init__(self, row: int, value: str, expected: str) -> None:
        super().__init__(value)
        self.row, self.value, self.expected = row, value, expected


class LocalClock:
    """Converts local times of a zone to UTC, block by block; rows in order settle the hour that summer time repeats."""

    def __init__(self, time: Time, *, in_order: bool = True) -> None:
        """Read times in the zone of ``time``. Without ``in_order``, only ``time.ambiguous`` settles the repeated hour."""
        self.zone, self._ambiguous, self._in_order = time.zone, time.ambiguous, in_order
        self.has_zones: bool | None = None  # None before the first block was read
        self._last_ns: int | None = None  # local time of the last row
        self._repeats = False  # True from the second reading of the repeated hour on

    def to_utc(self, local: pa.Array) -> Int64s:
        """Return local timestamps in ns UTC (row,). Raises `StampError` for a time that is not one moment."""
        if self.zone == "UTC":
            return _integers(local)
        local = local.cast(pa.timestamp("ns"))

        def read_as(ambiguous: str, nonexistent: str = "earliest") -> Int64s:
            return _integers(pc.assume_timezone(local, self.zone, ambiguous=ambiguous, nonexistent=nonexistent))

        local_ns, earlier, later = _integers(local), read_as("earliest"), read_as("latest")
        missing = earlier != read_as("earliest", "latest")
        if missing.any():
            row = int(missing.argmax())
            expected = f"a time that exists in {self.zone} ({self._readings(local[row])})"
            remedy = 'Set time.zone to that of the clock, such as "UTC" or "Etc/GMT-1"'
            raise StampError(row, str(local[row]), f"{expected}. {remedy}")
        repeated = earlier != later
        if not repeated.any():
            self._last_ns = int(local_ns[-1]) if len(local_ns) else self._last_ns
            return earlier
        return np.where(repeated & self._is_later(local, local_ns, earlier, later, repeated), later, earlier)

    def _is_later(
        self, local: pa.Array, local_ns: Int64s, earlier: Int64s, later: Int64s, repeated: Bools
    ) -> Bools | bool:
        """Return whether the later reading of a repeated time applies, shape (row,) or one value for all rows."""
        first, last = int(repeated.argmax()), len(repeated) - int(repeated[::-1].argmax()) - 1
        before = self._last_ns if first == 0 else int(local_ns[first - 1])
        back = repeated & (np.diff(local_ns, prepend=local_ns[0] if before is None else before) < -(10**9))
        began = self._repeats
        self._last_ns, self._repeats = int(local_ns[-1]), began or bool(back.any())
        if self._in_order and (self._repeats or before is not None):
            return began | np.logical_or.accumulate(back)
        hour_after_follows = self._in_order and last + 1 < len(later) and bool(later[last + 1] >= later[last])
        if not hour_after_follows and not self._ambiguous:
            expected = f"a time that occurs once in {self.zone} ({self._readings(local[first])})"
            remedy = 'Set time.ambiguous = "earlier" or "later"'
            raise StampError(first, str(local[first]), f"{expected}. {remedy}")
        self._repeats = hour_after_follows or self._ambiguous == "later"
        return self._repeats

    def _readings(self, local: pa.Scalar) -> str:
        """Return the two readings of a local time that occurs twice or never."""
        at = datetime.datetime.fromisoformat(str(local)[:26])
        both = [at.replace(tzinfo=zoneinfo.ZoneInfo(self.zone), fold=fold) for fold in (0, 1)]
        utc = [moment.astimezone(datetime.UTC).strftime("%H:%M:%S UTC") for moment in both]
        return f"as {both[0].tzname()} it is {utc[0]}, as {both[1].tzname()} {utc[1]}"


def _integers(stamps: pa.Array) -> Int64s:
    """Return timestamps as integers in ns (row,)."""
    zone = stamps.type.tz
    return np.asarray(stamps.cast(pa.timestamp("ns", zone)).cast(pa.int64()).to_numpy(zero_copy_only=False), np.int64)


def nanoseconds(column: pa.Array, time: Time, clock: LocalClock | None = None) -> Int64s:
    """Return timestamps in nanoseconds (time,), converted from the unit of ``time`` and rounded half to even.

    ``clock`` knows the blocks before, for local times.

    Raises `StampError` for a timestamp that is missing, is not a time, or does not fit in 64 bits (the year 2262).

    >>> nanoseconds(pa.array(["1744849152.0161362"]).cast(DECIMAL), Time()), nanoseconds(pa.array([1.5]), Time(unit="ms"))
    (array([1744849152016136200]), array([1500000]))
    >>> nanoseconds(pa.array(["1970-01-01T01:00:00.5+01:00"]), Time(unit="iso8601"))
    array([500000000])
    """
    values = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    _refuse_flagged(values.is_null(), values, "a time; the cell is empty")
    clock = clock or LocalClock(time)
    if pa.types.is_timestamp(values.type):
        in_ns = _cast(values, pa.timestamp("ns", values.type.tz), IN_RANGE)
        return clock.to_utc(in_ns) if values.type.tz is None else _integers(in_ns)
    if pa.types.is_time(values.type):
        of_day_ns = np.asarray(values.cast(pa.time64("ns")).cast(pa.int64()).to_numpy())
        return clock.to_utc(pa.array(of_day_ns + _day_ns(time)).cast(pa.timestamp("ns")))
    if time.format:
        return _from_format(values, time, clock)
    if time.unit == "iso8601":
        return _from_iso_text(values, clock)
    unit = time.unit
    if pa.types.is_decimal(values.type):
        return _from_decimals(values, DIGITS[unit])
    if pa.types.is_integer(values.type):
        return _from_integers(values, 10 ** DIGITS[unit])
    return _from_floats(values, 10 ** DIGITS[unit])


def _from_iso_text(column: pa.Array, clock: LocalClock) -> Int64s:
    """Return the times in ISO 8601 texts in ns (row,).

    Texts have a zone if the first of the file has one, else they are local times of ``clock``.

    Raises `StampError` for a text of another form.
    """
    text = pc.replace_substring_regex(pc.utf8_trim_whitespace(column.cast(pa.string())), _LOGGED, r"\1.\2")
    if clock.has_zones is None:
        clock.has_zones = any(bool(_ZONED.fullmatch(first)) for first in text[:1].to_pylist())
    if clock.has_zones:
        expected = "a time in ISO 8601, with a zone, as the first row has one"
        return _integers(_cast(text, pa.timestamp("ns", "UTC"), expected))
    expected = "a time in ISO 8601, without a zone, as the first row has none"
    return clock.to_utc(_cast(text, pa.timestamp("ns"), expected))


def _from_format(column: pa.Array, time: Time, clock: LocalClock) -> Int64s:
    """Return the timestamps (row,) in ns UTC of a column of text in the format of ``time``."""
    t_ns, valid = parse_stamps(column.cast(pa.string()), time.format)
    _refuse_flagged(pa.array(~valid), column, f"a time in the format {time.format}")
    local_ns = t_ns if has_date(time.format) else t_ns + _day_ns(time)
    return clock.to_utc(pa.array(local_ns).cast(pa.timestamp("ns")))


def _day_ns(time: Time) -> int:
    """Return the start of the day for times of day: that of ``start``, or else 1970-01-01."""
    return int(np.datetime64(time.start[:10], "D").astype("datetime64[ns]").astype(np.int64)) if time.start else 0


def _from_decimals(column: pa.Array, digits: int) -> Int64s:
    """Return decimals with ``digits`` relevant decimals as ns (row,). Raises `StampError` for times out of range."""
    if column.type == DECIMAL:
        high, low = _decimal_words(column)
        _refuse_flagged(pa.array(np.abs(high) > _BEYOND), column, IN_RANGE)
        in_seconds = digits == DIGITS["s"] and bool((np.abs(high) < _USUAL).all())
        if in_seconds:
            return _from_seconds(high, low)
    t_ns, fits = last_digits(
        pc.round(column, ndigits=digits, round_mode="half_to_even").cast(pa.decimal128(38, digits))
    )
    _refuse_flagged(pa.array(~fits), column, IN_RANGE)
    return t_ns


def last_digits(column: pa.Array) -> tuple[Int64s, Bools]:
    """Return decimals as integers in units of their last digit (row,), and whether each fits in 64 bits.

    >>> last_digits(pa.array(["1.25", "-3"]).cast(pa.decimal128(19, 2)))[0]
    array([ 125, -300])
    """
    high, low = _decimal_words(column)
    digits: Int64s = low.astype(np.int64)
    return digits, high == digits >> 63


def overflows(rounded: pa.ChunkedArray) -> Bools:
    """Return which timestamps Arrow may have misread, shape (row,), from the same column read as float64.

    Arrow multiplies the digits of a cell by a power of ten in 128 bits and does not detect an overflow, so 1e34 may
    become any number.

    >>> overflows(pa.chunked_array([[1744849152.5, None, -1e34]]))
    array([False, False,  True])
    """
    return np.asarray(np.abs(rounded.fill_null(0).to_numpy()) >= _MAX_STAMP)


def _decimal_words(column: pa.Array) -> tuple[Int64s, np.ndarray[Any, np.dtype[np.uint64]]]:
    """Return the high and the low 64-bit words (row,) of decimal128 values."""
    words = np.frombuffer(column.buffers()[1], dtype="<i8").reshape(-1, 2)[column.offset :][: len(column)]
    return words[:, 1], words[:, 0].view(np.uint64)


def _from_seconds(high: Int64s, low: np.ndarray[Any, np.dtype[np.uint64]]) -> Int64s:
    """Convert seconds with 18 decimals, as two words (row,), to nanoseconds, rounded half to even."""
    high_whole, high_remainder = divmod(1 << 64, _UNIT)  # the high word counts 2^64
    low_whole, low_left = np.divmod(low, np.uint64(_UNIT))
    carried, remainder = np.divmod(high * high_remainder + low_left.astype(np.int64), _UNIT)
    t_ns: Int64s = high * high_whole + low_whole.astype(np.int64) + carried
    t_ns += (remainder > _UNIT // 2) | ((remainder == _UNIT // 2) & (t_ns & 1 == 1))
    return t_ns


def _from_integers(column: pa.Array, factor: int) -> Int64s:
    """Return integers in units of ``factor`` ns as ns (row,). Raises `StampError` for times out of range."""
    values = column.to_numpy(zero_copy_only=False)
    limit = np.iinfo(np.int64).max // factor
    _refuse_flagged(
        pa.array((values > limit) | (values < -limit if values.dtype.kind == "i" else False)),
        column,
        IN_RANGE,
    )
    t_ns: Times = values.astype(np.int64) * factor
    return t_ns


def _from_floats(column: pa.Array, factor: int) -> Int64s:
    """Return floats in units of ``factor`` ns as ns (row,). Raises `StampError` for times out of range."""
    values = column.cast(pa.float64()).to_numpy(zero_copy_only=False)
    bad = ~np.isfinite(values) | (np.abs(values) > np.iinfo(np.int64).max / factor)
    _refuse_flagged(pa.array(bad), column, IN_RANGE)
    floors = np.floor(values)  # whole part, handled separately because its product with the factor would be rounded
    t_ns: Times = floors.astype(np.int64) * factor + np.rint((values - floors) * factor).astype(np.int64)
    return t_ns


def _cast(column: pa.Array, kind: pa.DataType, expected: str) -> pa.Array:
    """Cast a column to ``kind``. Raises `StampError`, with ``expected``, for the first value that cannot be converted."""
    try:
        return column.cast(kind)
    except pa.ArrowInvalid:
        for row, value in enumerate(column):
            try:
                value.cast(kind)
            except pa.ArrowInvalid:
                raise StampError(row, str(value.as_py()), expected) from None
        raise


def _refuse_flagged(bad: Any, column: pa.Array, expected: str) -> None:
    flags = bad.to_numpy(zero_copy_only=False)
    if flags.any():
        row = int(flags.argmax())
        value: Any = column[row].as_py()
        text = f"{value.normalize():f}" if isinstance(value, Decimal) else str(value)
        size = float(value) if isinstance(value, int | float | Decimal) else 0.0
        unit = unit_of_unix_time(size) if size < 2**63 and expected == IN_RANGE else None
        hint = f'; it looks like Unix time in {unit}, so write unit = "{unit}" in the layout' if unit else ""
        raise StampError(row, text, f"{expected}{hint}")
