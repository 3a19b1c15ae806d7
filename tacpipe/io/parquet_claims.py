"""Count the bytes that the columns of a Parquet file declare, page by page, before anything is unpacked.

A file of a few hundred bytes can declare any number of rows, and a page any size: pyarrow checks neither and allocates
the memory. Every page has a header (https://parquet.apache.org/docs/file-format/, Thrift's compact protocol) with its
unpacked size and number of values, whose sums must match the column's totals. Values stored as differences or runs may
be arbitrarily many, so their size is compared with the available memory.
"""

from __future__ import annotations

import mmap
import re
from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from pyarrow.parquet import ParquetSchema

Bytes = bytes | memoryview | mmap.mmap
DATA, DICTIONARY = 0, 2  # page types
PLAIN, DELTA_LENGTH = 0, 6  # encodings whose texts have their own length
INDEXES = (2, 8)  # encodings whose texts are in a dictionary
INDEX = 4  # size of a dictionary index in memory
# size of a value in memory by type
WIDTHS = {"BOOLEAN": 1, "INT32": 4, "INT64": 8, "INT96": 12, "FLOAT": 4, "DOUBLE": 8}
OFFSET = 8  # size of a text's offset in memory
_VARINT = rb"([\x80-\xff]*[\x00-\x7f])"
_SMALL = rb"[\x00-\x7f]"  # a number of one byte
_CHUNK, _ELEMENT, _ORDER = b"&\x15\x1c"  # first bytes of a column chunk, a schema element and a column order
# column chunk: offset 0, type, 2 encodings, name, codec, values, sizes, page offset, page statistics
_USUAL_CHUNK = re.compile(
    rb"&\x00\x1c\x15%b\x19\x25%b%b\x19\x18(%b)([ -~]*)\x15%b\x16%b\x16%b\x16%b&%b"
    rb"\x49\x1c\x15%b\x15%b\x15%b\x00\x3c(?:\x16%b)?[\x19)]\x06(?:\x19\x26%b%b)?\x00\x00\x00"
    % (*(_SMALL,) * 5, *(_VARINT,) * 4, *(_SMALL,) * 3, *(_VARINT,) * 3),
)
_USUAL_NAME = re.compile(rb"\x15%b\x25%b\x18(%b)" % ((_SMALL,) * 3))  # type, repetition, length of the name
_USUAL_KIND = re.compile(  # converted type; logical type: none, text, or integer
    rb"(?:\x25%b)?(?:\x4c(?:\x1c\x00|\xac\x13%b[\x11\x12]\x00)\x00)?\x00" % ((_SMALL,) * 2)
)
_USUAL = re.compile(  # page type 0, unpacked size, size, optional checksum, number of values, encoding
    rb"\x15\x00\x15%b\x15%b(?:\x15%b\x1c|\x2c)\x15%b\x15(%b)\x15%b\x15%b(?:\x1c\x00)?\x00\x00"
    % (*(_VARINT,) * 4, *(_SMALL,) * 3),
)
MAX_DEPTH = 8  # maximum nesting depth of structures in a page header


class _Leaf(NamedTuple):
    """A column in the schema."""

    path: str
    kind: str  # physical type
    length: int  # size of a fixed-length value in bytes


class PageHeader(NamedTuple):
    """Fields of a page header."""

    kind: int
    unpacked: int  # bytes
    size: int  # bytes in the file
    values: int
    encoding: int


