"""Read stamps that are text in a format of ``strptime``, a whole column at a time."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from tacpipe.errors import UsageError
from tacpipe.printable import excerpt

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import Bools, Int64s

_DIRECTIVES = {
    "Y": r"\d{4}",
    "y": r"\d{2}",
    **dict.fromkeys("mdHIMS", r"\d{1,2}"),
    "f": r"\d{1,9}",
    "p": r"[AaPp][Mm]",
    "b": r"[A-Za-z]{3}",
    "B": r"[A-Za-z]+",
}
_PART = re.compile(r"(?P<fraction>%S[.,]%f)|%(?P<letter>.)|(?P<text>[^%]+)", re.DOTALL)
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
DAY_NS = 86_400 * 10**9


def check_format(text: str, place: str) -> None:
    """Raise `UsageError` for a format with a directive that is not read, or without an hour."""
    letters = re.findall(r"%(.)", text.replace("%%", ""), re.DOTALL)
    unread = sorted({f"%{letter}" for letter in letters} - {f"%{letter}" for letter in _DIRECTIVES})
    if unread or not {"H", "I"} & set(letters):
        raise UsageError(
            f"{place}: format is {excerpt(text)}; it must name an hour (%H), and is made of "
            f"{', '.join(f'%{letter}' for letter in _DIRECTIVES)}."
        )


def has_date(text: str) -> bool:
    """Return whether stamps of a format state their day.

    >>> has_date("%d.%m.%Y %H:%M"), has_date("%H:%M:%S.%f")
    (True, False)
    """
    return bool(re.search("%[Yy]", text))


def format_expression(text: str) -> str:
    """Return the regular expression of a format, with a group for each directive.

    A fraction of a second may be left out, as Python does where it is zero.
    """
    regex = ""
    for match in _PART.finditer(text):
        if match["fraction"]:
            regex += rf"(?P<S>\d{{1,2}})(?:{re.escape(match['fraction'][2])}(?P<f>\d{{1,9}}))?"
        elif match["letter"] == "%":
            regex += "%"
        elif match["letter"]:
            regex += f"(?P<{match['letter']}>{_DIRECTIVES[match['letter']]})"
        else:
            regex += "".join(
                letter if letter.isalnum() or letter == " " else f"[{letter}]" if letter != "^" else r"\^"
                for letter in match["text"]
            )
    return f"^{regex}$"


def parse_stamps(column: pa.Array, text: str) -> tuple[Int64s, Bools]:
    """Return stamps as nanoseconds since 1970 without regard to a zone, or since midnight, and whether each is a time.

    ``column`` holds text of the format ``text``; both results have the shape (row,).

    >>> import pyarrow as pa
    >>> parse_stamps(pa.array(["01.02.1970 00:00:01.5", "31.02.1970 00:00:00", "x"]), "%d.%m.%Y %H:%M:%S.%f")
    (array([2678401500000000,                0,                0]), array([ True, False, False]))
    """
    import numpy as np
    import pyarrow.compute as pc

    groups = pc.extract_regex(pc.utf8_trim_whitespace(column), format_expression(text))
    valid = groups.is_valid().to_numpy(zero_copy_only=False)
    parts = {field.name: pc.struct_field(groups, field.name).fill_null("") for field in groups.type}

    def number(letter: str, default: int = 0) -> Int64s:
        values = parts.get(letter)
        if values is None:
            return np.full(len(column), default, np.int64)
        filled = pc.if_else(pc.equal(values, ""), str(default), values)
        return np.asarray(filled.cast("int64").to_numpy(zero_copy_only=False))

    month = number("m", 1)
    for letter in {"b", "B"} & set(parts):
        names = pc.utf8_slice_codeunits(pc.utf8_lower(parts[letter]), 0, 3).to_pylist()
        month = np.array([_MONTHS.index(name) + 1 if name in _MONTHS else 0 for name in names], np.int64)
    year = number("Y", 1970) if "y" not in parts else number("y") + np.where(number("y") < 69, 2000, 1900)
    hour = number("H")
    if "I" in parts:
        afternoon = np.array([text[:1].lower() == "p" for text in parts["p"].to_pylist()]) if "p" in parts else False
        hour = number("I") % 12 + np.where(afternoon, 12, 0)
    day, minute, second = number("d", 1), number("M"), number("S")
    valid &= (month >= 1) & (month <= 12) & (year >= 1678) & (year < 2262) & (hour < 24) & (minute < 60) & (second < 61)
    months = (np.where(valid, year, 1970) - 1970) * 12 + np.where(valid, month, 1) - 1
    days = months.astype("datetime64[M]").astype("datetime64[D]").astype(np.int64) + day - 1
    valid &= (day >= 1) & (days.astype("datetime64[D]").astype("datetime64[M]").astype(np.int64) == months)
    fraction = np.zeros(len(column), np.int64)
    if "f" in parts:
        padded = pc.utf8_rpad(parts["f"], 9, "0")
        fraction = np.asarray(padded.cast("int64").to_numpy(zero_copy_only=False))
    t_ns = ((days * 24 + hour) * 60 + minute) * 60 + second
    return np.where(valid, t_ns * 10**9 + fraction, 0), valid
