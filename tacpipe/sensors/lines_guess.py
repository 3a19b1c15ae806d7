"""Guess the options of the sensor `lines` that fit all lines of a text.

What cannot be seen in the bytes is guessed: names, units, types, and which column counts or is a clock.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

import numpy as np

from tacpipe.arrays import Bools, Floats, Int64s, Times
from tacpipe.sensors import layout
from tacpipe.sensors.framing import Chunks, Pending
from tacpipe.sensors.line_layout import LineSum, line_sums
from tacpipe.sensors.sensor import Options, OptionValue

FEWEST = 5  # lines that a guess takes
MOST = 1000  # lines that are looked at
ALIKE = 0.8  # fraction of the lines that must be alike
SEPARATORS = ",;\t|: "  # separators, in the order in which they are tried
COMMENTS = ("#", "//", "%", ";")
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")
LABELLED = re.compile(r"([A-Za-z_][A-Za-z_0-9]*\s*[:=]\s*)(.*)")
LEAD = re.compile(r"[$!@A-Za-z_][^\d+\-.,;|\t ]*[,;|: \t]|[$!@<\[({]")
MARKED = re.compile(r"\*([0-9A-Fa-f]{2}|[0-9A-Fa-f]{4}|[0-9A-Fa-f]{8})$")
NAME = re.compile(r"[a-z][a-z0-9_]*")
MISSING = ("nan", "NaN", "NAN", "ovf", "inf", "")
SUMMED = ("xor8", "sum8", "crc8", "lrc", "sum16", "crc16-modbus", "crc16-ccitt", "crc32")
CLOCKS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
OFF = 0.2  # largest deviation of a clock from the arrivals of a second or two
STEADY = 0.9  # fraction of the steps of a counter that are alike
ROUND = 2  # significant digits of a rate


def of(data: Chunks) -> list[Options]:
    """Return the options of `Lines` for what came, at most one set; none where it is not lines of numbers."""
    lines, t_ns = _lines(data)
    comments = [mark for mark in COMMENTS if any(line.startswith(mark) for line in lines)]
    rows = [row for row, line in enumerate(lines) if line and not line.startswith(tuple(comments) or "\0")]
    texts, t_ns = [lines[row] for row in rows], t_ns[rows]
    if len(texts) < FEWEST:
        return []
    options: dict[str, OptionValue] = {}
    total, bodies = _sum(texts)
    cells_of_lines = _cells(bodies)
    if cells_of_lines is None:
        return []
    prefix, separator, suffix, decimal, cells, cell_rows = cells_of_lines
    t_ns = t_ns[cell_rows]
    labels, words = _labels(cells)
    if words is None or len(words) < FEWEST:
        return []
    missing = [word for word in MISSING if any(word in row for row in words)]
    numbers, is_integer = _numbers(words, decimal, missing)
    if numbers is None:
        return []
    names = _names([line.lstrip("#/%; ") for line in lines], separator, labels, len(words[0]), prefix, suffix)
    rate_hz = _rate_hz(t_ns)
    sequence = _counter(numbers, is_integer)
    clock = _clock(numbers, is_integer, t_ns, sequence)
    columns = _columns(names, labels, numbers, is_integer, sequence, clock)
    options |= {"rate_hz": rate_hz, "columns": columns}
    flat = [column["name"] for column in columns] if names else None
    options |= {} if separator == "," or len(labels) == 1 else {"separator": separator}
    options |= {} if decimal == "." else {"decimal": decimal}
    options |= {"prefix": prefix} if prefix else {}
    options |= {"suffix": suffix} if suffix else {}
    options |= {"missing": missing} if missing else {}
    options |= {"comments": comments} if comments else {}
    options |= {"sum": total} if total else {}
    if sequence is not None:
        step = _step(numbers[:, sequence])
        column = flat[sequence] if flat else "count"
        options["sequence"] = {"column": column, **({} if step == 1 else {"step": step})}
    if clock is not None:
        options["clock"] = {"column": flat[clock[0]] if flat else "device_time", "unit": clock[1]}
    return [options]


def _lines(data: Chunks) -> tuple[list[str], Times]:
    """Return the whole lines that came, with the arrival of each; no lines where they are not text."""
    pending = Pending()
    pending.append(data)
    stop = data.data.rfind(b"\n")
    raw = data.data[: stop + 1].split(b"\n")[:-1]
    ends = np.cumsum([len(line) + 1 for line in raw]) - 1 if raw else np.zeros(0, dtype=np.int64)
    first = int(not (raw and raw[0].startswith(tuple(mark.encode() for mark in COMMENTS))))  # others may be cut off
    raw, ends = raw[first : MOST + 1], ends[first : MOST + 1]
    try:
        lines = [line.strip().decode("ascii") for line in raw]
    except UnicodeDecodeError:
        lines = [line.strip().decode("ascii", "replace") for line in raw]
    return lines, pending.arrivals(ends) if len(ends) else np.zeros(0, dtype=np.int64)


def _sum(lines: Sequence[str]) -> tuple[dict[str, str | bool] | None, list[str]]:
    """Return the check sum that every line ends with, and the lines without it."""
    tail = max(ALIKE * len(lines), FEWEST)
    marks = ["*"] if sum(bool(MARKED.search(line)) for line in lines) >= tail else [",", ";", "\t", " "]
    for mark in marks:
        parted = [line.rpartition(mark) for line in lines if mark in line]
        if len(parted) < tail:
            continue
        for digits in ("hex", "decimal"):
            kind = _kind(parted, mark, digits)
            if kind is not None:
                return kind, [line.rpartition(mark)[0] for line in lines if mark in line]
    return None, list(lines)


def _kind(parted: Sequence[tuple[str, str, str]], mark: str, digits: str) -> dict[str, str | bool] | None:
    base = 16 if digits == "hex" else 10
    words = [options.strip() for _, _, options in parted]
    try:
        declared = np.array(
            [int(word, base) if not set(word) - set("0123456789abcdefABCDEF") else -1 for word in words]
        )
    except ValueError:
        return None
    if len(np.unique(declared)) < FEWEST:  # a constant, or a column that hardly moves
        return None
    begins = list(dict.fromkeys(["", *(body[:1] for body, _, _ in parted[:1] if not body[:1].isalnum())]))
    for kind in SUMMED:
        if digits == "hex" and max(map(len, words)) > 2 * layout.SUMS[kind][1]:
            continue
        for begin in begins:
            for through in (False, True):
                total = LineSum(kind=kind, mark=mark, begin=begin, mark_summed=through)  # type: ignore[arg-type]
                end = mark if through else ""
                texts = [(body.removeprefix(begin) + end).encode("ascii", "replace") for body, _, _ in parted]
                if (line_sums(texts, total) == declared).mean() >= STEADY:
                    options: dict[str, str | bool] = {"kind": kind, "mark": mark, "digits": digits, "begin": begin}
                    options["mark_summed"] = through
                    usual = {"mark": "*", "digits": "hex", "begin": "", "mark_summed": False}
                    return {name: value for name, value in options.items() if usual.get(name) != value}
    return None


def _cells(lines: Sequence[str]) -> tuple[str, str, str, str, list[list[str]], Int64s] | None:
    """Return prefix, separator, suffix, decimal mark, the cells of the lines that are alike, and which lines these are."""
    prefix = _shared(lines)
    bodies = [line.removeprefix(prefix) for line in lines]
    for separator in SEPARATORS:
        decimal = "."
        if separator != "," and any(DECIMAL_COMMA.search(line) for line in bodies):
            decimal = ","
        parted = [line.split(separator) if separator != " " else line.split() for line in bodies]
        width, count = Counter(map(len, parted)).most_common(1)[0]
        if count < ALIKE * len(lines) or (width == 1 and separator != " "):
            continue
        rows = [row for row, words in enumerate(parted) if len(words) == width]
        cells = [[word.strip() for word in parted[row]] for row in rows]
        suffix = ""
        if width > 1 and all(words[-1] == "" for words in cells):
            cells, suffix = [words[:-1] for words in cells], separator
        sound = [row for row, words in enumerate(cells) if _is_row(words, decimal)]
        if len(sound) >= ALIKE * len(lines):
            sound_rows = np.array(rows)[sound]
            return prefix, separator, suffix, decimal, [cells[row] for row in sound], sound_rows
    return None


def _shared(lines: Sequence[str]) -> str:
    """Return the text that nearly all lines begin with and that no number begins with; empty: none."""
    prefixes = Counter(match[0] for line in lines if (match := LEAD.match(line)))
    if not prefixes:
        return ""
    prefix, count = prefixes.most_common(1)[0]
    if count < ALIKE * len(lines) or prefix.rstrip(" \t").endswith((":", "=")):  # the prefix is a label
        return ""
    return prefix


def _is_row(words: Sequence[str], decimal: str) -> bool:
    """Return whether every cell is a number, a missing one, or one behind its label; and one at least a number."""
    words_of_row = [(match[2] if (match := LABELLED.fullmatch(word)) else word) for word in words]
    numbers = [bool(NUMBER.fullmatch(word.replace(decimal, "."))) for word in words_of_row]
    return any(numbers) and all(
        is_number or word in MISSING for is_number, word in zip(numbers, words_of_row, strict=True)
    )


def _labels(cells: Sequence[Sequence[str]]) -> tuple[list[str], list[list[str]] | None]:
    """Return the label of each cell, empty where there are none, and the cells without."""
    labels = [match[1] if (match := LABELLED.fullmatch(word)) else "" for word in cells[0]]
    if not any(labels):
        return labels, [list(words) for words in cells]
    alike = [words for words in cells if all(map(str.startswith, words, labels))]
    stripped = [[word[len(label) :].strip() for word, label in zip(words, labels, strict=True)] for words in alike]
    return [label.rstrip() for label in labels], stripped if len(alike) >= ALIKE * len(cells) else None


def _numbers(words: Sequence[Sequence[str]], decimal: str, missing: Sequence[str]) -> tuple[Floats | None, Bools]:
    """Return the cells as numbers (line, cell), NaN where missing, and which are whole in every line (cell,)."""
    plain = [["nan" if word in missing else word.replace(decimal, ".") for word in row] for row in words]
    try:
        numbers = np.array(plain, dtype=np.float64)
    except (ValueError, OverflowError):
        return None, np.zeros(0, dtype=bool)
    is_integer = [[bool(re.fullmatch(r"[+-]?\d+", word)) for word in row] for row in plain]
    return numbers, np.asarray(np.array(is_integer).all(axis=0))


def _names(
    lines: Sequence[str], separator: str, labels: Sequence[str], width: int, prefix: str, suffix: str
) -> list[str] | None:
    """Return the columns' names, by their labels or by a line that has as many words; None where nothing gives them."""
    candidates = [list(labels)] if any(labels) else []
    for line in lines:
        words = line.removeprefix(prefix).removesuffix(suffix).split(separator if separator != " " else None)
        candidates += (
            [words] if len(words) == width and not any(NUMBER.fullmatch(word.strip()) for word in words) else []
        )
    for words in candidates:
        names = [re.sub(r"[^a-z0-9]+", "_", word.strip().lower()).strip("_") for word in words]
        if all(NAME.fullmatch(name) for name in names) and len(set(names)) == width:
            return names
    return None


