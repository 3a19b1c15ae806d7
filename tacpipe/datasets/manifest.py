"""The manifest: what a dataset is, as one deterministic JSON file."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from tacpipe.datasets import page_text, pages
from tacpipe.datasets.checks import Listed, check, check_beside
from tacpipe.datasets.dataset_digest import DatasetDigest
from tacpipe.datasets.paths import MANIFEST, shard_path
from tacpipe.errors import DamagedError, StorageError, UsageError
from tacpipe.io import files, regular
from tacpipe.io.files import unread
from tacpipe.io.hashing import bytes_digest, remembered_file_digest
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt, plain

FORMAT = 1
NAME = MANIFEST
VALUES = "{values}"  # among the files of a source: the digest of what was read beside them, as labels
EXPORT = "export."  # begins the names of stages whose result is other tools' files
ACQUIRE = "acquire"  # the command that records a rig; it stands where others name their stage, and has no key
Entry = page_text.Entry
_REMEMBERED = 3
_STATED = ("format", "digest")  # in the file, besides what a manifest has
_parsed: dict[str, Manifest] = {}  # by the digest of their content, the last ones that were verified


@dataclass(frozen=True)
class Manifest:
    """What a dataset is: recordings, files, and how they came to be."""

    stage: str
    version: int
    params: Mapping[str, Any] = field(default_factory=dict)
    inputs: Mapping[str, Any] = field(default_factory=dict)
    chain: Sequence[Mapping[str, Any]] = ()
    recordings: Mapping[str, Entry] = field(default_factory=dict)
    files: Mapping[str, Any] = field(default_factory=dict)
    skipped: Mapping[str, str] = field(default_factory=dict)
    sources: Mapping[str, Any] = field(default_factory=dict)
    labels: Mapping[str, Mapping[str, Attribute]] = field(default_factory=dict)

    @cached_property
    def digest(self) -> str:
        """The dataset's digest: of names, attributes, shards and files, and not of how they were made."""
        hashed = DatasetDigest(self.files)
        for part in pages.parts(self.recordings):
            hashed.add(part)
        return hashed.digest()

    @cached_property
    def content(self) -> bytes:
        """The bytes of ``manifest.json``: the same manifest gives the same bytes."""
        fields = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return pages.write({"format": FORMAT, "digest": self.digest, **fields})

    @cached_property
    def content_digest(self) -> str:
        """The digest of ``manifest.json``."""
        return bytes_digest(self.content)

    @property
    def recorded(self) -> bool:
        """Whether this is a dataset of recordings: it was made from no other dataset."""
        return bool(self.recordings) and not self.inputs

    @property
    def exported(self) -> bool:
        """Whether its files are those of another tool."""
        return self.stage.startswith(EXPORT)

    @property
    def copied(self) -> bool:
        """Whether its directory holds copies, not links: recordings, and exports, in which other tools may write."""
        return self.recorded or self.exported

    @cached_property
    def included(self) -> Mapping[str, Entry]:
        """The recordings that nobody excluded."""
        recordings = self.recordings
        some = pages.holding(recordings, b'"excluded"')
        excluded = [name for part in some for name, entry in part.items() if entry["attributes"].get("excluded")]
        return pages.changed(self.recordings, dict.fromkeys(excluded)) if excluded else self.recordings

    def labelled(self, labels: Mapping[str, Mapping[str, Attribute]]) -> Manifest:
        """Return the manifest with attributes set by hand; labels of recordings that are not here are dropped."""
        kept = {
            name: {**self.labels.get(name, {}), **values} for name, values in labels.items() if name in self.recordings
        }
        changed = {}
        for name, values in sorted(kept.items()):
            attributes = {**self.recordings[name]["attributes"], **values}
            known = {key: value for key, value in attributes.items() if value is not None}
            changed[name] = {**self.recordings[name], "attributes": known}
        recordings = pages.changed(self.recordings, changed)
        return replace(self, recordings=recordings, labels={**self.labels, **kept})

    def contents(self) -> Iterator[tuple[str, str, int]]:
        """Yield path in the directory, digest and size in bytes of every shard and file."""
        if self._listing is not None:
            for paths, digests, sizes in self._listing:
                yield from zip(paths.split("\n"), digests.split("\n"), sizes, strict=False)
            return
        for name, entry in self.recordings.items():
            for stream, shard in entry["shards"].items():
                yield shard_path(name, stream), shard["digest"], shard["bytes"]
        for name, file in self.files.items():
            yield name, file["digest"], file["bytes"]

    def objects(self) -> Iterable[tuple[str, str]]:
        """Yield (path in the directory, digest) of every shard and file."""
        return ((path, name) for path, name, _ in self.contents())

    def sizes(self) -> Iterable[tuple[str, int]]:
        """Yield digest and size in bytes of every shard and file."""
        return ((name, size) for _, name, size in self.contents())

    def at(self, path: str) -> Mapping[str, Any] | None:
        """Return digest and size of the shard or file at ``path``, None where there is none."""
        if path in self.files:
            file: Mapping[str, Any] = self.files[path]
            return file
        bare = path.removesuffix(".parquet")
        parts = bare.split("/")
        places = [(bare, ""), *(("/".join(parts[:at]), "/".join(parts[at:])) for at in range(1, len(parts)))]
        known = (one for one in places if bare != path and one[0] in self.recordings)
        shards = (self.recordings[one]["shards"].get(stream) for one, stream in known)
        return next((shard for shard in shards if shard is not None), None)

    def size_of(self, name: str, path: str) -> int | None:
        """Return how many bytes the shard or file of this digest has at ``path``, None where there is none."""
        found = self.at(path)
        return found["bytes"] if found is not None and found["digest"] == name else None

    @cached_property
    def _listing(self) -> list[Listed] | None:
        """What `check` found of a manifest of many recordings, so that `contents` parses them not again."""
        return None

    @cached_property
    def shard_bytes(self) -> int:
        """How many bytes all shards have together."""
        return sum(shard["bytes"] for entry in self.recordings.values() for shard in entry["shards"].values())

    @cached_property
    def rows(self) -> int:
        """How many rows all shards have together."""
        return sum(shard["rows"] for entry in self.recordings.values() for shard in entry["shards"].values())


