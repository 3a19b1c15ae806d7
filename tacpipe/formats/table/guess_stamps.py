"""Guess the column of stamps in a file, and their unit or format."""

from __future__ import annotations

import datetime
import re
from collections.abc import Sequence

import numpy as np
import pyarrow as pa

from tacpipe.channels import vocabulary
from tacpipe.formats.table import column_names, label_table, stamp_formats, stamps
from tacpipe.formats.table.file_sample import FileSample
from tacpipe.formats.table.layout import UNKNOWN, quoted

_DAYS = ("", "%d.%m.%Y ", "%d/%m/%Y ", "%m/%d/%Y ", "%Y/%m/%d ", "%Y-%m-%d_", "%d-%m-%Y ", "%d %b %Y ", "%b %d %Y ")
_CLOCKS = ("%H:%M:%S.%f", "%H:%M:%S,%f", "%H-%M-%S.%f", "%H:%M")
_STAMP_FORMATS = (
    *(f"{day}{clock}" for clock in _CLOCKS for day in _DAYS),
    *("%Y%m%d_%H%M%S", "%Y%m%d %H%M%S", "%Y%m%d%H%M%S"),
)
_ISO = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d.*")


def time_column(sample: FileSample) -> str | None:
    """Return the column whose name is that of stamps, else the first column if its numbers rise, else None."""
    rising = [name for name in sample.names if rises(sample.values[name]) and not label_table.RECORDING.fullmatch(name)]
    stamped = {
        name
        for name in sample.names
        if name in rising
        or any(isinstance(value, str | datetime.datetime | datetime.time) for value in sample.values[name])
    }
    for time_name in (column_names.TIME_NAME, column_names.TIME_ENDING):
        for name in sample.names:
            if name in stamped and time_name.fullmatch(column_names.without_unit(name)):
                return name
    return rising[0] if rising and rising[0] == sample.names[0] else None


def rises(values: Sequence[float | str | None]) -> bool:
    """Return whether all values are numbers that never fall, the last above the first."""
    numbers = [value for value in values if isinstance(value, int | float)]
    return (
        len(numbers) == len(values) > 1
        and bool(np.all(np.diff(np.array(numbers, float)) >= 0))
        and numbers[-1] > numbers[0]
    )


def time_entry(sample: FileSample, column: str | None, file: str = "") -> str:
    """Return the entry ``time`` for stamps in a column; ``file`` is the entry of the file of stamps, if there is one."""
    if column is None:
        return f'{{ rate_hz = "{UNKNOWN}" }}  # no column rises as stamps do; write the rate'
    source = file or f"column = {quoted(column)}"
    values = sample.values[column]
    texts = [value for value in values if isinstance(value, str)]
    if any(isinstance(value, datetime.datetime | datetime.time) for value in values):
        return f"{{ {source} }}"
    if any(_ISO.match(text) for text in texts):
        return f'{{ {source}, unit = "iso8601" }}'
    if texts:
        return _text_entry(texts, source)
    first = next((abs(value) for value in values if isinstance(value, int | float)), 0.0)
    for limit, unit in ((1e11, "s"), (1e14, "ms"), (1e17, "us"), (float("inf"), "ns")):
        if 1e8 <= first < limit:
            return f'{{ {source}, unit = "{unit}" }}'
    suffix = re.search(r"(?:^|[_ ])(ms|us|ns|s|sec|seconds)$", column_names.without_unit(column), re.IGNORECASE)
    unit_text = sample.stated_unit(column) or vocabulary.unit_from_text(suffix[1] if suffix else "")
    steps = np.diff([value for value in values if isinstance(value, float)])
    if not unit_text and len(steps) and 0 < float(np.median(steps)) < 0.5:
        unit_text = "s"  # steps this small in ms would be thousands of rows per second
    unit = unit_text if unit_text in stamps.DIGITS else UNKNOWN
    return f'{{ {source}, unit = "{unit}", origin = "start" }}  # counts from the start of the recording'


def _text_entry(texts: Sequence[str], source: str) -> str:
    """Return the entry ``time`` for stamps that are text, in the formats that read all of them with days in order."""
    fitting = []
    for text in _STAMP_FORMATS:
        t_ns, valid = stamp_formats.nanoseconds(pa.array(texts), text)
        if valid.all():
            fitting.append((int(t_ns.max() - t_ns.min()), text))
    if not fitting:
        return f'{{ {source}, format = "{UNKNOWN}" }}  # as strptime has it, for texts such as {quoted(texts[0])}'
    text = min(fitting)[1]
    if not stamp_formats.has_date(text):
        return f'{{ {source}, format = "{text}" }}  # the time of day; start = "2026-05-01" adds the day'
    alternatives = [candidate for span, candidate in fitting if candidate != text and span == min(fitting)[0]]
    return f'{{ {source}, format = "{text}" }}' + (f"  # or {', '.join(alternatives)}" if alternatives else "")
