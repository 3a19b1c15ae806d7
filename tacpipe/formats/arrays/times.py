"""When the rows of a stream of arrays were measured: by the array of its stamps, or a rate that the file states."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from tacpipe.formats.arrays.episodes import Episode
from tacpipe.formats.arrays.parts import Part
from tacpipe.formats.arrays.tree import Tree
from tacpipe.formats.containers.container import Time, TimeUnit

RATES = ("rate_hz", "fps", "frequency_hz", "frequency", "control_freq", "sampling_rate", "sample_rate", "rate", "hz")
UNITS: Mapping[str, TimeUnit] = {
    **{"s": "s", "sec": "s", "second": "s", "seconds": "s", "ms": "ms", "millisecond": "ms", "milliseconds": "ms"},
    **{"us": "us", "µs": "us", "microsecond": "us", "microseconds": "us", "ns": "ns", "nanosecond": "ns"},
    "nanoseconds": "ns",
}
SINCE_1970: tuple[tuple[float, TimeUnit], ...] = ((1e11, "s"), (1e14, "ms"), (1e17, "us"), (float("inf"), "ns"))
LEAST = 1e8  # seconds since 1970: what is less counts from the start of a recording


def of(tree: Tree, episode: Episode, part: Part) -> Time:
    """Return where the stamps of a stream come from; an empty `Time` where the file states neither stamps nor a rate."""
    if part.clock:
        unit = _unit(part, size := _last(tree, episode, part))
        if unit is not None:
            declared = part.time is not None and part.time.attributes.get("quantity") == "time"
            since_1970 = declared or size >= LEAST * 10 ** {"s": 0, "ms": 3, "us": 6, "ns": 9}[unit]
            return Time(column=part.clock, unit=unit, origin="unix" if since_1970 else "start")
    rate = rate_hz(tree, episode, part)
    return Time() if rate is None else Time(rate_hz=rate)


def rows(episode: Episode, part: Part) -> int:
    """Return how many rows of a stream belong to a recording."""
    length = part.arrays[0].shape[0]
    return max((length if episode.stop is None else min(episode.stop, length)) - episode.start, 0)


def above(group: str) -> list[str]:
    """Return a group and those above it, the root first.

    >>> above("data/demo_0")
    ['', 'data', 'data/demo_0']
    """
    names = group.split("/") if group else []
    return ["/".join(names[:count]) for count in range(len(names) + 1)]


def _last(tree: Tree, episode: Episode, part: Part) -> float:
    """Return the last stamp of a stream as its file holds it, without sign; 0 where there is none."""
    array = part.time or part.arrays[0]
    last = episode.start + rows(episode, part)
    found = np.asarray(tree.read(array, max(last - 1, 0), last))
    values = (found if part.time is not None else found[part.clock]).reshape(-1)
    return abs(float(values[0])) if len(values) and np.isfinite(values[0]) else 0.0


def _unit(part: Part, size: float) -> TimeUnit | None:
    """Return the unit of stamps, as an attribute, the name or their size shows it; None where nothing does."""
    attributes = part.time.attributes if part.time is not None else {}
    stated = next((str(attributes[key]) for key in ("unit", "units") if isinstance(attributes.get(key), str)), "")
    suffix = re.search(r"_(ns|us|ms|s|sec|seconds)$", part.clock, re.IGNORECASE)
    unit = UNITS.get(stated.strip().lower()) or (UNITS.get(suffix[1].lower()) if suffix else None)
    return unit or (next(unit for most, unit in SINCE_1970 if size < most) if size >= LEAST else None)


def rate_hz(tree: Tree, episode: Episode, part: Part | None) -> float | None:
    """Return the rate that attributes of a stream's arrays, its group or one above state, or that all recordings have."""
    arrays = part.arrays if part is not None else ()
    groups = [*reversed(above(arrays[0].group))] if arrays else []
    stated = [*(one.attributes for one in arrays), *map(tree.attributes, groups)]
    stated += [tree.attributes(episode.beside)] if episode.beside is not None else []
    return next((found for one in stated if (found := _stated(one)) is not None), None)


def _stated(attributes: Mapping[str, Any]) -> float | None:
    for name in RATES:
        value = attributes.get(name)
        if isinstance(value, int | float | np.number) and np.isfinite(value) and 0 < value <= 1e9:
            return float(value)
    environment = attributes.get("env_args")  # of robomimic: a text of JSON
    if isinstance(environment, str | bytes):
        try:
            inner = json.loads(environment)["env_kwargs"]
        except (ValueError, KeyError, TypeError, RecursionError):
            return None
        return _stated({"control_freq": inner.get("control_freq")}) if isinstance(inner, dict) else None
    return None