def parse(content: bytes, where: str, *, verified: bool = False, beside: Manifest | None = None) -> Manifest:
    """Return the manifest of these bytes; ``verified`` ones come from the store and need no second look.

    Of a large one that shares pages with the manifest ``beside``, which was checked, the others alone are parsed. Raises
    `DamagedError` if they are not a manifest, or if what they name does not give their digest.
    """
    name = bytes_digest(content)
    if name in _parsed:  # a command meets the same manifest several times
        return _parsed[name]
    try:
        manifest, stored = _read(content, where, verified=verified, beside=beside)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DamagedError(
            f"{where} is not a manifest of tacpipe ({plain(str(error), 200)}). Restore it, or run the stage that made it "
            f"again."
        ) from None
    manifest.__dict__.update(content=content, content_digest=name)  # primes cached properties: both are at hand
    computed = stored if verified else manifest.digest
    if computed != stored:
        raise DamagedError(
            f"{where} was edited by hand: what it names has the digest {computed[:12]}, it states {excerpt(stored)[1:13]}. "
            f"Run the stage that made it again; labels are changed with `tacpipe label`."
        )
    if not verified:  # all of it was looked at
        _remember(manifest, name)
    return manifest


def unparsed(content: bytes, where: str) -> Manifest | None:
    """Return the manifest of bytes that were checked before, none of whose recordings is parsed yet.

    None where it is not kept in pages. Raises `StorageError` where memory is short.
    """
    value = pages.split(content, where) if len(content) >= pages.LARGE else None
    if value is None or value.pop("format") != FORMAT:
        return None
    stored = value.pop("digest")
    manifest = Manifest(**value)
    manifest.__dict__.update(content=content, content_digest=bytes_digest(content), digest=stored)
    return manifest


def noted(file: Path, wanted: str, rows: int) -> None:
    """Have whoever asks next for the manifest in ``file`` get it `unparsed`: it was checked before, if it has this digest.

    ``rows`` are those that its shards have together.
    """
    if wanted in _parsed:
        return
    found = unparsed(regular.content(file, regular.JSON_BYTES), str(file))
    if found is not None and found.content_digest == wanted:
        found.__dict__["rows"] = rows
        _remember(found, wanted)


