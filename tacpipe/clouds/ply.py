"""Clouds of points as PLY files: what a depth camera's program saves while it is recorded, and users have.

Binary of either order of bytes, or text. The vertices must have x, y and z; red, green and blue are colours, other
properties are skipped. Source: Greg Turk, "The PLY Polygon File Format" (1994).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tacpipe.arrays import Bytes, Float32s
from tacpipe.clouds import cloud
from tacpipe.clouds.cloud import COLOUR
from tacpipe.errors import TacpipeError
from tacpipe.printable import excerpt, listed

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
POSITION = ("x", "y", "z")
LONGEST_HEADER = 65_536  # bytes
DIGITS = 18  # largest number of digits of a number in a header


@dataclass(frozen=True)
class _Header:
    form: str
    vertex: np.dtype[np.void]
    points: int
    length: int  # bytes, the line end behind end_header included
    only_vertices: bool  # no other element follows
    skipped: int  # size of other elements before the vertices: bytes, or lines of a text file


def parsed(path: Path, content: bytes) -> tuple[Float32s, Bytes | None]:
    """Return points (point, xyz) as they stand, those that are not finite too, and colours (point, rgb) if there are any.

    Raises `TacpipeError`, naming the file, where it is no PLY file, its vertices are not its first element or have no x, y
    and z, colours are no bytes, or points are missing.
    """
    header = _header(path, content)
    if not header.points:
        raise TacpipeError(f"{path} holds no point (element vertex 0). Copy it again or leave it out.")
    if header.form == "ascii":
        lines = cloud.filled(content[header.length :])[header.skipped :]
        _require(path, header, len(lines), 1, "lines")
        points = cloud.parsed(path, lines[: header.points], header.vertex, (*POSITION, *COLOUR))
    else:
        body = content[header.length + header.skipped :]
        _require(path, header, len(body), header.vertex.itemsize, "bytes")
        points = np.frombuffer(body, header.vertex, header.points)
    with np.errstate(over="ignore"):  # values beyond float32 become infinite, and are refused or left out
        xyz = np.column_stack([points[axis] for axis in POSITION]).astype(np.float32)
    if not set(COLOUR) <= set(header.vertex.names or ()):
        return xyz, None
    return xyz, np.column_stack([points[name] for name in COLOUR])


def packed(points_m: Float32s, colours: Bytes | None) -> bytes:
    """Return the binary PLY file of points (point, xyz) and colours (point, rgb)."""
    vertex = np.dtype([(axis, "<f4") for axis in POSITION] + [(name, "u1") for name in COLOUR if colours is not None])
    rows = np.zeros(len(points_m), vertex)
    for axis, column in zip(POSITION, points_m.T, strict=True):
        rows[axis] = column
    for name, column in zip(COLOUR, () if colours is None else colours.T, strict=colours is not None):
        rows[name] = column
    kinds = [f"property {'float' if name in POSITION else 'uchar'} {name}" for name in vertex.names or ()]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *kinds, "end_header", ""]
    return "\n".join(lines).encode() + rows.tobytes()


def _header(path: Path, content: bytes) -> _Header:
    end = content.find(b"end_header", 0, LONGEST_HEADER)
    stop = content.find(b"\n", end) + 1
    lines = [line.split() for line in content[: max(end, 0)].decode("latin-1").splitlines()]
    if end < 0 or not stop or lines[:1] != [["ply"]]:
        raise TacpipeError(f"{path} is not a PLY file or was cut off: it must begin with ply and end its header.")
    form = next((words[1] for words in lines if words[:1] == ["format"] and len(words) == 3), "")
    starts = [number for number, words in enumerate(lines) if words[:1] == ["element"]]
    elements = [lines[start:end] for start, end in itertools.pairwise([*starts, len(lines)])]
    place = next((number for number, (first, *_) in enumerate(elements) if first[1:2] == ["vertex"]), 0)
    first = elements[place][0] if elements else []
    before = [_size(element, form) for element in elements[:place]]
    if form not in ORDERS or first[1:2] != ["vertex"] or len(first) != 3 or not _is_count(first[2]) or None in before:
        declared = elements[0][0][1:] if elements else []
        raise TacpipeError(
            f"{path} has the format {excerpt(form)} and the first element {excerpt(' '.join(declared))}; a cloud is of "
            f"the format {', '.join(ORDERS)}, and its vertices come first."
        )
    rows = [row for row in elements[place] if row[:1] == ["property"]]
    skipped = sum(size for size in before if size is not None)
    return _Header(form, _vertex(path, rows, form), int(first[2]), stop, len(elements) == 1, skipped)


def _size(element: list[list[str]], form: str) -> int | None:
    """Return how many bytes an element has, or lines where it is text; None where the header does not give it (lists)."""
    (_, *declared), *rows = element
    kinds = [words[1:] for words in rows if words[:1] == ["property"]]
    if len(declared) != 2 or not _is_count(declared[1]):
        return None
    if form == "ascii":
        return int(declared[1])
    if not all(len(kind) == 2 and kind[0] in LETTERS for kind in kinds):
        return None
    return int(declared[1]) * sum(int(LETTERS[kind[0]][1]) for kind in kinds)


def _vertex(path: Path, rows: list[list[str]], form: str) -> np.dtype[np.void]:
    kinds: dict[str, str] = {}
    for words in rows:
        if len(words) != 3 or words[1] not in LETTERS or words[2] in kinds:
            raise TacpipeError(
                f"{path} has the vertices' {excerpt(' '.join(words))}; it must be a type, one number, and a name."
            )
        kinds[words[2]] = LETTERS[words[1]]
    floats = all(kinds.get(axis, "")[:1] == "f" for axis in POSITION)
    coloured = all(kinds.get(name, "u1") == "u1" for name in COLOUR)
    if not floats or not coloured:
        raise TacpipeError(
            f"{path} has vertices of {listed(kinds)}; they must have x, y and z of floats, and colours, "
            f"where there are any, of uchar."
        )
    return np.dtype([(name, ORDERS[form] + letters) for name, letters in kinds.items()])


def _is_count(word: str) -> bool:
    return word.isascii() and word.isdigit() and len(word) <= DIGITS


def _require(path: Path, header: _Header, available: int, width: int, unit: str) -> None:
    """Raise `TacpipeError` where too little follows the header for its points, or too much though nothing else may."""
    needed = header.points * width
    if available < needed or (header.only_vertices and available > needed):
        raise TacpipeError(
            f"{path} declares {header.points} points, which are {needed} {unit}, and {available} follow. Copy it again."
        )
