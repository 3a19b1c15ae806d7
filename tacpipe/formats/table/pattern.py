"""Patterns with placeholders: ``{trial}/skin_{hand}.csv`` matches paths and gives what was in the place of the braces.

``{name}`` is any text without a slash, at least one character; ``*`` is any text without a slash, ``**`` any folders. A
placeholder that comes twice has the same text both times.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping

from tacpipe.errors import UsageError
from tacpipe.printable import plain

_PART = re.compile(r"\{(\w+)\}|(\*\*/?)|(\*)|([^{}*]+)|(.)", re.DOTALL)


@functools.lru_cache(maxsize=1024)
def compiled(pattern: str) -> re.Pattern[str]:
    """Return the regular expression of a pattern. Raises `UsageError` where a brace has no partner."""
    found, seen = [], set()
    for name, folders, any_text, literal, stray in _PART.findall(pattern):
        if stray:
            raise UsageError(
                f"The pattern {plain(pattern)} has a brace without its partner. Write placeholders as {{name}}."
            )
        if name:
            found.append(f"(?P={name})" if name in seen else f"(?P<{name}>[^/]+?)")
            seen.add(name)
        elif folders:
            found.append("(?:.*/)?" if folders.endswith("/") else ".*")
        else:
            found.append("[^/]*" if any_text else re.escape(literal))
    try:
        return re.compile("".join(found), re.DOTALL)
    except re.error as error:
        raise UsageError(f"The pattern {plain(pattern)} cannot be read: {error}.") from error


def match(pattern: str, text: str) -> dict[str, str] | None:
    """Return the text of each placeholder where the whole of ``text`` matches, else None.

    >>> match("{trial}/skin_{hand}.csv", "t-07/skin_left.csv")
    {'trial': 't-07', 'hand': 'left'}
    >>> match("**/{trial}.csv", "a/b/t1.csv"), match("*.csv", "a/t1.csv"), match("{a}-{a}", "x-y")
    ({'trial': 't1'}, None, None)
    """
    found = compiled(pattern).fullmatch(text)
    return None if found is None else found.groupdict()


def placeholders(pattern: str) -> tuple[str, ...]:
    """Return the names in braces, in order.

    >>> placeholders("{trial}/skin_{hand}.csv")
    ('trial', 'hand')
    """
    return tuple(compiled(pattern).groupindex)


def filled(pattern: str, values: Mapping[str, str]) -> str:
    """Return a pattern with its placeholders replaced. Raises `UsageError` where one has no value.

    >>> filled("{object}-{trial}", {"object": "cup", "trial": "3"})
    'cup-3'
    """
    missing = [name for name in placeholders(pattern) if name not in values]
    if missing:
        known = ", ".join(values) or "none"
        raise UsageError(f"{plain(pattern)} names {{{missing[0]}}}, which no file pattern has; there are {known}.")
    return re.sub(r"\{(\w+)\}", lambda found: values[found[1]], pattern)
