"""The manifest: what a dataset is, as one deterministic JSON file."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
from array import array
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

from tacpipe.datasets import pages
from tacpipe.errors import DamagedError, StorageError, UsageError
from tacpipe.io import places, regular
from tacpipe.io.files import unread
from tacpipe.io.hashing import DIGEST, bytes_digest, canonical
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt, plain

FORMAT = 1
NAME = "manifest.json"
VALUES = "{values}"  # among the files of a source: the digest of what was read beside them, as labels
EXPORT = "export."  # begins the names of stages whose result is other tools' files
ACQUIRE = "acquire"  # the command that records a rig; it stands where others name their stage, and has no key
NAME_BYTES = 200  # of a part of a path; file systems take 255, and drafts add to it
_PART = r"(?:[^./\\\x00-\x1f\x7f][^/\\\x00-\x1f\x7f]*|\.z(?:array|attrs|group|metadata))"  # the last: of Zarr
_PATH = re.compile(rf"{_PART}(?:/{_PART})*")
_PATHS = re.compile(rf"(?:{_PATH.pattern}(?:\n{_PATH.pattern})*)?")
_DIGESTS = re.compile(rf"(?:{DIGEST.pattern}\n)*")
_SHARED = f"two of its shards and files share a path, or one is called {NAME}"
_ATTRIBUTES = frozenset((str, int, float, bool, type(None)))
_TEXT, _WHOLE = frozenset((str,)), frozenset((int,))
_REMEMBERED = 2
_parsed: dict[str, Manifest] = {}  # by the digest of their content, the last ones that were verified
Entry = pages.Entry
_Listed: TypeAlias = "tuple[str, str, array[int]]"  # paths and digests, one a line, and sizes in bytes


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
        hashed = _Hashed(self.files)
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
        some = recordings.holding(b'"excluded"') if isinstance(recordings, pages.Pages) else [recordings]
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

    def size_of(self, name: str, path: str) -> int | None:
        """Return how many bytes the shard or file of this digest has at ``path``, None where there is none."""
        bare = path.removesuffix(".parquet")
        parts = bare.split("/")
        places = [(bare, ""), *(("/".join(parts[:at]), "/".join(parts[at:])) for at in range(1, len(parts)))]
        known = [self.recordings[one]["shards"].get(stream) for one, stream in places if one in self.recordings]
        sizes = (one["bytes"] for one in [self.files.get(path), *known] if one is not None and one["digest"] == name)
        return next(sizes, None)

    @cached_property
    def _listing(self) -> list[_Listed] | None:
        """What `check` found of a manifest of many recordings, so that `contents` parses them not again."""
        return None

    @cached_property
    def rows(self) -> int:
        """How many rows all shards have together."""
        return sum(shard["rows"] for entry in self.recordings.values() for shard in entry["shards"].values())


def parse(content: bytes, where: str, *, verified: bool = False) -> Manifest:
    """Return the manifest of these bytes; ``verified`` ones come from the store and need no second look.

    Raises `DamagedError` if they are not a manifest, or if what they name does not give their digest.
    """
    name = bytes_digest(content)
    if name in _parsed:  # a command meets the same manifest several times
        return _parsed[name]
    try:
        manifest, stored = _read(content, where, verified=verified)
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
        _parsed[name] = manifest
        for oldest in list(_parsed)[:-_REMEMBERED]:
            del _parsed[oldest]
    return manifest


def _read(content: bytes, where: str, *, verified: bool) -> tuple[Manifest, str]:
    """Return the manifest of these bytes, with its own digest at hand, and the digest that they state."""
    if len(content) >= pages.LARGE and (value := pages.split(content, where)) is not None:
        with contextlib.suppress(ValueError):  # pages that are not as they should be: all of it is parsed
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
        listing: list[_Listed] = []
        check(manifest, listing=listing, hashed=False)
        manifest.__dict__["_listing"] = listing
        return manifest, stored
    check(manifest, hashed=not verified)
    return manifest, stored


class _Hashed:
    """The digest of a dataset: the canonical JSON of its files and recordings, which come in parts."""

    def __init__(self, files: Mapping[str, Any]) -> None:
        self._hash = hashlib.sha256(b'{"files":' + canonical({name: file["digest"] for name, file in files.items()}))
        self._between = b',"recordings":{'

    def add(self, recordings: Mapping[str, Entry]) -> None:
        """Add those that come next in the order of names."""
        text = canonical({name: _described(entry) for name, entry in recordings.items()})[1:-1]
        if text:
            self._hash.update(self._between + text)
            self._between = b","

    def digest(self) -> str:
        """Return the digest of all that was added; nothing may be added after that."""
        self._hash.update(b"}}" if self._between == b"," else self._between + b"}}")
        return self._hash.hexdigest()


def safe_path(path: str) -> bool:
    """Return whether a path stays within the directory that it is relative to, and every file system takes it.

    >>> [safe_path(path) for path in ("trial-01/xela1.parquet", "../x", "/x", ".git/x", "a//b", "a\\nb", "")]
    [True, False, False, False, False, False, False]
    """
    try:
        short = all(len(part.encode()) <= NAME_BYTES for part in path.split("/"))
    except UnicodeEncodeError:  # half a character: no file has such a name
        return False
    return short and _PATH.fullmatch(path) is not None


def check(manifest: Manifest, *, hashed: bool = True, listing: list[_Listed] | None = None) -> None:
    """Raise `ValueError`, `TypeError` or `KeyError` where a manifest holds what none can: it may be untrusted.

    Each recording is looked at once: its digest, where it is to be ``hashed``, and its rows are at hand afterwards, and all
    that it names is added to ``listing``.
    """
    _check_lineage(manifest)
    _check_contents(manifest.files.values())
    _check_paths([*manifest.files], ())
    foldered, rows = False, 0
    hashes = _Hashed(manifest.files) if hashed else None
    for part in pages.parts(manifest.recordings):
        for entry in part.values():
            if not _ATTRIBUTES.issuperset(map(type, entry["attributes"].values())):
                _refuse_attributes(entry["attributes"])
        shards = [shard for entry in part.values() for shard in entry["shards"].values()]
        _check_contents(shards)
        counts = [shard["rows"] for shard in shards]
        _check_counts(counts)
        rows += sum(counts)
        paths = [shard_path(name, stream) for name, entry in part.items() for stream in entry["shards"]]
        _check_paths(paths, manifest.files)
        foldered |= any("/" in name for name in part)
        if hashes is not None:
            hashes.add(part)
        if listing is not None and shards:
            listing.append(_listed(paths, shards))
    if listing is not None and manifest.files:
        listing.append(_listed([*manifest.files], manifest.files.values()))
    if foldered and isinstance(manifest.recordings, pages.Pages):  # two pages may name one path
        _refuse_shared([path for path, _ in manifest.objects()])
    manifest.__dict__.update({"rows": rows} | ({} if hashes is None else {"digest": hashes.digest()}))


def _listed(paths: Iterable[str], contents: Collection[Mapping[str, Any]]) -> _Listed:
    digests = "\n".join([one["digest"] for one in contents])
    return "\n".join(paths), digests, array("q", [one["bytes"] for one in contents])


def _refuse_attributes(attributes: Mapping[str, Any]) -> None:
    for name, value in attributes.items():
        if not isinstance(value, str | int | float | None):
            raise TypeError(f"the attribute {name[:80]!r} is a {type(value).__name__}")


def _check_contents(contents: Collection[Mapping[str, Any]]) -> None:
    _check_counts([one["bytes"] for one in contents])
    digests = [one["digest"] for one in contents]
    if not (_TEXT.issuperset(map(type, digests)) and _DIGESTS.fullmatch("".join([f"{one}\n" for one in digests]))):
        for one in digests:
            _expect_digest(one)


def _check_counts(counts: Collection[Any]) -> None:
    if not _WHOLE.issuperset(map(type, counts)) or min(counts, default=0) < 0:
        wrong = next(count for count in counts if type(count) is not int or count < 0)
        raise ValueError(f"{str(wrong)[:80]!r} is not a count of rows or bytes")


def _check_paths(paths: list[str], others: Collection[str]) -> None:
    text = "\n".join(paths)  # hundreds at once: a hit does not wait for a thousand calls
    plain = text and text.isascii() and text.count("\n") == len(paths) - 1 and _PATHS.fullmatch(text)
    if not plain or max(map(len, paths), default=0) > NAME_BYTES:
        for path in paths:
            if not safe_path(path):
                raise ValueError(f"the path {path[:80]!r} leads out of the dataset, or no file can have it")
    _refuse_shared(paths)
    if NAME in paths or (others and not set(others).isdisjoint(paths)):
        raise ValueError(_SHARED)


def _refuse_shared(paths: Sequence[str]) -> None:
    if len(set(paths)) < len(paths):
        raise ValueError(_SHARED)


def _described(entry: Entry) -> dict[str, Any]:
    """Return what the dataset's digest is made of."""
    shards = {stream: shard["digest"] for stream, shard in entry["shards"].items()}
    return {"attributes": entry["attributes"], "shards": shards}


