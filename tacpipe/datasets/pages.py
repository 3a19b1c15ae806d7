"""Recordings of a large dataset, kept as the text of its manifest: a page of some hundred is parsed when it is asked for.

Parsed, a recording takes four times the memory of its text, and most commands look at each once, or at a few of them.
"""

from __future__ import annotations

import json
import re
import zlib
from bisect import bisect_right
from collections.abc import Collection, ItemsView, Iterable, Iterator, Mapping, Sequence, ValuesView
from typing import Any

from tacpipe.datasets.page_text import Entry, indented, page
from tacpipe.io import regular

LARGE = 1 << 20  # bytes of a manifest from which on its recordings are kept as text
MANY = 3_000  # recordings from which on a result is: they have about as many bytes
GROUPED = 256  # recordings of a page, in the mean
_MOST_BYTES = 1 << 24  # of a page
_KEPT = 4  # pages that stay parsed
_BEGIN, _END = b'\n "recordings": {\n', b"\n }"
_MEMBER = b'\n  "'  # begins a line of a recording's name, and no other line
_NAME = re.compile(rb'  ("(?:[^"\\]|\\.)*"): ')
ORDER = "its recordings are not in the order of their names"
_NAMES = re.compile(rb'\n  ("(?:[^"\\]|\\.)*"): ')  # literal from the start, so that searching is fast
_FOLDERED = re.compile(rb'\n  "(?:[^"\\/]|\\.)*/')
_FOLLOWING = re.compile(rb',\n  ("(?:[^"\\]|\\.)*"): ')  # a name that is not the first


def begins(name: str) -> bool:
    """Return whether a page, and a group of recordings that has a record, begins with the recording of this name.

    That rests on the name alone: so a recording that comes or goes changes one page, or two.
    """
    return zlib.crc32(name.encode(errors="surrogatepass")) % GROUPED == 0


