"""Text from anywhere in a form that is safe to print: short, on one line, without control characters."""

from __future__ import annotations

import difflib
import re
import reprlib
import unicodedata
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from typing import Any

WALL_CLOCK_NS = 10**18  # timestamps above this (2001) are Unix time
_WIDE = ("W", "F")  # widths of East Asian letters that occupy two cells
_SHORT = reprlib.Repr()  # visits only what it prints, so that aliases of aliases cost no time
_SHORT.maxlevel = 2
_SHORT.maxstring = _SHORT.maxother = 60
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = _SHORT.maxset = 4


def excerpt(value: Any) -> str:
    """Return the repr of a value, cut to a line's length.

    >>> excerpt("x" * 1000), excerpt([[[1]], 2, 3, 4, 5])
    ("'xxxxxxxxxxxxxxxxxxxxxxxxxxx...xxxxxxxxxxxxxxxxxxxxxxxxxxxx'", '[[[...]], 2, 3, 4, ...]')
    """
    try:
        return _SHORT.repr(value)
    except ValueError:  # Python refuses to print integers of more than 4300 digits
        return "a number of thousands of digits"


def plain(text: str, max_characters: int = 60) -> str:
    r"""Return text as it is where it is short and printable, else its `excerpt`.

    >>> plain("xela1"), plain("a\x1b[2J")
    ('xela1', "'a\\x1b[2J'")
    """
    return text if len(text) <= max_characters and text.isprintable() else excerpt(text)


def listed(names: Iterable[object], max_names: int = 8) -> str:
    """Return names with commas between, the first of many.

    >>> listed(["a", "b", "c"], max_names=2), listed([])
    ('a, b and 1 more', 'none')
    """
    texts = [plain(str(name)) for name in names]
    suffix = f" and {len(texts) - max_names} more" if len(texts) > max_names else ""
    return (", ".join(texts[:max_names]) or "none") + suffix


def format_count(count: int, plural: str) -> str:
    """Return a count with its noun, singular for 1; thousands are separated.

    >>> format_count(1, "recordings"), format_count(1200, "slides")
    ('1 recording', '1,200 slides')
    """
    return f"{count:,} {plural.removesuffix('s') if count == 1 else plural}"


def round_to(value: float, digits: int) -> float:
    """Return a value with some significant digits.

    >>> round_to(123.456, 4), round_to(0.000123456, 2)
    (123.5, 0.00012)
    """
    return float(f"{value:.{digits}g}")


def suggestion(name: str, names: Iterable[str]) -> str:
    """Return a sentence, with a space before it, that suggests the most similar of ``names``; "" if none is similar.

    >>> suggestion("materail", ["sensor", "material"]), suggestion("xyz", ["sensor"])
    (' Did you mean material?', '')
    """
    similar = difflib.get_close_matches(name, list(names), n=1, cutoff=0.7)
    return f" Did you mean {plain(similar[0])}?" if similar else ""


def grouped_failures(failures: Mapping[str, str], limit: int = 5) -> list[str]:
    """Return one line per reason with the names that failed for it; reasons that differ only in these names are equal.

    >>> grouped_failures({"a": "a.csv is empty", "b": "b.csv is empty", "c": "no clock"})
    ['a, b: NAME.csv is empty', 'c: no clock']
    """
    names_by_reason: dict[str, list[str]] = {}
    for name, reason in failures.items():
        without_name = re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", "NAME", reason)
        names_by_reason.setdefault(without_name, []).append(name)
    return [
        f"{listed(names, limit)}: {reason if len(names) > 1 else failures[names[0]]}"
        for reason, names in names_by_reason.items()
    ]


def shown(text: str) -> str:
    r"""Return text with each character that a terminal does not print as an escape: controls, line ends, bidi marks.

    >>> shown("trial-木"), shown("a\x1b[2J\n"), shown("\u202etxt")
    ('trial-木', 'a\\x1b[2J\\n', '\\u202etxt')
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or unicodedata.category(c) == "Zs" else ascii(c)[1:-1] for c in text)


def moment(t_ns: int) -> str:
    """Return a timestamp as a date in UTC if it counts from 1970, else as seconds.

    >>> moment(1_396_293_889_366_115_136), moment(2_500_000_000)
    ('2014-03-31 19:24:49.366 UTC', '2.500 s')
    """
    if t_ns < WALL_CLOCK_NS:
        return f"{t_ns / 1e9:.3f} s"
    date = datetime.fromtimestamp(t_ns // 10**9, UTC)
    return f"{date:%Y-%m-%d %H:%M:%S}.{t_ns // 10**6 % 1000:03d} UTC"


def lines(texts: Iterable[str]) -> str:
    """Return texts as lines, each escaped by `shown`, so that a line break in a text does not add a line."""
    return "\n".join(shown(text) for text in texts)


def padded(text: str, width: int) -> str:
    """Return ``text`` with spaces after it, ``width`` cells of a terminal wide.

    >>> padded("木", 4), padded("cup", 4)
    ('木  ', 'cup ')
    """
    cells = sum(
        2 if unicodedata.east_asian_width(c) in _WIDE else not unicodedata.category(c).startswith("M") for c in text
    )
    return text + " " * (width - cells)