def _check_lineage(manifest: Manifest) -> None:
    for several in manifest.inputs.values():
        for given in several:
            _expect_digest(given["manifest"])
            _expect_digest(given["dataset"])
    for step in ({"stage": manifest.stage, "version": manifest.version, "params": manifest.params}, *manifest.chain):
        if not isinstance(step["stage"], str) or not isinstance(step["version"], int):
            raise TypeError("a stage or its version is not named")
        _expect_mapping(step["params"], "params")
        _expect_mapping(step.get("fitted") or {}, "fitted")
    for labels in manifest.labels.values():
        _expect_mapping(labels, "labels")
    _expect_mapping(manifest.skipped, "skipped")
    _expect_mapping(manifest.sources, "sources")


def _expect_mapping(value: object, what: str) -> None:
    if not isinstance(value, Mapping):
        raise TypeError(f"its {what} are a {type(value).__name__}")


def _expect_digest(name: object) -> None:
    if not isinstance(name, str) or not DIGEST.fullmatch(name):
        raise ValueError(f"{str(name)[:80]!r} is not a digest")


def shard_path(recording: str, stream: str) -> str:
    """Return the path of a shard within its dataset directory.

    >>> shard_path("trial-01", "xela1"), shard_path("trial-01", "")
    ('trial-01/xela1.parquet', 'trial-01.parquet')
    """
    return f"{recording}/{stream}.parquet" if stream else f"{recording}.parquet"


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
        return parse(self.content, str(self.directory / NAME))


