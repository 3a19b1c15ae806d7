"""The pages of a large dataset: its recordings, divided by name, each page a small JSON object in the store.

The manifest of such a dataset is a root that lists the pages with their digests and counts. Changing a recording
rewrites its page and the root. Page boundaries depend only on the recordings' names, so the same recordings give the
same pages.
"""

from __future__ import annotations

import contextlib
import json
import zlib
from bisect import bisect_right
from collections.abc import Callable, ItemsView, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal, NamedTuple, NotRequired, Protocol, TypedDict, TypeVar, cast

from tacpipe.datasets import paths
from tacpipe.errors import DamagedError, TacpipeError
from tacpipe.io import regular
from tacpipe.io.hashing import DIGEST, Written, bytes_digest, canonical, digest
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import plain
from tacpipe.store.location import locate, open_store
from tacpipe.store.records import Content, RecordingEntry, Shard
from tacpipe.store.store import MissingError, Store

V = TypeVar("V", bound=Mapping[str, Any])
INLINE = 1000  # maximum number of recordings that a manifest contains itself
GROUPED = 256  # average number of recordings per page
PAGE = "page-"  # prefix of a page's file name in the directory of a dataset
BEGINS = b'{"labels":'  # prefix of the content of every page
EXCLUDED = "excluded"  # attribute of recordings that stages skip
_PARSED = 256  # maximum number of parsed pages in memory, about 80 MB
_WRITTEN_BYTES = 1 << 25  # maximum size of cached JSON of a key
# counts that are often 0
_OPTIONAL: tuple[Literal["labelled", "sourced", "excluded"], ...] = ("labelled", "sourced", "excluded")
_COUNTS = ("bytes", "recordings", "rows", "shard_bytes", *_OPTIONAL)
_ATTRIBUTES = frozenset((str, int, float, bool, type(None)))


class Item(NamedTuple):
    """A recording of a dataset: its entry, its hand-set labels, and the digests of its raw files by name."""

    entry: RecordingEntry
    labels: Mapping[str, Attribute] | None = None
    sources: Mapping[str, str] | None = None


class PageJson(TypedDict):
    """A page as stored in a root; the fields are those of `Page`."""

    first: str
    digest: str
    bytes: int
    content: str
    recordings: int
    rows: int
    shard_bytes: int
    labelled: NotRequired[int]
    sourced: NotRequired[int]
    excluded: NotRequired[int]


@dataclass(frozen=True)
class Page:
    """The entry of a page in a root."""

    first: str  # name of the first recording
    digest: str  # name of the page's object
    bytes: int  # size of the page's object
    content: str  # digest of names, attributes and shard digests, from which the dataset's digest is computed
    recordings: int
    rows: int
    shard_bytes: int
    labelled: int = 0  # number of recordings with hand-set labels
    sourced: int = 0  # number of recordings with raw files
    excluded: int = 0

    @classmethod
    def from_json(cls, value: PageJson) -> Page:
        """Return a page from a root. Raises `ValueError`, `TypeError` or `KeyError` if it is invalid."""
        page = cls(**value)
        if type(page.first) is not str or page.recordings < 1:
            raise ValueError(f"a page begins with {str(page.first)[:80]!r} and has {page.recordings} recordings")
        for name in (page.digest, page.content):
            if type(name) is not str or not DIGEST.fullmatch(name):
                raise ValueError(f"{str(name)[:80]!r} is not a digest")
        for count in (getattr(page, name) for name in _COUNTS):
            if type(count) is not int or count < 0:
                raise ValueError(f"{str(count)[:80]!r} is not a count")
        return page

    def to_json(self) -> PageJson:
        """Return the page as stored in a root, without counts of 0."""
        value = cast("PageJson", asdict(self))
        for name in _OPTIONAL:
            if not value[name]:
                del value[name]
        return value

    @property
    def path(self) -> str:
        """The path of the page's object in the directory of its dataset."""
        return f"{PAGE}{self.digest[:32]}.json"


