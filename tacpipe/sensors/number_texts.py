"""Parse numbers in many texts at once: in lines, and in XML messages that differ only in their numbers.

Functions return None if any text is unusual, so that the caller must parse the texts one by one. Results equal those of
`float`.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Floats, Int64s

SPACES = b" \t\r\n"
BLANKS = b" \t"  # characters allowed around a separator
NEWLINE = 0x0A
MAX_BYTES = (1 << 31) - 1  # limit of 32-bit offsets in a text
NUMBERS = re.compile(rb"(?<=[\">])-?\d+(?:\.\d+)?(?=[\"<])")  # numbers between quotes or tags of an XML text
FIRST = 1_000_000  # index of the first number in `replace_by_index`
UNSUPPORTED = (b"<?", b"<!", b"&", b"'", b"\0")  # XML syntax that patterns do not support
TEXT_END = b"\0"  # separator of texts, which XML cannot contain


def parse_lines(lines: Sequence[bytes], width: int) -> Floats | None:
    """Return the numbers (line, number) of lines with ``width`` numbers separated by spaces, or None if a line differs."""
    texts = cells(lines, width)
    numbers = None if texts is None else floats(texts)
    return None if numbers is None else numbers.reshape(len(lines), width)


def cells(lines: Sequence[bytes], width: int, separator: bytes = b"") -> pa.Array | None:
    """Return the cells of lines as a flat array (line × cell), or None if a line does not have ``width`` cells.

    ``separator`` is the byte between cells, which may have spaces around it. If it is empty, spaces of any length separate
    cells.

    >>> cells([b"1, 2", b",-3"], 2, b",").to_pylist()
    ['1', '2', '', '-3']
    """
    text = b"\n".join(lines) + b"\n"
    if not separator:
        return _spaced_cells(text, len(lines), width)
    blanks = BLANKS.replace(separator, b"")
    if any(blank in text for blank in (b" ", b"\t") if blank in blanks):
        if re.search(rb"[^\s%b][%b]+[^\s%b]" % (re.escape(separator), blanks, re.escape(separator)), text):
            return None  # spaces within a cell
        text = text.translate(None, blanks)
    data = np.frombuffer(text, np.uint8)
    marks = np.flatnonzero((data == separator[0]) | (data == NEWLINE))
    if len(marks) != len(lines) * width or (data[marks[width - 1 :: width]] != NEWLINE).any():
        return None
    ends = marks - np.arange(len(marks))  # ends of cells in the text without separators
    return _slice(text.translate(None, separator + b"\n"), np.concatenate([[0], ends]))


def _spaced_cells(text: bytes, count: int, width: int) -> pa.Array | None:
    """Return the cells of a text that are separated by spaces or tabs, as `cells` does; None if they cannot be split."""
    data = np.frombuffer(text, np.uint8)
    spaces = np.flatnonzero(data <= SPACES[0])
    without_spaces = text.translate(None, SPACES)
    if len(without_spaces) + len(spaces) != len(text):
        return None  # another control character
    ends = spaces - np.arange(len(spaces))  # ends of cells in ``without_spaces``, repeated for adjacent spaces
    last = np.flatnonzero(ends != np.concatenate([[0], ends[:-1]]))
    if len(last) != count * width or (data[spaces[last[width - 1 :: width]]] != NEWLINE).any():
        return None
    return _slice(without_spaces, np.concatenate([[0], ends[last]]))


@dataclass(frozen=True, eq=False)
class Pattern:
    """The parts of an XML text other than its numbers."""

    marks: int  # number of quotes and angle brackets
    before: Int64s  # (number,), index of the mark before each number; the next mark ends the number
    fixed_text: bytes  # the text without its numbers, and `TEXT_END`

    def extract(self, texts: Sequence[bytes]) -> pa.Array | None:
        """Return the texts of the numbers (text × number,), or None if a text does not have this pattern.

        The returned texts are between the right marks, but may not be numbers.
        """
        text = TEXT_END.join(texts) + TEXT_END
        marks = _mark_offsets(text)
        if len(marks) != len(texts) * self.marks:
            return None
        mark_offsets = marks.reshape(len(texts), self.marks)
        edges = np.empty((len(texts), len(self.before), 2), dtype=np.int64)  # (text, number, start and end)
        edges[:, :, 0] = mark_offsets[:, self.before] + 1
        edges[:, :, 1] = mark_offsets[:, self.before + 1]
        pieces = _slice(text, np.concatenate([[0], edges.ravel(), [len(text)]]))
        if pieces is None:
            return None
        between, numbers = (select_range(pieces, range(first, len(pieces), 2)) for first in (0, 1))
        return numbers if between.buffers()[2].to_pybytes() == self.fixed_text * len(texts) else None


def replace_by_index(text: bytes) -> bytes:
    """Replace each number in an XML text by its index, counted from `FIRST`.

    >>> replace_by_index(b'<a x="-1.5" y="yes">7</a>')
    b'<a x="1000000" y="yes">1000001</a>'
    """
    count = itertools.count(FIRST)
    return NUMBERS.sub(lambda _: b"%d" % next(count), text)


def pattern(text: bytes) -> Pattern | None:
    """Return the pattern of a text, or None if it has no numbers or unsupported XML syntax."""
    starts = np.array([match.start() for match in NUMBERS.finditer(text)])
    if not len(starts) or any(syntax in text for syntax in UNSUPPORTED):
        return None
    marks = _mark_offsets(text)
    return Pattern(len(marks), np.searchsorted(marks, starts) - 1, NUMBERS.sub(b"", text) + TEXT_END)


def _mark_offsets(text: bytes) -> Int64s:
    data = np.frombuffer(text, np.uint8)
    return np.flatnonzero((data == ord('"')) | (data == ord("<")) | (data == ord(">")))


def _slice(text: bytes, edges: Int64s) -> pa.Array | None:
    """Return the parts of a text between ``edges`` (part + 1,), or None if it is too long for 32-bit offsets."""
    if len(text) > MAX_BYTES:
        return None
    return pa.StringArray.from_buffers(len(edges) - 1, pa.py_buffer(edges.astype(np.int32)), pa.py_buffer(text))


def select_range(texts: pa.Array, rows: range) -> pa.Array:
    """Return the texts in a range of rows."""
    return select(texts, np.arange(rows.start, rows.stop, rows.step))


def select(texts: pa.Array, rows: Int64s) -> pa.Array:
    """Return the texts in these rows."""
    return texts.take(pa.Array.from_buffers(pa.int64(), len(rows), [None, pa.py_buffer(rows)]))


def concatenate(texts: pa.Array) -> bytes:
    """Return the concatenation of all texts."""
    _, offsets, data = texts.buffers()
    ends = np.frombuffer(offsets, np.int32)[texts.offset : texts.offset + len(texts) + 1]
    return data.to_pybytes()[int(ends[0]) : int(ends[-1])] if data is not None else b""


def with_content(texts: pa.Array, text: bytes) -> pa.Array:
    """Return texts of the same lengths with the content of ``text``, whose length is the total."""
    _, offsets, _ = texts.buffers()
    ends = np.frombuffer(offsets, np.int32)[texts.offset : texts.offset + len(texts) + 1]
    return pa.StringArray.from_buffers(len(texts), pa.py_buffer((ends - ends[0]).astype(np.int32)), pa.py_buffer(text))


def floats(texts: pa.Array) -> Floats | None:
    """Return the texts as floats (text,), or None if one is not a number."""
    return cast(texts, np.dtype(np.float64))


def integers(texts: pa.Array) -> Int64s | None:
    """Return the texts as integers (text,), or None if one is not an integer."""
    return cast(texts, np.dtype(np.int64))


def cast(texts: pa.Array, kind: np.dtype[Any]) -> AnyArray | None:
    """Return the texts as numbers (text,), or None if one is invalid.

    The result is a view of pyarrow's buffer, because its own conversion would import pandas.
    """
    try:
        numbers = texts.cast(kind.name)
    except pa.ArrowInvalid:
        return None
    return np.frombuffer(numbers.buffers()[1], kind, len(texts))
