"""Colours: of values on a scale, and of things that are to be distinguished, on dark and on light ground."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from tacpipe.arrays import AnyArray, Bytes, Floats

# distinguished by eyes that do not distinguish red from green (Okabe and Ito), bright enough for dark ground
DISTINCT = ("#56b4e9", "#e69f00", "#35b779", "#f0e442", "#cc79a7", "#d55e00", "#8c9eff", "#9aa5b1")
PRINTED = ("#0969da", "#d1480c", "#1a7f37", "#8250df", "#bf8700", "#0e7490", "#bf3989", "#57606a")  # on light ground
AXES = ("#e8604c", "#5fbf60", "#5b8ff9", "#c9a227")  # x, y, z, w: as tools for robots have them
FAULT = "#e5484d"  # of gaps and events
TRUTH = "#9aa5b1"  # of what a simulation knows
MEASURED = "#8d99a6"
SHADES = 257  # of a scale, an odd number: 0 has one of its own
_RISING = ("#2b3040", "#4b2a7b", "#8f2d80", "#d3436e", "#f8765c", "#febb81", "#fcfdbf")  # dark to bright
_BOTH = ("#7cc4ff", "#2f7fd0", "#2b3040", "#e07b39", "#ffd08a")  # below, at and above 0


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue of a colour written ``#rrggbb``.

    >>> rgb("#0080ff")
    (0, 128, 255)
    """
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def coloured(values: AnyArray, low: float, high: float) -> Bytes:
    """Return colours (…, rgb) of ``values`` (…) on a scale from ``low`` to ``high``; NaN is black.

    A scale that begins below 0 has the ground's colour in its middle, others at their lower end.

    >>> coloured(np.array([0.0, 5.0, np.nan]), 0.0, 5.0).tolist()
    [[43, 48, 64], [252, 253, 191], [0, 0, 0]]
    """
    anchors: Floats = np.array([rgb(one) for one in (_BOTH if low < 0 < high else _RISING)], dtype=np.float64)
    table = np.stack(
        [np.interp(np.linspace(0, 1, SHADES), np.linspace(0, 1, len(anchors)), channel) for channel in anchors.T],
        axis=1,
    )
    width = high - low if high > low else 1.0
    finite = np.isfinite(values)
    place = np.clip((np.where(finite, values, low) - low) / width, 0, 1)
    found = np.round(table).astype(np.uint8)[np.round((SHADES - 1) * place).astype(np.intp)]
    found[~finite] = 0
    return np.asarray(found)


def named(text: str, colours: Sequence[str] = DISTINCT) -> str:
    """Return a colour for a name, the same each time."""
    return colours[zlib.crc32(text.encode()) % len(colours)]


def numbered(place: int, colours: Sequence[str] = DISTINCT) -> str:
    """Return a colour for the place of a thing in a row of such; they repeat where there are more."""
    return colours[place % len(colours)]