def _columns(
    names: list[str] | None,
    labels: Sequence[str],
    numbers: Floats,
    whole: Bools,
    sequence: int | None,
    clock: tuple[int, str] | None,
) -> list[dict[str, str]]:
    """Return the columns, those of a kind next to each other as one where nothing names them."""
    options: list[dict[str, str]] = []
    taxels = 0
    for place in range(len(whole)):
        role = place == sequence or (clock is not None and place == clock[0])
        kind = _type(numbers[:, place], is_integer=bool(whole[place]), role=role)
        label = {"label": labels[place]} if labels[place] else {}
        if names is not None:
            unit = {} if role or kind == "f32" else {"unit": "count"}
            options.append({"name": names[place], "type": kind, **unit, **label})
        elif role:
            options.append({"name": "count" if place == sequence else "device_time", "type": kind})
        else:
            taxels += 1
            unit = {} if kind == "f32" else {"unit": "count"}
            last = options[-1] if options else {}
            if last.get("type") == kind and last.get("name", "").startswith("taxel{"):
                last["name"] = re.sub(r"\.\.\d+", f"..{taxels}", last["name"])
            else:
                options.append({"name": f"taxel{{{taxels}..{taxels}}}", "type": kind, **unit})
    return options


def _type(numbers: Floats, *, is_integer: bool, role: bool) -> str:
    """Return a type that holds what came and what may come: 32 bits, or 64 where these are needed."""
    if not is_integer:
        return "f64" if role else "f32"
    largest = float(np.abs(numbers).max())
    if role:
        return "u32" if largest < 1 << 32 else "u64"
    return "i32" if largest < 1 << 31 else "i64"


