"""Parts that all charts share: their colours, legend, zoom and tips, and how numbers are written into a specification."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

Spec = dict[str, Any]
COLOURS = tuple(f"var(--c{number})" for number in range(8))
QUIET, INK, BETTER, WORSE = "var(--faint)", "var(--text)", "var(--c0)", "var(--c1)"
DIGITS = 5  # digits of a number: more cannot be seen
FEW_STEPS = 12  # whole numbers on an axis, up to which each has a tick
MARGIN = 8  # pixels between points and the ends of an axis, so that none is cut


def colour_of(number: int, count: int) -> str:
    """Return a colour that is derived from its neighbours' on a light page and on a dark one."""
    if count <= len(COLOURS):
        return COLOURS[number]
    return f"hsl({360 * number // count} 70% {(42, 62)[number % 2]}%)"


def legend_of(count: int) -> Spec | None:
    """Return the legend of so many names, None where there is one."""
    if count < 2:
        return None
    return {"title": None, "orient": "bottom", "direction": "vertical" if count < 7 else "horizontal", "labelLimit": 330,
            "columns": 1 if count < 7 else 2, "symbolStrokeWidth": 3, "symbolOpacity": 1}  # fmt: skip


def zoom() -> Spec:
    """Return what zooms with Shift and the wheel and moves by dragging."""
    return {"name": "zoom", "select": {"type": "interval", "zoom": "wheel![event.shiftKey]"}, "bind": "scales"}


def whole_steps(values: Iterable[object]) -> Spec:
    """Return the options of an axis: ticks at whole numbers where all values are whole, such as epochs and counts."""
    numbers = sorted({value for value in values if isinstance(value, int | float)})
    if not all(float(value).is_integer() for value in numbers):
        return {}
    return {"axis": {"tickMinStep": 1} if len(numbers) > FEW_STEPS else {"values": numbers, "format": ","}}


def tip_of(name: str, title: str) -> Spec:
    """Return a field that is stated under the cursor."""
    return {"field": name, "title": title or " "}


def y_of(name: str) -> Spec:
    """Return the place of a field up and down."""
    return {"field": name, "type": "quantitative"}


def diagonal_of(ends: Sequence[float]) -> Spec:
    """Return a thin line on which x and y are the same, between its ends."""
    values = [{"x": short(end), "y": short(end)} for end in ends]
    mark = {"type": "line", "stroke": INK, "strokeWidth": 0.8}
    return {
        "data": {"values": values},
        "mark": mark,
        "encoding": {"x": {"field": "x", "type": "quantitative"}, "y": y_of("y")},
    }


def text_of(value: float) -> str:
    """Return a number as text."""
    return f"{value:.4g}".replace("-", "\N{MINUS SIGN}")


def short(value: float) -> float | None:
    """Return a number with as many digits as can be seen; None where it is not defined, as JSON has it."""
    value = float(value)
    return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