@dataclass(frozen=True)
class PageContent:
    """The recordings of a page, sorted by name, with their hand-set labels and raw files."""

    recordings: dict[str, RecordingEntry]
    labels: dict[str, Mapping[str, Attribute]]
    sources: dict[str, Mapping[str, str]]

    @classmethod
    def from_items(cls, items: Mapping[str, Item]) -> PageContent:
        """Return the content of a page with these recordings."""
        ordered = sorted(items.items())
        return cls(
            {name: item.entry for name, item in ordered},
            {name: item.labels for name, item in ordered if item.labels is not None},
            {name: item.sources for name, item in ordered if item.sources is not None},
        )

    @classmethod
    def from_bytes(cls, content: bytes) -> PageContent:
        """Return the content of a page's object. Raises `ValueError`, `TypeError` or `KeyError` if it is invalid."""
        page = cls(**json.loads(content))
        if not all(type(part) is dict for part in (page.recordings, page.labels, page.sources)):
            raise TypeError("it is not a page")
        return page

    def to_bytes(self) -> bytes:
        """Return the page's object; equal content gives equal bytes."""
        return canonical(vars(self))

    def describe(self, stored: bytes, *, name: str = "") -> Page:
        """Return the entry of this page in a manifest. ``stored`` are the page's bytes, ``name`` their digest if known."""
        shards = [shard for entry in self.recordings.values() for shard in entry["shards"].values()]
        return Page(
            next(iter(self.recordings)),
            name or bytes_digest(stored),
            len(stored),
            digest(described(self.recordings)),
            len(self.recordings),
            sum(shard.get("rows", 0) for shard in shards),  # entries in the input of a key have neither rows nor bytes
            sum(shard.get("bytes", 0) for shard in shards),
            len(self.labels),
            len(self.sources),
            sum(bool(entry["attributes"].get(EXCLUDED)) for entry in self.recordings.values()),
        )

    def items(self) -> dict[str, Item]:
        """Return the recordings with their labels and raw files, by name."""
        return {
            name: Item(entry, self.labels.get(name), self.sources.get(name)) for name, entry in self.recordings.items()
        }

    def check(self) -> None:
        """Raise `ValueError`, `TypeError` or `KeyError` if a page, which may be untrusted, is invalid."""
        names = list(self.recordings)
        if names != sorted(names) or not {*self.labels, *self.sources} <= self.recordings.keys():
            raise ValueError("its recordings are not in the order of their names")
        check_entries(self.recordings)
        for values in (*self.labels.values(), *self.sources.values()):
            if not isinstance(values, Mapping):
                raise TypeError(f"labels or sources of a recording are a {type(values).__name__}")


class PageReader(Protocol):
    """Reads the objects of pages."""

    place: str  # location of the objects, used in messages

    def __call__(self, page: Page) -> bytes:
        """Return the verified bytes of a page's object. Raises `MissingPageError`."""


class MissingPageError(MissingError):
    """A page of a manifest is missing or damaged, so its recordings are unknown."""


class ObjectReader(Protocol):
    """A store, in a folder or a bucket, from which pages are read."""

    @property
    def place(self) -> str:
        """The path or address of the store."""

    def read(self, name: str, size: int | None = None) -> bytes:
        """Return the verified content of an object. Raises `MissingError`."""


class StoredPages:
    """Reads pages from a store, or from the ``directory`` of their dataset if the store lacks them."""

    def __init__(self, store: ObjectReader | None, directory: Path | None = None) -> None:
        self._store, self._directory = store, directory
        self.place = f"{directory or ''} {'' if store is None else store.place}"

    def __call__(self, page: Page) -> bytes:
        """Return the verified bytes of a page's object. Raises `MissingPageError`."""
        if self._store is None:
            assert self._directory is not None
            self._store = locate(self._directory.absolute())
        try:
            return self._store.read(page.digest, page.bytes)
        except MissingError as error:
            copy = None
            if self._directory is not None:
                copy = paths.verified_copy(page.digest, page.path, (str(self._directory),), page.bytes)
            if copy is None:
                raise MissingPageError(
                    f"{error} It is the page of the manifest that holds {plain(page.first)} and {page.recordings - 1} "
                    f"recordings after it. Bring it with `tacpipe store pull` or `tacpipe store checkout`, or run the stage "
                    f"that made the dataset again."
                ) from None
        if isinstance(self._store, Store) and self._store.check():
            with contextlib.suppress(
                TacpipeError
            ):  # the store may be read-only, and the copy in the directory is equivalent
                self._store.put(copy, durable=True)
        return copy

    def __reduce__(self) -> tuple[Any, ...]:
        return _stored_pages, (None if self._store is None else self._store.place, self._directory)


