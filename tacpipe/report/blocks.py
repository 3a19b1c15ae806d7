"""The parts of a page as data: tables, charts, notes and folds, which `tacpipe.report.page` renders."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypedDict

from tacpipe.io import JsonObject

TINY = 1e-12  # numbers below this are zeros with a rounding error
NONE = "–"  # shown in place of a missing number


@dataclass(frozen=True)
class Cell:
    """A table cell: its text, small text below, a sort value if that is not the text, and the text copied on a click."""

    text: str
    below: str = ""
    value: float | None = None
    copy: str = ""


@dataclass(frozen=True)
class Row:
    """A table row, of kind ``best``, ``quiet`` or empty."""

    cells: Sequence[str | Cell]
    kind: str = ""


@dataclass(frozen=True)
class Group:
    """Rows of one group: under a heading, or folded under the first row."""

    rows: Sequence[Row]
    title: str = ""
    folded: bool = False


@dataclass(frozen=True)
class Table:
    """A table that can be sorted by column and scrolled sideways with its first column fixed."""

    title: str
    heads: Sequence[str]
    groups: Sequence[Group]
    words: bool = False  # whether cells are left-aligned text

    @property
    def rows(self) -> list[Row]:
        """All rows."""
        return [row for group in self.groups for row in group.rows]


DataRow = dict[str, str | float | None]  # a row of chart data, by field


class ChartScale(TypedDict, total=False):
    """How values of a field map to positions or colours."""

    type: str
    zero: bool
    nice: bool
    padding: float
    domain: Sequence[str | float | None]
    range: Sequence[str] | Sequence[Sequence[int]]


class ChartAxis(TypedDict, total=False):
    """The ticks and labels of an axis, or the labels of panels."""

    tickMinStep: float
    values: Sequence[float]
    format: str
    ticks: bool
    domain: bool
    labelExpr: str
    labelAngle: float
    labelLimit: float
    labelPadding: float
    labelFontSize: float
    labelFontWeight: int
    labelOrient: str
    labelAnchor: str


class ChartLegend(TypedDict, total=False):
    """The position and the symbols of a legend."""

    title: str | None
    orient: str
    direction: str
    columns: int
    labelLimit: float
    symbolType: str
    symbolStrokeWidth: float
    symbolOpacity: float


class Condition(TypedDict):
    """A value that depends on the reader's selection."""

    param: str
    value: float
    empty: bool  # whether everything counts as selected while nothing is


class SortField(TypedDict):
    """The field to sort by."""

    field: str


class ChartChannel(TypedDict, total=False):
    """A field or a value that is mapped to a position, a colour or another property of a mark."""

    field: str
    type: str
    title: str | None
    sort: SortField | Sequence[str] | None
    scale: ChartScale | None
    axis: ChartAxis | None
    header: ChartAxis
    legend: ChartLegend | None
    condition: Condition
    value: float


class ChartEncoding(TypedDict, total=False):
    """The channels of a layer."""

    x: ChartChannel
    x2: ChartChannel
    y: ChartChannel
    y2: ChartChannel
    color: ChartChannel
    opacity: ChartChannel
    shape: ChartChannel
    strokeDash: ChartChannel
    text: ChartChannel
    row: ChartChannel
    tooltip: Sequence[ChartChannel]


class ChartMark(TypedDict, total=False):
    """The shape and appearance of a row of data."""

    type: str
    clip: bool
    filled: bool
    size: float
    shape: str | dict[str, str]
    opacity: float
    fill: str
    stroke: str | None
    strokeWidth: float
    strokeDash: Sequence[int]
    fontSize: float
    tooltip: str | None


class ChartSelection(TypedDict, total=False):
    """A selection with the pointer."""

    type: str
    fields: Sequence[str]
    zoom: str


class ChartParam(TypedDict, total=False):
    """A named selection."""

    name: str
    select: ChartSelection
    bind: str


class Spec(TypedDict, total=False):
    """The Vega-Lite specification of a chart or of a layer, restricted to the parts that are used here."""

    data: dict[str, list[DataRow]]
    transform: Sequence[dict[str, str]]
    params: Sequence[ChartParam]
    mark: ChartMark
    encoding: ChartEncoding
    layer: list[Spec]
    height: int | dict[str, int]
    view: dict[str, str | None]
    facet: ChartChannel | ChartEncoding
    spec: Spec
    resolve: dict[str, dict[str, str]]
    spacing: int
    usermeta: dict[str, float | None]  # hints for the page's script


@dataclass(frozen=True)
class Chart:
    """A chart with a caption; a wide one fills the column."""

    title: str
    spec: Spec
    caption: str = ""
    wide: bool = False


@dataclass(frozen=True)
class SmallPrint:
    """A paragraph in small print."""

    text: str


@dataclass(frozen=True)
class Charts:
    """Charts side by side."""

    charts: Sequence[Chart]


@dataclass(frozen=True)
class Fold:
    """A heading that folds its blocks."""

    title: str
    blocks: Sequence[Block]
    about: str = ""  # a few words next to the heading


@dataclass(frozen=True)
class Picture:
    """A JPEG image with a description and a caption."""

    content: bytes
    text: str
    below: str = ""

    @property
    def source(self) -> str:
        """The image as the source of an HTML element."""
        return f"data:image/jpeg;base64,{base64.b64encode(self.content).decode()}"


@dataclass(frozen=True)
class ImageRow:
    """Images next to each other."""

    title: str
    pictures: Sequence[Picture]


Block = Table | Chart | SmallPrint | Charts | ImageRow | Fold