class Pages(Mapping[str, Entry]):
    """Recordings by name, in the order of names; what `page` made of each part of them is given in that order."""

    def __init__(self, texts: Sequence[bytes | memoryview], count: int) -> None:
        self.texts = texts
        self._count = count
        self._first = [json.loads(found[1]) for text in texts if (found := _NAME.match(text))]
        if len(self._first) < len(texts) or any(a >= b for a, b in zip(self._first, self._first[1:], strict=False)):
            raise ValueError(ORDER)
        self._sound = bytearray(len(texts))  # whether a page holds what its lines begin with, in order
        self._parsed: dict[int, dict[str, Entry]] = {}

    def __getitem__(self, name: str) -> Entry:
        return self._page(max(0, bisect_right(self._first, name) - 1))[name]

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[str]:
        for number in range(len(self.texts)):
            yield from self._names(number)

    def items(self) -> ItemsView[str, Entry]:
        """Return names and entries; each page is parsed as it comes."""
        return _Items(self)

    def values(self) -> ValuesView[Entry]:
        """Return the entries; each page is parsed as it comes."""
        return _Values(self)

    def __reduce__(self) -> tuple[Any, ...]:
        return Pages, ([bytes(text) for text in self.texts], self._count)

    def parts(self) -> Iterator[dict[str, Entry]]:
        """Yield the recordings a page at a time.

        Raises `ValueError` for a page that is not one, and in the end where there are not as many recordings as there should
        be, in the order of their names.
        """
        count, last = 0, ""
        for number in range(len(self.texts)):
            part = self.part(number, last)
            count, last = count + len(part), next(reversed(part))
            yield part
        if count != self._count:
            raise ValueError("two of its recordings share a name")

    def part(self, number: int, before: str = "") -> dict[str, Entry]:
        """Return the recordings of a page, whose names come after ``before``. Raises `ValueError` where it is not one."""
        part = self._page(number)
        names = list(part)
        if not self._sound[number]:
            if not names or names != sorted(names) or names != self._names(number):
                raise ValueError(ORDER)
            self._sound[number] = True
        if before and names[0] <= before:
            raise ValueError(ORDER)
        return part

    def of(self, numbers: Collection[int]) -> Pages:
        """Return some of the pages, in their order."""
        texts = [self.texts[number] for number in sorted(numbers)]
        return Pages(texts, sum(map(_count, texts)))

    def grouped(self) -> Iterator[list[int]]:
        """Yield the pages of each group that has a record: one, and more where the recording that began one is gone."""
        group: list[int] = []
        for number, name in enumerate(self._first):
            if group and begins(name):
                yield group
                group = []
            group.append(number)
        if group:
            yield group

    def names(self, numbers: Iterable[int]) -> list[bytes]:
        """Return the names on pages, as they are written."""
        return [name for number in numbers for name in _NAMES.findall(b"\n" + bytes(self.texts[number]))]

    def ends(self, number: int) -> tuple[str, str]:
        """Return the names with which a page begins and ends, as its lines state them."""
        text = bytes(self.texts[number])
        last = _NAME.match(text, text.rfind(_MEMBER) + 1)
        return self._first[number], self._first[number] if last is None else json.loads(last[1])

    @property
    def beginnings(self) -> Sequence[str]:
        """The name with which each page begins."""
        return self._first

    def count(self, number: int) -> int:
        """Return how many recordings are on a page, as its lines state them."""
        return _count(self.texts[number])

    def changed(self, entries: Mapping[str, Entry | None]) -> Pages:
        """Return the recordings with others in the place of some that are there; None leaves one out."""
        texts = list(self.texts)
        for number in sorted({bisect_right(self._first, name) - 1 for name in entries}):
            part: Mapping[str, Entry | None] = {**self._page(number), **entries}
            now = {name: part[name] for name in self._page(number)}
            texts[number] = page({name: entry for name, entry in now.items() if entry is not None})
        gone = sum(entry is None for entry in entries.values())
        return Pages([text for text in texts if len(text)], self._count - gone)

    def holding(self, word: bytes) -> Iterator[dict[str, Entry]]:
        """Yield those pages alone in whose text a word stands."""
        for number, text in enumerate(self.texts):
            if word in bytes(text):
                yield self._page(number)

    def _names(self, number: int) -> list[str]:
        found: list[str] = json.loads(b"[%b]" % b",".join(self.names([number])))
        return found

    def _page(self, number: int) -> dict[str, Entry]:
        found = self._parsed.get(number)
        if found is None:
            found = json.loads(f"{{{str(self.texts[number], 'ascii')}}}")
            while len(self._parsed) >= _KEPT:
                del self._parsed[next(iter(self._parsed))]
            self._parsed[number] = found
        return found


def _count(text: bytes | memoryview) -> int:
    return bytes(text).count(_MEMBER) + 1


class _Items(ItemsView[str, Entry]):
    _mapping: Pages

    def __iter__(self) -> Iterator[tuple[str, Entry]]:
        for part in self._mapping.parts():
            yield from part.items()


class _Values(ValuesView[Entry]):
    _mapping: Pages

    def __iter__(self) -> Iterator[Entry]:
        for part in self._mapping.parts():
            yield from part.values()


def holding(recordings: Mapping[str, Entry], word: bytes) -> Iterable[Mapping[str, Entry]]:
    """Return the recordings, of those kept as text only pages in which a word stands."""
    return recordings.holding(word) if isinstance(recordings, Pages) else [recordings]


def changed(recordings: Mapping[str, Entry], entries: Mapping[str, Entry | None]) -> Mapping[str, Entry]:
    """Return recordings with others in the place of some that are there; None leaves one out."""
    if isinstance(recordings, Pages):
        return recordings.changed(entries)
    found = {name: entries.get(name, entry) for name, entry in recordings.items()}
    return {name: entry for name, entry in found.items() if entry is not None}


def beside(before: Mapping[str, Entry], now: Mapping[str, Entry]) -> Iterator[tuple[str, Entry | None, Entry | None]]:
    """Yield name and entry, before and now, of all recordings of two datasets, in the order of names."""
    left, right = ordered(before), ordered(now)
    old, new = next(left, None), next(right, None)
    while old is not None or new is not None:
        if new is None or (old is not None and old[0] < new[0]):
            assert old is not None
            yield old[0], old[1], None
            old = next(left, None)
        elif old is None or new[0] < old[0]:
            yield new[0], None, new[1]
            new = next(right, None)
        else:
            yield old[0], old[1], new[1]
            old, new = next(left, None), next(right, None)


