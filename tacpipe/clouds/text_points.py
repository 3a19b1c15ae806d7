"""Points written as text, one line each: what PLY and PCD files of the format ascii hold."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import AnyArray, Floats
from tacpipe.errors import TacpipeError
from tacpipe.printable import plain


def filled(body: bytes) -> list[str]:
    """Return the lines that are not blank."""
    return [line.decode("latin-1") for line in body.splitlines() if not line.isspace() and line]


def parsed(path: Path, lines: Sequence[str], point: np.dtype[np.void], wanted: Collection[str]) -> NDArray[np.void]:
    """Return the points (point,) of lines, one or more, each the numbers of one ``point``; fields not ``wanted`` are 0.

    Raises `TacpipeError`, naming the file, where a line holds other than that many numbers, or a number that its field
    cannot have.
    """
    names = point.names or ()
    edges = np.cumsum([0, *(int(np.prod(point[name].shape)) for name in names)])
    try:
        numbers = np.loadtxt(lines, np.float64, comments=None, ndmin=2)  # (point, number)
    except ValueError as error:
        raise TacpipeError(
            f"{path} has lines that are not {edges[-1]} numbers each: {plain(str(error).partition(';')[0], 120)}. Copy the "
            f"file again."
        ) from error
    if numbers.shape[1] != edges[-1]:
        raise TacpipeError(
            f"{path} has lines of {numbers.shape[1]} numbers; each point has {edges[-1]}. Copy the file again."
        )
    found = np.zeros(len(numbers), point)
    for name, place in zip(names, edges, strict=False):
        if name in wanted:
            found[name] = _cast(path, name, numbers[:, place], point[name])
    return found


def _cast(path: Path, name: str, column: Floats, kind: np.dtype[Any]) -> AnyArray:
    """Return a column (point,) in the type of its field; what a float cannot hold becomes infinite."""
    if kind.kind in "iu":
        limits = np.iinfo(kind)
        wrong = ~((column >= limits.min) & (column <= limits.max) & (column == np.rint(column)))
        if wrong.any():
            point = int(np.argmax(wrong))
            raise TacpipeError(
                f"{path}, point {point}: {name} is {column[point]:g}; it must be a whole number from {limits.min} to "
                f"{limits.max}. Copy the file again."
            )
    with np.errstate(over="ignore"):
        return column.astype(kind)
