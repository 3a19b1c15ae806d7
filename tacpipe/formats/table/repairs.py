"""Repair the stamps of a stream as its layout states, and check them block by block.

Stamps that share a moment are arrivals in batches, or a clock whose resolution is too coarse. The first are kept for
`synchronize`, the second are refused with the entry of the layout that repairs them. Nothing is left out without a note.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tacpipe.arrays import Bools, Indices, Times
from tacpipe.errors import TacpipeError
from tacpipe.formats.table import stamps
from tacpipe.formats.table.layout import UNKNOWN, StreamLayout
from tacpipe.plugins.rows import drop_rows
from tacpipe.signals.sampling import BURST_FRACTION

MIN_ROWS = 10  # a clock with fewer rows is not examined
SHOWN_ROWS = 3  # maximum number of rows that a note names
SAMPLED = 2000  # maximum number of distinct stamps whose resolution is examined
SECOND_NS = 10**9
BATCH_AIM = "after which `synchronize` estimates when each row was measured"


class ClockError(TacpipeError):
    """Stamps that cannot be right, with the ``changes`` of the layout's ``time`` that repair them."""

    def __init__(self, sentence: str, **changes: Any) -> None:
        super().__init__(sentence)
        self.changes = {
            name: int(value) if type(value) is float and value.is_integer() else value
            for name, value in changes.items()
        }


