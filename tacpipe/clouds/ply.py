"""How many points a PLY file tells of and how many it holds, whatever elements lie around them.

Source: Greg Turk, "The PLY Polygon File Format" (1994): a header of lines up to ``end_header``; elements follow in the order
of the header, each row the element's properties in their order.
"""

from __future__ import annotations

from pathlib import Path

from tacpipe.errors import TacpipeError
from tacpipe.io import regular
from tacpipe.printable import excerpt

SIZES = {  # bytes of a scalar property
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
LONGEST_HEADER = 65_536  # bytes
DIGITS = 18  # of a number in a header


def points(path: Path) -> int:
    """Return how many points (``element vertex``) a PLY file tells of.

    Raises `TacpipeError`, naming the file, where it is no PLY file, has no points, or is shorter than they are.
    """
    content = regular.content(path)
    end = content.find(b"end_header", 0, LONGEST_HEADER)
    lines = [line.split() for line in content[: max(end, 0)].decode("latin-1").splitlines()]
    if end < 0 or lines[:1] != [["ply"]]:
        raise TacpipeError(
            f"{path} is not a PLY file, or was cut off: it must begin with ply and a header up to end_header."
        )
    body = content[content.find(b"\n", end) + 1 or len(content) :]
    form = next((words[1] for words in lines if words[:1] == ["format"] and len(words) == 3), "")
    for name, count, widths in _elements(path, lines):
        if widths is None and count:  # a row's length is in the row, of one byte or more: what follows is not counted
            _require(path, count, name, len(body))
            _require(path, _told(path, lines), "vertex", len(body))
            return _told(path, lines)
        held = len(body.split()) if form == "ascii" else len(body)
        needed = count * (len(widths or ()) if form == "ascii" else sum(widths or ()))
        if held < needed:
            unit = "numbers" if form == "ascii" else "bytes"
            raise TacpipeError(
                f"{path} was cut off: its {count} rows of {name} are {needed} {unit}, and {held} follow. Copy it again."
            )
        if name == "vertex":
            break
        body = b" ".join(body.split()[needed:]) if form == "ascii" else body[needed:]
    return _told(path, lines)


def _elements(path: Path, lines: list[list[str]]) -> list[tuple[str, int, list[int] | None]]:
    """Return name, rows and sizes of the properties of each element; None for sizes where one is a list."""
    found: list[tuple[str, int, list[int] | None]] = []
    for words in lines:
        if words[:1] == ["element"]:
            if len(words) != 3 or not (words[2].isascii() and words[2].isdigit()) or len(words[2]) > DIGITS:
                raise TacpipeError(
                    f"{path} has the line {excerpt(' '.join(words))}; it must be element, a name and a number."
                )
            found.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"] and found:
            name, count, sizes = found[-1]
            scalar = sizes is not None and len(words) == 3 and words[1] in SIZES
            found[-1] = (name, count, [*sizes, SIZES[words[1]]] if scalar and sizes is not None else None)
    return found


def _require(path: Path, count: int, name: str, held: int) -> None:
    if count > held:
        raise TacpipeError(
            f"{path} was cut off: it declares {count} rows of {name:.40}, and {held} bytes follow. Copy it again."
        )


def _told(path: Path, lines: list[list[str]]) -> int:
    found = [int(words[2]) for words in lines if words[:2] == ["element", "vertex"]]
    if len(found) != 1 or not found[0]:
        raise TacpipeError(f"{path} declares no points (element vertex). Give a cloud, or a mesh with its vertices.")
    return found[0]
