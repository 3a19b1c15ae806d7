"""The parts of a page as data: tables, charts, notes and folds; `tacpipe.report.html` writes them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from tacpipe.report.charts import Spec

TINY = 1e-12  # a smaller number is a rounded 0
NONE = "–"  # stands where there is no number


@dataclass(frozen=True)
class Cell:
    """Text of a table, small text below it, what it is sorted by where that is not the text, and what a click copies."""

    text: str
    below: str = ""
    value: float | None = None
    copy: str = ""


@dataclass(frozen=True)
class Row:
    """A row of a table; its kind is one of ``best``, ``quiet`` or empty."""

    cells: Sequence[str | Cell]
    kind: str = ""


@dataclass(frozen=True)
class Group:
    """Rows that stay together: a heading, or a first row behind which the others fold."""

    rows: Sequence[Row]
    title: str = ""
    folded: bool = False


@dataclass(frozen=True)
class Table:
    """A table that can be sorted by its columns and scrolls sideways below its first one."""

    title: str
    heads: Sequence[str]
    groups: Sequence[Group]
    words: bool = False  # True: cells are text, to the left

    @property
    def rows(self) -> list[Row]:
        """All rows."""
        return [row for group in self.groups for row in group.rows]


@dataclass(frozen=True)
class Chart:
    """A chart and what it shows; a wide one takes the whole column."""

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
    """A heading behind which blocks are folded."""

    title: str
    blocks: Sequence[Block]
    about: str = ""  # a few words next to the heading


Block = Table | Chart | SmallPrint | Charts | Fold


@dataclass(frozen=True)
class Section:
    """The part of the page that one task has: its first screen, then what is folded."""

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
    """Return a table of one group, with the kinds of rows by their number."""
    return Table(title, heads, [Group([Row(row, (kinds or {}).get(at, "")) for at, row in enumerate(rows)])], words)


def fold(title: str, *blocks: Block | None, about: str = "") -> list[Fold]:
    """Return a fold of those blocks that are there, or None if none is."""
    shown_blocks = [
        block for block in blocks if block is not None and not (isinstance(block, SmallPrint) and not block.text)
    ]
    if all(isinstance(block, SmallPrint) for block in shown_blocks):
        return []
    return [Fold(title, shown_blocks, about)]


def notes(*texts: str) -> SmallPrint:
    """Return texts as one paragraph, empty ones left out."""
    return SmallPrint(" ".join(filter(None, texts)))


def number(value: float, digits: int = 4) -> Cell:
    """Return a number with so many digits, without exponent where it is not tiny.

    >>> number(12345.6).text, number(-0.012345).text, number(float("nan")).text
    ('12,346', '−0.01235', '–')
    """
    if math.isnan(value):
        return Cell(NONE)
    value = 0.0 if abs(value) < TINY else value
    text = f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.{digits}g}"
    return Cell(text.replace("-", "\N{MINUS SIGN}"), value=value)


def fixed(value: float, digits: int) -> str:
    """Return a number with so many decimals.

    >>> fixed(0.05496, 4), fixed(float("nan"), 4)
    ('0.0550', '–')
    """
    return NONE if math.isnan(value) else f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "\N{MINUS SIGN}")


def signed(value: float, digits: int = 3) -> str:
    """Return a number with its sign, with fewer decimals where it is large.

    >>> signed(0.5), signed(-123.4), signed(float("nan")), signed(2.0, 1)
    ('+0.500', '−123', '–', '+2.0')
    """
    if math.isnan(value):
        return NONE
    digits = digits if abs(value) < 10 or digits < 2 else 1 if abs(value) < 100 else 0
    return f"{round(value, digits) + 0.0:+,.{digits}f}".replace("-", "\N{MINUS SIGN}")


def interval(mean: float, low: float, high: float, digits: int = 3) -> Cell:
    """Return a signed number above its interval, where that is more than a point.

    >>> interval(0.5, 0.25, 0.75)
    Cell(text='+0.500', below='+0.250 to +0.750', value=0.5, copy='')
    """
    if math.isnan(mean):
        return Cell(NONE)
    ends = signed(low, digits), signed(high, digits)
    below = "" if NONE in ends or ends[0] == ends[1] else f"{ends[0]} to {ends[1]}"
    return Cell(signed(mean, digits), below, mean)


def with_sd(mean: float, sd: float, digits: int = 4) -> Cell:
    """Return mean ± standard deviation, as far as both are defined.

    >>> with_sd(0.05, 0.00123).text, with_sd(0.05, float("nan")).text
    ('0.0500 ± 0.0012', '0.0500')
    """
    if math.isnan(mean):
        return Cell(NONE)
    return Cell(fixed(mean, digits) + ("" if math.isnan(sd) else f" ± {fixed(sd, digits)}"), value=mean)


def p_value(p: float) -> Cell:
    """Return a p value with two digits.

    >>> p_value(0.00016).text, p_value(1e-9).text, p_value(float("nan")).text
    ('0.00016', '< 0.0001', '–')
    """
    return Cell(NONE if math.isnan(p) else "< 0.0001" if p < 1e-4 else f"{p:.2g}", value=None if math.isnan(p) else p)


def form(name: str, text: str, published: bool) -> str:
    """Return a caption or title, as that of a table or figure of the paper where the data are the paper's.

    >>> form("Figure 9", "validation accuracy", True), form("Figure 9", "validation accuracy", False)
    ("Figure 9 in the paper's form: validation accuracy", 'Validation accuracy')
    """
    return f"{name} in the paper's form: {text}" if published else f"{text[:1].upper()}{text[1:]}"


def counted(count: int, plural: str) -> str:
    """Return how many there are of a noun.

    >>> counted(1, "recordings"), counted(1200, "slides")
    ('1 recording', '1,200 slides')
    """
    return f"{count:,} {plural.removesuffix('s') if count == 1 else plural}"


def listed(names: Sequence[str]) -> str:
    """Return names as a sentence has them.

    >>> listed(["a", "b", "c"]), listed(["a"]), listed([])
    ('a, b and c', 'a', '')
    """
    return " and ".join(part for part in (", ".join(names[:-1]), *names[-1:]) if part)
