"""Guess the stamps of a file and what its columns measure, as the entries ``time`` and ``columns`` of a layout."""

from __future__ import annotations

import datetime
import json
import re
from collections.abc import Sequence

import numpy as np
import pyarrow as pa

from tacpipe.channels import vocabulary
from tacpipe.formats.table import column_names, label_table, stamp_formats, stamps
from tacpipe.formats.table.binary import ArrayMember
from tacpipe.formats.table.columns import TYPES
from tacpipe.formats.table.file_sample import FileSample, belongs_to
from tacpipe.formats.table.layout import UNKNOWN, quoted

_INTEGERS = (("uint16", 0, 2**16 - 1), ("int16", -(2**15), 2**15 - 1), ("int32", -(2**31), 2**31 - 1))


def column_entries(sample: FileSample, reserved: set[str]) -> list[str]:
    """Return the entries for the columns of a file that are not in ``reserved``, those of arrays first."""
    rules, array_columns = _array_entries(sample)
    names = [name for name in sample.names if name not in reserved | array_columns]
    return [*rules, *_column_entries(sample, names)]


def _array_entries(sample: FileSample) -> tuple[list[str], set[str]]:
    """Return an entry for each array with several values per row, and the columns of these arrays."""
    rules = []
    array_columns: set[str] = set()
    placed = [name for name, array in sample.arrays.items() if _shape(name, array)]
    for name in placed:
        array = sample.arrays[name]
        shape = _shape(name, array)
        kind = array.dtype.name if array.dtype.name in TYPES else "float64"
        axes = ["x", "y", "z"] if shape[-1] == 3 else []
        quantity, unit = column_names.meaning(name, kind)
        if quantity == UNKNOWN and shape == (3,):
            quantity, unit = column_names.meaning(f"{name}_x", kind)
        name_entry = (
            f'name = "{name}{{taxel}}{"_{axis}" if axes else ""}", '
            if len(placed) > 1 and quantity == "tactile"
            else ""
        )
        rule = f"match = {quoted(f'{name}_*')}, {name_entry}quantity = {quoted(quantity)}, unit = {quoted(unit)}"
        rule += f", type = {quoted(kind)}, shape = {list(shape)}" + (f", axes = {json.dumps(axes)}" if axes else "")
        rules.append(f"{{ {rule} }},")
        array_columns |= {column for column in sample.names if belongs_to(column, name)}
    return rules, array_columns


def _shape(name: str, array: ArrayMember) -> tuple[int, ...]:
    """Return the shape of an array's rows where it places values in a sensor or a vector, else nothing."""
    vector = array.row_shape == (3,)
    return (
        array.row_shape
        if len(array.row_shape) > 1 or vector or (array.width and column_names.meaning(name, "")[0] == "tactile")
        else ()
    )


def _column_entries(sample: FileSample, names: Sequence[str]) -> list[str]:
    """Return one entry per set of columns whose names differ only in numbers and whose values are alike."""
    by_rule: dict[tuple[str, ...], list[str]] = {}
    bases = {name: column_names.without_unit(name) for name in names}
    matches = {column_names.numbered_pattern(base) for base in bases.values()}
    components = {column_names.component(base) for base in bases.values()}
    for name, base in bases.items():
        kind = _kind([value for value in sample.values[name] if value is not None])
        quantity, unit = column_names.meaning(base, kind)
        unit = sample.stated_unit(name) or unit
        match, bracket = column_names.numbered_pattern(base), name.strip()[len(base) :]
        if quantity == "tactile" and {f"{match[:-1]}{axis}" for axis in "xyz"} <= matches:
            match = f"{match[:-1]}{{axis}}"
        by_rule.setdefault((match, bracket, quantity, unit, kind), []).append(name)
    rules = []
    for (match, bracket, quantity, unit, kind), members in by_rule.items():
        base = bases[members[0]] if len(members) == 1 else column_names.taxel_pattern(match, quantity, kind)
        is_place = {column_names.lower_name(bases[name]) for name in members} <= {"x", "y", "z"}
        if quantity == UNKNOWN and kind.startswith("float") and is_place:
            quantity = "position" if components >= set("xyzw") or unit in ("m", "cm", "mm") else quantity
        if kind == "text":
            rules.append(f"{{ match = {quoted(base + bracket)}, skip = true }},")
            continue
        renamed = column_names.identifier(base).lower() if bracket else column_names.identifier(base)
        name = f"name = {quoted(renamed)}, " if renamed != base + bracket else ""
        unlisted = len(members) >= 6 and "{" in base and not (sample.text and sample.text.header)
        comment = '  # of an array: add shape = [16, 3], axes = ["x", "y", "z"]' if unlisted else ""
        rules.append(
            f"{{ match = {quoted(base + bracket)}, {name}quantity = {quoted(quantity)}, unit = {quoted(unit)}, "
            f"type = {quoted(kind)} }},{comment}"
        )
    return sorted(rules, key=lambda rule: rule.partition("quantity")[0].count("{"))  # exact names before patterns


def _kind(values: Sequence[float | str]) -> str:
    """Return the type of a column, by the values of its first rows."""
    if not values or any(isinstance(value, str) for value in values):
        return "text" if values else "float64"
    if any(isinstance(value, bool) for value in values):
        return "bool"
    if not all(isinstance(value, int | float) for value in values):
        return "text"
    if any(isinstance(value, float) for value in values):  # also for 2.0: a later cell may hold 2.5
        return "float64"
    numbers = [int(value) for value in values]
    return next(
        (kind for kind, lowest, highest in _INTEGERS if lowest <= min(numbers) and max(numbers) <= highest), "float64"
    )


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
        return _text_stamp_entry(texts, source)
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


def _text_stamp_entry(texts: Sequence[str], source: str) -> str:
    """Return the entry ``time`` for stamps that are text, in the formats that read all of them with days in order."""
    fitting = []
    for text in _STAMP_FORMATS:
        t_ns, valid = stamp_formats.parse_stamps(pa.array(texts), text)
        if valid.all():
            fitting.append((int(t_ns.max() - t_ns.min()), text))
    if not fitting:
        return f'{{ {source}, format = "{UNKNOWN}" }}  # as strptime has it, for texts such as {quoted(texts[0])}'
    text = min(fitting)[1]
    if not stamp_formats.has_date(text):
        return f'{{ {source}, format = "{text}" }}  # the time of day; start = "2026-05-01" adds the day'
    alternatives = [candidate for span, candidate in fitting if candidate != text and span == min(fitting)[0]]
    return f'{{ {source}, format = "{text}" }}' + (f"  # or {', '.join(alternatives)}" if alternatives else "")
