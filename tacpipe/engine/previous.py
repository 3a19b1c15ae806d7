"""Reuse the results of the run that produced an output, for pages of recordings that have not changed since.

The run's record names the manifests that it read and produced. A page that is equal in the old and the new input
manifest has equal keys, hence the same page of results. A note on the directory records that the objects of these
results exist, once this was checked.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets import pages
from tacpipe.datasets.manifest import Manifest
from tacpipe.datasets.pages import Pages
from tacpipe.datasets.paths import shard_path
from tacpipe.engine import keys
from tacpipe.engine.outcome import Outcome
from tacpipe.errors import StorageError, TacpipeError
from tacpipe.io.hashing import digest
from tacpipe.plugins import registry
from tacpipe.plugins.rows import StageRows, stage_rows_from_json
from tacpipe.store import records
from tacpipe.store.presence import Head, Look, Note
from tacpipe.store.records import RecordingEntry, RunIdentity, Step, Summary
from tacpipe.store.store import Store


@dataclass(frozen=True)
class Reusable:
    """Reusable results: result pages by the digest of their input page, and the summary of their records."""

    pages: Mapping[str, Pages]
    summary: Summary  # argument of `Outcome.add_group`

    @property
    def count(self) -> int:
        """Number of recordings."""
        return sum(part.total("recordings") for part in self.pages.values())


@dataclass
class Previous:
    """A completed run over one dataset whose output has not changed since."""

    store: Store
    directory: Path
    note: Note
    look: Look
    identity: RunIdentity
    summary: Summary
    source: Manifest  # input
    result: Manifest  # output

    def reusable(self, entries: Mapping[str, RecordingEntry], step: Step) -> Reusable | None:
        """Return the reusable results of one stage of a chain for ``entries``, or None if there are none."""
        earlier_entries, results = self.source.included, self.result.pages
        if results is None or not (
            isinstance(entries, pages.Recordings) and isinstance(earlier_entries, pages.Recordings)
        ):
            return None
        if not self._is_same_step(step):
            return None
        present_digests = {page.digest for page in entries.pages.pages}
        firsts = [page.first for page in results.pages] + [""]
        number_by_first = {first: number for number, first in enumerate(firsts)}
        earlier_pages = earlier_entries.pages.pages
        next_firsts = [*(page.first for page in earlier_pages[1:]), ""]
        reusable: dict[str, Pages] = {}
        for page, next_first in zip(earlier_pages, next_firsts, strict=True):
            number = number_by_first.get(page.first)
            if page.digest not in present_digests or number is None or number == len(results):
                continue
            # equal first names and counts mean that the page has the results of exactly these recordings
            result = results.pages[number]
            covers_page = firsts[number + 1] == next_first and result.recordings == page.recordings
            if covers_page and self.store.has(result.digest, result.bytes):
                reusable[page.digest] = results.part(number)
        replaced = [group for group in pages.groups(earlier_entries) if group.page not in reusable]
        summary = self._summary(step, replaced, sum(part.total("recordings") for part in reusable.values()))
        return None if summary is None else Reusable(reusable, summary)

    def is_current(self) -> bool:
        """Return whether the directory still shows the run's result with unchanged files."""
        root = self.store.roots.get(self.directory)
        return root is not None and root["manifest"] == self.note.head.manifest and self.look.unchanged

    def succeed(self, head: Head, published: Manifest) -> bool:
        """Record that the directory now contains all of ``published``. Return False if each file must be checked instead."""
        removed_entries, placed_entries = pages.differing(self.result.recordings, published.recordings)
        removed = [shard_path(name, stream) for name, entry in removed_entries.items() for stream in entry["shards"]]
        placed = [
            (shard_path(name, stream), shard["digest"], shard["bytes"])
            for name, entry in placed_entries.items()
            for stream, shard in entry["shards"].items()
        ]
        for manifest in (self.result, published):
            for page in () if manifest.pages is None else manifest.pages.pages:
                removed += [page.path] if manifest is self.result else []
                placed += [(page.path, page.digest, page.bytes)] if manifest is published else []
        files = [(path, file["digest"], file["bytes"]) for path, file in published.files.items()]
        return self.look.succeed(self.note, head, [*removed, *self.result.files], [*placed, *files])

    def _is_same_step(self, step: Step) -> bool:
        """Return whether the earlier run computed its result by exactly this step from ``source``."""
        result = self.result
        input_digests = [dataset["manifest"] for dataset in result.inputs.get("datasets", ())]
        return (
            result.stage == self.identity["run"] == step["stage"]
            and input_digests == [self.source.content_digest]
            and bool(result.chain)
            and digest(result.chain[-1]) == digest(step)
        )

    def _summary(self, step: Step, replaced: Sequence[pages.RecordGroup], count: int) -> Summary | None:
        """Return the summary of all results except those of the ``replaced`` groups, or None if it is unknown.

        ``count`` is the number of the other results. Records of the replaced results are read only if the earlier run
        has results of different code, or counted rows.
        """
        earlier = _counts_by_code(self.summary, step["stage"])
        if any(sum(counts.values()) != len(self.result.recordings) for counts in earlier.values()):
            return None
        replaced_counts: list[_CountsByCode] = []
        rows = stage_rows_from_json(self.summary.get("stage_rows"))
        if rows or any(len(counts) > 1 for counts in earlier.values()):
            for group in replaced:
                summary = self._group_summary(step, group.entries())
                if summary is None:
                    return None
                replaced_counts.append(_counts_by_code(summary, step["stage"]))
                rows = _subtract_rows(rows, stage_rows_from_json(summary.get("stage_rows")))
        remaining: _CountsByCode = {}
        for source, counts in earlier.items():
            remaining[source] = _subtract(counts, [part.get(source, {}) for part in replaced_counts], count)
            if sum(remaining[source].values()) != count:
                return None
        replaced_names = {name for group in replaced for name in group.entries()}
        replaced_names.add("")  # the empty name is a stage over a whole dataset, which runs again
        notes = {
            note: [name for name in names if name not in replaced_names]
            for note, names in (self.summary.get("notes") or {}).items()
        }
        return {
            "code": {name: counts for (kind, name), counts in remaining.items() if kind == "code" and counts},
            "packages": {name: counts for (kind, name), counts in remaining.items() if kind == "packages" and counts},
            "notes": {note: names for note, names in notes.items() if names},
            "stage_rows": {stage: counted.to_json() for stage, counted in rows.items()},
        }

    def _group_summary(self, step: Step, entries: Mapping[str, RecordingEntry]) -> Summary | None:
        """Return the summary of the results of some input recordings, or None if a record is missing."""
        record = self.store.record(digest(keys.of_group(step, registry.load_step(step["stage"]), entries)))
        if record is not None:
            return records.summary(record)
        outcome = Outcome(self.directory)
        for task in keys.shard_tasks(self.store, replace(self.source, recordings=entries), step, ()):
            record = self.store.record(digest(task.identity))
            if record is None:
                return None
            outcome.add_record(step["stage"], task.recording, record)
        return outcome.of_results()


