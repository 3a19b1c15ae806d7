"""What a manifest may hold: it may be untrusted, so everything in it is looked at before it is used."""

from __future__ import annotations

import re
from array import array
from collections.abc import Collection, Iterable, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

from tacpipe.datasets import page_text, pages, paths
from tacpipe.datasets.dataset_digest import DatasetDigest
from tacpipe.datasets.page_text import Entry
from tacpipe.io.hashing import DIGEST

if TYPE_CHECKING:
    from tacpipe.datasets.manifest import Manifest

_DIGESTS = re.compile(rf"(?:{DIGEST.pattern}\n)*")
_ATTRIBUTES = frozenset((str, int, float, bool, type(None)))
_TEXT, _WHOLE = frozenset((str,)), frozenset((int,))
Listed: TypeAlias = "tuple[str, str, array[int]]"  # paths and digests, one a line, and sizes in bytes


def check(manifest: Manifest, *, hashed: bool = True, listing: list[Listed] | None = None) -> None:
    """Raise `ValueError`, `TypeError` or `KeyError` where a manifest holds what none can: it may be untrusted.

    Each recording is looked at once: its digest, where it is to be ``hashed``, and its rows are at hand afterwards, and all
    that it names is added to ``listing``.
    """
    _check_lineage(manifest)
    _check_contents(manifest.files.values())
    paths.check([*manifest.files], ())
    foldered, rows, size = False, 0, 0
    hashes = DatasetDigest(manifest.files) if hashed else None
    for part in pages.parts(manifest.recordings):
        shards, places = _check_part(part, manifest.files)
        rows, size = (number + sum(one[what] for one in shards) for number, what in ((rows, "rows"), (size, "bytes")))
        foldered |= any("/" in name for name in part)
        if hashes is not None:
            hashes.add(part)
        if listing is not None and shards:
            listing.append(_listed(places, shards))
    if listing is not None and manifest.files:
        listing.append(_listed([*manifest.files], manifest.files.values()))
    if foldered and isinstance(manifest.recordings, pages.Pages):  # two pages may name one path
        paths.refuse_shared([path for path, _ in manifest.objects()])
    sums = {"rows": rows, "shard_bytes": size}
    manifest.__dict__.update(sums | ({} if hashes is None else {"digest": hashes.digest()}))


def check_beside(manifest: Manifest, known: Manifest) -> bool:
    """Do as `check` for a manifest that shares pages with one that was checked: these are not parsed.

    What the digests of both are made of is read from the text of these pages. Return False where that does not give the
    digest that ``known`` has, or where a manifest is not in pages: then all is to be looked at. Raises as `check` does.
    """
    before, now = known.recordings, manifest.recordings
    if not (isinstance(before, pages.Pages) and isinstance(now, pages.Pages)) or manifest.files != known.files:
        return False
    if pages.foldered(before) or pages.foldered(now):
        return False
    _check_lineage(manifest)
    both = pages.shared(before, now)
    old, new = DatasetDigest(known.files), DatasetDigest(manifest.files)
    last, reached, rows = "", 0, 0
    for number in range(len(now.texts)):
        place = both.get(number)
        if place is None:
            part = now.part(number, last)
            shards, _ = _check_part(part, manifest.files)
            rows += sum(shard["rows"] for shard in shards)
            new.add(part)
        else:
            rows -= _add_pages(old, before, range(reached, place))
            text = page_text.described(now.texts[number])
            for hashes, recordings, at in ((old, before, place), (new, now, number)):
                hashes.add(recordings.part(at)) if text is None else hashes.add_described(text)
            reached = place + 1
        first, ending = now.ends(number)
        if last and first <= last:
            raise ValueError(pages.ORDER)
        last = ending
    rows -= _add_pages(old, before, range(reached, len(before.texts)))
    if old.digest() != known.digest:
        return False
    manifest.__dict__.update({"digest": new.digest()} | ({"rows": known.rows + rows} if "rows" in vars(known) else {}))
    return True


def _add_pages(hashes: DatasetDigest, recordings: pages.Pages, numbers: Iterable[int]) -> int:
    """Add pages to what a digest is made of, and return the rows of their shards."""
    rows = 0
    for number in numbers:
        part = recordings.part(number)
        hashes.add(part)
        rows += sum(shard["rows"] for entry in part.values() for shard in entry["shards"].values())
    return rows


def _check_part(part: Mapping[str, Entry], files: Collection[str]) -> tuple[list[Mapping[str, Any]], list[str]]:
    """Return the shards of recordings and their paths, once both were looked at."""
    for entry in part.values():
        if not _ATTRIBUTES.issuperset(map(type, entry["attributes"].values())):
            _refuse_attributes(entry["attributes"])
    shards = [shard for entry in part.values() for shard in entry["shards"].values()]
    _check_contents(shards)
    _check_counts([shard["rows"] for shard in shards])
    places = [paths.shard_path(name, stream) for name, entry in part.items() for stream in entry["shards"]]
    paths.check(places, files)
    return shards, places


def _listed(places: Iterable[str], contents: Collection[Mapping[str, Any]]) -> Listed:
    digests = "\n".join([one["digest"] for one in contents])
    return "\n".join(places), digests, array("q", [one["bytes"] for one in contents])


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