def _stored_pages(place: str | None, directory: Path | None) -> StoredPages:
    return StoredPages(None if place is None else open_store(place), directory)


class Pages:
    """The pages of a dataset, sorted by name; each is read and checked when it is needed.

    ``fresh`` contains the objects of pages created in this process, by digest, which may not be stored yet.
    """

    def __init__(self, pages: Iterable[Page], read: PageReader | None, fresh: Mapping[str, bytes]) -> None:
        """Build the pages of a root: ``read`` reads their objects, of which ``fresh`` are not stored yet, by digest.

        Raises ``ValueError`` if they are not in order.
        """
        self.pages = tuple(pages)
        self._firsts = [page.first for page in self.pages]
        if any(a >= b for a, b in zip(self._firsts, self._firsts[1:], strict=False)):
            raise ValueError("its pages are not in the order of the names of recordings")
        self._read = read
        self.fresh = fresh
        self._parsed: dict[int, PageContent] = {}
        self._checked: set[int] = set()  # indices of checked pages

    @classmethod
    def from_items(cls, items: Iterable[tuple[str, Item]], read: PageReader | None = None) -> Pages:
        """Return the pages of recordings that are sorted by name."""
        divided: list[Page] = []
        fresh: dict[str, bytes] = {}

        def add_page(group: dict[str, Item]) -> None:
            content = PageContent.from_items(group)
            stored = content.to_bytes()
            page = content.describe(stored)
            divided.append(page)
            fresh[page.digest] = stored

        group: dict[str, Item] = {}
        for name, item in items:
            if group and begins(name):
                add_page(group)
                group = {}
            group[name] = item
        if group:
            add_page(group)
        return cls(divided, read, fresh)

    @classmethod
    def joined(cls, parts: Iterable[Pages]) -> Pages:
        """Join consecutive parts, sorted by name, and merge pages whose first recording no longer begins a page."""
        divided: list[Page] = []
        fresh: dict[str, bytes] = {}
        read: PageReader | None = None
        for part in parts:
            read = read or part._read
            for number, page in enumerate(part.pages):
                if divided and not begins(page.first):  # the first recording of the page was removed
                    last = cls([divided.pop()], read, fresh).load(0)
                    merged = cls.from_items(sorted((last.items() | part.load(number).items()).items()))
                    divided += merged.pages
                    fresh |= merged.fresh
                    continue
                divided.append(page)
                if page.digest in part.fresh:
                    fresh[page.digest] = part.fresh[page.digest]
        digests = {page.digest for page in divided}
        return cls(divided, read, {name: content for name, content in fresh.items() if name in digests})

    def __len__(self) -> int:
        return len(self.pages)

    def __reduce__(self) -> tuple[Any, ...]:
        return Pages, (self.pages, self._read, self.fresh)

    def part(self, number: int) -> Pages:
        """Return one page as `Pages`."""
        page = self.pages[number]
        fresh = {page.digest: self.fresh[page.digest]} if page.digest in self.fresh else {}
        return Pages([page], self._read, fresh)

    def changed(self, items: Mapping[str, Item | None]) -> Pages:
        """Return the pages with recordings added or replaced; None removes one."""
        if not items:
            return self
        by_page: dict[int, dict[str, Item | None]] = {}
        for name, item in items.items():
            by_page.setdefault(self.number(name), {})[name] = item

        def parts() -> Iterator[Pages]:
            for number in range(max(1, len(self.pages))):
                if number not in by_page:
                    yield self.part(number)
                    continue
                existing = self.load(number).items() if self.pages else {}
                changed = sorted({**existing, **by_page[number]}.items())
                yield Pages.from_items(((name, item) for name, item in changed if item is not None), self._read)

        return Pages.joined(parts())

    def number(self, name: str) -> int:
        """Return the index of the page that contains a recording with this name, or would contain it."""
        return max(0, bisect_right(self._firsts, name) - 1)

    def object(self, page: Page) -> bytes:
        """Return the object of a page. Raises `MissingPageError` if it is missing or damaged."""
        if page.digest in self.fresh:
            return self.fresh[page.digest]
        if self._read is None:
            raise MissingPageError(f"The page {page.digest[:12]} of a manifest cannot be read: its store is unknown.")
        return self._read(page)

    def load(self, number: int) -> PageContent:
        """Return the checked content of a page.

        Raises `MissingPageError` if its object is missing or damaged, and `DamagedError` if it does not match the root.
        """
        content = self._parsed.get(number)
        if content is None:
            page = self.pages[number]
            stored = self.object(page)
            regular.expect_parsed(f"The page {page.digest[:12]} of a manifest", len(stored))
            try:
                content = PageContent.from_bytes(stored)
                if page.digest not in self.fresh and number not in self._checked:
                    self._check(content, stored, number)
                    self._checked.add(number)
            except (ValueError, KeyError, TypeError, AttributeError, RecursionError, StopIteration) as error:
                raise DamagedError(
                    f"The page {page.digest[:12]} of a manifest was not written by tacpipe ({plain(str(error), 200)}). "
                    f"Restore the manifest, or rerun the stage that made it."
                ) from None
            while len(self._parsed) >= _PARSED:
                del self._parsed[next(iter(self._parsed))]
            self._parsed[number] = content
        return content

    def _check(self, content: PageContent, stored: bytes, number: int) -> None:
        """Raise ``ValueError``, ``TypeError`` or ``KeyError`` if a page does not match its entry in the root."""
        page = self.pages[number]
        content.check()
        if content.describe(stored, name=page.digest) != page:
            raise ValueError("it does not hold what the root states of it")
        if number + 1 < len(self.pages) and next(reversed(content.recordings)) >= self._firsts[number + 1]:
            raise ValueError("its recordings belong to another page")

    def total(self, count: str) -> int:
        """Return the sum of a count over all pages."""
        return sum(map(attrgetter(count), self.pages))

    def differing(self, before: Pages) -> Pages:
        """Return the pages that are not in the dataset ``before``."""
        theirs = {page.digest for page in before.pages}
        return Pages([page for page in self.pages if page.digest not in theirs], self._read, self.fresh)

    def missing(self, has: Callable[[str, int], bool]) -> list[Page]:
        """Return the pages whose object a store lacks; ``has`` tests for an object by digest and size in bytes."""
        return [page for page in self.pages if not has(page.digest, page.bytes)]

    def keep(self, store: Store, *, durable: bool = False) -> None:
        """Store the object of every page. Raises `MissingPageError` for one that cannot be found."""
        store.announce([page.digest for page in self.pages])
        for page in self.pages:
            if (durable and page.digest in self.fresh) or not store.has(page.digest, page.bytes):
                store.put(self.object(page), durable=durable)


