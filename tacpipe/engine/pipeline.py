"""Run a command: determine the required results, reuse stored ones, compute the missing ones, publish the dataset."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tacpipe.datasets import labels, lineage, manifest, replacing, selection
from tacpipe.datasets.dataset import Dataset
from tacpipe.datasets.manifest import Manifest
from tacpipe.datasets.paths import shard_path
from tacpipe.engine import by_recording, computing, execution, keys, output, provenance
from tacpipe.engine.by_recording import ByRecording
from tacpipe.engine.executors.local import ChosenExecutor
from tacpipe.engine.keys import WorkerTask
from tacpipe.engine.outcome import Outcome
from tacpipe.engine.output import Unread
from tacpipe.engine.previous import Previous
from tacpipe.engine.request import Request, RequestInputs
from tacpipe.errors import TacpipeError, UsageError, WouldChangeError
from tacpipe.io import terminal
from tacpipe.io.hashing import digest
from tacpipe.plugins import given_params, registry
from tacpipe.plugins import params as params_of
from tacpipe.plugins.stage import ROLES
from tacpipe.store import records
from tacpipe.store.location import locate
from tacpipe.store.records import Content, RecordingEntry, RunIdentity, StageIdentity, Step, StoredResult
from tacpipe.store.store import MissingError, Store

if TYPE_CHECKING:
    from tacpipe.trackers.tracking import Tracker

# entry of a recording whose part of the stage returns only files
_NOTHING: RecordingEntry = {"attributes": {}, "shards": {}}


def open_dataset(path: Path | str) -> Dataset:
    """Return the dataset at ``path``; its shards are read from the store, or adopted from the directory."""
    located = manifest.find(path)
    directory = located.directory.absolute()
    read = execution.reader(locate(directory), (str(directory),), located.manifest)
    return Dataset(located.manifest, read, directory=directory, opener=open_dataset)


def run(request: Request) -> Outcome:
    """Produce the dataset of ``request``, computing only what is not stored.

    Raises `UsageError` for options that exclude each other.
    """
    started = time.perf_counter()
    if request.rerun and (request.check or request.compare):
        raise UsageError("--rerun computes and stores; it does not go with --check or --recompute-and-compare.")
    if request.track and (request.check or request.compare):
        raise UsageError("--track follows what is stored; it does not go with --check or --recompute-and-compare.")
    trackers: dict[str, Tracker] = {}
    if request.track:
        from tacpipe.trackers import tracking

        trackers = tracking.open_trackers(request.track)
    replacing.refuse_inputs(request.output, request.reads)
    store = locate(*request.locations)
    inputs = RequestInputs(request, store)
    request = inputs.request  # its params may follow from the split
    with ChosenExecutor(request.executor, request.jobs) as chosen:
        work = _RequestRun(request, store, inputs, inputs.identity(), chosen)
        outcome = work.outcome
        with _track_run(request, trackers, outcome, store) as end_tracking:
            result = output.settle(store, request, inputs.plan(), work)
            if isinstance(result, Manifest):  # otherwise there is nothing to track
                end_tracking(result)
    return _conclude(outcome, inputs, result, started)


def _conclude(outcome: Outcome, inputs: RequestInputs, result: Manifest | Unread, started: float) -> Outcome:
    outcome.notes = [
        *sorted(set(inputs.notes)),
        *inputs.describe_unread(),
        *inputs.describe_findings(),
        *outcome.describe_results(),
        *outcome.notes,
    ]
    outcome.rows = result.rows
    outcome.seconds = round(time.perf_counter() - started, 3)
    return outcome


@contextmanager
def _track_run(
    request: Request, trackers: dict[str, Tracker], outcome: Outcome, store: Store
) -> Iterator[Callable[[Manifest], None]]:
    """Let trackers follow trainings in the block. Yields the function that ends their run with the resulting manifest."""
    if not trackers:
        yield lambda result: None
        return
    from tacpipe.trackers import tracking
    from tacpipe.training import following

    params = {**params_of.to_json(request.params), "stage": request.name, "fold": request.fold}
    tracked = tracking.Tracking(trackers, tracking.name_of(request.output, outcome.key), tracking.flat_params(params))

    def end(result: Manifest) -> None:
        tracked.finish(request.output, tracking.files(result, store))
        outcome.notes += tracked.failures if terminal.is_quiet() else []

    try:
        with following.track_with([tracked]):
            yield end
    except BaseException:
        tracked.abandon()
        raise


class _RequestRun:
    """Produces the result of a request from the store, or by computing what is missing."""

    def __init__(
        self, request: Request, store: Store, inputs: RequestInputs, identity: RunIdentity, chosen: ChosenExecutor
    ) -> None:
        """Prepare a run without changing anything."""
        self.request, self.store, self.inputs, self.identity, self.chosen = request, store, inputs, identity, chosen
        self.stage = inputs.stage
        self.outcome = Outcome(request.output, digest(identity))
        self.reads = [dataset.digest for dataset in inputs.used]
        self._prepared_recordings: dict[str, Manifest] = {}  # by argument
        self.previous: Previous | None = None  # earlier run whose unchanged results are reused

    @property
    def key(self) -> str:
        """The key of the run."""
        return self.outcome.key

    def count(self, manifest_of_run: Manifest) -> int:
        """Return the number of stored results that a manifest consists of."""
        return len(self.inputs.merged.included) if self.stage.part else len(manifest_of_run.recordings) or 1

    def recall(self, manifest_digest: str, reused: int) -> bool:
        """Restore the outcome of an earlier run; return whether it produced the manifest with this digest."""
        record = self.store.record(self.key)
        if record is None or record["result"]["files"][manifest.NAME]["digest"] != manifest_digest:
            return False
        self.outcome.begin()
        self.outcome.restore(records.summary(record))
        self.outcome.reused = reused
        return True

    def answer(self) -> Manifest | None:
        """Return the manifest of an identical earlier run if everything it names still exists, else None."""
        self.outcome.begin()
        record = self.store.record(self.outcome.key)
        if record is None:
            return None
        name = record["result"]["files"][manifest.NAME]["digest"]
        self.store.announce([name])
        try:
            stored_manifest = manifest.stored(self.store, name, "the stored manifest")
            self.store.announce(
                page.digest for page in (stored_manifest.pages.pages if stored_manifest.pages is not None else ())
            )
            sizes = list(stored_manifest.sizes())
        except MissingError:  # the manifest or one of its pages is missing
            return None
        self.store.announce(name for name, _ in sizes)
        if not all(self.store.has(name, size) for name, size in sizes):
            return None
        self.outcome.restore(records.summary(record))
        self.outcome.reused = self.count(stored_manifest)
        return stored_manifest

    def result(self, *, rerun: bool, previous: Previous | None = None) -> Manifest:
        """Return the stored manifest, or compute and store it; with ``rerun`` it is always computed.

        Unchanged results of a ``previous`` run are reused.
        """
        result = None if rerun else self.answer()
        self.previous = previous if self.stage.mapped and self.stage.argument("Recording") else None
        if result is None:
            self.outcome.begin()
            result = self.make()
            self._remember(result)
        return result

    def make(self) -> Manifest:
        """Compute what is missing and return the result's manifest.

        Raises `TacpipeError` if the stage returned something that a dataset cannot contain.
        """
        for dataset in self.inputs.used:
            source_manifest = dataset.manifest  # raises if the manifest was edited by hand, before anything is written
            if self.store.run:  # `explain` and `gc` trace a dataset to the manifests that it was computed from
                source_manifest.keep(self.store)
        result = self._make()
        if self.stage.source:  # a training prints what concerns it with its findings
            self.outcome.add_dataset_notes(labels.attributes(result))
        try:
            manifest.check_pages(result, fresh=True)
        except (ValueError, TypeError, KeyError) as error:
            raise TacpipeError(f"{self.request.name} returned a result that no dataset can hold: {error}.") from None
        return result

    def _make(self) -> Manifest:
        """Run the stage on whole datasets or by recording, and return the manifest.

        Raises `UsageError` without a recording.
        """
        request, stage = self.request, self.stage
        empty = Manifest(request.name, stage.version, params_of.to_json(request.params), self.inputs.lineage())
        if not stage.mapped:
            inputs = {
                name: self._identity_of_argument(name, kind)
                for name, kind in stage.arguments.items()
                if kind != "Workspace"
            }
            inputs |= {"equal": self.inputs.equal_recordings} if self.inputs.equal_recordings else {}
            identity = keys.identity(request.name, stage.version, request.params, inputs)
            if stage.part is not None:
                files = {**self._run_whole(request.name, identity, counted=False)["files"], **self._parts.files}
                return replace(empty, files={**files, **self._originals()}, skipped=self._skipped_recordings)
            result = self._run_whole(request.name, identity)
            return replace(empty, chain=self._chain(), recordings=result["recordings"], files=result["files"])
        fitted_files = self._fit() if stage.fit else None
        chain: Sequence[Step] = ()
        recordings: Mapping[str, RecordingEntry] = {}
        if stage.argument("Recording"):
            source = self.inputs.merged
            step = keys.chain_step(request.name, stage, request.params, fitted_files)
            recordings = self._by_recording.run_step(source, step, self.inputs.dataset_dirs)
            chain = [*source.chain, step]
        elif tasks := self._own_tasks():
            recordings = self._by_recording.run(request.name, tasks)
        if not recordings and not self.outcome.bad:
            raise UsageError(f"{request.name} found no recording to work on.")
        return replace(
            empty,
            chain=chain,
            recordings=recordings,
            files=fitted_files or {},
            skipped=self._skipped_recordings,
            sources={name: files for name, files in self.inputs.source_digests.items() if name in recordings},
        )

    def _own_tasks(self) -> list[WorkerTask]:
        """Return one task per recording for a stage without input datasets: an ingest or a simulation."""
        request, stage = self.request, self.stage
        if stage.source:
            sources, digests = self.inputs.sources, self.inputs.source_digests
            return keys.source_tasks(self.store, request.name, stage, request.params, sources, digests)
        return keys.trial_tasks(self.store, request.name, stage, request.params)

    @property
    def _skipped_recordings(self) -> dict[str, str]:
        carried = {
            name: reason for dataset in self.inputs.datasets for name, reason in dataset.manifest.skipped.items()
        }
        return {**carried, **self.outcome.bad}

    @property
    def _by_recording(self) -> ByRecording:
        return ByRecording(self.store, self.request, self.outcome, self.chosen, self.previous)

    def _chain(self) -> Sequence[Step]:
        if "model" in self.inputs.named_datasets:
            return self.inputs.model.chain
        chains = [dataset.manifest.chain for dataset in self.inputs.datasets]
        return chains[0] if chains and all(chain == chains[0] for chain in chains) else ()

    # ---- stages over whole datasets

    def _prepared(self, name: str) -> Manifest:
        """Return the recordings of argument ``name`` after the stages that they go through first.

        These are the stages that the argument's annotation states, else those of the model's chain. They run once.
        """
        if name not in self._prepared_recordings:
            self._prepared_recordings[name] = self._prepare(name)
        return self._prepared_recordings[name]

    def _prepare(self, name: str) -> Manifest:
        inputs, source, prepare = self.inputs, self.inputs.merged, self.stage.prepare(name)
        stages = None if prepare is None else prepare(self.request.params)
        if stages is not None:
            steps = []
            for first, options in stages.items():
                stage = registry.load(first)
                steps.append(keys.chain_step(first, stage, given_params.build(first, stage, options=options), None))
            model = Manifest(self.request.name, self.stage.version, chain=[*source.chain, *steps])
        elif "model" in inputs.named_datasets:
            model = inputs.model
        else:
            return source
        return self._by_recording.replay(source, model, inputs.dataset_dirs, str(self.request.datasets[0]))

    @cached_property
    def _parts(self) -> Manifest:
        """Results of the stage's part for each recording: tables, and files by name.

        Raises `UsageError` if there is no recording.
        """
        name = f"{self.request.name}{registry.PART}"
        source = self._prepared(self.stage.argument("Dataset") or "")
        assert self.stage.part is not None
        step = keys.chain_step(name, self.stage.part, self.request.params, None)
        tasks = keys.shard_tasks(self.store, source, step, self.inputs.dataset_dirs)
        if not tasks:
            raise UsageError(f"{self.request.name} found no recording to work on.")
        results = self._by_recording.results(name, tasks)
        recordings = {recording: result["recordings"].get("", _NOTHING) for recording, result in results.items()}
        files = {file: stored for result in results.values() for file, stored in result["files"].items()}
        return Manifest(name, self.stage.part.version, step["params"], recordings=recordings, files=files)

    def _originals(self) -> dict[str, Content]:
        """Return the input shards that become files of the result, if the stage requests them."""
        folder = self.stage.originals(self.request.params) if self.stage.originals is not None else ""
        if not folder:
            return {}
        source = self.inputs.merged
        originals: dict[str, Content] = {}
        read = execution.reader(self.store, self.inputs.dataset_dirs, dict(source.sizes()))
        for recording, entry in source.included.items():
            for stream, shard in entry["shards"].items():
                path = shard_path(recording, stream)
                if not self.store.has(shard["digest"], shard["bytes"]):
                    read(shard["digest"], path)  # adopts or recomputes the shard
                originals[f"{folder}/{path}"] = {"digest": shard["digest"], "bytes": shard["bytes"]}
        return originals

    def _identity_of_argument(self, name: str, kind: str) -> Any:
        """Return the part of the key for an argument that is not a single recording, such as a dataset or a model.

        It is None for an initial model that was not given.
        """
        inputs, reads = self.inputs, self.stage.reads
        if kind == "Model" and name == "init":
            init = inputs.initial_model
            return keys.of_dataset(init, None, {}) if init else None
        if kind == "Model":
            return keys.of_dataset(inputs.model, None, {})
        if kind == "Datasets":
            return [keys.of_dataset(dataset.manifest, reads, dataset.manifest.included) for dataset in inputs.datasets]
        if kind == "Rows":
            return [lineage.chain_rows(self.store, dataset.manifest, dataset.digest) for dataset in inputs.datasets]
        if kind == "Roles":
            return self._roles(name)
        if kind == "Parts":
            return keys.of_dataset(self._parts, None, self._parts.recordings)
        return self._identity_of_recordings(name)

    def _identity_of_recordings(self, name: str) -> Any:
        """Return the part of the key for the recordings of argument ``name``.

        With a split, only recordings of one role are used, unless the stage reads the roles itself: the role that ``name``
        names, else ``--role``, else test. Recordings whose part failed are left out. Raises `UsageError` for ``--role``
        without a split.
        """
        inputs, reads, source = self.inputs, self.stage.reads, self._prepared(name)
        chosen: Mapping[str, RecordingEntry] = source.included
        if name in ROLES:
            chosen = inputs.in_role(source, name, may_lack=self.stage.optional(name))
        elif "split" in inputs.named_datasets and "split" not in self.stage.arguments:
            chosen = inputs.in_role(source, self.request.role or "test")
        elif self.request.role is not None:
            raise UsageError(f"--role {self.request.role} has no effect without --split.")
        if self.stage.part is not None:
            chosen = {recording: entry for recording, entry in chosen.items() if recording in self._parts.recordings}
        return keys.of_dataset(source, reads, chosen)

    def _roles(self, name: str) -> Any:
        """Return the identity of the roles of argument ``name``, or None if its option was not given.

        Raises `UsageError` for ``--fold`` without a split, and for a split of another dataset.
        """
        dataset = self.inputs.named_datasets.get(name)
        fold = self.request.fold
        if dataset is None:
            if name == "split" and fold:
                raise UsageError(f"--fold {fold} has no effect without --split.")
            return None
        table = selection.split_digest(dataset.manifest, str(dataset.directory))
        if name != "split":
            return table
        if not self.inputs.roles.keys() & self.inputs.merged.included.keys():
            raise UsageError(f"No recording of the dataset has a role in {dataset.directory}. Split this dataset.")
        return {"roles": table, "fold": fold}

    def _run_whole(self, name: str, identity: StageIdentity, *, counted: bool = True) -> StoredResult:
        """Return the result of a key over whole datasets, from the store or by running the stage.

        Only ``counted`` results count in the outcome. Raises `WouldChangeError` if it is missing and ``--check`` is
        set, and the error of the stage.
        """
        self.store.expect([digest(identity)])
        record = self.store.record(digest(identity))
        is_stored = record is not None and self.store.is_complete(record)
        if record is not None and is_stored and not self.request.compare and not self.request.rerun:
            self.outcome.reused += counted
            self.outcome.add_record(name, "", record)
            return record["result"]
        if self.request.check:
            raise WouldChangeError(f"{name} would run: there is no result for these inputs and params.")
        task = WorkerTask(
            self.store.place,
            name,
            identity,
            dataset_dirs=self.inputs.dataset_dirs,
            replace=record is not None,
            dry=self.request.compare,
            rerun=self.request.rerun,
            device=self.request.device,
            run=self.store.run,
        )
        (computed,) = self.chosen.opened().run(computing.compute, [task], [])
        if computed.record is None:
            raise by_recording.error(computed.exit_code, computed.error)
        self.outcome.add_record(name, "", computed.record)
        result: StoredResult = computed.record["result"]
        if self.request.compare and is_stored and record is not None:
            self.outcome.compare(record, computed.record, name)
            result = record["result"]  # later steps were computed from the stored result
        elif self.request.compare and not counted:
            raise UsageError(
                f"There is no stored result of {name} to compare with. Run the command without "
                f"--recompute-and-compare first."
            )
        self.outcome.ran += computed.is_new and counted
        self.outcome.reused += counted and not computed.is_new
        return result

    def _fit(self) -> dict[str, Content]:
        """Return the files that the stage fitted to the training recordings, or those of ``--codec``.

        Raises `UsageError` if the codec was made by another stage.
        """
        codec, name, fit = self.inputs.named_datasets.get("codec"), self.request.name, self.stage.fit
        if codec is not None:
            chain = codec.manifest.chain
            if not chain or chain[-1]["stage"] != name:
                raise UsageError(f"{codec.directory} was not made by {name}, so it holds no codec of its kind.")
            return dict(codec.manifest.files)
        assert fit is not None
        source = self.inputs.merged
        described = keys.of_dataset(source, fit.reads or (), self.inputs.in_role(source, "train"))
        identity = keys.identity(
            f"{name}.fit", fit.version, self.request.params, {next(iter(fit.arguments)): described}
        )
        return dict(self._run_whole(f"{name}.fit", identity, counted=False)["files"])

    def _remember(self, result_manifest: Manifest) -> None:
        """Store the manifest and, if every recording was valid, the run, so that a rerun is a cache hit."""
        stored = result_manifest.keep(self.store, durable=result_manifest.recorded).to_json()
        if not self.outcome.bad:
            result: StoredResult = {"recordings": {}, "files": {manifest.NAME: stored}}
            made_by = provenance.describe_run(self.outcome.of_results())
            self.store.commit(self.identity, result, made_by, replace=True)
