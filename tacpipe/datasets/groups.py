"""Groups of recordings: neighbours in the order of names, of which the results of a stage have one record together."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass

from tacpipe.datasets import pages
from tacpipe.datasets.page_text import Entry, page
from tacpipe.datasets.pages import Pages


def of_names(names: Iterable[str]) -> Iterator[list[str]]:
    """Yield names, sorted, in groups of some `pages.GROUPED`, of which one more or one less name changes one or two.

    Where a group ends depends on the name after it alone, as `pages.begins` states.

    >>> names = [f"trial-{number:04d}" for number in range(2000)]
    >>> before, now = (set(map(tuple, of_names(some))) for some in (names, [*names, "trial-0500-again"]))
    >>> len(before) > 2, len(now - before) <= 2
    (True, True)
    """
    group: list[str] = []
    for name in sorted(names):
        if group and pages.begins(name):
            yield group
            group = []
        group.append(name)
    if group:
        yield group


def of(recordings: Mapping[str, Entry], passed: Container[str] = ()) -> Iterator[tuple[str, Mapping[str, Entry]]]:
    """Yield the first name and the recordings of each group; none, and nothing is parsed, where that name is ``passed``."""
    if isinstance(recordings, Pages):
        for group in recordings.grouped():
            first = recordings.beginnings[group[0]]
            some = ((name, entry) for number in group for name, entry in recordings.part(number).items())
            yield first, {} if first in passed else dict(some)
        return
    for names in of_names(recordings):
        yield names[0], {} if names[0] in passed else {name: recordings[name] for name in names}


@dataclass(frozen=True)
class Kept:
    """A part of the recordings of a result, as text or as it is, and how many they are."""

    entries: Mapping[str, Entry] | bytes | memoryview
    count: int


def kept(entries: Mapping[str, Entry], *, as_text: bool) -> Kept:
    """Return recordings as they are kept until all are there: as text where they are many."""
    return Kept(page(entries) if as_text else entries, len(entries))


def joined(given: Iterable[Kept]) -> Mapping[str, Entry]:
    """Return recordings that come in parts, in the order of names, as one mapping; all parts are kept in the same way."""
    found: dict[str, Entry] = {}
    texts, count = [], 0
    for part in given:
        if isinstance(part.entries, bytes | memoryview):
            texts += [part.entries] if part.count else []
            count += part.count
        else:
            found |= part.entries
    return Pages(texts, count) if texts else found