class _View(Mapping[str, V]):
    """One field of the recordings in pages, by name."""

    part: str  # field of `PageContent`
    count: str  # field of `Page`

    def __init__(self, pages: Pages) -> None:
        self.pages = pages

    def __getitem__(self, name: str) -> V:
        if not self.pages.pages:
            raise KeyError(name)
        number = self.pages.number(name)
        if not getattr(self.pages.pages[number], self.count):
            raise KeyError(name)
        part: Mapping[str, V] = getattr(self.pages.load(number), self.part)
        return part[name]

    def __iter__(self) -> Iterator[str]:
        for part in self.parts():
            yield from part

    def __len__(self) -> int:
        return self.pages.total(self.count)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.pages,)

    def items(self) -> ItemsView[str, V]:
        """Return names and fields, of which each page is loaded once."""
        return _ViewItems(self)

    def parts(self) -> Iterator[Mapping[str, V]]:
        """Yield the content page by page."""
        for number, page in enumerate(self.pages.pages):
            if getattr(page, self.count):
                yield getattr(self.pages.load(number), self.part)


class _ViewItems(ItemsView[str, V]):
    """Names and fields of the recordings in pages, page by page."""

    _mapping: _View[V]

    def __iter__(self) -> Iterator[tuple[str, V]]:
        for part in self._mapping.parts():
            yield from part.items()


