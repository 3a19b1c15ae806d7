"""The run that gave what an output shows: of pages of recordings that did not change since, its results are taken over.

That rests on what a hit rests on: the record of that run names the manifest that it read and the one that it gave. A page
that is the same in both manifests, of then and of now, has the same keys, and so the same page of results. A note on the
directory states that the objects of these are there, once it was found to hold.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets import pages
from tacpipe.datasets.manifest import Entry, Manifest
from tacpipe.datasets.pages import Pages
from tacpipe.datasets.paths import shard_path
from tacpipe.errors import StorageError, TacpipeError
from tacpipe.io.hashing import digest
from tacpipe.store.notes import Head, Note
from tacpipe.store.presence import Look
from tacpipe.store.store import Store


@dataclass(frozen=True)
class Taken:
    """Results that are taken over: pages by the digest of the page that they are results of, and what records state."""

    pages: Mapping[str, Pages]
    stated: Mapping[str, Any]  # as `Outcome.add_group` takes it

    @property
    def count(self) -> int:
        """How many recordings they are."""
        return sum(part.total("recordings") for part in self.pages.values())


@dataclass
class Previous:
    """A run over one dataset, recording by recording, whose output is as it left it."""

    store: Store
    directory: Path
    note: Note
    look: Look
    record: Mapping[str, Any]
    given: Manifest  # its input
    made: Manifest  # its result

    def taken(self, entries: Mapping[str, Entry], step: Mapping[str, Any]) -> Taken | None:
        """Return what is taken over of the results of a link of a chain for ``entries``; None where nothing can be."""
        before, results = self.given.included, self.made.pages
        if results is None or not (isinstance(entries, pages.Recordings) and isinstance(before, pages.Recordings)):
            return None
        if not self._gave(step):
            return None
        now = {page.digest for page in entries.pages.pages}
        firsts = [page.first for page in results.pages] + [""]
        places = {first: number for number, first in enumerate(firsts)}
        read = before.pages.pages
        followers = [*(page.first for page in read[1:]), ""]
        found: dict[str, Pages] = {}
        left = set(range(len(results)))
        for page, follower in zip(read, followers, strict=True):
            number = places.get(page.first)
            if page.digest not in now or number is None or number == len(results):
                continue
            result = results.pages[
                number
            ]  # with both ends and as many recordings, it holds the results of all of these
            whole = firsts[number + 1] == follower and result.recordings == page.recordings
            if whole and self.store.has(result.digest, result.bytes):
                found[page.digest] = results.part(number)
                left.discard(number)
        others = {name for number in left for name in results.load(number).recordings}
        count = sum(part.total("recordings") for part in found.values())
        stated = self._stated(step["stage"], others, count)
        return None if stated is None else Taken(found, stated)

    def stands(self) -> bool:
        """Return whether the directory still shows what the run gave, with the files that were found there."""
        root = self.store.roots.get(self.directory)
        return root is not None and root["manifest"] == self.note.head.manifest and self.look.unchanged

    def succeed(self, head: Head, shown: Manifest) -> bool:
        """Note that all of ``shown`` is in the directory now; return False where each file is to be looked at for that."""
        before, now = pages.differing(self.made.recordings, shown.recordings)
        gone = [shard_path(name, stream) for name, entry in before.items() for stream in entry["shards"]]
        placed = [
            (shard_path(name, stream), shard["digest"], shard["bytes"])
            for name, entry in now.items()
            for stream, shard in entry["shards"].items()
        ]
        for manifest in (self.made, shown):
            for page in () if manifest.pages is None else manifest.pages.pages:
                gone += [page.path] if manifest is self.made else []
                placed += [(page.path, page.digest, page.bytes)] if manifest is shown else []
        files = [(path, file["digest"], file["bytes"]) for path, file in shown.files.items()]
        return self.look.succeed(self.note, head, [*gone, *self.made.files], [*placed, *files])

    def _gave(self, step: Mapping[str, Any]) -> bool:
        made = self.made
        named = [one["manifest"] for one in made.inputs.get("datasets", ())]
        return (
            made.stage == self.record["identity"]["run"] == step["stage"]
            and named == [self.given.content_digest]
            and bool(made.chain)
            and digest(made.chain[-1]) == digest(step)
        )

    def _stated(self, stage: str, others: set[str], count: int) -> Mapping[str, Any] | None:
        """Return what records state of results of which ``others`` are left out; None where that is not known."""
        provenance = self.record["provenance"]
        codes: Mapping[str, int] = (provenance.get("code") or {}).get(stage) or {}
        packages: Mapping[str, Mapping[str, int]] = provenance.get("packages") or {}
        for counts in filter(None, (codes, *packages.values())):
            if [*counts.values()] != [len(self.made.recordings)]:  # it is unknown which results other code computed
                return None
        left = {*others, ""}  # the last: of a stage over a whole dataset, which is asked again
        given: Mapping[str, Sequence[str]] = provenance.get("notes") or {}
        notes = {note: [name for name in names if name not in left] for note, names in given.items()}
        return {
            "code": {stage: dict.fromkeys(codes, count)} if codes and count else {},
            "packages": {name: dict.fromkeys(counts, count) for name, counts in packages.items() if count},
            "notes": {note: names for note, names in notes.items() if names},
        }


def inputs(store: Store, note: Note) -> Sequence[str]:
    """Return the digests of the manifests that the run read which gave what is noted."""
    record = store.record(note.head.key)
    return [] if record is None else list(record["identity"].get("datasets", ()))


def found(store: Store, directory: Path, note: Note) -> Previous | None:
    """Return the run that gave what ``directory`` shows, as noted; None where that is not known, or not all is there.

    All that it names must be announced before, and be kept from collections until what is made of it is shown.
    """
    record = None if store.distant else store.record(note.head.key)
    if record is None or "run" not in record["identity"]:
        return None
    named, gave = record["identity"].get("datasets", ()), record["result"]["files"].get(manifest_of.NAME)
    if len(named) != 1 or gave is None or gave["digest"] != note.head.manifest:
        return None
    look = Look(store, directory)
    if not look.holds(note, listed=True):
        return None
    try:
        made, given = manifest_of.stored(store, note.head.manifest), manifest_of.stored(store, named[0])
        if manifest_of.find(directory).digest != note.head.manifest or given.pages is None:
            return None
        return Previous(store, directory, note, look, record, given, made)
    except StorageError:
        raise
    except TacpipeError:
        return None