class Claims:
    """Counts the bytes that the columns of a file declare, each column once.

    The footer is parsed here, because pyarrow's parser aborts the process if parts of a footer contradict each other.
    Raises `ValueError` if the footer is inconsistent, or if a requested column does not match its pages.
    """

    def __init__(self, schema: ParquetSchema, content: Bytes) -> None:
        length = int.from_bytes(content[-8:-4], "little")
        footer, _ = _struct(content, len(content) - 8 - length, len(content) - 8, 0)
        leaves = (schema.column(index) for index in range(len(schema)))
        self._leaves = [_Leaf(leaf.path, leaf.physical_type, leaf.length) for leaf in leaves]
        self._groups: list[list[Any]] = [group.get(1) or [] for group in footer.get(4) or ()]
        self._counted: dict[tuple[int, bool], tuple[int, int]] = {}  # bytes and largest page by column and `shared`
        rows = sum(_expect_number(group.get(3)) for group in footer.get(4) or ())
        if footer.get(3) != rows:
            raise ValueError(f"it declares {footer.get(3)} rows, and its groups of {rows}")

    def count(
        self, content: Bytes, columns: Collection[str] | None = None, *, shared: bool = False
    ) -> tuple[int, int, int]:
        """Return the total size of ``columns`` in memory, the size of the largest page, and the number of columns.

        ``content`` is the file. If ``shared``, each dictionary entry counts once, as in the file.
        """
        positions = [
            position
            for position, leaf in enumerate(self._leaves)
            if columns is None or leaf.path in columns or leaf.path.partition(".")[0] in columns
        ]
        for position in positions:
            if (position, shared) not in self._counted:
                self._counted[position, shared] = self._count_column(content, position, shared=shared)
                if isinstance(content, mmap.mmap):
                    content.madvise(mmap.MADV_DONTNEED)
        counts = [self._counted[position, shared] for position in positions]
        return sum(total for total, _ in counts), max((largest for _, largest in counts), default=0), len(positions)

    def _count_column(self, content: Bytes, position: int, *, shared: bool) -> tuple[int, int]:
        """Return the size of a column in memory, and that of its largest page.

        Raises `ValueError` if the file is damaged.
        """
        leaf, total, largest = self._leaves[position], 0, 0
        for chunks in self._groups:
            if position >= len(chunks):
                raise ValueError(f"column {leaf.path!r:.60} is not in a group of rows")
            chunk = chunks[position].get(3) or {}
            start, stop = _span(chunk, len(content), leaf.path)
            only_page = _USUAL.match(content, start, stop)  # most columns have one page
            if only_page is not None and only_page.end() + _varint(only_page[2]) == stop and leaf.kind in WIDTHS:
                values, unpacked = _varint(only_page[4]), _varint(only_page[1])
                if values == chunk.get(5) and values >= 0 and unpacked >= 0:
                    total, largest = total + values * WIDTHS[leaf.kind], max(largest, unpacked)
                    continue
            pages = list(_pages(content, start, stop))
            values = sum(page.values for page in pages if page.kind != DICTIONARY)
            if values != chunk.get(5):
                raise ValueError(f"column {leaf.path!r:.60} declares {chunk.get(5)} values and holds {values}")
            width = leaf.length if leaf.kind == "FIXED_LEN_BYTE_ARRAY" else WIDTHS.get(leaf.kind, 0)
            total += values * width if width else _texts(pages, shared=shared)
            largest = max(largest, *(page.unpacked for page in pages), 0)
        return total, largest


def _span(chunk: Mapping[int, Any], end: int, name: str) -> tuple[int, int]:
    """Return start and end of the pages of a column chunk. Raises `ValueError` if they are outside of the file."""
    start = _expect_number(chunk.get(9))
    dictionary_start = chunk.get(11)  # offset of its dictionary, if it has one
    start = min(start, dictionary_start) if isinstance(dictionary_start, int) and dictionary_start > 0 else start
    stop = start + _expect_number(chunk.get(7))
    if not 0 <= start <= stop <= end:
        raise ValueError(f"column {name!r:.60} lies at bytes {start} to {stop} of {end}")
    return start, stop


def _texts(pages: Collection[PageHeader], *, shared: bool) -> int:
    """Return the maximum size of texts in memory.

    Each text with a shared prefix or dictionary may be as long as the dictionary.
    """
    dictionary_bytes = max((page.unpacked for page in pages if page.kind == DICTIONARY), default=0)
    total = dictionary_bytes if shared else 0
    for page in pages:
        if page.kind != DICTIONARY and shared and page.encoding in INDEXES:
            total += page.values * INDEX
        elif page.kind != DICTIONARY:
            longest = 0 if page.encoding in (PLAIN, DELTA_LENGTH) else max(dictionary_bytes, page.unpacked)
            total += page.unpacked + page.values * (OFFSET + longest)
    return total


def _pages(content: Bytes, offset: int, stop: int) -> Iterator[PageHeader]:
    """Yield the headers of the pages between two offsets. Raises `ValueError` if one is invalid."""
    while offset < stop:
        usual = _USUAL.match(content, offset, stop)
        if usual is not None:
            page = PageHeader(DATA, _varint(usual[1]), _varint(usual[2]), _varint(usual[4]), usual[5][0] >> 1)
            offset = usual.end()
        else:
            header, offset = _struct(content, offset, stop, 0)
            inner: dict[int, Any] = next(
                (header[field] for field in (5, 7, 8) if isinstance(header.get(field), dict)), {}
            )
            encoding = inner.get(4 if 8 in header else 2, -1)
            page = PageHeader(
                *(
                    _expect_number(value)
                    for value in (header.get(1), header.get(2), header.get(3), inner.get(1, 0), encoding)
                )
            )
        if page.unpacked < 0 or page.size < 0 or page.values < 0 or offset + page.size > stop:
            raise ValueError(f"a page declares {page.size} bytes, {page.unpacked} unpacked, of {stop - offset}")
        offset += page.size
        yield page


def _expect_number(value: Any) -> int:
    if not isinstance(value, int):
        raise ValueError("a page's header lacks a number")
    return value


