"""Lay out what `tacpipe show` describes: values on one line, entries by name, and lists that are cut off."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from tacpipe.io import terminal
from tacpipe.scores import words

FILES = 5  # maximum number of files that are listed; further files are counted
SHOWN = 8  # maximum length of a displayed list or nested mapping; longer ones are counted


def section(title: str, lines: Sequence[str], count: int = 0) -> str:
    r"""Return a title with its indented lines, and the number of those that are missing of ``count``; "" without any.

    >>> section("events", ["cut", "grasp"], 5), section("events", [])
    ('events\n  cut\n  grasp\n  … and 3 more (--full)', '')
    """
    ending = [further(count - len(lines))] if count > len(lines) else []
    return "\n  ".join([title, *lines, *ending]) if lines or ending else ""


def further(count: int) -> str:
    """Return the line that ends a list without its last ``count`` entries."""
    return f"… and {count} more (--full)"


def align(described: Iterable[tuple[str, Any]]) -> list[str]:
    """Return names and values in two aligned columns, with long values wrapped and empty ones omitted.

    The name of several texts stands before the first one.
    """
    filled = [(name, value) for name, value in described if value not in (None, "", [])]
    width = max((len(name) for name, _ in filled), default=0) + 2
    text_width = max(terminal.width_of(sys.stdout) - width, 20)
    rows = []
    for name, value in filled:
        texts = value if isinstance(value, list) else [str(value)]
        lines = [line for text in texts for line in _wrap_at_commas(text, text_width)]
        rows += [f"{'' if number else name:<{width}}{line}" for number, line in enumerate(lines)]
    return rows


def _wrap_at_commas(text: str, width: int) -> list[str]:
    """Return text wrapped after commas.

    >>> _wrap_at_commas("epochs 2, learning rate 0.002, seed 0", 20)
    ['epochs 2,', 'learning rate 0.002,', 'seed 0']
    """
    unbroken = text.replace(" ", "\0").replace(",\0", ", ")
    lines = textwrap.wrap(unbroken, width, break_long_words=False, break_on_hyphens=False)
    return [line.replace("\0", " ") for line in lines]


def flat(value: Any) -> str:
    """Return a nested value as one line; long lists are replaced by their length.

    >>> flat({"train": {"a": 35, "b": 33}, "val": 2, "names": []}), flat(list(range(20))), flat(None), flat(0.5)
    ('train a 35, train b 33, val 2', '20 values', '–', '0.5')
    """
    return ", ".join(f"{name} {described}".strip() for name, described in _leaves(value)) or words.NONE


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, str]]:
    """Yield the path and the text of each value in nested values; long lists are replaced by their length."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _leaves(item, f"{name} {key}".strip().replace("_", " "))
    elif isinstance(value, list):
        if len(value) > SHOWN:
            yield name, f"{len(value)} values"
        elif value:
            yield name, " ".join(map(str, value))
    elif isinstance(value, float):
        yield name, f"{value:.6g}"
    elif value is not None and value != "":
        yield name, str(value)


def files_text(files: Mapping[str, int], *, full: bool = False) -> list[str]:
    """Return names and sizes of files; only the count and the first names if there are many and ``full`` is false.

    >>> files_text({"config.json": 15696, "history.jsonl": 188})
    ['files  config.json 15.7 kB, history.jsonl 188 bytes']
    >>> " ".join(files_text(dict.fromkeys("abcdefgh", 1000))).split()[:5]
    ['files', '8,', 'together', '8.0', 'kB:']
    """
    names = [f"{name} {_size(size)}" for name, size in files.items()]
    if full or len(names) <= FILES + 1:
        return align([("files", ", ".join(names))])
    total = _size(sum(files.values()))
    text = f"{len(names)}, together {total}: {', '.join(names[:FILES])} and {len(names) - FILES} more"
    return align([("files", f"{text} (--full)")])


def _size(count: int) -> str:
    for factor, unit in ((1e6, "MB"), (1e3, "kB")):
        if count >= factor:
            return f"{count / factor:.1f} {unit}"
    return f"{count} bytes"
