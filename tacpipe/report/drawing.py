"""Figures as inline SVG: the same numbers give the same bytes, and colours follow the page's theme.

matplotlib draws with marker colours, which are then replaced by the page's CSS variables; ids that nothing refers to
and all metadata are taken out.
"""

from __future__ import annotations

import colorsys
import io
import itertools
import re
import textwrap
import warnings
from collections.abc import Callable
from html import escape
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes


INK, FAINT = "#010203", "#010204"
COLOURS = {"model": "#010301", "persistence": "#010302", "codec": "#010303", "other": "#010304"}
_THEME = {INK: "currentColor", FAINT: "var(--faint)", **{hexes: f"var(--{name})" for name, hexes in COLOURS.items()}}
STYLES = tuple(itertools.product(("-", "--", ":"), ("model", "persistence", "codec", "other")))  # of lines
LEGEND = 52  # letters of a line
_COLUMN = 6.0  # inches; a wider figure keeps its size on a small screen and is scrolled, or its text could not be read
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text stays text
    "text.parse_math": False,  # and a dollar in a name is one
    "font.family": "sans-serif",
    "font.sans-serif": ["system-ui", "DejaVu Sans"],
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "grid.color": FAINT,
    "grid.linewidth": 0.5,
}


def svg(draw: Callable[[list[Axes]], None], title: str, size: tuple[float, float], panels: int = 1) -> str:
    """Return what ``draw`` puts on the panels, as an ``<svg>`` element."""
    import matplotlib
    from matplotlib.figure import Figure

    content = io.StringIO()
    with matplotlib.rc_context({**_STYLE, "svg.hashsalt": title}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "constrained_layout not applied")  # names longer than the figure
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(panels, 1, sharex=True, squeeze=False)
        draw(list(grid[:, 0]))
        for axes in grid[:, 0]:
            _write_plainly(axes)
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(content, format="svg", transparent=True, metadata=nothing)
    drawn = re.sub(r"<metadata>.*?</metadata>", "", content.getvalue(), flags=re.DOTALL)
    drawn = drawn[drawn.index("<svg") :]
    wanted = set(re.findall(r"#([\w-]+)[\")]", drawn))
    drawn = re.sub(r' id="([\w.-]+)"', lambda found: found[0] if found[1] in wanted else "", drawn)
    for colour, variable in _THEME.items():
        drawn = drawn.replace(colour, variable)
    wide = ' class="wide"' if size[0] > _COLUMN else ""
    return drawn.replace("<svg", f'<svg role="img"{wide} aria-label="{escape(title)}"', 1)


def plain_number(value: float) -> str:
    """Return a tick of a logarithmic axis as text: powers of ten in superscript digits where there are many zeros.

    >>> plain_number(0.24), plain_number(1.0), plain_number(3e-5), plain_number(1e6)
    ('0.24', '1', '3×10⁻⁵', '10⁶')
    """
    if value == 0 or 1e-4 < abs(value) < 1e5:
        return f"{value:.10g}".replace("-", "−")
    digits, _, exponent = f"{value:.3e}".partition("e")
    power = f"10{str(int(exponent)).translate(_SUPERSCRIPT)}"
    factor = f"{float(digits):g}".replace("-", "−")
    return power if factor == "1" else f"{factor}×{power}"


def _write_plainly(axes: Axes) -> None:
    """Write the ticks of logarithmic axes as text: matplotlib's own are mathtext, which stays raw where text is text."""
    from matplotlib.ticker import LogFormatter

    class Plain(LogFormatter):
        def __call__(self, x: float, pos: int | None = None) -> str:
            return plain_number(x) if super().__call__(x, pos) else ""  # which ticks have room for a label

    for axis in (axes.xaxis, axes.yaxis):
        if isinstance(axis.get_major_formatter(), LogFormatter):
            axis.set_major_formatter(Plain())
        if isinstance(axis.get_minor_formatter(), LogFormatter):
            axis.set_minor_formatter(Plain(labelOnlyBase=False))


def legend_below(axes: Axes, columns: int = 1) -> None:
    """Put the names of what is drawn below the axes, long ones in several lines."""
    lines, names = axes.get_legend_handles_labels()
    # a name that is wider than the figure would take the width from what is drawn
    wrapped = ["\n   ".join(textwrap.wrap(name, LEGEND)) for name in names]
    axes.legend(lines, wrapped, ncols=columns, loc="upper left", bbox_to_anchor=(0, -0.18), borderaxespad=0)


def hue(number: int, of: int) -> tuple[float, float, float]:
    """Return a colour that is derived from its neighbours' on a light page and on a dark one."""
    return colorsys.hls_to_rgb(number / max(of, 1), (0.45, 0.6)[number % 2], 0.75)
