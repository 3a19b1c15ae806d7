"""Guess the options of a sensor from received bytes, for probing."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from tacpipe.sensors import camera, lines_guess, lsl
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Options, OptionValue

# rows and columns of known boards, by number of taxels
GRIDS = {384: (12, 32), 256: (16, 16), 512: (16, 32), 1024: (32, 32)}
MIN_TAXELS = 64  # smallest unknown board, because many other devices use the same two marker bytes
MIN_DEGC, MAX_DEGC = -40.0, 85.0  # operating range of the magnetometers of an AnySkin
MAX_DISTANCES = 3  # number of distances between marks that are tried


def guess_options(kind: str, data: Chunks) -> list[Options]:
    """Return the options to try for the sensor with the registered name ``kind``, most likely first.

    >>> guess_options("justfloat", Chunks.from_pairs([(0, (bytes(12) + bytes.fromhex("0000807f")) * 5)]))
    [{'channels': 3}, {'model': 'fulai-3.0'}, {'model': 'fulai-3.1'}, {'model': 'fulai-3.2'}]
    >>> guess_options("biotac", Chunks.from_pairs([]))
    [{}]
    """
    if kind == "lines":  # needs arrival times for the rate and to find the clock
        return lines_guess.guess_options(data)
    if kind == "lsl":
        return lsl.guess_options(data)
    if kind == "camera":
        return camera.options(data)
    return VARIANTS[kind](data.data) if kind in VARIANTS else [{}]


def distances(data: bytes, mark: bytes) -> list[int]:
    """Return the most common distances in bytes between consecutive marks, most common first.

    >>> distances(b"ab__ab__ab_ab__", b"ab")
    [4, 3]
    """
    offsets, mark_at = [], data.find(mark)
    while mark_at >= 0:
        offsets.append(mark_at)
        mark_at = data.find(mark, mark_at + 1)
    counts = Counter(after - before for before, after in itertools.pairwise(offsets))
    return [distance for distance, _ in counts.most_common(MAX_DISTANCES)]


def _flexitac(data: bytes) -> list[Options]:
    taxels = [distance - 2 for distance in distances(data, b"\xaa\x55") if distance - 2 >= MIN_TAXELS]
    grids = [GRIDS.get(count, (1, count)) for count in taxels]
    return [{"rows": rows, "columns": columns} for rows, columns in grids] or [{}]


def _anyskin(data: bytes) -> list[Options]:
    """Return options of AnySkin for each number of magnetometers that the bytes suggest, or default options if none."""
    sizes = [distance - 2 for distance in distances(data, b"\r\n")]
    binary: list[Options] = [{"magnetometers": size // 16} for size in sizes if size and size % 16 == 0]
    lines = [line.split() for line in data.split(b"\n")[1:4] if _has_temperatures(line.split())]
    text: list[Options] = [
        {"mode": "ascii", "magnetometers": count // 4} for count in sorted({len(words) for words in lines})
    ]
    return [*binary, *text] or [{}]


def _has_temperatures(words: Sequence[bytes]) -> bool:
    """Return whether every fourth word is a plausible temperature in °C with decimals, as in lines of AnySkin."""
    try:
        return len(words) % 4 == 0 < len(words) and all(
            b"." in word and MIN_DEGC <= float(word) <= MAX_DEGC for word in words[::4]
        )
    except ValueError:
        return False


def _justfloat(data: bytes) -> list[Options]:
    sizes = [distance - 4 for distance in distances(data, bytes.fromhex("0000807f"))]
    plain: list[Options] = [{"channels": size // 4} for size in sizes if size and size % 4 == 0]
    return plain + [{"model": model} for model in ("fulai-3.0", "fulai-3.1", "fulai-3.2")]


def _choices(name: str, *values: OptionValue) -> Callable[[bytes], list[Options]]:
    return lambda _: [{name: value} for value in values]


VARIANTS: Mapping[str, Callable[[bytes], list[Options]]] = {
    "anyskin": _anyskin,
    "flexitac": _flexitac,
    "justfloat": _justfloat,
    "optoforce": _choices("axes", 6, 3, 12),
    "robotiq": _choices("fingers", 2, 1),
    "xela": _choices("taxels", 16, 24, 30),
}
