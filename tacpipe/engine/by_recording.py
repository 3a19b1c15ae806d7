"""Run stages recording by recording: take each result from the store, or run the stage on that recording."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tacpipe.datasets import pages, selection
from tacpipe.datasets.dataset import Dataset
from tacpipe.datasets.manifest import Manifest
from tacpipe.datasets.pages import Item
from tacpipe.engine import computing, execution, keys, provenance
from tacpipe.engine.executors.local import ChosenExecutor
from tacpipe.engine.keys import Done, WorkerTask
from tacpipe.engine.outcome import Outcome
from tacpipe.engine.previous import Previous
from tacpipe.engine.request import Request
from tacpipe.errors import FAILED, LOCKED, LockedError, TacpipeError, UsageError, WouldChangeError
from tacpipe.io import terminal
from tacpipe.io.hashing import bytes_digest, digest
from tacpipe.plugins import registry
from tacpipe.printable import grouped_failures
from tacpipe.store import records
from tacpipe.store.location import locate
from tacpipe.store.records import ComputedResult, GroupIdentity, Provenance, RecordingEntry, Step, StoredResult
from tacpipe.store.store import Store

NAMED = 3  # maximum number of recordings that are named for an error
SHOWN = 100  # maximum number of recordings that are listed one by one when some could not be read
Answer = Mapping[str, RecordingEntry] | pages.Pages  # results of a group of recordings


@dataclass(frozen=True)
class _RecordingGroup:
    """A group of recordings, and the identity whose digest is its key."""

    identity: GroupIdentity
    entries: Mapping[str, RecordingEntry]


@dataclass(frozen=True)
class ByRecording:
    """Computes the results of a request for each recording. Adds counts and notes to ``outcome``."""

    store: Store
    request: Request
    outcome: Outcome
    chosen: ChosenExecutor
    previous: Previous | None = None  # earlier run whose unchanged results are reused

    def run_step(self, source: Manifest, step: Step, dataset_dirs: tuple[str, ...]) -> Mapping[str, RecordingEntry]:
        """Return the result of a map stage, one link of a chain, for each recording of ``source``.

        Each group of recordings has a record in addition to the records of its recordings. If one recording changed,
        one record is read per group, plus one per recording of the changed group. Results of many recordings are stored
        in pages. Raises the errors of `run`.
        """
        entries, name, stage = source.included, step["stage"], registry.load_step(step["stage"])
        results_or_pending: list[Answer | _RecordingGroup] = []
        missing: list[WorkerTask] = []
        stored: dict[str, ComputedResult] = {}  # records of incomplete groups, by recording
        reusable = None if self.previous is None else self.previous.reusable(entries, step)
        reusable_pages: Mapping[str, pages.Pages] = {}
        if reusable is not None:
            reusable_pages = reusable.pages
            self.outcome.reused += reusable.count
            self.outcome.add_group(reusable.summary)
        else:
            self.store.expect(digest(keys.of_group(step, stage, group.entries())) for group in pages.groups(entries))
        is_paged = len(entries) > pages.INLINE

        def pack_results(results: Mapping[str, RecordingEntry]) -> Answer:
            return (
                pages.Pages.from_items((recording, Item(entry)) for recording, entry in results.items())
                if is_paged
                else results
            )

        for group in pages.groups(entries):
            if group.page in reusable_pages:
                results_or_pending.append(reusable_pages[group.page])
                continue
            group_entries = group.entries()
            pending = _RecordingGroup(keys.of_group(step, stage, group_entries), group_entries)
            group_results = None if self.request.compare or self._reruns(name) else self._group_entries(pending)
            if group_results is None:
                tasks = keys.shard_tasks(self.store, replace(source, recordings=group_entries), step, dataset_dirs)
                group_records, uncomputed = self._find_stored(name, tasks)
                if uncomputed:
                    stored |= group_records
                    missing += uncomputed
                    results_or_pending.append(pending)
                    continue
                group_results = self._remember_group(name, pending, group_records)
            results_or_pending.append(pack_results(_with_input_attributes(group_results, group_entries)))
        computed = self._compute_missing(name, missing, stored, len(entries))

        def iterate_results() -> Iterator[Answer]:
            for answer_or_pending in results_or_pending:
                if not isinstance(answer_or_pending, _RecordingGroup):
                    yield answer_or_pending
                    continue
                records_of = {
                    recording: computed[recording] for recording in answer_or_pending.entries if recording in computed
                }
                group_results = self._remember_group(name, answer_or_pending, records_of)
                yield pack_results(_with_input_attributes(group_results, answer_or_pending.entries))

        if is_paged:
            return pages.Recordings(
                pages.Pages.joined(part for part in iterate_results() if isinstance(part, pages.Pages))
            )
        return {name: entry for part in iterate_results() if isinstance(part, Mapping) for name, entry in part.items()}

    def _group_entries(self, group: _RecordingGroup) -> Mapping[str, RecordingEntry] | None:
        """Return the entries in a group's record, or None if there is no record or an object is missing."""
        record = self.store.record(digest(group.identity))
        if record is None or not self.store.is_complete(record):
            return None
        self.outcome.reused += len(group.entries)
        self.outcome.add_group(records.summary(record))
        return record["result"]["recordings"]

    def run(self, name: str, tasks: Sequence[WorkerTask]) -> dict[str, RecordingEntry]:
        """Return the result of each task of stage ``name`` as an entry, by recording.

        Raises `TacpipeError` if recordings could not be read, and `WouldChangeError` if ``--check`` is set and the
        stage would run.
        """
        return _with_input_attributes(
            {recording: result["recordings"][""] for recording, result in self.results(name, tasks).items()}, {}
        )

    def results(self, name: str, tasks: Sequence[WorkerTask]) -> dict[str, StoredResult]:
        """Return the ``result`` in each task's record, by recording. Raises the errors of `run`."""
        return {recording: record["result"] for recording, record in self._records(name, tasks).items()}

    def _reruns(self, name: str) -> bool:
        return self.request.rerun and registry.stage_name(name) == self.request.name

    def _records(self, name: str, tasks: Sequence[WorkerTask]) -> dict[str, ComputedResult]:
        """Return the record of each task, by recording."""
        stored, missing = self._find_stored(name, tasks)
        return self._compute_missing(name, missing, stored, len(tasks))

    def _find_stored(
        self, name: str, tasks: Sequence[WorkerTask]
    ) -> tuple[dict[str, ComputedResult], list[WorkerTask]]:
        """Return the stored records by recording, and the tasks of recordings that must be computed.

        To compare results, all tasks are returned as dry runs.
        """
        stored: dict[str, ComputedResult] = {}
        missing: list[WorkerTask] = []
        rerun = self._reruns(name)
        self.store.expect(digest(task.identity) for task in tasks)
        for task in tasks:
            record = self.store.record(digest(task.identity))
            if record is not None and not rerun and self.store.is_complete(record):
                stored[task.recording] = record
                self.outcome.add_record(name, task.recording, record)
            else:
                missing.append(replace(task, replace=record is not None, rerun=rerun, run=self.store.run))
        if self.request.compare:
            missing = [replace(task, dry=True) for task in tasks]
        self.outcome.reused += len(tasks) - len(missing)
        return stored, missing

    def _compute_missing(
        self, name: str, missing: Sequence[WorkerTask], stored: Mapping[str, ComputedResult], count: int
    ) -> dict[str, ComputedResult]:
        """Compute the ``missing`` tasks, and return their records with the ``stored`` ones.

        ``count`` is the number of both.

        Raises `WouldChangeError` if ``--check`` is set and a task is missing, and the error of `run` if all recordings
        failed.
        """
        if missing and self.request.check:
            raise WouldChangeError(f"{registry.stage_name(name)} would run for {len(missing)} of {count} recordings.")
        complete = {**stored, **self._compute(name, missing, stored)}
        if missing and not complete and len(missing) == count:
            lines = _lines(self.outcome.bad)
            raise error(FAILED, f"{registry.stage_name(name)} could not read any of the {count} recordings:\n{lines}")
        return complete

    def _remember_group(
        self, name: str, group: _RecordingGroup, records_by_name: Mapping[str, ComputedResult]
    ) -> dict[str, RecordingEntry]:
        """Return the entries of a group's recordings. If the group is complete, store them under its key."""
        result = {recording: record["result"]["recordings"][""] for recording, record in records_by_name.items()}
        if self.store.run and len(group.entries) > 1 and len(records_by_name) == len(group.entries):
            summary = Outcome(self.outcome.output)
            for recording, record in records_by_name.items():
                summary.add_record(name, recording, record)
            made_by = provenance.describe_run(summary.of_results())
            self.store.commit(group.identity, {"recordings": result, "files": {}}, made_by, replace=True)
        return result

    def replay(self, source: Manifest, model: Manifest, dataset_dirs: tuple[str, ...], dataset_name: str) -> Manifest:
        """Run the stages of a model's chain that ``source`` has not gone through, and return the resulting manifest.

        Shards may be adopted from ``dataset_dirs``, which include the model's directory. Raises `UsageError` if
        ``source`` went through other stages, or if a stage now has another version.
        """
        model_chain = model.chain
        if list(source.chain) != list(model_chain[: len(source.chain)]):
            raise UsageError(
                f"The model was trained on recordings of other stages than {dataset_name} went through: "
                f"{selection.chain_difference(model_chain, source.chain)}. Give the recordings themselves: the model's own "
                f"stages are then run on them."
            )
        replayed = source
        for step in model_chain[len(source.chain) :]:
            stage = registry.load(step["stage"])
            if stage.version != step["version"]:
                raise UsageError(
                    f"The model was trained on the output of version {step['version']} of {step['stage']}; this "
                    f"tacpipe has version {stage.version}. Train it again."
                )
            recordings = self.run_step(replayed, step, dataset_dirs)
            files = {name: model.files[name] for name in step["fitted"] or {}}
            replayed = Manifest(
                step["stage"], step["version"], step["params"], {}, [*replayed.chain, step], recordings, files
            )
        return replayed

    def _compute(
        self, name: str, tasks: Sequence[WorkerTask], stored: Mapping[str, ComputedResult]
    ) -> dict[str, ComputedResult]:
        """Compute tasks and return their records. With ``--recompute-and-compare``, compare them with ``stored``."""
        computed: dict[str, ComputedResult] = {}
        if not tasks:
            return computed
        bad: dict[str, Done] = {}
        executor = self.chosen.opened()
        module = registry.stages()[registry.stage_name(name)].partition(":")[0]
        preload = ["tacpipe.io.parquet", "tacpipe.engine.computing", module]
        with terminal.progress_bar(registry.stage_name(name), len(tasks)) as advance:
            for result in executor.run(computing.compute, tasks, preload):
                advance(note=result.recording)
                if result.record is None:
                    bad[result.recording] = result
                    continue
                self.outcome.ran += result.is_new
                self.outcome.reused += not result.is_new
                self.outcome.add_record(name, result.recording, result.record)
                made_by = result.record["provenance"]
                necessary: Provenance = {  # not the environment, because there may be a million recordings
                    "notes": made_by.get("notes", []),
                    "code": made_by.get("code"),
                    "packages": made_by.get("packages", {}),
                }
                if "rows" in made_by:
                    necessary["rows"] = made_by["rows"]
                computed[result.recording] = {"result": result.record["result"], "provenance": necessary}
                if self.request.compare and result.recording in stored:
                    self.outcome.compare(stored[result.recording], result.record, result.recording)
        self._raise_failures(name, bad, {**stored, **computed})
        return computed

    def _raise_failures(self, name: str, bad: Mapping[str, Done], good: Mapping[str, ComputedResult]) -> None:
        """Add failed recordings to the outcome, and raise their error unless ``--skip-bad`` excuses it.

        ``bad`` contains the failures by recording, and ``good`` the results.
        """
        # paths are relative, because the location of files is not part of a manifest
        source = f"{self.request.source}/"
        self.outcome.bad.update({name: bad[name].error.replace(source, "") for name in sorted(bad)})
        other_errors = sorted({(-failure.exit_code, failure.error) for failure in bad.values() if not failure.at_fault})
        if other_errors and all(
            code == -FAILED for code, _ in other_errors
        ):  # a failing disk causes the same error for each recording, so it is reported once
            raise error(FAILED, other_errors[0][1])
        if not bad or (self.request.skip_bad and not other_errors):
            return
        lock_errors = [failure.error for failure in bad.values() if failure.exit_code == LOCKED]
        if lock_errors:  # another process is computing the recording, which may be valid
            raise LockedError(lock_errors[0])
        lines = _verdicts({recording: bad[recording].error for recording in bad}, good)
        plural = "recordings" if len(bad) > 1 else "recording"
        advice = "Fix these." if other_errors else "Fix these, or leave them out with --skip-bad."
        kept = "The other recordings are kept in the store. " if good else ""
        raise error(
            max(failure.exit_code for failure in bad.values()),
            f"{registry.stage_name(name)} could not read {len(bad)} {plural} of {len(bad) + len(good)}:\n{lines}\n"
            f"{kept}{advice}",
        )


