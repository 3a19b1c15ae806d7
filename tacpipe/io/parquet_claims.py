"""What the columns of a Parquet file declare, counted page by page before anything is unpacked.

A file of some hundred bytes can declare any number of rows, and a page any size: pyarrow checks neither, and takes the
memory. Every page has a header (https://parquet.apache.org/docs/file-format/, Thrift's compact protocol) that states its
size once unpacked and how many values it holds; these must be the columns' own totals. Values that are stored as
differences or runs may be as many as one likes, so what they would take is compared with the memory that is left.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from pyarrow.parquet import ParquetSchema

DATA, DICTIONARY = 0, 2  # kinds of pages
PLAIN, DELTA_LENGTH = 0, 6  # encodings of texts that are as long as what represents them
INDEXES = (2, 8)  # encodings of texts that stand in a dictionary
INDEX = 4  # bytes of a place in a dictionary, in memory
WIDTHS = {"BOOLEAN": 1, "INT32": 4, "INT64": 8, "INT96": 12, "FLOAT": 4, "DOUBLE": 8}  # bytes of a value in memory
OFFSET = 8  # bytes that a text takes beside its own
_VARINT = rb"([\x80-\xff]*[\x00-\x7f])"
_USUAL = re.compile(  # kind 0, unpacked size, size, maybe a check sum, and of its values the number and the encoding
    rb"\x15\x00\x15%b\x15%b(?:\x15%b\x1c|\x2c)\x15%b\x15(.)\x15.\x15.(?:\x1c\x00)?\x00\x00" % ((_VARINT,) * 4),
    re.DOTALL,
)
DEEPEST = 8  # structures within one another in a page's header


class Page(NamedTuple):
    """What a page's header states."""

    kind: int
    unpacked: int  # bytes
    size: int  # bytes in the file
    values: int
    encoding: int


def claimed(schema: ParquetSchema, content: bytes | memoryview, columns: Collection[str] | None = None) -> int:
    """Return how many bytes the ``columns`` of a file (None: all) are in memory by what they declare, at least.

    Raises `ValueError` as `counted` does.
    """
    total, largest, _ = counted(schema, content, columns)
    return total + largest


def counted(
    schema: ParquetSchema, content: bytes | memoryview, columns: Collection[str] | None = None, *, shared: bool = False
) -> tuple[int, int, int]:
    """Return how many bytes all values of ``columns`` are, how many the largest page is, and how many columns there are.

    Where ``shared``, texts in a dictionary are as they are in the file: each is there once.

    The footer is read here, because pyarrow's own look at it ends the process where its parts contradict one another.
    Raises `ValueError` where a column states another number of values than its pages, or of pages that are not there.
    """
    length = int.from_bytes(content[-8:-4], "little")
    told, _ = _struct(content, len(content) - 8 - length, len(content) - 8, 0)
    leaves = list(_leaves(schema, columns))
    total = largest = rows = 0
    for group in told.get(4) or ():
        rows += _whole(group.get(3))
        chunks = group.get(1) or ()
        for place, name, width in leaves:
            if place >= len(chunks):
                raise ValueError(f"column {name!r:.60} is not in a group of rows")
            chunk = chunks[place].get(3) or {}
            pages = list(_pages(content, *_span(chunk, len(content), name)))
            values = sum(page.values for page in pages if page.kind != DICTIONARY)
            if values != chunk.get(5):
                raise ValueError(f"column {name!r:.60} declares {chunk.get(5)} values and holds {values}")
            total += values * width if width else _texts(pages, shared=shared)
            largest = max(largest, *(page.unpacked for page in pages), 0)
    if told.get(3) != rows:
        raise ValueError(f"it declares {told.get(3)} rows, and its groups of {rows}")
    return total, largest, len(leaves)


def _leaves(schema: ParquetSchema, columns: Collection[str] | None) -> Iterator[tuple[int, str, int]]:
    """Yield place, name and bytes of a value in memory of each column that is read; 0 for texts, which vary."""
    for place in range(len(schema)):
        leaf = schema.column(place)
        if columns is None or leaf.path.partition(".")[0] in columns or leaf.path in columns:
            kind = leaf.physical_type
            yield place, leaf.path, leaf.length if kind == "FIXED_LEN_BYTE_ARRAY" else WIDTHS.get(kind, 0)


def _span(chunk: Mapping[int, Any], end: int, name: str) -> tuple[int, int]:
    """Return where the pages of a column's chunk begin and end."""
    start = _whole(chunk.get(9))
    words = chunk.get(11)  # where its dictionary is, if it has one
    start = min(start, words) if isinstance(words, int) and words > 0 else start
    stop = start + _whole(chunk.get(7))
    if not 0 <= start <= stop <= end:
        raise ValueError(f"column {name!r:.60} lies at bytes {start} to {stop} of {end}")
    return start, stop