class Recordings(_View[RecordingEntry]):
    """The recordings of a dataset in pages."""

    part, count = "recordings", "recordings"


class Labels(_View[Mapping[str, Attribute]]):
    """The hand-set labels of the recordings of a dataset in pages."""

    part, count = "labels", "labelled"


class SourceDigests(_View[Mapping[str, str]]):
    """The digests of the raw files of recordings of a dataset in pages."""

    part, count = "sources", "sourced"


class KeyRecordings(Recordings, Written):
    """The part of each recording that enters a key: attributes and stream digests. It is encoded page by page."""

    def __init__(self, pages: Pages) -> None:
        super().__init__(pages)
        self._json_by_page: dict[int, bytes] = {}  # JSON by page index, up to `_WRITTEN_BYTES`
        self._written_bytes = 0

    def __getitem__(self, name: str) -> RecordingEntry:
        return key_entry(super().__getitem__(name))

    def parts(self) -> Iterator[Mapping[str, RecordingEntry]]:
        """Yield the recordings page by page."""
        for part in super().parts():
            yield {name: key_entry(entry) for name, entry in part.items()}

    def written(self) -> Iterator[bytes]:
        """Yield the canonical JSON of all recordings, page by page. Pages are cached, because it is needed several times."""
        yield b"{"
        for number in range(len(self.pages)):
            text = self._json_by_page.get(number)
            if text is None:
                entries = self.pages.load(number).recordings
                text = canonical({name: key_entry(entry) for name, entry in entries.items()})[1:-1]
                if self._written_bytes + len(text) <= _WRITTEN_BYTES:
                    self._json_by_page[number] = text
                    self._written_bytes += len(text)
            yield b"," * bool(number) + text
        yield b"}"


class RecordGroup(NamedTuple):
    """Consecutive recordings in name order whose results share one record."""

    page: str  # digest of the page with exactly these recordings, or empty if there are no pages
    entries: Callable[[], Mapping[str, RecordingEntry]]


def begins(name: str) -> bool:
    """Return whether a page and a group of recordings start at the recording with this name.

    This depends only on the name, so adding or removing a recording changes one or two pages.
    """
    return zlib.crc32(name.encode(errors="surrogatepass")) % GROUPED == 0


def group_names(names: Iterable[str]) -> Iterator[list[str]]:
    """Yield sorted names in groups of about `GROUPED`; adding or removing a name changes one or two groups.

    >>> names = [f"trial-{number:04d}" for number in range(2000)]
    >>> before, now = (set(map(tuple, group_names(some))) for some in (names, [*names, "trial-0500-again"]))
    >>> len(before) > 2, len(now - before) <= 2
    (True, True)
    """
    group: list[str] = []
    for name in sorted(names):
        if group and begins(name):
            yield group
            group = []
        group.append(name)
    if group:
        yield group


def groups(recordings: Mapping[str, RecordingEntry]) -> Iterator[RecordGroup]:
    """Yield the groups of recordings without reading pages."""
    if isinstance(recordings, Recordings):
        pages = recordings.pages
        for number, page in enumerate(pages.pages):
            yield RecordGroup(page.digest, lambda number=number: pages.load(number).recordings)  # type: ignore[misc]
        return
    for names in group_names(recordings):
        yield RecordGroup("", lambda names=names: {name: recordings[name] for name in names})  # type: ignore[misc]


def parts(recordings: Mapping[str, V]) -> Iterator[Mapping[str, V]]:
    """Yield values by recording: one page at a time, or all at once if there are no pages."""
    if isinstance(recordings, _View):
        yield from recordings.parts()
    else:
        yield recordings


