"""What every part of the page is written with: style, figures, tables, and numbers as text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

Tree = Mapping[str, Any]

STYLE = """
:root { color-scheme: light dark; --paper: #fff; --text: #1c1e21; --faint: #8a8f98; --note: #5b626c; --panel: #f4f5f7;
  --model: #1f6feb; --persistence: #d9730d; --codec: #2f9e63; --other: #8a6fc9; }
@media (prefers-color-scheme: dark) { :root { --paper: #15171a; --text: #e3e5e8; --panel: #1f2226;
  --faint: #7d838c; --note: #a6adb7; --model: #6cabff; --persistence: #ff9d4d; --codec: #5fce93; --other: #b79cf2; } }
body { background: var(--paper); color: var(--text); font: 16px/1.5 system-ui, sans-serif; max-width: 72rem;
  margin: 2rem auto; padding: 0 1rem; overflow-wrap: break-word; }
h1 { font-size: 1.4rem; } h2 { font-size: 1.15rem; margin-top: 2.5rem; } h3 { font-size: 1rem; margin-bottom: .3rem; }
.headline { background: var(--panel); border-left: .35rem solid var(--faint); padding: .8rem 1.1rem; font-size: 1.3rem; }
.better { border-color: var(--codec); } .worse { border-color: var(--persistence); }
.note { color: var(--note); font-size: .9rem; }
.badge { background: var(--persistence); color: var(--paper); border-radius: .3rem; padding: .1rem .5rem;
  font-size: .85rem; vertical-align: middle; }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 24rem), 1fr)); gap: 1.5rem; }
.pair > * { min-width: 0; }
figure { margin: 1rem 0; } figcaption { color: var(--note); font-size: .9rem; } svg { max-width: 100%; height: auto; }
svg.wide { max-width: none; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .92rem; }
th, td { text-align: right; padding: .25rem .55rem; border-bottom: 1px solid var(--panel); }
th:first-child, td:first-child, .words th, .words td { text-align: left; } .scroll { overflow-x: auto; }
td { vertical-align: top; } td:first-child, small { white-space: nowrap; } small { color: var(--note); font-size: .8rem; }
.words td:first-child { white-space: normal; } .names th:nth-child(2), .names td:nth-child(2) { text-align: left; }
tr.best td { font-weight: 600; } tr.quiet td { color: var(--note); }
code { font-size: .85rem; overflow-wrap: anywhere; }
"""


NONE = "–"  # stands where there is no number


class Markup(str):
    """Text that is HTML already, and is not escaped again."""


def gain(skill: float) -> str:
    """Return skill in words.

    >>> gain(0.2), gain(-3.5)
    ('20 % better', '350 % worse')
    """
    percent = abs(100 * skill)
    return f"{percent:,.{0 if percent >= 10 else 1}f} % {'better' if skill >= 0 else 'worse'}"


def skill(value: float) -> str:
    """Return a skill with its sign.

    >>> skill(-43.559), skill(0.1234)
    ('−43.6', '+0.123')
    """
    described = f"{value:+.3g}" if abs(value) < 1000 else f"{value:+,.0f}"
    return described.replace("-", "−")


def number(value: float) -> str:
    """Return a number with four digits, without exponent where it is not tiny.

    >>> number(12345.6), number(0.012345)
    ('12,346', '0.01235')
    """
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def interval(one: Tree) -> str:
    """Return a skill and its interval, as far as they are defined.

    >>> interval({"mean": 0.5, "low": 0.25, "high": 0.75})
    '+0.5 (+0.25 to +0.75)'
    """
    if "mean" not in one:
        return "not defined"
    return skill(one["mean"]) + (f" ({skill(one['low'])} to {skill(one['high'])})" if "low" in one else "")


def decimals(value: float) -> str:
    """Return a skill with three decimals, so that those of a column are as long.

    >>> decimals(0.5), decimals(-123.4)
    ('+0.500', '−123')
    """
    return f"{value:+.3f}".replace("-", "−") if abs(value) < 10 else skill(value)


def sure(mean: float, low: float, high: float) -> Markup:
    """Return a skill above its interval in small print, as far as both are defined.

    >>> sure(0.5, 0.25, float("nan")), sure(float("nan"), 0.1, 0.2)
    ('+0.500', 'not defined')
    >>> sure(0.5, 0.25, 0.75), sure(-12.345, -12.345, -12.345)
    ('+0.500<br><small>+0.250 to +0.750</small>', '−12.3')
    """
    if math.isnan(mean):
        return Markup("not defined")
    described = [decimals(value) for value in (mean, low, high)]
    spread = low < high and described[1] != described[2]  # neither NaN nor persistence next to itself
    return Markup(described[0] + (f"<br><small>{described[1]} to {described[2]}</small>" if spread else ""))


def with_sd(mean: float, sd: float, digits: int = 4) -> str:
    r"""Return mean ± standard deviation with so many decimals, as far as both are defined.

    >>> with_sd(0.05, 0.00123), with_sd(0.05, float("nan")), with_sd(float("nan"), 0.1)
    ('0.0500\xa0±\xa00.0012', '0.0500', '–')
    """
    if math.isnan(mean):
        return NONE
    return f"{mean:.{digits}f}" + ("" if math.isnan(sd) else f"\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{sd:.{digits}f}")


def listed(names: list[str]) -> str:
    """Return names as a sentence has them.

    >>> listed(["a", "b", "c"]), listed(["a"]), listed([])
    ('a, b and c', 'a', '')
    """
    return " and ".join(part for part in (", ".join(names[:-1]), *names[-1:]) if part)


def figure(svg: str, caption: str) -> str:
    """Return a figure with what it shows."""
    return f'<figure><div class="scroll">{svg}</div><figcaption>{escape(caption)}</figcaption></figure>'


def note(text: str) -> str:
    """Return a paragraph in small print; empty without a text."""
    return f'<p class="note">{escape(text)}</p>' if text else ""


def table(
    title: str, heads: Sequence[str], rows: Sequence[Sequence[str]], kinds: Mapping[int, str] | None = None
) -> str:
    """Return a table that scrolls sideways where it is too wide; ``kinds`` has classes of rows by their number."""
    head = "".join(f"<th>{_cell(cell)}</th>" for cell in heads)
    body = ""
    for number, row in enumerate(rows):
        kind = f' class="{kinds[number]}"' if kinds and number in kinds else ""
        body += f"<tr{kind}>" + "".join(f"<td>{_cell(cell)}</td>" for cell in row) + "</tr>\n"
    return (
        f'<h4>{escape(title)}</h4><div class="scroll"><table><thead><tr>{head}</tr></thead>\n'
        f"<tbody>{body}</tbody></table></div>"
    )


def _cell(content: str) -> str:
    return content if isinstance(content, Markup) else escape(content)