def _varint(text: Bytes) -> int:
    """Return a number in Thrift's compact protocol: seven bits per byte, low ones first, in zigzag encoding.

    >>> _varint(bytes([0x96, 0x01])), _varint(bytes([1]))
    (75, -1)
    """
    number = 0
    for shift, byte in enumerate(text[:10]):
        number |= (byte & 127) << 7 * shift
    return (number >> 1) ^ -(number & 1)


def _struct(content: Bytes, offset: int, stop: int, depth: int) -> tuple[dict[int, Any], int]:
    """Return the integer and structure fields of a structure by number, and the structure's end.

    Raises `ValueError` if it is truncated or nested too deeply.
    """
    fields: dict[int, Any] = {}
    number = 0
    while offset < stop:
        type_byte = content[offset]
        offset += 1
        if not type_byte:
            return fields, offset
        kind = type_byte & 15
        if type_byte >> 4:
            number += type_byte >> 4
        else:
            number, offset = _number(content, offset, stop)
        if 3 < kind < 7 and offset < stop and content[offset] < 128:  # a one-byte number, which is the most common
            fields[number] = content[offset] >> 1 ^ -(content[offset] & 1)
            offset += 1
        else:
            fields[number], offset = _value(content, offset, stop, kind, depth)
    raise ValueError("its footer or a page's header was cut off")


def _value(content: Bytes, offset: int, stop: int, kind: int, depth: int) -> tuple[Any, int]:
    """Return a value of type ``kind`` at an offset, None if it is not needed, and its end.

    Raises `ValueError` for an unknown type.
    """
    if kind in (1, 2):  # true, false
        return kind == 1, offset
    if kind == 3:
        return _byte(content, offset, stop)
    if kind in (4, 5, 6):
        return _number(content, offset, stop)
    if kind == 7:
        return None, offset + 8
    if kind == 8:  # a text, whose length is not in zigzag encoding
        length, offset = _number(content, offset, stop)
        return None, offset + (2 * length if length >= 0 else -2 * length - 1)
    if kind == 9 and depth < MAX_DEPTH:
        return _list(content, offset, stop, depth + 1)
    if kind == 12 and depth < MAX_DEPTH:
        return _struct(content, offset, stop, depth + 1)
    raise ValueError("its footer or a page's header is none")


def _list(content: Bytes, offset: int, stop: int, depth: int) -> tuple[list[Any], int]:
    """Return the values of a list at an offset, and its end. Raises `ValueError` if it is truncated."""
    type_byte, offset = _byte(content, offset, stop)
    count, kind = type_byte >> 4, type_byte & 15
    if count == 15:
        length, offset = _number(content, offset, stop)
        count = 2 * length if length >= 0 else -2 * length - 1
    values: list[Any] = []
    for _ in range(count):
        usual = _read_common_form(content, offset, stop) if kind == 12 else None
        if usual is not None:
            values.append(usual[0])
            offset = usual[1]
            continue
        value, offset = _byte(content, offset, stop) if kind in (1, 2) else _value(content, offset, stop, kind, depth)
        if offset > stop:
            raise ValueError("its footer or a page's header was cut off")
        values.append(value)
    return values, offset


def _read_common_form(content: Bytes, offset: int, stop: int) -> tuple[dict[int, Any], int] | None:
    """Return the needed fields by Thrift number and the end of a footer structure; None if it is not in the common form.

    Of a column chunk, these are the metadata (3) with the number of values (5), the size (7) and the offset of the first
    page (9). No field of schema elements and column orders is needed.
    """
    first_byte = content[offset] if offset < stop else 0
    if first_byte == _CHUNK and (chunk := _USUAL_CHUNK.match(content, offset, stop)) and len(chunk[2]) == chunk[1][0]:
        return {3: {5: _varint(chunk[3]), 7: _varint(chunk[5]), 9: _varint(chunk[6])}}, chunk.end()
    if first_byte == _ELEMENT and (name := _USUAL_NAME.match(content, offset, stop)):
        kind = _USUAL_KIND.match(content, name.end() + name[1][0], stop)
        return None if kind is None else ({}, kind.end())
    if first_byte == _ORDER and content[offset : min(offset + 3, stop)] == b"\x1c\x00\x00":
        return {}, offset + 3
    return None


def _byte(content: Bytes, place: int, stop: int) -> tuple[int, int]:
    if place >= stop:
        raise ValueError("a page's header was cut off")
    return content[place], place + 1


def _number(content: Bytes, offset: int, stop: int) -> tuple[int, int]:
    """Return the number at an offset, and its end. Raises `ValueError` if it is truncated."""
    end = offset
    while end < stop and content[end] & 128:
        end += 1
    if end >= stop:
        raise ValueError("its footer or a page's header was cut off")
    return _varint(content[offset : end + 1]), end + 1