@dataclass
class StreamClock:
    """The clock of one stream: repairs and checks its stamps block by block, and collects notes about them."""

    stream: StreamLayout
    file: str  # name of the file in errors
    place: Callable[[int], str]  # name of a row in errors, from its index in the file
    notes: list[str] = field(default_factory=list)
    part: int | None = None  # index of the stretch between two settings of the clock; None for all rows
    is_contained: bool = False  # True for a container, whose streams may have few events
    is_measured: bool = True  # False for streams of text, whose times matter less
    has_arrivals: bool | None = None  # None before the first block was read
    parts: int = 1  # number of stretches so far
    _read: int = 0  # number of rows read
    _rows: int = 0  # number of rows kept
    _last_raw_ns: int | None = None  # last stamp before repairs
    _last_day_ns: int | None = None  # last time of day, with the days before it
    _file_last_ns: int | None = None  # last stamp that is not a stray
    _last_ns: int | None = None  # last stamp that was kept
    _turns: int = 0  # number of times that the counter has wrapped
    _equal: int = 0
    _equal_rows: list[int] = field(default_factory=list)
    # row of each jump forward, its index among the rows kept, its stamp, and its step
    _jumps: list[tuple[int, int, int, int]] = field(default_factory=list)
    _strays: list[int] = field(default_factory=list)  # rows that are left out
    _stray_ns: int = 0
    _negative: int = 0

    def repair(self, raw_ns: Times | None, rows: Indices) -> tuple[Times | None, Indices]:
        """Return the repaired stamps of a block, and the positions in it of the rows that stay.

        ``rows`` are their positions in the file. Drops the first rows and unwraps counters and times of day.
        """
        time = self.stream.time
        retained = np.arange(min(len(rows), max(0, time.drop_first - self._read)), len(rows))
        self._read += len(rows)
        if raw_ns is None or not len(retained):
            return raw_ns, retained
        t_ns = raw_ns[retained]
        before, self._last_raw_ns = self._last_raw_ns, int(t_ns[-1])
        if time.format and not stamps.has_date(time.format):
            t_ns = add_days_past_midnight(t_ns, self._last_day_ns)
            self._last_day_ns = int(t_ns[-1])
        if time.wrap:
            unit_ns = 10 ** stamps.DIGITS.get(time.unit, 9)
            wrap_ns = round(time.wrap * unit_ns)
            steps = self._steps(t_ns, before)
            turns = self._turns + np.cumsum((steps < -wrap_ns / 2).astype(np.int64) - (steps > wrap_ns / 2))
            self._turns = int(turns[-1])
            t_ns = t_ns + turns * wrap_ns
        return t_ns, retained

    def check(self, t_ns: Times, rows: Indices) -> Indices:
        """Return the positions of the rows of a block that stay. Raises `TacpipeError` if stamps decrease or are too coarse.

        ``t_ns`` are repaired stamps, and ``rows`` their positions in the file.
        """
        retained = self._without_strays(t_ns, rows)
        if self.stream.time.split_at_reset and len(retained):
            steps = self._steps(t_ns[retained], self._file_last_ns)
            parts = self.parts - 1 + np.cumsum(_is_reset(steps))
            self.parts = int(parts[-1]) + 1
            self._file_last_ns = int(t_ns[retained[-1]])
            retained = retained[parts == self.part]
        if len(retained):
            self._count(t_ns[retained], rows[retained])
            self._last_ns = int(t_ns[retained[-1]])
        if not self.stream.time.split_at_reset:
            self._file_last_ns = self._last_ns
        if self.has_arrivals is None and self._rows:
            self.has_arrivals = self.stream.time.batch or self._is_batched
        return retained

    def _without_strays(self, t_ns: Times, rows: Indices) -> Indices:
        """Return the positions of the rows of a block whose stamps are not days from those around them."""
        retained = np.arange(len(t_ns))
        last = self._file_last_ns
        jumps = np.flatnonzero(np.abs(self._steps(t_ns, last)) > stamps.DAY_NS)
        if not len(jumps) or len(jumps) > max(4, len(t_ns) // 50):
            return retained
        bounds = [*np.unique([0, *jumps]).tolist(), len(t_ns)]
        stray: list[int] = []
        for start, end in itertools.pairwise(bounds):
            following = int(t_ns[end]) if end < len(t_ns) else None
            is_behind = last is not None and t_ns[start] < last
            is_ahead = following is not None and following < t_ns[end - 1] and (last is None or following >= last)
            if end - start <= max(1, len(t_ns) // 100) and (is_behind or is_ahead):
                stray += range(start, end)
                self._stray_ns = int(t_ns[start])
            else:
                last = int(t_ns[end - 1])
        self._strays += rows[stray].tolist()
        return np.setdiff1d(retained, stray)

    def _count(self, t_ns: Times, rows: Indices) -> None:
        """Count equal stamps, jumps and negative stamps. Raises `TacpipeError` if stamps decrease or are too coarse."""
        steps = self._steps(t_ns, self._last_ns)
        backwards = np.flatnonzero(steps < 0)
        if len(backwards):
            raise self._order_error(t_ns, steps, backwards, rows)
        equal = np.flatnonzero(steps == 0)
        equal = equal[equal > 0] if self._last_ns is None else equal
        self._rows += len(t_ns)
        self._equal += len(equal)
        self._negative += int((t_ns < 0).sum())
        self._equal_rows += rows[equal[: SHOWN_ROWS - len(self._equal_rows)]].tolist()
        far = np.flatnonzero(steps > stamps.DAY_NS)
        if len(far) <= len(t_ns) // MIN_ROWS:  # otherwise the rows are days apart
            self._jumps += [
                (int(rows[index]), self._rows - len(t_ns) + index, int(t_ns[index]), int(steps[index]))
                for index in far.tolist()
            ]
        is_coarse_possible = self._is_batched and not self.stream.time.batch and t_ns[0] != t_ns[-1]
        if is_coarse_possible and (cause := coarse_cause(t_ns, self.stream.time.unit)):
            raise self._coarse_error(cause, t_ns)

    def _steps(self, t_ns: Times, before: int | None) -> Times:
        return np.diff(t_ns, prepend=t_ns[:1] if before is None else before)

    @property
    def drop_first(self) -> int:
        """The number of first rows that precede a jump of more than a day, in addition to those that are left out."""
        index = max((index for _, index, _, _ in self._jumps if index <= self._rows / 2), default=0)
        return self.stream.time.drop_first + index if index else 0

    @property
    def _is_batched(self) -> bool:
        """True if over a hundredth of the rows so far share a stamp with the row before."""
        return self.is_measured and self._rows >= MIN_ROWS and self._equal > BURST_FRACTION * self._rows

    def finish(self) -> None:
        """Add the notes on all rows. Raises `TacpipeError` if too many stamps are negative or equal."""
        time, name = self.stream.time, self.stream.name
        least = MIN_ROWS if self.is_contained else SHOWN_ROWS
        if self.is_measured and self._equal and self._equal == self._rows - 1 and self._rows >= least:
            assert self._last_ns is not None
            is_float32 = self._last_ns != 0 and self._last_ns % (128 * SECOND_NS) == 0
            hint = " (float32 has a resolution of 128 s there)" if is_float32 else ""
            fault = f"{self.file}: all {self._rows} stamps of {name} are {_moment(self._last_ns)}{hint}"
            raise ClockError(f"{fault}. Write the true rate, as in {self._entry(rate_hz=100)}.", rate_hz=UNKNOWN)
        is_numeric = time.origin == "unix" and not time.is_text and not time.wrap
        from_start = f"If they count from the start of the recording, write {self._entry(origin='start')}."
        if is_numeric and self._rows >= least and self._negative > BURST_FRACTION * self._rows:
            fault = f"{self.file}: {self._negative} of {self._rows} stamps of {name} are before 1970"
            raise ClockError(f"{fault}, as after the overflow of a counter. {from_start}", origin="start")
        if is_numeric and 0 < (self._last_ns or 0) < 365 * stamps.DAY_NS and not self.is_contained:
            self.notes.append(f"The stamps of {name} are of 1970. {from_start}")
        shared = f"{self._equal} of {self._rows} rows of {name} share a stamp with the row before"
        if self._is_batched and not self.has_arrivals:
            place, remedy = self.place(self._equal_rows[0]), f"Write {self._entry(batch=True)}, {BATCH_AIM}"
            raise ClockError(f"{place} and below: {shared}. {remedy}.", batch=True)
        if self._equal and self.has_arrivals:
            self.notes.append(f"{shared}; `synchronize` estimates when each was measured.")
        elif self._equal and self.is_measured:
            self.notes.append(f"{shared} ({self._places(self._equal_rows, self._equal)}).")
        if time.drop_first:
            drop_rows(name, "left out by time.drop_first", min(time.drop_first, self._read))
        if self._strays:
            count = len(self._strays)
            drop_rows(name, "with a stamp days from those around it", count)
            places = f"{self._places(self._strays, count)}: {_moment(self._stray_ns)}"
            fault = f"{count} of {self._rows + count} rows of {name} are left out"
            self.notes.append(f"{fault}: their stamps are days from those around them ({places}).")
        for row, index, t_ns, step in self._jumps[:SHOWN_ROWS]:
            is_start = index <= self._rows / 2
            remedy = f"drop_first = {time.drop_first + index}" if is_start else "split_at_reset = true"
            aim = f"leave out the rows before it ({index})" if is_start else "make two recordings"
            fault = f"{self.place(row)}: the stamp is {_duration(step)} after {_moment(t_ns - step)} of the row before"
            self.notes.append(f"{fault}. To {aim}, set {remedy} in the time of [streams.{name}].")

    def _entry(self, **changes: object) -> str:
        """Return the entry of the layout with the changed time, and where it belongs."""
        return f"`time = {self.stream.time.entry(**changes)}` in [streams.{self.stream.name}]"

    def _places(self, rows: Sequence[int], count: int) -> str:
        names = ", ".join(self.place(row).removeprefix(f"{self.file}, ") for row in rows[:SHOWN_ROWS])
        return names + (f" and {count - SHOWN_ROWS} more" if count > SHOWN_ROWS else "")

    def _coarse_error(self, cause: str, t_ns: Times) -> ClockError:
        """Return the error for stamps whose resolution is coarser than the period."""
        distinct = np.unique(t_ns)
        rate_hz = float(f"{len(t_ns) / len(distinct) / np.diff(distinct).min() * SECOND_NS:.3g}")
        fault = (
            f"{self.file}: {self._equal} of {self._rows} rows of {self.stream.name} share a stamp with the row before"
        )
        replaced, placed = self._entry(rate_hz=rate_hz), self._entry(batch=True)
        return ClockError(
            f"{fault}, because {cause}. Write {replaced} with the true rate, which replaces the stamps, or {placed}, "
            f"{BATCH_AIM}.",
            batch=True,
        )

    def _order_error(self, t_ns: Times, steps: Times, backwards: Indices, rows: Indices) -> ClockError:
        """Return the error for the first stamp that is before the one above it, with the entry that repairs it."""
        time, index = self.stream.time, int(backwards[0])
        step = int(steps[index])
        usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
        following = [t_ns[start : start + MIN_ROWS].max() > t_ns[start] - steps[start] for start in backwards[:SAMPLED]]
        is_shuffled = float(np.mean(following)) > 0.5 or len(backwards) > len(t_ns) / MIN_ROWS
        changes: dict[str, Any]
        if wrap := _wrap(-step + usual, usual, time.unit):
            advice, changes = "A counter wraps there: write {}", {"wrap": wrap}
        elif time.is_text and time.zone == "UTC" and abs(-step - 3600 * SECOND_NS) < 60 * SECOND_NS:
            advice, changes = "If summer time ended there, write the zone, as in {}", {"zone": "Europe/Berlin"}
        elif is_shuffled:
            advice, changes = "Write {} to sort the rows", {"sort": True}
        else:
            advice, changes = (
                "If the clock was set there, write {}: each part becomes a recording",
                {"split_at_reset": True},
            )
        place, remedy = self.place(int(rows[index])), advice.format(self._entry(**changes))
        fault = f"{place}: the stamp is {-step / 1e9:g} s before that of the row above"
        return ClockError(f"{fault}. {remedy}.", **(changes | {"zone": UNKNOWN} if "zone" in changes else changes))


def coarse_cause(t_ns: Times, unit: str) -> str:
    """Return why stamps (row,) have a resolution of seconds, of a short float or of a few digits; "" if they do not.

    >>> coarse_cause(np.array([5, 5, 6, 7]) * 10**9, "s"), coarse_cause(np.array([5, 5, 6, 7]) * 10**8, "s")
    ('stamps are whole seconds', '')
    """
    distinct = np.unique(t_ns)[:SAMPLED]
    unit_ns = 10 ** stamps.DIGITS.get(unit, 9)
    values, step = distinct / unit_ns, float(np.diff(distinct).min()) / unit_ns
    for length, name in ((60 * SECOND_NS, "minutes"), (SECOND_NS, "seconds")):
        if step * unit_ns == length and not (distinct % length).any():
            return f"stamps are whole {name}"
    for kind in (np.float16, np.float32):
        with np.errstate(over="ignore", invalid="ignore"):
            rounded = values.astype(kind)
            spacing = float(np.spacing(np.abs(rounded).max()))
        if not step <= 1.5 * spacing:
            continue
        printed = np.array([float(str(value)) for value in rounded])
        if (np.minimum(np.abs(rounded - values), np.abs(printed - values)) <= step / 1000).all():
            return f"{kind.__name__} has a resolution of {spacing:g} {unit} at {values[-1]:.10g} {unit}"
    spacing = float(10.0 ** (np.floor(np.log10(max(np.abs(values).max(), 1e-9))) - 5))
    six_digits = np.array([float(f"{value:.6g}") for value in values])
    if step <= 1.5 * spacing and (np.abs(six_digits - values) <= step / 1000).all():
        return f"stamps have six digits, a resolution of {spacing:g} {unit}"
    return "" if (distinct % SECOND_NS).any() else "stamps are whole seconds"


def add_days_past_midnight(t_ns: Times, last_ns: int | None) -> Times:
    """Return times of day with a day added after each midnight; ``last_ns`` is the time before them.

    >>> add_days_past_midnight(np.array([86_399, 1]) * 10**9, None)
    array([86399000000000, 86401000000000])
    """
    day_ns = stamps.DAY_NS
    previous_ns = int(t_ns[0]) if last_ns is None else last_ns
    days = max(0, round((previous_ns - int(t_ns[0])) / day_ns))  # days before the first time
    return t_ns + (days + np.cumsum(np.diff(t_ns, prepend=t_ns[0]) < -day_ns // 2)) * day_ns


def _is_reset(steps: Times) -> Bools:
    """Return the rows before which the clock was set: backwards, or by more than a day."""
    return (steps < 0) | (steps > stamps.DAY_NS)


def _wrap(span_ns: float, usual_ns: float, unit: str) -> float:
    """Return the size of a counter in ``unit`` whose wrap explains a step back by ``span_ns``, or 0.

    Counters have 16, 24, 31 or 32 bits, and count units, ns, us, ms or s.

    >>> _wrap(2**32 * 1e3 + 10**7, 10**7, "us")
    4294967296.0
    """
    unit_ns = 10.0 ** stamps.DIGITS.get(unit, 9)
    for tick_ns in (unit_ns, 1.0, 1e3, 1e6, 1e9):
        for size_ns in (2.0**bits * tick_ns for bits in (16, 24, 31, 32)):
            if abs(span_ns - size_ns) <= max(2 * usual_ns, 1e-6 * size_ns) and usual_ns < size_ns / 100:
                return size_ns / unit_ns
    return 0.0


def _moment(t_ns: int) -> str:
    """Return a stamp as text.

    >>> _moment(1_718_000_000_500_000_000)
    '2024-06-10T06:13:20.5'
    """
    second, _, fraction = str(np.datetime64(t_ns, "ns")).partition(".")
    return f"{second}.{fraction.rstrip('0')}".rstrip(".")


def _duration(step_ns: int) -> str:
    """Return a duration of more than a day as text.

    >>> _duration(2 * 86_400 * 10**9), _duration(1_718_000_000 * 10**9)
    ('2.0 days', '54.4 years')
    """
    days = step_ns / stamps.DAY_NS
    return f"{days / 365.25:.1f} years" if days > 366 else f"{days:.1f} days"