def _remember(manifest: Manifest, name: str) -> None:
    _parsed[name] = manifest
    for oldest in list(_parsed)[:-_REMEMBERED]:
        del _parsed[oldest]


def _read(content: bytes, where: str, *, verified: bool, beside: Manifest | None) -> tuple[Manifest, str]:
    """Return the manifest of these bytes, with its own digest at hand, and the digest that they state."""
    if len(content) >= pages.LARGE and (value := pages.split(content, where)) is not None:
        with contextlib.suppress(ValueError):  # pages that are not as they should be: all of it is parsed
            if beside is not None and value["format"] == FORMAT:
                manifest = Manifest(**{key: one for key, one in value.items() if key not in _STATED})
                if check_beside(manifest, beside) and manifest.digest == value["digest"]:
                    return manifest, manifest.digest
            return _checked(value, where, verified=verified)
    regular.expect_parsed(where, len(content))
    return _checked(json.loads(content), where, verified=verified)


def _checked(value: dict[str, Any], where: str, *, verified: bool) -> tuple[Manifest, str]:
    found, stored = value.pop("format"), value.pop("digest")
    if found != FORMAT:
        if type(found) is not int or found < FORMAT:
            raise ValueError(f"its format is {excerpt(found)}")
        raise UsageError(
            f"{where} has manifest format {found}; this tacpipe reads format {FORMAT}. Install a newer tacpipe."
        )
    manifest = Manifest(**value)
    if verified and isinstance(manifest.recordings, pages.Pages):
        listing: list[Listed] = []
        check(manifest, listing=listing, hashed=False)
        manifest.__dict__["_listing"] = listing
        return manifest, stored
    check(manifest, hashed=not verified)
    return manifest, stored


class Found:
    """A manifest as it was found: the directory of its dataset, and its bytes.

    Those of a large one are hashed at once, and read when they are asked for.
    """

    def __init__(self, directory: Path, content: bytes | None = None) -> None:
        self.directory = directory
        self.digest = hashed(directory / NAME) if content is None else bytes_digest(content)
        if content is not None:
            self.__dict__["content"] = content

    @cached_property
    def content(self) -> bytes:
        """The bytes of the manifest file. Raises `StorageError` where they are no longer those that gave its digest."""
        file = self.directory / NAME
        try:
            content = regular.content(file, regular.JSON_BYTES)
        except OSError as error:
            raise unread(file, error) from error
        if bytes_digest(content) != self.digest:
            raise StorageError(f"{file} was changed by another program meanwhile. Run the same command again.")
        return content

    @cached_property
    def manifest(self) -> Manifest:
        """The manifest, checked. Raises `DamagedError` if it was edited by hand."""
        if self.digest in _parsed:  # it need not be read
            return _parsed[self.digest]
        return parse(self.content, str(self.directory / NAME))


def find(path: Path | str) -> Found:
    """Return the manifest of the dataset at ``path`` (its directory, or the manifest itself).

    Raises `UsageError` where there is none, and `StorageError` where the system fails to read it.
    """
    given = files.local(path)
    file = given if given.name == NAME else given / NAME
    try:
        large = os.stat(file).st_size >= pages.LARGE  # noqa: PTH116  (of a pipe or a device it is 0)
        return Found(file.parent, None if large else regular.content(file, regular.JSON_BYTES))
    except regular.IrregularError as error:
        raise UsageError(f"{error} There is no dataset.") from None
    except (FileNotFoundError, NotADirectoryError):
        what = "is empty or not there" if not given.exists() else f"has no {NAME}"
        raise UsageError(
            f"{given} {what}, so it is not a dataset. Give the directory that a tacpipe command wrote with -o."
        ) from None
    except OSError as error:
        raise unread(file, error) from error


def hashed(file: Path) -> str:
    """Return the digest of a manifest file, of which memory holds a block at a time; raises as `regular.content`.

    One that this process has read and that did not change since is not read again.
    """
    return remembered_file_digest(file, _hashed)


def _hashed(file: Path | str) -> str:
    found = hashlib.sha256()
    for block in regular.blocks(file, regular.JSON_BYTES):
        found.update(block)
    return found.hexdigest()
