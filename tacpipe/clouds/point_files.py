"""Parse point clouds strictly: PCD files of the Point Cloud Library, version 0.7, and PLY files.

The lines of a PCD header describe the fields of a point. After its last line, ``DATA``, the points follow as lines of
numbers or as a memory dump. Colour is one of the fields, ``rgb``: the bytes of 0x00RRGGBB, usually declared as a float.
Source: "The PCD (Point Cloud Data) file format", documentation of the Point Cloud Library.

PLY is text, or binary in either byte order. The vertices must have x, y and z; red, green and blue are colours, and
other properties are skipped. Source: Greg Turk, "The PLY Polygon File Format" (1994).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import Bytes, Float32s
from tacpipe.clouds import cloud
from tacpipe.clouds.cloud import COLOUR, Cloud
from tacpipe.errors import TacpipeError
from tacpipe.io import regular
from tacpipe.printable import excerpt, listed, plain

KEYWORDS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
VERSIONS = ("0.7", ".7")
# numpy's letter, sizes in bytes
KINDS = {"F": ("f", (4, 8)), "I": ("i", (1, 2, 4, 8)), "U": ("u", (1, 2, 4, 8))}
POSITION = ("x", "y", "z")
COLOURS = ("rgb", "rgba")  # either name is valid; the alpha of rgba is ignored
MAX_HEADER_BYTES = 65_536  # a file without a DATA line in these is not PCD
DIGITS = 18  # maximum number of digits of a number in a header
MAX_POINT_BYTES = 65_536  # maximum size of a point, including skipped fields
LZF_MAX_RATIO = 88  # maximum compression ratio: three bytes unpack to 264


@dataclass(frozen=True)
class Header:
    """The header of a PCD file."""

    point: np.dtype[np.void]  # the fields of a point, packed
    points: int
    data: str  # ascii, binary or binary_compressed
    length: int  # size of the header in bytes, including its last line end

    @property
    def colour(self) -> str | None:
        """The name of the colour field, or None."""
        return next((name for name in COLOURS if name in (self.point.names or ())), None)


def read(path: Path) -> Cloud:
    """Return the cloud of a PCD file, in the unit of the file (metres by convention). Other fields are skipped.

    Raises `TacpipeError` with the path if the file is not PCD 0.7, has no points or no float x, y and z, is shorter
    than its header declares or longer by more than padding, is compressed, or contains points that are not finite.
    """
    xyz, colours = parse_pcd(path, regular.source(path))
    finite = np.logical_and.reduce(np.isfinite(xyz), axis=1)
    if not finite.all():
        raise TacpipeError(
            f"{path} contains {np.count_nonzero(~finite)} of {len(finite)} points that are not finite (NaN), the first "
            f"being point {int(np.argmin(finite))}; remove such points and save it again."
        )
    return Cloud(xyz, colours)


def parse_pcd(path: Path, content: bytes) -> tuple[Float32s, Bytes | None]:
    """Return the points (point, xyz), including those that are not finite, and the colours (point, rgb) or None.

    Raises `TacpipeError` as `read` does, except for points that are not finite.
    """
    header = read_header(path, content)
    if header.data == "binary_compressed":
        raise TacpipeError(
            f"{path} contains compressed points (DATA binary_compressed); save it as DATA binary: "
            f"`pcl_convert_pcd_ascii_binary IN.pcd OUT.pcd 1` does."
        )
    if header.points == 0:
        raise TacpipeError(f"{path} contains no point (POINTS 0). Copy the file again or exclude its recording.")
    points = _parse_binary(path, content, header) if header.data == "binary" else _parse_text(path, content, header)
    with np.errstate(over="ignore"):  # values beyond float32 become infinite and are rejected or dropped
        xyz = np.column_stack([points[axis] for axis in POSITION]).astype(np.float32)  # (point, xyz)
    if header.colour is None:
        return xyz, None
    return xyz, unpack_colours(np.ascontiguousarray(points[header.colour]).view("<u4"))


def read_header(path: Path, content: bytes | None = None) -> Header:
    """Return the header of a PCD file; ``content`` is its bytes, if they were already read.

    Raises `TacpipeError` with the path if the header is incomplete or inconsistent.
    """
    lines, length = _header_lines(path, regular.source(path) if content is None else content)
    missing = [keyword for keyword in ("VERSION", "FIELDS", "SIZE", "TYPE", "POINTS") if keyword not in lines]
    if missing:
        raise TacpipeError(
            f"{path} has no {' and no '.join(missing)} in its header; it must be a PCD file of version 0.7."
        )
    if lines["VERSION"] not in [[version] for version in VERSIONS]:
        raise TacpipeError(
            f"{path} is a PCD file of version {plain(' '.join(lines['VERSION']))}; only 0.7 can be read. Save it as 0.7."
        )
    points = _whole_number(path, "POINTS", lines["POINTS"])
    if "WIDTH" in lines and "HEIGHT" in lines:
        width, height = (_whole_number(path, keyword, lines[keyword]) for keyword in ("WIDTH", "HEIGHT"))
        if width * height != points:
            raise TacpipeError(
                f"{path} has WIDTH {width}, HEIGHT {height} and POINTS {points}; POINTS must be WIDTH times HEIGHT. "
                f"Copy the file again."
            )
    data = " ".join(lines["DATA"])
    if data not in ("ascii", "binary", "binary_compressed"):
        raise TacpipeError(f"{path} has DATA {plain(data)}; it must be ascii, binary or binary_compressed.")
    return Header(_point_dtype(path, lines), points, data, length)


def require_compressed_size(path: Path, content: bytes, header: Header) -> None:
    """Raise `TacpipeError` if the size of compressed points does not match the header or exceeds the possible ratio.

    Two 4-byte numbers come first: the compressed and the uncompressed size.
    """
    points_size, available_size = header.points * header.point.itemsize, len(content) - header.length - 8
    compressed_size, declared_size = np.frombuffer(content[header.length :][:8].ljust(8, b"\0"), "<u4").tolist()
    if (
        available_size < compressed_size
        or declared_size != points_size
        or points_size > compressed_size * LZF_MAX_RATIO
    ):
        raise TacpipeError(
            f"{path} declares {header.points} points of {header.point.itemsize} bytes, and {max(available_size, 0)} bytes "
            f"follow that declare {compressed_size} compressed and {declared_size} uncompressed bytes: it was cut off "
            "or its header is wrong. Copy the file again."
        )


def unpack_colours(packed: NDArray[np.uint32]) -> Bytes:
    """Return the colours (point, rgb), 0 to 255, of numbers 0x00RRGGBB (point,).

    >>> unpack_colours(np.array([0x00FF8001], np.uint32)).tolist()
    [[255, 128, 1]]
    """
    return np.stack([(packed >> shift) & 255 for shift in (16, 8, 0)], axis=1).astype(np.uint8)


def _header_lines(path: Path, content: bytes) -> tuple[dict[str, list[str]], int]:
    """Return the words after each keyword of the header, and the header's size in bytes.

    Raises `TacpipeError` for an unknown or repeated keyword, and if there is no line DATA.
    """
    lines: dict[str, list[str]] = {}
    position = 0
    while "DATA" not in lines:
        end = content.find(b"\n", position, MAX_HEADER_BYTES)
        if end < 0:
            raise TacpipeError(
                f"{path} is not a PCD file or was cut off: its header ends without a line DATA. Give a PCD file of version "
                f"0.7, or copy it again."
            )
        words = content[position:end].decode("latin-1").split()
        position = end + 1
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in KEYWORDS or words[0] in lines:
            raise TacpipeError(
                f"{path} is not a PCD file: its header has the line {' '.join(words)[:60]!r}; each line must "
                f"start with one of {', '.join(KEYWORDS)}, each once. Give a PCD file of version 0.7."
            )
        lines[words[0]] = words[1:]
    return lines, position


def _whole_number(path: Path, keyword: str, words: list[str]) -> int:
    """Return the number after a keyword.

    Raises `TacpipeError` unless it is one whole number of at most `DIGITS` digits.
    """
    if len(words) != 1 or not (words[0].isascii() and words[0].isdigit()) or len(words[0]) > DIGITS:
        raise TacpipeError(
            f"{path} has {keyword} {plain(' '.join(words))}; it must be a whole number of {DIGITS} digits at most. "
            f"Copy the file again."
        )
    return int(words[0])


def _point_dtype(path: Path, lines: dict[str, list[str]]) -> np.dtype[np.void]:
    """Return the dtype of a point. Raises `TacpipeError` if the fields are incomplete, or position or colour is invalid."""
    names = lines["FIELDS"]
    counts = lines.get("COUNT", ["1"] * len(names))
    for keyword, words in (("SIZE", lines["SIZE"]), ("TYPE", lines["TYPE"]), ("COUNT", counts)):
        if len(words) != len(names):
            raise TacpipeError(
                f"{path} has {len(names)} FIELDS ({plain(' '.join(names))}) and {len(words)} in {keyword}; each "
                f"field needs one."
            )
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    total = 0
    for index, (name, kind, size, count_text) in enumerate(
        zip(names, lines["TYPE"], lines["SIZE"], counts, strict=True)
    ):
        letter, sizes = KINDS.get(kind, ("", ()))
        width, count = _whole_number(path, "SIZE", [size]), _whole_number(path, "COUNT", [count_text])
        if width not in sizes:
            declared = f"the field {plain(name)} of TYPE {plain(kind)} and SIZE {plain(size)}"
            raise TacpipeError(f"{path} has {declared}, which do not fit together.")
        is_bad_position = name in POSITION and (letter != "f" or count != 1)
        is_bad_colour = name in COLOURS and (width != 4 or count != 1)
        if is_bad_position or is_bad_colour:
            expected = "one float (TYPE F)" if name in POSITION else "one number of four bytes (SIZE 4)"
            raise TacpipeError(
                f"{path} has the field {name} of TYPE {kind}, SIZE {size} and COUNT {count_text}; it must be {expected}."
            )
        total += width * count
        if not count > 0 or total > MAX_POINT_BYTES:
            raise TacpipeError(
                f"{path} has the field {plain(name)} of COUNT {count_text}; a point has at most {MAX_POINT_BYTES} bytes and "
                f"each field at least one number. Copy the file again."
            )
        field_name = name if name in (*POSITION, *COLOURS) else f"skipped{index}"  # PCL names all its padding "_"
        fields.append((field_name, f"<{letter}{width}", () if count == 1 else (count,)))
    missing = [axis for axis in POSITION if names.count(axis) != 1]
    if missing or any(names.count(name) > 1 for name in COLOURS):
        raise TacpipeError(
            f"{path} has the FIELDS {plain(' '.join(names))}; x, y and z must each occur once, and rgb at most once."
        )
    return np.dtype(fields)


def _parse_binary(path: Path, content: bytes, header: Header) -> NDArray[np.void]:
    """Return the points (point,) after a binary header; the library pads files with zeros to whole memory pages.

    Raises `TacpipeError` if points are missing or other data follow.
    """
    size = header.point.itemsize
    available, needed = len(content) - header.length, header.points * size
    if available < needed:
        raise TacpipeError(
            f"{path} was cut off or its header is wrong: it declares {header.points} points of {size} bytes, and "
            f"{available // size} follow. Copy the file again."
        )
    if any(content[header.length + needed :]):
        raise TacpipeError(
            f"{path} declares {header.points} points of {size} bytes, and {available - needed} more bytes follow "
            "that are not padding with zeros. Copy the file again."
        )
    return np.frombuffer(content, header.point, header.points, header.length)


def _parse_text(path: Path, content: bytes, header: Header) -> NDArray[np.void]:
    """Return the points (point,) of the lines after a text header, one point per line.

    Raises `TacpipeError` if their number differs from that in the header, or a value is invalid.
    """
    lines = cloud.nonblank_lines(content[header.length :])
    if len(lines) != header.points:
        raise TacpipeError(
            f"{path} was cut off or its header is wrong: it declares {header.points} points, and {len(lines)} lines follow. "
            f"Copy the file again."
        )
    return cloud.parse_points(path, lines, header.point, (*POSITION, *COLOURS))


LETTERS = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
PLY_POSITION = ("x", "y", "z")
PLY_MAX_HEADER_BYTES = 65_536  # bytes
PLY_MAX_DIGITS = 18  # maximum number of digits of a number in a header


@dataclass(frozen=True)
class _Header:
    form: str
    vertex: np.dtype[np.void]
    points: int
    length: int  # size of the header in bytes, including the line end after end_header
    only_vertices: bool  # whether the vertices are the last element
    skipped: int  # size of other elements before the vertices: bytes, or lines of a text file


def parse_ply(path: Path, content: bytes) -> tuple[Float32s, Bytes | None]:
    """Return the points (point, xyz), including those that are not finite, and the colours (point, rgb) or None.

    Raises `TacpipeError` with the path if the file is not PLY, its vertices have no x, y and z, colours are not bytes,
    or points are missing.
    """
    header = _ply_header(path, content)
    if not header.points:
        raise TacpipeError(f"{path} contains no point (element vertex 0). Copy it again or exclude it.")
    if header.form == "ascii":
        lines = cloud.nonblank_lines(content[header.length :])[header.skipped :]
        _require_length(path, header, len(lines), 1, "lines")
        points = cloud.parse_points(path, lines[: header.points], header.vertex, (*PLY_POSITION, *COLOUR))
    else:
        body = content[header.length + header.skipped :]
        _require_length(path, header, len(body), header.vertex.itemsize, "bytes")
        points = np.frombuffer(body, header.vertex, header.points)
    with np.errstate(over="ignore"):  # values beyond float32 become infinite and are rejected or dropped
        xyz = np.column_stack([points[axis] for axis in PLY_POSITION]).astype(np.float32)
    if not set(COLOUR) <= set(header.vertex.names or ()):
        return xyz, None
    return xyz, np.column_stack([points[name] for name in COLOUR])


def pack_ply(points_m: Float32s, colours: Bytes | None) -> bytes:
    """Return points (point, xyz) and colours (point, rgb), or None, as a binary PLY file."""
    vertex = np.dtype(
        [(axis, "<f4") for axis in PLY_POSITION] + [(name, "u1") for name in COLOUR if colours is not None]
    )
    rows = np.zeros(len(points_m), vertex)
    for axis, column in zip(PLY_POSITION, points_m.T, strict=True):
        rows[axis] = column
    for name, column in zip(COLOUR, () if colours is None else colours.T, strict=colours is not None):
        rows[name] = column
    kinds = [f"property {'float' if name in PLY_POSITION else 'uchar'} {name}" for name in vertex.names or ()]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *kinds, "end_header", ""]
    return "\n".join(lines).encode() + rows.tobytes()


def _ply_header(path: Path, content: bytes) -> _Header:
    """Return the header of a PLY file.

    Raises `TacpipeError` if it is incomplete, or its format or vertices are unknown.
    """
    end_position = content.find(b"end_header", 0, PLY_MAX_HEADER_BYTES)
    length = content.find(b"\n", end_position) + 1
    lines = [line.split() for line in content[: max(end_position, 0)].decode("latin-1").splitlines()]
    if end_position < 0 or not length or lines[:1] != [["ply"]]:
        raise TacpipeError(f"{path} is not a PLY file or was cut off: it must start with ply and have a full header.")
    form = next((words[1] for words in lines if words[:1] == ["format"] and len(words) == 3), "")
    element_lines = [number for number, words in enumerate(lines) if words[:1] == ["element"]]
    elements = [lines[start:end_position] for start, end_position in itertools.pairwise([*element_lines, len(lines)])]
    vertex_index = next(
        (number for number, (declaration, *_) in enumerate(elements) if declaration[1:2] == ["vertex"]), 0
    )
    declaration = elements[vertex_index][0] if elements else []
    earlier_sizes = [_element_size(element, form) for element in elements[:vertex_index]]
    if (
        form not in ORDERS
        or declaration[1:2] != ["vertex"]
        or len(declaration) != 3
        or not _is_count(declaration[2])
        or None in earlier_sizes
    ):
        declared = elements[0][0][1:] if elements else []
        raise TacpipeError(
            f"{path} has the format {excerpt(form)} and the first element {excerpt(' '.join(declared))}; a cloud must have "
            f"one of the formats {', '.join(ORDERS)}, and its vertices come first."
        )
    rows = [row for row in elements[vertex_index] if row[:1] == ["property"]]
    skipped = sum(size for size in earlier_sizes if size is not None)
    return _Header(form, _vertex_dtype(path, rows, form), int(declaration[2]), length, len(elements) == 1, skipped)


def _element_size(element: list[list[str]], form: str) -> int | None:
    """Return an element's size in bytes, or in lines for text; None if the header does not determine it (lists)."""
    (_, *declared), *rows = element
    kinds = [words[1:] for words in rows if words[:1] == ["property"]]
    if len(declared) != 2 or not _is_count(declared[1]):
        return None
    if form == "ascii":
        return int(declared[1])
    if not all(len(kind) == 2 and kind[0] in LETTERS for kind in kinds):
        return None
    return int(declared[1]) * sum(int(LETTERS[kind[0]][1]) for kind in kinds)