def _with_input_attributes(
    results: Mapping[str, RecordingEntry], entries: Mapping[str, RecordingEntry]
) -> dict[str, RecordingEntry]:
    """Return results sorted by name. Attributes of the input ``entries`` precede those of the result."""
    with_attributes: dict[str, RecordingEntry] = {}
    for name, entry in sorted(results.items()):
        inherited = entries[name]["attributes"] if name in entries else {}
        with_attributes[name] = {"attributes": {**inherited, **entry["attributes"]}, "shards": entry["shards"]}
    return with_attributes


def error(exit_code: int, sentence: str) -> TacpipeError:
    """Return an error with this sentence and exit code."""
    failure = TacpipeError(sentence)
    failure.exit_code = exit_code
    return failure


def _verdicts(bad: Mapping[str, str], good: Mapping[str, ComputedResult]) -> str:
    """Return one line per error with its recordings, then one per recording with its rows if they are not many."""
    verdicts = [_lines(bad)]
    if len(bad) + len(good) <= SHOWN:
        for recording, record in sorted(good.items()):
            entries = record["result"]["recordings"].values()
            rows = sum(shard.get("rows", 0) for entry in entries for shard in entry["shards"].values())
            verdicts.append(f"  {recording}: read, {rows} rows")
    return "\n".join(verdicts)


def _lines(bad: Mapping[str, str]) -> str:
    """Return one line per error, with the first recordings that have it."""
    return "\n".join(f"  {line}" for line in grouped_failures(dict(sorted(bad.items())), NAMED))


def run_chain_of_model(recordings: Dataset, model: Dataset) -> Dataset:
    """Run the remaining stages of a model's chain on recordings and return the result.

    Stored results are reused and new ones are stored, as by ``tacpipe predict``. Both datasets must be open. Raises
    `UsageError` if the recordings went through other stages, `TacpipeError` if a recording cannot be read.
    """
    assert recordings.path is not None and model.path is not None
    source = recordings.source
    selected = replace(source, recordings={name: source.recordings[name] for name in recordings.recordings})
    dataset_dirs = (str(recordings.path), str(model.path))
    store = locate(recordings.path, model.path)
    manifests = [source.content_digest, bytes_digest(model.source.content)]
    with ChosenExecutor("", 0) as chosen, store.at_work(manifests):
        mapping = ByRecording(store, Request("", None, Path()), Outcome(Path()), chosen)
        replayed = mapping.replay(selected, model.source, dataset_dirs, str(recordings.path))
    return Dataset(replayed, execution.reader(store, dataset_dirs))