def shared(before: Pages, now: Pages) -> dict[int, int]:
    """Return the pages that two datasets have both, byte for byte: the number in ``now`` to that in ``before``."""
    places = {name: number for number, name in enumerate(before.beginnings)}
    found = {number: places[name] for number, name in enumerate(now.beginnings) if name in places}
    return {number: place for number, place in found.items() if same(before.texts[place], now.texts[number])}


def same(one: bytes | memoryview, other: bytes | memoryview) -> bool:
    """Return whether the texts of two pages are the same."""
    return one is other or (len(one) == len(other) and bytes(one) == bytes(other))


def foldered(recordings: Pages) -> bool:
    """Return whether a name may lead into a folder: then recordings of two pages may name one path."""
    return any(map(_foldered, map(bytes, recordings.texts)))


def _foldered(text: bytes) -> bool:
    return b"\\u002" in text or (b"/" in text and _FOLDERED.search(b"\n" + text) is not None)


def differing(before: Mapping[str, Entry], now: Mapping[str, Entry]) -> tuple[Mapping[str, Entry], Mapping[str, Entry]]:
    """Return those recordings of two datasets among which all are that are not in both, or not the same in both."""
    if not (isinstance(before, Pages) and isinstance(now, Pages)):
        return before, now
    both = shared(before, now)
    gone = set(range(len(before.texts))).difference(both.values())
    return before.of(gone), now.of(set(range(len(now.texts))).difference(both))


def ordered(recordings: Mapping[str, Entry]) -> Iterator[tuple[str, Entry]]:
    """Return names and entries in the order of names."""
    return iter(recordings.items() if isinstance(recordings, Pages) else sorted(recordings.items()))


def parts(recordings: Mapping[str, Entry]) -> Iterator[Mapping[str, Entry]]:
    """Yield recordings as they lie in memory: a page at a time where they are text, else all at once."""
    if isinstance(recordings, Pages):
        yield from recordings.parts()
    else:
        yield recordings


def write(value: Mapping[str, Any]) -> bytes:
    """Return the bytes of a manifest with these fields, whose recordings may be `Pages`."""
    recordings = value["recordings"]
    if not isinstance(recordings, Pages) or not recordings:
        return indented({**value, "recordings": dict(recordings)}).encode() + b"\n"
    head = indented({**value, "recordings": {}}).encode() + b"\n"
    before, empty, after = head.partition(b'\n "recordings": {}')
    assert empty
    texts = (text for number, one in enumerate(recordings.texts) for text in ((b",\n" if number else b""), one))
    return b"".join([before, _BEGIN, *texts, _END, after])


def split(content: bytes, where: str) -> dict[str, Any] | None:
    """Return the value of a manifest with its recordings as `Pages`; None where the bytes are not as tacpipe writes them.

    What is returned is what ``json.loads`` would return, once all of `Pages.parts` were gone through without an error.
    Raises `StorageError` where memory is short.
    """
    begin = content.find(_BEGIN + b'  "')
    end = content.find(_END, begin)
    if begin < 0 or end < 0:
        return None
    head = content[:begin] + b'\n "recordings": {}' + content[end + len(_END) :]
    regular.expect_parsed(where, len(head))
    try:
        value = json.loads(head)
        if type(value) is not dict or indented(value).encode() + b"\n" != head:
            return None
        texts = [*_texts(content, begin + len(_BEGIN), end)]
        if max(map(len, texts)) > _MOST_BYTES:  # one recording has most of it
            return None
        found = Pages(texts, content.count(_MEMBER, begin, end))
    except (ValueError, TypeError, RecursionError):
        return None
    return {**value, "recordings": found}


def _texts(content: bytes, begin: int, end: int) -> Iterator[memoryview]:
    view, crc, grouped = memoryview(content), zlib.crc32, GROUPED  # what is called once a recording has a name here
    for found in _FOLLOWING.finditer(content, begin, end):
        name = found[1]
        if begins(json.loads(name)) if b"\\" in name else crc(name[1:-1]) % grouped == 0:
            yield view[begin : found.start()]
            begin = found.start() + len(b",\n")
    yield view[begin:end]