def _vertex_dtype(path: Path, rows: list[list[str]], form: str) -> np.dtype[np.void]:
    """Return the dtype of a vertex in a PLY file of a format.

    Raises `TacpipeError` for lists, or coordinates or colours of wrong types.
    """
    kinds: dict[str, str] = {}
    for words in rows:
        if len(words) != 3 or words[1] not in LETTERS or words[2] in kinds:
            raise TacpipeError(
                f"{path} has the vertices' {excerpt(' '.join(words))}; it must be a scalar type and a name."
            )
        kinds[words[2]] = LETTERS[words[1]]
    are_floats = all(kinds.get(axis, "")[:1] == "f" for axis in PLY_POSITION)
    are_bytes = all(kinds.get(name, "u1") == "u1" for name in COLOUR)
    if not are_floats or not are_bytes:
        raise TacpipeError(
            f"{path} has vertices of {listed(kinds)}; x, y and z must be floats, and colours, if any, uchar."
        )
    return np.dtype([(name, ORDERS[form] + letters) for name, letters in kinds.items()])


def _is_count(word: str) -> bool:
    return word.isascii() and word.isdigit() and len(word) <= PLY_MAX_DIGITS


def _require_length(path: Path, header: _Header, available: int, width: int, unit: str) -> None:
    """Raise `TacpipeError` if the data after the header is too short for its points or longer than allowed."""
    needed = header.points * width
    if available < needed or (header.only_vertices and available > needed):
        raise TacpipeError(
            f"{path} declares {header.points} points, or {needed} {unit}, but {available} follow. Copy it again."
        )