def _texts(pages: Collection[Page], *, shared: bool) -> int:
    """Return how many bytes texts can be: those that share beginnings, or stand in a dictionary, as long as it each."""
    words = max((page.unpacked for page in pages if page.kind == DICTIONARY), default=0)
    total = words if shared else 0
    for page in pages:
        if page.kind != DICTIONARY and shared and page.encoding in INDEXES:
            total += page.values * INDEX
        elif page.kind != DICTIONARY:
            longest = 0 if page.encoding in (PLAIN, DELTA_LENGTH) else max(words, page.unpacked)
            total += page.unpacked + page.values * (OFFSET + longest)
    return total


def _pages(content: bytes | memoryview, place: int, stop: int) -> Iterator[Page]:
    while place < stop:
        usual = _USUAL.match(content, place, stop)
        if usual is not None:
            page = Page(DATA, _varint(usual[1]), _varint(usual[2]), _varint(usual[4]), usual[5][0] >> 1)
            place = usual.end()
        else:
            told, place = _struct(content, place, stop, 0)
            inner: dict[int, Any] = next((told[field] for field in (5, 7, 8) if isinstance(told.get(field), dict)), {})
            encoding = inner.get(4 if 8 in told else 2, -1)
            page = Page(
                *(_whole(value) for value in (told.get(1), told.get(2), told.get(3), inner.get(1, 0), encoding))
            )
        if page.unpacked < 0 or page.size < 0 or page.values < 0 or place + page.size > stop:
            raise ValueError(f"a page declares {page.size} bytes, {page.unpacked} unpacked, of {stop - place}")
        place += page.size
        yield page


def _whole(value: Any) -> int:
    if not isinstance(value, int):
        raise ValueError("a page's header lacks a number")
    return value


def _varint(text: bytes | memoryview) -> int:
    """Return a number of Thrift's compact protocol: seven bits a byte, the low ones first, in zigzag.

    >>> _varint(bytes([0x96, 0x01])), _varint(bytes([1]))
    (75, -1)
    """
    number = 0
    for shift, byte in enumerate(text[:10]):
        number |= (byte & 127) << 7 * shift
    return (number >> 1) ^ -(number & 1)


def _struct(content: bytes | memoryview, place: int, stop: int, depth: int) -> tuple[dict[int, Any], int]:
    """Return the fields of a structure by number, whole numbers and structures alone, and where it ends."""
    found: dict[int, Any] = {}
    number = 0
    while place < stop:
        head = content[place]
        place += 1
        if not head:
            return found, place
        kind = head & 15
        if head >> 4:
            number += head >> 4
        else:
            number, place = _number(content, place, stop)
        if 3 < kind < 7 and place < stop and content[place] < 128:  # a number of one byte, as most are
            found[number] = content[place] >> 1 ^ -(content[place] & 1)
            place += 1
        else:
            found[number], place = _value(content, place, stop, kind, depth)
    raise ValueError("its footer or a page's header was cut off")


def _value(content: bytes | memoryview, place: int, stop: int, kind: int, depth: int) -> tuple[Any, int]:
    if kind in (1, 2):  # true, false
        return kind == 1, place
    if kind == 3:
        return _byte(content, place, stop)
    if kind in (4, 5, 6):
        return _number(content, place, stop)
    if kind == 7:
        return None, place + 8
    if kind == 8:  # a text: its length is no zigzag
        length, place = _number(content, place, stop)
        return None, place + (2 * length if length >= 0 else -2 * length - 1)
    if kind == 9 and depth < DEEPEST:
        return _list(content, place, stop, depth + 1)
    if kind == 12 and depth < DEEPEST:
        return _struct(content, place, stop, depth + 1)
    raise ValueError("its footer or a page's header is none")


def _list(content: bytes | memoryview, place: int, stop: int, depth: int) -> tuple[list[Any], int]:
    head, place = _byte(content, place, stop)
    count, kind = head >> 4, head & 15
    if count == 15:
        length, place = _number(content, place, stop)
        count = 2 * length if length >= 0 else -2 * length - 1
    found = []
    for _ in range(count):
        value, place = _byte(content, place, stop) if kind in (1, 2) else _value(content, place, stop, kind, depth)
        if place > stop:
            raise ValueError("its footer or a page's header was cut off")
        found.append(value)
    return found, place


def _byte(content: bytes | memoryview, place: int, stop: int) -> tuple[int, int]:
    if place >= stop:
        raise ValueError("a page's header was cut off")
    return content[place], place + 1


def _number(content: bytes | memoryview, place: int, stop: int) -> tuple[int, int]:
    end = place
    while end < stop and content[end] & 128:
        end += 1
    if end >= stop:
        raise ValueError("its footer or a page's header was cut off")
    return _varint(content[place : end + 1]), end + 1