_CountsByCode = dict[tuple[str, str], dict[str, int]]  # number of results by digest of the code, by kind and name


def _counts_by_code(summary: Summary, stage: str) -> _CountsByCode:
    """Return how many results the code of ``stage``, and of each package, computed."""
    stage_counts = (summary.get("code") or {}).get(stage)
    packages = {("packages", name): counts for name, counts in (summary.get("packages") or {}).items()}
    return {**({("code", stage): stage_counts} if stage_counts else {}), **packages}


def _subtract(counts: Mapping[str, int], replaced: Sequence[Mapping[str, int]], count: int) -> dict[str, int]:
    """Return the number of results by code without the replaced ones, which are all of the same code if there is one.

    ``count`` is the number of all remaining results.
    """
    if len(counts) == 1:
        return dict.fromkeys(counts, count) if count else {}
    remaining = Counter(counts)
    for replaced_counts in replaced:
        remaining.subtract(replaced_counts)
    return {code: number for code, number in remaining.items() if number}


def _subtract_rows(rows: dict[str, StageRows], replaced: Mapping[str, StageRows]) -> dict[str, StageRows]:
    """Return the counts of ``rows`` less those of ``replaced``, which are no longer part of the result.

    Returns no counts if ``replaced`` has stages or more rows that ``rows`` lacks: records were then computed again after
    ``rows`` were counted. ``rows`` are changed.
    """
    try:
        for stage, counted in replaced.items():
            rows[stage].subtract(counted)
    except (KeyError, TacpipeError):
        return {}
    return rows


def inputs(store: Store, note: Note) -> Sequence[str]:
    """Return the digests of the manifests read by the run that a note describes."""
    record = store.record(note.head.key)
    return [] if record is None or "run" not in (identity := record["identity"]) else identity["datasets"]


def find(store: Store, directory: Path, note: Note) -> Previous | None:
    """Return the run that produced the noted content of ``directory``, or None if it is unknown or incomplete.

    Its objects must already be announced, so that they are protected from collection until the new result is published.
    """
    record = None if store.distant else store.record(note.head.key)
    if record is None or "run" not in (identity := record["identity"]):
        return None
    input_digests, result_file = identity["datasets"], record["result"]["files"].get(manifest_of.NAME)
    if len(input_digests) != 1 or result_file is None or result_file["digest"] != note.head.manifest:
        return None
    look = Look(store, directory)
    if not look.holds(note, listed=True):
        return None
    try:
        result, source = manifest_of.stored(store, note.head.manifest), manifest_of.stored(store, input_digests[0])
        if manifest_of.find(directory).digest != note.head.manifest or source.pages is None:
            return None
        return Previous(store, directory, note, look, identity, records.summary(record), source, result)
    except StorageError:
        raise
    except TacpipeError:
        return None
