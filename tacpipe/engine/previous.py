"""The run that gave what an output shows: of recordings that did not change since, its results are taken over as text.

That rests on what a hit rests on: the record of that run names the manifest that it read and the one that it gave, and both
are read by their digests. A group of recordings whose text is the same in the manifest of then and in that of now has the
same keys, and so the same text of results. The objects of these are there as a note on the directory states, once it was
found to hold.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tacpipe.datasets import groups as groups_of
from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets import pages
from tacpipe.datasets.manifest import Entry, Found, Manifest
from tacpipe.datasets.paths import shard_path
from tacpipe.errors import StorageError, TacpipeError
from tacpipe.io.hashing import digest
from tacpipe.store.notes import Head, Note
from tacpipe.store.presence import Look
from tacpipe.store.store import Store


@dataclass(frozen=True)
class Taken:
    """Results that are taken over: of groups of recordings, by the name of the first, and what their records state."""

    groups: Mapping[str, groups_of.Kept]
    stated: Mapping[str, Any]  # as `Outcome.add_group` takes it

    @property
    def count(self) -> int:
        """How many recordings they are."""
        return sum(kept.count for kept in self.groups.values())


@dataclass
class Previous:
    """A run over one dataset, recording by recording, whose output is as it left it."""

    store: Store
    directory: Path
    note: Note
    look: Look
    record: Mapping[str, Any]
    given: Manifest | None  # what it read, of which nothing is parsed yet; None once all that is asked of it was asked
    made: Manifest  # what it gave

    def checked(self, found: Found) -> None:
        """Check the manifest that is read now; of one that differs little from the one of then little is parsed."""
        manifest_of.parse(found.content, str(found.directory / manifest_of.NAME), beside=self.given)

    def taken(self, entries: Mapping[str, Entry], step: Mapping[str, Any]) -> Taken | None:
        """Return what is taken over of the results of a link of a chain for ``entries``; None where nothing can be.

        It is asked once: what the run read is not kept.
        """
        made, before = self.made, self.given
        self.given = None
        if before is None or not isinstance(entries, pages.Pages) or not self._gave(step, before.content_digest):
            return None
        given = before.included
        if not isinstance(given, pages.Pages):
            return None
        assert isinstance(made.recordings, pages.Pages)
        both, results = pages.shared(given, entries), made.recordings
        places = {name: number for number, name in enumerate(results.beginnings)}
        groups: dict[str, groups_of.Kept] = {}
        for group in entries.grouped():
            first = entries.beginnings[group[0]]
            place = places.get(first)
            if place is None or not all(number in both for number in group):
                continue
            names = entries.names(group)
            if names == results.names([place]):  # no recording came between two that did not change
                groups[first] = groups_of.Kept(results.texts[place], len(names))
                del places[first]
        stated = self._stated(step["stage"], results.of(places.values()), sum(one.count for one in groups.values()))
        return None if stated is None else Taken(groups, stated)

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
        files = [(path, file["digest"], file["bytes"]) for path, file in shown.files.items()]
        return self.look.succeed(self.note, head, [*gone, *self.made.files], [*placed, *files])

    def _gave(self, step: Mapping[str, Any], given: str) -> bool:
        made = self.made
        named = [one["manifest"] for one in made.inputs.get("datasets", ())]
        return (
            isinstance(made.recordings, pages.Pages)
            and made.stage == self.record["identity"]["run"] == step["stage"]
            and named == [given]
            and bool(made.chain)
            and digest(made.chain[-1]) == digest(step)
        )

    def _stated(self, stage: str, others: pages.Pages, count: int) -> Mapping[str, Any] | None:
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
        made = manifest_of.find(directory)
        given = manifest_of.unparsed(store.read(named[0]), "the stored manifest")
        if made.digest != note.head.manifest or given is None:
            return None
        return Previous(store, directory, note, look, record, given, made.manifest)
    except StorageError:
        raise
    except TacpipeError:
        return None