@dataclass(frozen=True)
class Section:
    """The section of a task: its first screen, then folds."""

    name: str  # name of the task
    title: str
    sentence: str
    verdict: str = ""
    chart: Chart | None = None
    table: Table | None = None
    folds: Sequence[Fold] = ()
    simulated: bool = False
    counts: Sequence[str] = field(default=())  # "3 methods", "39 recordings"


def table(
    title: str,
    heads: Sequence[str],
    rows: Sequence[Sequence[str | Cell]],
    kinds: Mapping[int, str] | None = None,
    *,
    words: bool = False,
) -> Table:
    """Return a table of one group without a title; ``kinds`` are the kinds of rows by index, "" for the others.

    ``words`` left-aligns the cells.
    """
    return Table(
        title, heads, [Group([Row(row, (kinds or {}).get(index, "")) for index, row in enumerate(rows)])], words
    )


def fold(title: str, *blocks: Block | None, about: str = "") -> list[Fold]:
    """Return a list with a fold of the blocks that are not empty; an empty list if only small print remains."""
    shown_blocks = [
        block for block in blocks if block is not None and not (isinstance(block, SmallPrint) and not block.text)
    ]
    if all(isinstance(block, SmallPrint) for block in shown_blocks):
        return []
    return [Fold(title, shown_blocks, about)]


def notes(*texts: str) -> SmallPrint:
    """Return the non-empty texts as one paragraph."""
    return SmallPrint(" ".join(filter(None, texts)))


def number(value: float, digits: int = 4) -> Cell:
    """Return a number with this many significant digits, thousands separated, "–" for NaN; tiny numbers are 0.

    >>> number(12345.6).text, number(-0.012345).text, number(float("nan")).text
    ('12,346', '−0.01235', '–')
    """
    if math.isnan(value):
        return Cell(NONE)
    rounded = 0.0 if abs(value) < TINY else value
    text = f"{rounded:,.0f}" if abs(rounded) >= 1000 else f"{rounded:.{digits}g}"
    return Cell(text.replace("-", "\N{MINUS SIGN}"), value=rounded)


def fixed(value: float, digits: int) -> str:
    """Return a number with this many decimals, "–" for NaN.

    >>> fixed(0.05496, 4), fixed(float("nan"), 4)
    ('0.0550', '–')
    """
    return NONE if math.isnan(value) else f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "\N{MINUS SIGN}")


def signed(value: float, digits: int = 3) -> str:
    """Return a number with its sign, "–" for NaN; with at most one decimal from 10, and none from 100.

    >>> signed(0.5), signed(-123.4), signed(float("nan")), signed(2.0, 1)
    ('+0.500', '−123', '–', '+2.0')
    """
    if math.isnan(value):
        return NONE
    shown_digits = digits
    if abs(value) >= 10 and digits >= 2:
        shown_digits = 1 if abs(value) < 100 else 0
    return f"{round(value, shown_digits) + 0.0:+,.{shown_digits}f}".replace("-", "\N{MINUS SIGN}")


def interval(mean: float, low: float, high: float, digits: int = 3) -> Cell:
    """Return a signed number with its interval below, unless the interval is a point or NaN; "–" if the mean is NaN.

    >>> interval(0.5, 0.25, 0.75)
    Cell(text='+0.500', below='+0.250 to +0.750', value=0.5, copy='')
    """
    if math.isnan(mean):
        return Cell(NONE)
    ends = signed(low, digits), signed(high, digits)
    below = "" if NONE in ends or ends[0] == ends[1] else f"{ends[0]} to {ends[1]}"
    return Cell(signed(mean, digits), below, mean)


def estimate(values: Iterable[float | None], digits: int, basis: str = "", factor: float = 1.0) -> Cell:
    """Return a value with this many decimals, and below it its interval, unless that is a point or NaN, and its ``basis``.

    ``values`` are mean, low and high, to be multiplied by ``factor``; None is NaN. "–" if the mean is NaN.

    >>> estimate((0.95, 0.91, 0.97), 1, "190/200", 100)
    Cell(text='95.0', below='91.0 to 97.0, 190/200', value=95.0, copy='')
    """
    mean, low, high = (math.nan if value is None else factor * value for value in values)
    if math.isnan(mean):
        return Cell(NONE)
    ends = fixed(low, digits), fixed(high, digits)
    between = "" if NONE in ends or ends[0] == ends[1] else " to ".join(ends)
    return Cell(fixed(mean, digits), ", ".join(filter(None, (between, basis))), mean)


def p_value(p: float) -> Cell:
    """Return a p value with two digits, "< 0.0001" for a smaller one, "–" for NaN.

    >>> p_value(0.00016).text, p_value(1e-9).text, p_value(float("nan")).text
    ('0.00016', '< 0.0001', '–')
    """
    if math.isnan(p):
        return Cell(NONE)
    return Cell("< 0.0001" if p < 1e-4 else f"{p:.2g}", value=p)


def leaves(tree: JsonObject) -> dict[str, str]:
    """Return nested values as text by the names that lead to them; "–" for None.

    >>> leaves({"model": {"accuracy": {"biotac": 0.5}}, "classes": [1, 2], "p": None})
    {'model, accuracy, biotac': '0.5', 'classes': '[1, 2]', 'p': '–'}
    """
    texts: dict[str, str] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            texts.update({f"{name}, {path}": text for path, text in leaves(value).items()})
        elif isinstance(value, int | float) and not isinstance(value, bool):
            texts[name] = number(value).text
        else:
            texts[name] = NONE if value is None else json.dumps(value)
    return texts