def find(path: Path | str) -> Found:
    """Return the manifest of the dataset at ``path`` (its directory, or the manifest itself).

    Raises `UsageError` where there is none, and `StorageError` where the system fails to read it.
    """
    given = places.local(path)
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
    """Return the digest of a manifest file, of which memory holds a block at a time; raises as `regular.content`."""
    found = hashlib.sha256()
    for block in regular.blocks(file, regular.JSON_BYTES):
        found.update(block)
    return found.hexdigest()


def merge(manifests: Sequence[Manifest]) -> Manifest:
    """Return several datasets of one kind read as one.

    Raises `UsageError` if two recordings share a name, if the files differ, or if other chains of stages lie behind them.
    """
    if len(manifests) == 1:
        return manifests[0]
    recordings: dict[str, Entry] = {}
    files: dict[str, Any] = {}
    for manifest in manifests:
        for name in manifest.recordings:
            if name in recordings:
                raise UsageError(
                    f"Two of the datasets hold a recording named {name}. Names must be unique; leave one dataset out."
                )
        if manifest.chain != manifests[0].chain:
            raise UsageError(
                f"These datasets were made in different ways and cannot be read as one: "
                f"{chain_difference(manifests[0].chain, manifest.chain)}."
            )
        recordings.update(manifest.recordings)
        files.update(manifest.files)
    first = manifests[0]
    return Manifest(first.stage, first.version, first.params, {}, first.chain, recordings, files)


def chain_difference(wanted: Sequence[Mapping[str, Any]], found: Sequence[Mapping[str, Any]]) -> str:
    """Return in words where two chains of stages part.

    >>> step = {"stage": "synchronize", "version": 1, "params": {"rate_hz": 50.0}, "fitted": None}
    >>> chain_difference([step], [{**step, "params": {"rate_hz": 100.0}}])
    'synchronize has rate_hz 100.0 instead of 50.0'
    """
    from tacpipe.plugins import params as params_of

    for ours, theirs in zip(wanted, found, strict=False):
        if ours["stage"] != theirs["stage"]:
            return f"{theirs['stage']} is where {ours['stage']} should be"
        if ours["version"] != theirs["version"]:
            return f"{ours['stage']} has version {theirs['version']} instead of {ours['version']}"
        mine, other = (params_of.named(step["stage"], step["params"]) for step in (ours, theirs))
        for name in sorted({*mine, *other}):
            left, right = mine.get(name), other.get(name)
            if left != right:
                return f"{ours['stage']} has {name} {right} instead of {left}"
        if ours["fitted"] != theirs["fitted"]:
            return f"{ours['stage']} was fitted on other recordings"
    if len(wanted) != len(found):
        longer = wanted if len(wanted) > len(found) else found
        return f"only one of them went through {longer[min(len(wanted), len(found))]['stage']}"
    return "they are the same"
