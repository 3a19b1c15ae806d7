"""The manifest of a dataset: its description as one deterministic JSON file."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NotRequired, TypedDict, TypeVar

from tacpipe.datasets import pages as pages_of
from tacpipe.datasets import paths
from tacpipe.datasets.pages import Item, ObjectReader, Page, PageJson, PageReader, Pages, StoredPages
from tacpipe.datasets.paths import MANIFEST, shard_path
from tacpipe.errors import DamagedError, StorageError, TacpipeError, UsageError
from tacpipe.io import files as files_of
from tacpipe.io import regular
from tacpipe.io.files import read_error
from tacpipe.io.hashing import DIGEST, bytes_digest, digest
from tacpipe.plugins.stage import Attribute, StoredParams
from tacpipe.printable import excerpt, plain
from tacpipe.store.records import Content, RecordingEntry, Step
from tacpipe.store.store import Object, Store

FORMAT, PAGED_FORMAT = 1, 2  # 1: the manifest contains its recordings; 2: it lists pages of them
NAME = MANIFEST
VALUES = "{values}"  # name for the digest of a source's other values, such as labels
EXPORT = "export."  # prefix of the names of export stages
ACQUIRE = "acquire"  # the command that records a rig, in place of a stage; it has no key
V = TypeVar("V")
_REMEMBERED = 3
_PER_RECORDING = ("recordings", "labels", "sources")  # fields stored in pages
_parsed: dict[tuple[str, str], Manifest] = {}  # most recently verified manifests, by digest and location of pages


class InputDataset(TypedDict):
    """A dataset that a stage read."""

    dataset: str  # digest of its content
    manifest: str  # digest of its manifest


class ManifestJson(TypedDict):
    """The content of ``manifest.json``; the fields are those of `Manifest`."""

    format: int
    digest: str
    stage: str
    version: int
    params: StoredParams
    inputs: dict[str, list[InputDataset]]
    chain: list[Step]
    recordings: NotRequired[dict[str, RecordingEntry]]
    pages: NotRequired[list[PageJson]]  # pages that replace recordings, labels and sources
    files: dict[str, Content]
    skipped: dict[str, str]
    sources: NotRequired[dict[str, Mapping[str, str]]]
    labels: NotRequired[dict[str, Mapping[str, Attribute]]]


@dataclass(frozen=True)
class Manifest:
    """Content of a dataset: recordings, files, and their origin."""

    stage: str
    version: int
    params: StoredParams = field(default_factory=dict)
    inputs: Mapping[str, Sequence[InputDataset]] = field(default_factory=dict)  # inputs by argument
    chain: Sequence[Step] = ()
    recordings: Mapping[str, RecordingEntry] = field(default_factory=dict)
    files: Mapping[str, Content] = field(default_factory=dict)
    skipped: Mapping[str, str] = field(default_factory=dict)  # reason by recording
    sources: Mapping[str, Mapping[str, str]] = field(default_factory=dict)  # digests of raw files by recording
    labels: Mapping[str, Mapping[str, Attribute]] = field(default_factory=dict)

    @cached_property
    def pages(self) -> Pages | None:
        """The pages of a large dataset, or None if the manifest contains the recordings itself."""
        recordings, labels, sources = self.recordings, self.labels, self.sources
        if len(recordings) <= pages_of.INLINE:
            return None
        if isinstance(recordings, pages_of.Recordings):
            pages = recordings.pages
            if _same_pages(labels, pages, "labelled") and _same_pages(sources, pages, "sourced"):
                return pages
        entries = itertools.chain.from_iterable(sorted(part.items()) for part in pages_of.parts(recordings))
        return Pages.from_items((name, Item(entry, labels.get(name), sources.get(name))) for name, entry in entries)

    @cached_property
    def digest(self) -> str:
        """The dataset's digest, computed from names, attributes, shards and files, but not from their provenance."""
        if self.pages is not None:
            files = {name: file["digest"] for name, file in self.files.items()}
            return digest({"files": files, "pages": [page.content for page in self.pages.pages]})
        return _inline_digest(self)

    @cached_property
    def content(self) -> bytes:
        """The bytes of ``manifest.json``; equal manifests have equal bytes."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__} | {"digest": self.digest}
        if self.pages is None:
            inline = {name: dict(values[name]) for name in _PER_RECORDING}
            return (_indent_json({**values, **inline, "format": FORMAT}) + "\n").encode()
        lines = ",\n".join(f"  {json.dumps(page.to_json(), sort_keys=True)}" for page in self.pages.pages)
        shared_values = {name: value for name, value in values.items() if name not in _PER_RECORDING}
        head, empty, tail = _indent_json({**shared_values, "format": PAGED_FORMAT, "pages": []}).partition(
            '\n "pages": []'
        )
        assert empty
        return f'{head}\n "pages": [\n{lines}\n ]{tail}\n'.encode()

    @cached_property
    def content_digest(self) -> str:
        """The digest of ``manifest.json``."""
        return bytes_digest(self.content)

    def keep(self, store: Store, *, durable: bool = False) -> Object:
        """Store the manifest, after its pages. Raises `MissingPageError` for a page that cannot be found."""
        if self.pages is not None:
            self.pages.keep(store, durable=durable)
        return store.put(self.content, durable=durable)

    @property
    def ancestors(self) -> list[str]:
        """The digests of the manifests that this one was computed from."""
        return [reference["manifest"] for references in self.inputs.values() for reference in references]

    @property
    def recorded(self) -> bool:
        """Whether this is a dataset of recordings that was not computed from other datasets."""
        return bool(self.recordings) and not self.inputs

    @property
    def exported(self) -> bool:
        """Whether its files are exports for other tools."""
        return self.stage.startswith(EXPORT)

    @property
    def copied(self) -> bool:
        """Whether its directory contains copies instead of links, as for recordings and exports."""
        return self.recorded or self.exported

    @cached_property
    def included(self) -> Mapping[str, RecordingEntry]:
        """The recordings that are not excluded."""
        excluded = self.excluded
        if not excluded:
            return self.recordings
        if isinstance(self.recordings, pages_of.Recordings):
            return pages_of.Recordings(self.recordings.pages.changed(dict.fromkeys(excluded)))
        return {name: entry for name, entry in self.recordings.items() if name not in excluded}

    @cached_property
    def excluded(self) -> Mapping[str, Attribute]:
        """The reason of each excluded recording, by name."""
        recordings = self.recordings
        groups: Iterable[Mapping[str, RecordingEntry]] = [recordings]
        if isinstance(recordings, pages_of.Recordings):
            pages = recordings.pages
            groups = (pages.load(number).recordings for number, page in enumerate(pages.pages) if page.excluded)
        reasons = {}
        for group in groups:
            for name, entry in group.items():
                if reason := entry["attributes"].get(pages_of.EXCLUDED):
                    reasons[name] = reason
        return reasons

    def with_recordings(self, items: Mapping[str, Item | None]) -> Manifest:
        """Return the manifest with recordings added or replaced; None removes one."""
        if isinstance(self.recordings, pages_of.Recordings) and self.pages is not None:
            pages = self.pages.changed(items)
            return replace(
                self,
                recordings=pages_of.Recordings(pages),
                sources=pages_of.SourceDigests(pages),
                labels=pages_of.Labels(pages),
            )
        return replace(
            self,
            recordings=_apply_changes(self.recordings, {name: item and item.entry for name, item in items.items()}),
            sources=_apply_changes(self.sources, {name: item and item.sources for name, item in items.items()}),
            labels=_apply_changes(self.labels, {name: item and item.labels for name, item in items.items()}),
        )

    def item(self, name: str) -> Item:
        """Return a recording with its labels and raw files."""
        return Item(self.recordings[name], self.labels.get(name), self.sources.get(name))

    def labelled(self, labels: Mapping[str, Mapping[str, Attribute]]) -> Manifest:
        """Return the manifest with labels set by hand; labels of recordings that it does not contain are dropped."""
        items = {}
        for name, values in sorted(labels.items()):
            if name not in self.recordings:
                continue
            item = self.item(name)
            attributes = {**item.entry["attributes"], **(item.labels or {}), **values}
            set_attributes = {key: value for key, value in attributes.items() if value is not None}
            items[name] = item._replace(
                entry={**item.entry, "attributes": set_attributes}, labels={**(item.labels or {}), **values}
            )
        return self.with_recordings(items) if items else self

    def contents(self) -> Iterator[tuple[str, str, int]]:
        """Yield path in the directory, digest and size in bytes of every page, shard and file."""
        for page in () if self.pages is None else self.pages.pages:
            yield page.path, page.digest, page.bytes
        for part in pages_of.parts(self.recordings):
            for name, entry in part.items():
                for stream, shard in entry["shards"].items():
                    yield shard_path(name, stream), shard["digest"], shard["bytes"]
        for name, file in self.files.items():
            yield name, file["digest"], file["bytes"]

    def objects(self) -> Iterable[tuple[str, str]]:
        """Yield (path in the directory, digest) of every page, shard and file."""
        return ((path, name) for path, name, _ in self.contents())

    def sizes(self) -> Iterable[tuple[str, int]]:
        """Yield digest and size in bytes of every page, shard and file."""
        return ((name, size) for _, name, size in self.contents())

    def reached(self, walked: dict[str, set[str]], *, lenient: bool = False) -> set[str]:
        """Return the digests of all pages, shards and files. ``walked`` caches those of pages already read, by digest.

        If ``lenient``, the content of missing pages is skipped; otherwise they raise `MissingPageError`.
        """
        pages = self.pages
        if pages is None:
            return {name for _, name in self.objects()}
        reached = {file["digest"] for file in self.files.values()}
        for number, page in enumerate(pages.pages):
            if page.digest not in walked:
                try:
                    walked[page.digest] = pages_of.shard_digests(pages, number)
                except pages_of.MissingPageError:
                    if not lenient:
                        raise
            reached |= {page.digest, *walked.get(page.digest, ())}
        return reached

    def at(self, path: str) -> Content | None:
        """Return digest and size of the page, shard or file at ``path``, or None if there is none."""
        if path in self.files:
            return self.files[path]
        if self.pages is not None and path.startswith(pages_of.PAGE):
            page = next((page for page in self.pages.pages if page.path == path), None)
            if page is not None:
                return {"digest": page.digest, "bytes": page.bytes}
        bare = path.removesuffix(".parquet")
        parts = bare.split("/")
        places = [(bare, ""), *(("/".join(parts[:depth]), "/".join(parts[depth:])) for depth in range(1, len(parts)))]
        candidates = (candidate for candidate in places if bare != path and candidate[0] in self.recordings)
        shards = (self.recordings[name]["shards"].get(stream) for name, stream in candidates)
        return next((shard for shard in shards if shard is not None), None)

    def size_of(self, name: str, path: str) -> int | None:
        """Return the size in bytes of the page, shard or file with this digest at ``path``, or None if there is none."""
        content = self.at(path)
        return content["bytes"] if content is not None and content["digest"] == name else None

    @cached_property
    def shard_bytes(self) -> int:
        """The total size of all shards in bytes."""
        if self.pages is not None:
            return self.pages.total("shard_bytes")
        return sum(shard["bytes"] for entry in self.recordings.values() for shard in entry["shards"].values())

    @cached_property
    def rows(self) -> int:
        """The total number of rows in all shards."""
        if self.pages is not None:
            return self.pages.total("rows")
        return sum(shard["rows"] for entry in self.recordings.values() for shard in entry["shards"].values())


def _apply_changes(before: Mapping[str, V], changes: Mapping[str, V | None]) -> dict[str, V]:
    """Return values by name, sorted by name, with some added or replaced; None removes one."""
    return {name: value for name, value in sorted({**before, **changes}.items()) if value is not None}


def _same_pages(view: Mapping[str, Mapping[str, Attribute]], pages: Pages, count: str) -> bool:
    """Return whether labels or sources are those in pages."""
    return getattr(view, "pages", None) is pages or (not view and not pages.total(count))


def _indent_json(value: StoredParams) -> str:
    return json.dumps(value, sort_keys=True, indent=1, allow_nan=False)


def parse(content: bytes, source: str, read: PageReader | None = None, *, verified: bool = False) -> Manifest:
    """Return the manifest with these bytes; ``read`` reads its pages. ``verified`` bytes come from the store.

    Raises `DamagedError` if the bytes are not a manifest or its content does not match its digest.
    """
    name = bytes_digest(content)
    place = name, ("" if read is None else read.place)
    if place in _parsed:  # a command parses the same manifest several times
        return _parsed[place]
    regular.expect_parsed(source, len(content))
    try:
        manifest, declared = _read(json.loads(content), source, read)
        if manifest.pages is not None or not verified:
            check(manifest)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DamagedError(
            f"{source} is not a manifest of tacpipe ({plain(str(error), 200)}). Restore it, or run the stage that made it "
            f"again."
        ) from None
    computed = declared
    if manifest.pages is not None:
        computed = manifest.digest
    elif not verified:
        computed = _inline_digest(manifest)
    if computed != declared:
        raise DamagedError(
            f"{source} was edited by hand: its content has the digest {computed[:12]}, it states "
            f"{excerpt(declared)[1:13]}. Run the stage that made it again; labels are changed with `tacpipe label`."
        )
    manifest.__dict__.update(content=content, content_digest=name, digest=declared)  # fills cached properties
    if not verified:  # this access checks all of the content
        _parsed[place] = manifest
        for oldest in list(_parsed)[:-_REMEMBERED]:
            del _parsed[oldest]
    return manifest


def _read(value: dict[str, Any], source: str, read: PageReader | None) -> tuple[Manifest, str]:
    """Return the manifest in a JSON value, and its declared digest.

    Raises ``ValueError`` or ``KeyError`` for an invalid value, and `UsageError` for a newer format.
    """
    format_version, declared = value.pop("format"), value.pop("digest")
    if type(format_version) is not int or format_version < FORMAT:
        raise ValueError(f"its format is {excerpt(format_version)}")
    if format_version > PAGED_FORMAT:
        raise UsageError(
            f"{source} has manifest format {format_version}; this tacpipe reads formats {FORMAT} and {PAGED_FORMAT}. "
            f"Install a newer tacpipe."
        )
    if format_version == FORMAT:
        manifest = Manifest(**value)
        manifest.__dict__["pages"] = None  # the manifest contains its recordings, regardless of their number
        return manifest, declared
    pages = Pages([Page.from_json(page) for page in value.pop("pages")], read, {})
    if pages.total("recordings") <= pages_of.INLINE:
        raise ValueError(f"it lists pages of {pages.total('recordings')} recordings, which a manifest holds itself")
    if not value.keys().isdisjoint(_PER_RECORDING):
        raise ValueError("it holds recordings next to pages of them")
    views: Any = pages_of.Recordings(pages), pages_of.Labels(pages), pages_of.SourceDigests(pages)
    return Manifest(**value, **dict(zip(_PER_RECORDING, views, strict=True))), declared


def stored(store: ObjectReader, name: str, source: str = "") -> Manifest:
    """Return the manifest with this digest from a store. Raises `MissingError`, and the errors of `parse`."""
    return parse(store.read(name, regular.JSON_BYTES), source or name, StoredPages(store), verified=True)


def stored_or_none(store: ObjectReader, name: str) -> Manifest | None:
    """Return the manifest with this digest, or None if it is missing or damaged.

    Raises `StorageError` if the system fails to read it.
    """
    try:
        return stored(store, name)
    except StorageError:
        raise
    except TacpipeError:
        return None


def _inline_digest(manifest: Manifest) -> str:
    """Return the digest of a dataset whose manifest contains the recordings itself."""
    files = {name: file["digest"] for name, file in manifest.files.items()}
    return digest({"files": files, "recordings": pages_of.described(manifest.recordings)})


class Found:
    """A manifest file: the directory of its dataset, and its bytes. Its pages are in ``store``, if given."""

    def __init__(self, directory: Path, content: bytes, store: ObjectReader | None = None) -> None:
        self.directory, self.content = directory, content
        self.digest = bytes_digest(content)
        self._store = store

    @cached_property
    def manifest(self) -> Manifest:
        """The manifest, checked. Raises `DamagedError` if it was edited by hand."""
        source = str(self.directory / NAME)
        return parse(self.content, source, StoredPages(self._store, self.directory.absolute()))


def find(path: Path | str) -> Found:
    """Return the manifest of the dataset at ``path``, which is its directory or the manifest itself.

    Raises `UsageError` if there is none, and `StorageError` if the system fails to read it.
    """
    location = files_of.local(path)
    file = location if location.name == NAME else location / NAME
    try:
        return Found(file.parent, regular.content(file, regular.JSON_BYTES))
    except regular.IrregularError as error:
        raise UsageError(f"{error} There is no dataset.") from None
    except (FileNotFoundError, NotADirectoryError):
        problem = "does not exist or is empty" if not location.exists() else f"has no {NAME}"
        inside = next((f", such as {each.parent}" for each in sorted(location.glob(f"*/{NAME}"))), "")
        raise UsageError(
            f"{location} {problem}, so it is not a dataset. Give the directory that a tacpipe command wrote with -o{inside}."
        ) from None
    except OSError as error:
        raise read_error(file, error) from error


def check(manifest: Manifest) -> None:
    """Raise `ValueError`, `TypeError` or `KeyError` if a manifest, which may be untrusted, is invalid.

    Pages are checked when they are read.
    """
    _check_lineage(manifest)
    pages_of.check_contents(manifest.files.values())
    paths.check_paths([*manifest.files], ())
    if manifest.pages is None:
        paths.check_paths(pages_of.check_entries(manifest.recordings), manifest.files)
    else:
        paths.check_paths([page.path for page in manifest.pages.pages], manifest.files)


def check_pages(manifest: Manifest, *, fresh: bool = False) -> None:
    """Check all pages, or if ``fresh`` those created in this process. Raises as `check` and `Pages.load` do."""
    check(manifest)
    pages, in_folders = manifest.pages, False
    for number, page in enumerate(() if pages is None else pages.pages):
        assert pages is not None
        if page.digest in pages.fresh or not fresh:
            content = pages.load(number)
            if page.digest in pages.fresh:  # other pages were checked when they were read
                content.check()
            in_folders |= any("/" in name for name in content.recordings)
    if in_folders:  # two pages may contain the same path
        paths.refuse_shared_paths([path for path, _ in manifest.objects()])


def _check_lineage(manifest: Manifest) -> None:
    """Raise ``ValueError``, ``TypeError`` or ``KeyError`` if inputs, steps, labels or sources of a manifest are invalid."""
    for sources in manifest.inputs.values():
        for source in sources:
            _expect_digest(source["manifest"])
            _expect_digest(source["dataset"])
    for step in ({"stage": manifest.stage, "version": manifest.version, "params": manifest.params}, *manifest.chain):
        if not isinstance(step["stage"], str) or not isinstance(step["version"], int):
            raise TypeError("a stage or its version is not named")
        _expect_mapping(step["params"], "params")
        _expect_mapping(step.get("fitted") or {}, "fitted")
    for part in pages_of.parts(manifest.labels) if manifest.pages is None else ():
        for labels in part.values():
            _expect_mapping(labels, "labels")
    _expect_mapping(manifest.skipped, "skipped")
    _expect_mapping(manifest.sources, "sources")


def _expect_mapping(value: object, noun: str) -> None:
    if not isinstance(value, Mapping):
        raise TypeError(f"its {noun} are a {type(value).__name__}")


def _expect_digest(name: object) -> None:
    if not isinstance(name, str) or not DIGEST.fullmatch(name):
        raise ValueError(f"{str(name)[:80]!r} is not a digest")
