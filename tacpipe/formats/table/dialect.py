"""How a text file is written, found from its first lines: separator, decimal sign, comments, header."""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tacpipe.formats.table import compressed

LINES = 200  # lines sampled per file
HEAD_BYTES = 1 << 20  # bytes sampled per file, at most
SEPARATORS = (",", ";", "\t", "|", " ")
COMMENTS = ("#", "%", "//")
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_WHOLE = re.compile(r"[-+]?\d{1,18}")
_COMMA_NUMBER = re.compile(r"[-+]?\d+(,\d+)?([eE][-+]?\d+)?")
MISSING = ("", "NA", "N/A", "nan", "NaN", "null", "None", "-")


@dataclass(frozen=True)
class Dialect:
    """What `of` found, with the cells of the lines that it looked at."""

    separator: str
    decimal: Literal[".", ","]
    comment: str
    skip_lines: int
    header: bool
    names: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...] = field(repr=False)  # below the header
    missing: tuple[str, ...] = ()  # cells of MISSING that are there
    units: tuple[str, ...] = ()  # units of the columns, if the row below the header holds them

    def number(self, cell: str) -> float | None:
        """Return the number that a cell holds, an int where it is written as one, None where it holds none.

        >>> of(["a;b", "1,5;x"]).number("1,5"), of(["1,2.0"]).number("2.0"), of(["1,2.0"]).number("1")
        (1.5, 2.0, 1)
        """
        text = cell.strip()
        if _WHOLE.fullmatch(text):
            return int(text)
        if self.decimal == ",":
            return float(text.replace(",", ".")) if _COMMA_NUMBER.fullmatch(text) else None
        return float(text) if _NUMBER.fullmatch(text) else None


def encoding(path: Path) -> str:
    """Return the encoding of a text file, from its first bytes: UTF-16 by its mark, UTF-8, or else that of Windows."""
    with compressed.opened(path) as file:
        content = file.read(HEAD_BYTES)
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(content)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def first_lines(path: Path, encoding: str = "utf-8") -> list[str]:
    """Return the first lines of a text file, without one that is cut."""
    with compressed.opened(path, encoding) as file:
        content = file.read(HEAD_BYTES)
    lines = content.decode(errors="replace").splitlines(keepends=True)
    return lines[: min(LINES, len(lines) - (len(content) == HEAD_BYTES and len(lines) > 1))]


def of(lines: Sequence[str]) -> Dialect:
    """Return how these lines, the first of a file, are written.

    >>> found = of(["# made by x", "t;fx", "0,1;3,5", "0,2;4"])
    >>> found.separator, found.decimal, found.comment, found.header, found.names
    (';', ',', '#', True, ('t', 'fx'))
    >>> of(["1.5,2", "2.5,3"]).names
    ('column1', 'column2')
    """
    texts = [line.rstrip("\r\n").removeprefix("\ufeff") for line in lines]
    comment = next((mark for mark in COMMENTS if any(text.lstrip().startswith(mark) for text in texts)), "")
    kept = [text for text in texts if text.strip() and not (comment and text.lstrip().startswith(comment))]
    separator, width = _separator(kept)
    cells = [tuple(cell.strip() for cell in next(csv.reader([text], delimiter=separator))) for text in kept]
    skip = next((number for number, row in enumerate(cells) if len(row) == width), 0)
    rows = [row for row in cells[skip:] if len(row) == width]
    decimal = _decimal(rows, separator)
    probe = Dialect(separator, decimal, comment, 0, False, (), ())
    header = bool(rows) and _is_header(rows, probe)
    names = rows[0] if header else tuple(f"column{number}" for number in range(1, width + 1))
    units: tuple[str, ...] = ()
    if header and len(rows) > 2 and _is_text(rows[1], probe) and not _is_text(rows[2], probe):
        units, rows = rows[1], [rows[0], *rows[2:]]
    below = rows[1:] if header else rows
    missing = sorted({cell for row in below for cell in row if cell in MISSING})
    before = 0
    if units:  # the first row below them
        before = next(number for number, text in enumerate(texts) if text == kept[skip + 1]) + 1
    elif skip:  # lines of the file before the header, comments and blank ones among them
        before = next(number for number, text in enumerate(texts) if text == kept[skip])
    return Dialect(separator, decimal, comment, before, header, tuple(names), tuple(below), tuple(missing), units)


def _is_text(row: Sequence[str], probe: Dialect) -> bool:
    """Return whether no cell of a row holds a number."""
    return all(probe.number(cell) is None for cell in row)


def _separator(kept: Sequence[str]) -> tuple[str, int]:
    """Return the separator that gives most lines the same number of cells, and that number."""
    best = (0.0, 0, ",", 1)
    for rank, separator in enumerate(SEPARATORS):
        widths = Counter(len(next(csv.reader([text], delimiter=separator), [])) for text in kept)
        wide = Counter({width: count for width, count in widths.items() if width > 1})
        if not wide:
            continue
        width, count = wide.most_common(1)[0]
        score = count / len(kept)
        if separator == "," and score < 1 and any(";" in text for text in kept):
            score /= 2  # commas may be decimal ones
        best = max(best, (score, -rank, separator, width))
    return best[2], best[3]


def _decimal(rows: Sequence[tuple[str, ...]], separator: str) -> Literal[".", ","]:
    cells = [cell for row in rows for cell in row]
    commas = sum("," in cell and bool(_COMMA_NUMBER.fullmatch(cell)) for cell in cells)
    points = sum("." in cell and bool(_NUMBER.fullmatch(cell)) for cell in cells)
    return "," if separator != "," and commas > points else "."


def _is_header(rows: Sequence[tuple[str, ...]], probe: Dialect) -> bool:
    """Return whether the first row holds names: fewer numbers than the rows below it."""
    first = [probe.number(cell) is not None for cell in rows[0]]
    if not any(not number and cell not in MISSING for number, cell in zip(first, rows[0], strict=True)):
        return False
    if len(rows) == 1:
        return not any(first)
    below = [probe.number(cell) is not None for cell in rows[1]]
    return sum(first) < sum(below) or not any(first)
