"""Options that a product may be set to, as far as its bytes state: what to try where nobody wrote them down."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from tacpipe.sensors import camera, lines_guess, lsl
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Options, OptionValue

GRIDS = {
    384: (12, 32),
    256: (16, 16),
    512: (16, 32),
    1024: (32, 32),
}  # taxels to rows and columns of boards that are known
LEAST_TAXELS = 64  # smallest unknown board: many others mark their frames with the same two bytes
LEAST_DEGC, MOST_DEGC = -40.0, 85.0  # operating range of the magnetometers of an AnySkin
MOST_TRIED = 3  # distances between marks, the commonest first


def of(kind: str, data: Chunks) -> list[Options]:
    """Return the options to try for a sensor of this registered name on these bytes, the likeliest first.

    >>> of("justfloat", Chunks.of([(0, (bytes(12) + bytes.fromhex("0000807f")) * 5)]))
    [{'channels': 3}, {'model': 'fulai-3.0'}, {'model': 'fulai-3.1'}, {'model': 'fulai-3.2'}]
    >>> of("biotac", Chunks.of([]))
    [{}]
    """
    if kind == "lines":  # arrivals state more than bytes: the rate, and which number is a clock
        return lines_guess.of(data)
    if kind == "lsl":
        return lsl.options(data)
    if kind == "camera":
        return camera.options(data)
    return VARIANTS[kind](data.data) if kind in VARIANTS else [{}]


def distances(data: bytes, mark: bytes) -> list[int]:
    """Return how many bytes a mark mostly comes after the one before, the commonest first.

    >>> distances(b"ab__ab__ab_ab__", b"ab")
    [4, 3]
    """
    places, mark_at = [], data.find(mark)
    while mark_at >= 0:
        places.append(mark_at)
        mark_at = data.find(mark, mark_at + 1)
    counted = Counter(after - before for before, after in itertools.pairwise(places))
    return [distance for distance, _ in counted.most_common(MOST_TRIED)]


def _flexitac(data: bytes) -> list[Options]:
    taxels = [distance - 2 for distance in distances(data, b"\xaa\x55") if distance - 2 >= LEAST_TAXELS]
    grids = [GRIDS.get(count, (1, count)) for count in taxels]
    return [{"rows": rows, "columns": columns} for rows, columns in grids] or [{}]


def _anyskin(data: bytes) -> list[Options]:
    sizes = [distance - 2 for distance in distances(data, b"\r\n")]
    binary: list[Options] = [{"magnetometers": size // 16} for size in sizes if size and size % 16 == 0]
    lines = [line.split() for line in data.split(b"\n")[1:4] if _has_temperatures(line.split())]
    text: list[Options] = [
        {"mode": "ascii", "magnetometers": count // 4} for count in sorted({len(words) for words in lines})
    ]
    return [*binary, *text] or [{}]


def _has_temperatures(words: Sequence[bytes]) -> bool:
    """Return whether every fourth word can be the temperature of a chip in degrees, as AnySkin sends it with decimals."""
    try:
        return len(words) % 4 == 0 < len(words) and all(
            b"." in word and LEAST_DEGC <= float(word) <= MOST_DEGC for word in words[::4]
        )
    except ValueError:
        return False


def _justfloat(data: bytes) -> list[Options]:
    sizes = [distance - 4 for distance in distances(data, bytes.fromhex("0000807f"))]
    plain: list[Options] = [{"channels": size // 4} for size in sizes if size and size % 4 == 0]
    return plain + [{"model": model} for model in ("fulai-3.0", "fulai-3.1", "fulai-3.2")]


def _several(name: str, *values: OptionValue) -> Callable[[bytes], list[Options]]:
    return lambda _: [{name: value} for value in values]


VARIANTS: Mapping[str, Callable[[bytes], list[Options]]] = {
    "anyskin": _anyskin,
    "flexitac": _flexitac,
    "justfloat": _justfloat,
    "optoforce": _several("axes", 6, 3, 12),
    "robotiq": _several("fingers", 2, 1),
    "xela": _several("taxels", 16, 24, 30),
}