def differing(before: Mapping[str, V], now: Mapping[str, V]) -> tuple[Mapping[str, V], Mapping[str, V]]:
    """Return the values by recording of two datasets, without those on pages that both have."""
    if isinstance(before, _View) and isinstance(now, _View):
        return type(before)(before.pages.differing(now.pages)), type(now)(now.pages.differing(before.pages))
    return before, now


def compared(
    before: Mapping[str, RecordingEntry], now: Mapping[str, RecordingEntry]
) -> Iterator[tuple[str, RecordingEntry | None, RecordingEntry | None]]:
    """Yield name, old entry and new entry (or None) of all recordings of two datasets, sorted by name."""
    before_items, now_items = (iter(_sorted_entries(recordings)) for recordings in (before, now))
    old, new = next(before_items, None), next(now_items, None)
    while old is not None or new is not None:
        if new is None or (old is not None and old[0] < new[0]):
            assert old is not None
            yield old[0], old[1], None
            old = next(before_items, None)
        elif old is None or new[0] < old[0]:
            yield new[0], None, new[1]
            new = next(now_items, None)
        else:
            yield old[0], old[1], new[1]
            old, new = next(before_items, None), next(now_items, None)


def _sorted_entries(recordings: Mapping[str, RecordingEntry]) -> Iterator[tuple[str, RecordingEntry]]:
    return ((name, entry) for part in parts(recordings) for name, entry in sorted(part.items()))


def shard_digests(pages: Pages, number: int) -> set[str]:
    """Return the digests of the shards in a page. Raises the errors of `Pages.load`."""
    entries = pages.load(number).recordings.values()
    return {shard["digest"] for entry in entries for shard in entry["shards"].values()}


class DescribedEntry(TypedDict):
    """The part of a recording that enters the digest of a dataset."""

    attributes: Mapping[str, Attribute]
    shards: dict[str, str]  # digest by stream


def described(recordings: Mapping[str, RecordingEntry]) -> dict[str, DescribedEntry]:
    """Return the part of recordings that enters the digest of a dataset."""
    return {
        name: {
            "attributes": entry["attributes"],
            "shards": {stream: shard["digest"] for stream, shard in entry["shards"].items()},
        }
        for name, entry in recordings.items()
    }


def key_entry(entry: RecordingEntry) -> RecordingEntry:
    """Return the part of a recording that enters a key: attributes and stream digests."""
    shards: dict[str, Shard] = {stream: {"digest": shard["digest"]} for stream, shard in entry["shards"].items()}
    return {"attributes": entry["attributes"], "shards": shards}


def check_entries(recordings: Mapping[str, RecordingEntry]) -> list[str]:
    """Return the paths of all shards. Raises `ValueError`, `TypeError` or `KeyError` for an invalid entry."""
    for entry in recordings.values():
        if not _ATTRIBUTES.issuperset(map(type, entry["attributes"].values())):
            _refuse_attributes(entry["attributes"])
    shards = [shard for entry in recordings.values() for shard in entry["shards"].values()]
    check_contents(shards)
    check_counts([shard["rows"] for shard in shards])
    places = [paths.shard_path(name, stream) for name, entry in recordings.items() for stream in entry["shards"]]
    paths.check_paths(places, ())
    return places


def _refuse_attributes(attributes: Mapping[str, Attribute]) -> None:
    for name, value in attributes.items():
        if not isinstance(value, str | int | float | None):
            raise TypeError(f"the attribute {name[:80]!r} is a {type(value).__name__}")


def check_contents(contents: Iterable[Content]) -> None:
    """Raise `ValueError`, `TypeError` or `KeyError` if shards or files lack a digest or a size in bytes."""
    all_contents = list(contents)
    check_counts([content["bytes"] for content in all_contents])
    for name in (content["digest"] for content in all_contents):
        if type(name) is not str or not DIGEST.fullmatch(name):
            raise ValueError(f"{str(name)[:80]!r} is not a digest")


def check_counts(counts: Iterable[Any]) -> None:
    """Raise `ValueError` for an invalid count of rows or bytes."""
    for count in counts:
        if type(count) is not int or count < 0:
            raise ValueError(f"{str(count)[:80]!r} is not a count of rows or bytes")
