"""Guess the options of the sensor `lines` from received text.

Names, units, types, and the columns that are a counter or a clock are guesses, because the bytes do not show them.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tacpipe.arrays import Bools, Floats, Int64s, Times
from tacpipe.sensors import layout
from tacpipe.sensors.framing import ByteBuffer, Chunks
from tacpipe.sensors.line_layout import LineSum, line_sums
from tacpipe.sensors.sensor import Options, OptionValue

MIN_LINES = 5  # minimum number of lines for a guess
MAX_LINES = 1000  # maximum number of examined lines
MIN_SHARE = 0.8  # smallest fraction of the lines that must have the same layout
SEPARATORS = ",;\t|: "  # separators in the order in which they are tried
COMMENTS = ("#", "//", "%", ";")
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")
LABEL = re.compile(r"([A-Za-z_][A-Za-z_0-9]*\s*[:=]\s*)(.*)")
PREFIX = re.compile(r"[$!@A-Za-z_][^\d+\-.,;|\t ]*[,;|: \t]|[$!@<\[({]")
CHECKSUM = re.compile(r"\*([0-9A-Fa-f]{2}|[0-9A-Fa-f]{4}|[0-9A-Fa-f]{8})$")
NAME = re.compile(r"[a-z][a-z0-9_]*")
MISSING = ("nan", "NaN", "NAN", "ovf", "inf", "")
SUM_KINDS = ("xor8", "sum8", "crc8", "lrc", "sum16", "crc16-modbus", "crc16-ccitt", "crc32")
CLOCKS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
CLOCK_TOLERANCE = 0.2  # largest relative deviation of a clock from the arrival times of a second or two
MIN_MATCHING = 0.9  # smallest fraction of matching checksums, and of equal steps of a counter
RATE_DIGITS = 2  # significant digits of a rate


def guess_options(data: Chunks) -> list[Options]:
    """Return one set of options of `Lines` for the received bytes, or an empty list if they are not lines of numbers."""
    lines, t_ns = _lines(data)
    comments = [mark for mark in COMMENTS if any(line.startswith(mark) for line in lines)]
    rows = [row for row, line in enumerate(lines) if line and not line.startswith(tuple(comments) or "\0")]
    texts, t_ns = [lines[row] for row in rows], t_ns[rows]
    if len(texts) < MIN_LINES:
        return []
    options: dict[str, OptionValue] = {}
    checksum, bodies = _guess_sum(texts)
    layout = _split_cells(bodies)
    if layout is None:
        return []
    prefix, separator, suffix, decimal, cells, cell_rows = layout
    t_ns = t_ns[cell_rows]
    labels, words = _labels(cells)
    if words is None or len(words) < MIN_LINES:
        return []
    missing = [word for word in MISSING if any(word in row for row in words)]
    numbers, is_integer = _numbers(words, decimal, missing)
    if numbers is None:
        return []
    names = _names([line.lstrip("#/%; ") for line in lines], separator, labels, len(words[0]), prefix, suffix)
    rate_hz = _rate_hz(t_ns)
    sequence = _find_counter(numbers, is_integer)
    clock = _find_clock(numbers, is_integer, t_ns, sequence)
    columns = _columns(names, labels, numbers, is_integer, sequence, clock)
    options |= {"rate_hz": rate_hz, "columns": columns}
    column_names = [column["name"] for column in columns] if names else None
    options |= {} if separator == "," or len(labels) == 1 else {"separator": separator}
    options |= {} if decimal == "." else {"decimal": decimal}
    options |= {"prefix": prefix} if prefix else {}
    options |= {"suffix": suffix} if suffix else {}
    options |= {"missing": missing} if missing else {}
    options |= {"comments": comments} if comments else {}
    options |= {"sum": checksum} if checksum else {}
    if sequence is not None:
        step = _step(numbers[:, sequence])
        column = column_names[sequence] if column_names else "count"
        options["sequence"] = {"column": column, **({} if step == 1 else {"step": step})}
    if clock is not None:
        options["clock"] = {"column": column_names[clock[0]] if column_names else "device_time", "unit": clock[1]}
    return [options]


def _lines(data: Chunks) -> tuple[list[str], Times]:
    """Return the complete lines, and the arrival of each (line,) in ns."""
    buffer = ByteBuffer()
    buffer.append(data)
    stop = data.data.rfind(b"\n")
    raw = data.data[: stop + 1].split(b"\n")[:-1]
    ends = np.cumsum([len(line) + 1 for line in raw]) - 1 if raw else np.zeros(0, dtype=np.int64)
    # the first line may be incomplete
    first = int(not (raw and raw[0].startswith(tuple(mark.encode() for mark in COMMENTS))))
    raw, ends = raw[first : MAX_LINES + 1], ends[first : MAX_LINES + 1]
    try:
        lines = [line.strip().decode("ascii") for line in raw]
    except UnicodeDecodeError:
        lines = [line.strip().decode("ascii", "replace") for line in raw]
    return lines, buffer.arrivals(ends) if len(ends) else np.zeros(0, dtype=np.int64)


def _guess_sum(lines: Sequence[str]) -> tuple[dict[str, str | bool] | None, list[str]]:
    """Return the options of the checksum at the end of the lines, or None, and the lines without it.

    Lines without the mark of the checksum are left out.
    """
    min_count = max(MIN_SHARE * len(lines), MIN_LINES)
    separators = ["*"] if sum(bool(CHECKSUM.search(line)) for line in lines) >= min_count else [",", ";", "\t", " "]
    for separator in separators:
        split_lines = [line.rpartition(separator) for line in lines if separator in line]
        if len(split_lines) < min_count:
            continue
        for digits in ("hex", "decimal"):
            options = _sum_options(split_lines, separator, digits)
            if options is not None:
                return options, [line.rpartition(separator)[0] for line in lines if separator in line]
    return None, list(lines)


def _sum_options(split_lines: Sequence[tuple[str, str, str]], mark: str, digits: str) -> dict[str, str | bool] | None:
    """Return the options of a checksum that nearly all lines match, or None if there are none.

    ``split_lines`` contains body, mark and checksum of each line; ``digits`` is the notation of the checksum.
    """
    base = 16 if digits == "hex" else 10
    words = [word.strip() for _, _, word in split_lines]
    try:
        declared = np.array(
            [int(word, base) if not set(word) - set("0123456789abcdefABCDEF") else -1 for word in words]
        )
    except ValueError:
        return None
    if len(np.unique(declared)) < MIN_LINES:  # a constant, or a column that hardly changes
        return None
    begins = list(dict.fromkeys(["", *(body[:1] for body, _, _ in split_lines[:1] if not body[:1].isalnum())]))
    for kind in SUM_KINDS:
        if digits == "hex" and max(map(len, words)) > 2 * layout.SUMS[kind][1]:
            continue
        for begin in begins:
            for mark_summed in (False, True):
                total = LineSum(kind=kind, mark=mark, begin=begin, mark_summed=mark_summed)  # type: ignore[arg-type]
                end = mark if mark_summed else ""
                texts = [(body.removeprefix(begin) + end).encode("ascii", "replace") for body, _, _ in split_lines]
                if (line_sums(texts, total) == declared).mean() >= MIN_MATCHING:
                    options: dict[str, str | bool] = {"kind": kind, "mark": mark, "digits": digits, "begin": begin}
                    options["mark_summed"] = mark_summed
                    defaults = {"mark": "*", "digits": "hex", "begin": "", "mark_summed": False}
                    return {name: value for name, value in options.items() if defaults.get(name) != value}
    return None


class _CellLayout(NamedTuple):
    """The layout that most lines have, and the cells of these lines."""

    prefix: str
    separator: str
    suffix: str
    decimal: str
    cells: list[list[str]]  # (line, cell)
    rows: Int64s  # (line,), index of each of these lines


def _split_cells(lines: Sequence[str]) -> _CellLayout | None:
    """Return the layout that most lines have, with their cells, or None if no separator fits most lines."""
    prefix = _common_prefix(lines)
    bodies = [line.removeprefix(prefix) for line in lines]
    for separator in SEPARATORS:
        decimal = "."
        if separator != "," and any(DECIMAL_COMMA.search(line) for line in bodies):
            decimal = ","
        words_by_line = [line.split(separator) if separator != " " else line.split() for line in bodies]
        width, count = Counter(map(len, words_by_line)).most_common(1)[0]
        if count < MIN_SHARE * len(lines) or (width == 1 and separator != " "):
            continue
        rows = [row for row, words in enumerate(words_by_line) if len(words) == width]
        cells = [[word.strip() for word in words_by_line[row]] for row in rows]
        suffix = ""
        if width > 1 and all(words[-1] == "" for words in cells):
            cells, suffix = [words[:-1] for words in cells], separator
        valid = [row for row, words in enumerate(cells) if _is_row(words, decimal)]
        if len(valid) >= MIN_SHARE * len(lines):
            valid_cells = [cells[row] for row in valid]
            return _CellLayout(prefix, separator, suffix, decimal, valid_cells, np.array(rows)[valid])
    return None


def _common_prefix(lines: Sequence[str]) -> str:
    """Return the text before the first number of most lines, or "" if they have no common prefix."""
    prefixes = Counter(match[0] for match in map(PREFIX.match, lines) if match)
    if not prefixes:
        return ""
    prefix, count = prefixes.most_common(1)[0]
    if count < MIN_SHARE * len(lines) or prefix.rstrip(" \t").endswith((":", "=")):  # the prefix is a label
        return ""
    return prefix


def _is_row(words: Sequence[str], decimal: str) -> bool:
    """Return whether every cell is a number or a missing value, with or without label, and at least one is a number."""
    matches = [LABEL.fullmatch(word) for word in words]
    words_without_labels = [match[2] if match else word for match, word in zip(matches, words, strict=True)]
    numbers = [bool(NUMBER.fullmatch(word.replace(decimal, "."))) for word in words_without_labels]
    return any(numbers) and all(
        is_number or word in MISSING for is_number, word in zip(numbers, words_without_labels, strict=True)
    )


def _labels(cells: Sequence[Sequence[str]]) -> tuple[list[str], list[list[str]] | None]:
    """Return the label before each number of the first line, or "", and the cells (line, cell) without their labels.

    Lines with different labels are left out. The cells are None if too few lines remain.
    """
    matches = [LABEL.fullmatch(word) for word in cells[0]]
    labels = [match[1] if match else "" for match in matches]
    if not any(labels):
        return labels, [list(words) for words in cells]
    labelled = [words for words in cells if all(map(str.startswith, words, labels))]
    stripped = [[word[len(label) :].strip() for word, label in zip(words, labels, strict=True)] for words in labelled]
    has_labels = len(labelled) >= MIN_SHARE * len(cells)
    return [label.rstrip() for label in labels], stripped if has_labels else None


def _numbers(words: Sequence[Sequence[str]], decimal: str, missing: Sequence[str]) -> tuple[Floats | None, Bools]:
    """Return the cells as numbers (line, cell), NaN if missing, and a mask (cell,) of those that are always integers.

    The numbers are None if a cell is not a number.
    """
    float_texts = [["nan" if word in missing else word.replace(decimal, ".") for word in row] for row in words]
    try:
        numbers = np.array(float_texts, dtype=np.float64)
    except (ValueError, OverflowError):
        return None, np.zeros(0, dtype=bool)
    is_integer = [[bool(re.fullmatch(r"[+-]?\d+", text)) for text in row] for row in float_texts]
    return numbers, np.asarray(np.array(is_integer).all(axis=0))


def _names(
    lines: Sequence[str], separator: str, labels: Sequence[str], width: int, prefix: str, suffix: str
) -> list[str] | None:
    """Return the names of the columns from labels or a header line, or None if there are none."""
    candidates = [list(labels)] if any(labels) else []
    for line in lines:
        words = line.removeprefix(prefix).removesuffix(suffix).split(separator if separator != " " else None)
        if len(words) == width and not any(NUMBER.fullmatch(word.strip()) for word in words):
            candidates.append(words)
    for words in candidates:
        names = [re.sub(r"[^a-z0-9]+", "_", word.strip().lower()).strip("_") for word in words]
        if all(NAME.fullmatch(name) for name in names) and len(set(names)) == width:
            return names
    return None


def _columns(
    names: list[str] | None,
    labels: Sequence[str],
    numbers: Floats,
    is_integer: Bools,
    sequence: int | None,
    clock: tuple[int, str] | None,
) -> list[dict[str, str]]:
    """Return the option ``columns``. Adjacent columns of one type without names become one array.

    ``sequence`` is the index of the counter, ``clock`` the index and unit of the clock, each None if there is none.
    """
    options: list[dict[str, str]] = []
    taxels = 0
    for column in range(len(is_integer)):
        has_role = column == sequence or (clock is not None and column == clock[0])
        kind = _type(numbers[:, column], is_integer=bool(is_integer[column]), has_role=has_role)
        label = {"label": labels[column]} if labels[column] else {}
        if names is not None:
            unit = {} if has_role or kind == "f32" else {"unit": "count"}
            options.append({"name": names[column], "type": kind, **unit, **label})
        elif has_role:
            options.append({"name": "count" if column == sequence else "device_time", "type": kind})
        else:
            taxels += 1
            unit = {} if kind == "f32" else {"unit": "count"}
            previous = options[-1] if options else {}
            if previous.get("type") == kind and previous.get("name", "").startswith("taxel{"):
                previous["name"] = re.sub(r"\.\.\d+", f"..{taxels}", previous["name"])
            else:
                options.append({"name": f"taxel{{{taxels}..{taxels}}}", "type": kind, **unit})
    return options


def _type(numbers: Floats, *, is_integer: bool, has_role: bool) -> str:
    """Return a type for the column: 32 bits, or 64 if they are needed for the values or for a clock."""
    if not is_integer:
        return "f64" if has_role else "f32"
    largest = float(np.abs(numbers).max())
    if has_role:
        return "u32" if largest < 1 << 32 else "u64"
    return "i32" if largest < 1 << 31 else "i64"


def _rate_hz(t_ns: Times) -> float:
    """Return the rate of the lines in Hz, rounded to `RATE_DIGITS`, or 100 if they all arrived at once."""
    span_ns = int(t_ns[-1] - t_ns[0])
    if span_ns <= 0:
        return 100.0
    rate_hz = (len(t_ns) - 1) * 1e9 / span_ns
    return float(f"{rate_hz:.{RATE_DIGITS}g}")


def _step(numbers: Floats) -> int:
    return int(Counter(np.diff(numbers).astype(np.int64).tolist()).most_common(1)[0][0])


def _find_counter(numbers: Floats, is_integer: Bools) -> int | None:
    """Return the first column that increases by 1 with nearly every line, or None."""
    for column in np.flatnonzero(is_integer).tolist():
        steps = np.diff(numbers[:, column])
        if (steps == 1).mean() >= MIN_MATCHING and numbers[:, column].min() >= 0:
            return int(column)
    return None


def _find_clock(numbers: Floats, is_integer: Bools, t_ns: Times, sequence: int | None) -> tuple[int, str] | None:
    """Return the index and unit of the first column that increases with time, or None."""
    span_ns = float(t_ns[-1] - t_ns[0])
    for column in range(numbers.shape[1]):
        values = numbers[:, column]
        if column == sequence or span_ns <= 0 or not np.isfinite(values).all() or (np.diff(values) < 0).any():
            continue
        ticks = float(values[-1] - values[0])
        for unit, unit_ns in CLOCKS.items():
            if (
                (is_integer[column] or unit in ("s", "ms"))
                and abs(ticks * unit_ns / span_ns - 1) < CLOCK_TOLERANCE
                and ticks > MIN_LINES
            ):
                return column, unit
            if not is_integer[column] and unit == "s" and abs(ticks * unit_ns / span_ns - 1) < CLOCK_TOLERANCE:
                return column, unit
    return None
