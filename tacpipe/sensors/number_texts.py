"""Numbers in texts, read from many texts at once: from lines, and from texts that differ in nothing but their numbers.

A text that only a look at it by itself can read makes all of them unread (None): what is read here is what `float` reads.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyArray, Floats, Int64s

if TYPE_CHECKING:
    import pyarrow as pa


SPACES = b" \t\r\n"
BLANKS = b" \t"  # characters that may be around a separator
NEWLINE = 0x0A
MOST_BYTES = (1 << 31) - 1  # limit of 32-bit places in a text
NUMBERS = re.compile(rb"(?<=[\">])-?\d+(?:\.\d+)?(?=[\"<])")  # numbers between the marks of an XML text
FIRST = 1_000_000  # first identifier of a stored text
ODD = (b"<?", b"<!", b"&", b"'", b"\0")  # marks of an XML text other than quotes and tags
APART = b"\0"  # separator of texts, which no XML contains


def of_lines(lines: Sequence[bytes], width: int) -> Floats | None:
    """Return the numbers (line, number) of lines that hold ``width`` each, with space between; None where one does not."""
    texts = cells(lines, width)
    numbers = None if texts is None else floats(texts)
    return None if numbers is None else numbers.reshape(len(lines), width)


def cells(lines: Sequence[bytes], width: int, separator: bytes = b"") -> pa.Array | None:
    """Return the cells of lines (line times cell), one after another; None where a line has not ``width`` of them.

    ``separator`` is the byte between cells, which may have spaces around it; without one it is space of any length.

    >>> cells([b"1, 2", b",-3"], 2, b",").to_pylist()
    ['1', '2', '', '-3']
    """
    text = b"\n".join(lines) + b"\n"
    if not separator:
        return _spaced_cells(text, len(lines), width)
    blanks = BLANKS.replace(separator, b"")
    if any(blank in text for blank in (b" ", b"\t") if blank in blanks):
        if re.search(rb"[^\s%b][%b]+[^\s%b]" % (re.escape(separator), blanks, re.escape(separator)), text):
            return None  # space within a cell
        text = text.translate(None, blanks)
    data = np.frombuffer(text, np.uint8)
    marks = np.flatnonzero((data == separator[0]) | (data == NEWLINE))
    if len(marks) != len(lines) * width or (data[marks[width - 1 :: width]] != NEWLINE).any():
        return None
    ends = marks - np.arange(len(marks))  # ends of cells in the text without separators
    return _texts(text.translate(None, separator + b"\n"), np.concatenate([[0], ends]))


def _spaced_cells(text: bytes, count: int, width: int) -> pa.Array | None:
    data = np.frombuffer(text, np.uint8)
    spaces = np.flatnonzero(data <= SPACES[0])
    solid = text.translate(None, SPACES)
    if len(solid) + len(spaces) != len(text):
        return None  # another character below the space
    ends = spaces - np.arange(len(spaces))  # ends of cells in ``solid``, repeated where spaces are adjacent
    last = np.flatnonzero(ends != np.concatenate([[0], ends[:-1]]))
    if len(last) != count * width or (data[spaces[last[width - 1 :: width]]] != NEWLINE).any():
        return None
    return _texts(solid, np.concatenate([[0], ends[last]]))


@dataclass(frozen=True, eq=False)
class Pattern:
    """An XML text but for its numbers."""

    marks: int  # quotes and angle brackets in it
    before: Int64s  # (number,), which of these each follows; the next one ends it
    rest: bytes  # the text without its numbers, and what parts it from the next

    def written(self, texts: Sequence[bytes]) -> pa.Array | None:
        """Return the numbers of texts as they are written (text times number,); None where a text has another pattern.

        They stand between the right marks, but may be no numbers.
        """
        text = APART.join(texts) + APART
        marks = _marks(text)
        if len(marks) != len(texts) * self.marks:
            return None
        places = marks.reshape(len(texts), self.marks)
        edges = np.empty((len(texts), len(self.before), 2), dtype=np.int64)  # (text, number, start and end)
        edges[:, :, 0] = places[:, self.before] + 1
        edges[:, :, 1] = places[:, self.before + 1]
        pieces = _texts(text, np.concatenate([[0], edges.ravel(), [len(text)]]))
        if pieces is None:
            return None
        between, numbers = (taken(pieces, range(first, len(pieces), 2)) for first in (0, 1))
        return numbers if between.buffers()[2].to_pybytes() == self.rest * len(texts) else None


def numbered(text: bytes) -> bytes:
    """Return an XML text with the number of each number in its place, from `FIRST` on.

    >>> numbered(b'<a x="-1.5" y="yes">7</a>')
    b'<a x="1000000" y="yes">1000001</a>'
    """
    count = itertools.count(FIRST)
    return NUMBERS.sub(lambda _: b"%d" % next(count), text)


def pattern(text: bytes) -> Pattern | None:
    """Return the pattern of a text; None where it has no numbers, or parts that need more than a look at its marks."""
    starts = np.array([match.start() for match in NUMBERS.finditer(text)])
    if not len(starts) or any(odd in text for odd in ODD):
        return None
    marks = _marks(text)
    return Pattern(len(marks), np.searchsorted(marks, starts) - 1, NUMBERS.sub(b"", text) + APART)


def _marks(text: bytes) -> Int64s:
    data = np.frombuffer(text, np.uint8)
    return np.flatnonzero((data == ord('"')) | (data == ord("<")) | (data == ord(">")))


def _texts(text: bytes, edges: Int64s) -> pa.Array | None:
    """Return the pieces of a text between ``edges``; None where it is too long to state them."""
    import pyarrow as pa

    if len(text) > MOST_BYTES:
        return None
    return pa.StringArray.from_buffers(len(edges) - 1, pa.py_buffer(edges.astype(np.int32)), pa.py_buffer(text))


def taken(texts: pa.Array, rows: range) -> pa.Array:
    """Return some of the texts."""
    return at(texts, np.arange(rows.start, rows.stop, rows.step))


def at(texts: pa.Array, places: Int64s) -> pa.Array:
    """Return the texts at some places."""
    import pyarrow as pa

    return texts.take(pa.Array.from_buffers(pa.int64(), len(places), [None, pa.py_buffer(places)]))


def joined(texts: pa.Array) -> bytes:
    """Return all texts as one, without anything between them."""
    _, offsets, data = texts.buffers()
    ends = np.frombuffer(offsets, np.int32)[texts.offset : texts.offset + len(texts) + 1]
    return data.to_pybytes()[int(ends[0]) : int(ends[-1])] if data is not None else b""


def replaced(texts: pa.Array, text: bytes) -> pa.Array:
    """Return texts as long as these, cut from one that is as long as all of them."""
    import pyarrow as pa

    _, offsets, _ = texts.buffers()
    ends = np.frombuffer(offsets, np.int32)[texts.offset : texts.offset + len(texts) + 1]
    return pa.StringArray.from_buffers(len(texts), pa.py_buffer((ends - ends[0]).astype(np.int32)), pa.py_buffer(text))


def floats(texts: pa.Array) -> Floats | None:
    """Return the numbers (text,) of texts; None where one is none."""
    return cast(texts, np.dtype(np.float64))


def wholes(texts: pa.Array) -> Int64s | None:
    """Return the whole numbers (text,) of texts; None where one is none."""
    return cast(texts, np.dtype(np.int64))


def cast(texts: pa.Array, kind: np.dtype[Any]) -> AnyArray | None:
    """Return the numbers (text,) in the buffer that holds them: pyarrow would import pandas to make an array of them."""
    import pyarrow as pa

    try:
        numbers = texts.cast(kind.name)
    except pa.ArrowInvalid:
        return None
    return np.frombuffer(numbers.buffers()[1], kind, len(texts))
