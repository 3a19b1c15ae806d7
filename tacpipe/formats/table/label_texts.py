"""Files of labels as text: rows of a CSV, cells as the values that they are written as."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path

from tacpipe.errors import TacpipeError
from tacpipe.io import regular
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt

MOST_BYTES = 1 << 26  # of a file of labels


def plain_value(text: str) -> Attribute:
    """Return what a cell's text means: true, false, a number where it is written as one, else text.

    A number with leading zeros is text, as it is most often a name.

    >>> [plain_value(text) for text in ("3", "0.5", "007", "true", "cork", "", "nan")]
    [3, 0.5, '007', True, 'cork', None, 'nan']
    """
    text = text.strip()
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    if not text:
        return None
    digits = text.lstrip("-")
    if digits.isascii() and digits.isdigit() and (digits == "0" or not digits.startswith("0")):
        return int(text) if len(digits) < 19 else text
    try:
        number = float(text)
    except ValueError:
        return text
    finite = number == number and abs(number) != float("inf")
    return number if finite and not digits.startswith("00") and "_" not in text and not digits.isdigit() else text


def read_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the cells of each line that holds some, the header first; all are as wide as it."""
    text = read_text(path)
    separator = "\t" if path.suffix.lower() == ".tsv" else (";" if ";" in text.partition("\n")[0] else ",")
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
    header: list[str] = []
    for cells in reader:
        if not any(cell.strip() for cell in cells):
            continue
        header = header or cells
        if len(cells) != len(header):
            raise TacpipeError(
                f"{path}, line {reader.line_num} has {len(cells)} cells under a header of {len(header)}."
            )
        yield reader.line_num, [cell.strip() for cell in cells]


def read_text(path: Path) -> str:
    """Return the text of a file of labels. Raises `TacpipeError` for one that is too large or not UTF-8."""
    with regular.failing(path):
        content = regular.content(path, MOST_BYTES)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise TacpipeError(
            f"{path} is not UTF-8: byte {error.start} is {excerpt(content[error.start : error.end])}."
        ) from error