def _rate_hz(t_ns: Times) -> float:
    span_ns = int(t_ns[-1] - t_ns[0])
    if span_ns <= 0:
        return 100.0
    rate_hz = (len(t_ns) - 1) * 1e9 / span_ns
    return float(f"{rate_hz:.{ROUND}g}")


def _step(numbers: Floats) -> int:
    return int(Counter(np.diff(numbers).astype(np.int64).tolist()).most_common(1)[0][0])


def _counter(numbers: Floats, is_integer: Bools) -> int | None:
    """Return the first column that grows by 1 with nearly every line, or by another number with all; None: none."""
    for place in np.flatnonzero(is_integer).tolist():
        steps = np.diff(numbers[:, place])
        if (steps == 1).mean() >= STEADY and numbers[:, place].min() >= 0:
            return int(place)
    return None


def _clock(numbers: Floats, is_integer: Bools, t_ns: Times, sequence: int | None) -> tuple[int, str] | None:
    """Return the column that grows as time does, and its unit; None: none, or all came at once."""
    span_ns = float(t_ns[-1] - t_ns[0])
    for place in range(numbers.shape[1]):
        values = numbers[:, place]
        if place == sequence or span_ns <= 0 or not np.isfinite(values).all() or (np.diff(values) < 0).any():
            continue
        ticks = float(values[-1] - values[0])
        for unit, unit_ns in CLOCKS.items():
            if (
                (is_integer[place] or unit in ("s", "ms"))
                and abs(ticks * unit_ns / span_ns - 1) < OFF
                and ticks > FEWEST
            ):
                return place, unit
            if not is_integer[place] and unit == "s" and abs(ticks * unit_ns / span_ns - 1) < OFF:
                return place, unit
    return None
