"""What a command does: find out what is needed, answer from the store, run the rest, publish the dataset."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from tacpipe.datasets import manifest, replacing, roles
from tacpipe.datasets.dataset import Dataset
from tacpipe.datasets.manifest import Entry, Manifest
from tacpipe.datasets.paths import shard_path
from tacpipe.engine import by_recording, computing, execution, keys, output, provenance
from tacpipe.engine.by_recording import ByRecording
from tacpipe.engine.executors.executor import Chosen
from tacpipe.engine.outcome import Outcome
from tacpipe.engine.output import Unread
from tacpipe.engine.previous import Previous
from tacpipe.engine.request import Inputs, Request
from tacpipe.engine.task import Task
from tacpipe.errors import TacpipeError, UsageError, WouldChangeError
from tacpipe.io import progress
from tacpipe.io.hashing import digest
from tacpipe.plugins import given_params, registry
from tacpipe.plugins import params as params_of
from tacpipe.plugins.stage import ORIGINALS, ROLES
from tacpipe.store import records
from tacpipe.store.location import locate
from tacpipe.store.store import MissingError, Store
from tacpipe.trackers import tracker, tracking
from tacpipe.trackers.tracker import Tracker
from tacpipe.training import following

_NOTHING: Entry = {"attributes": {}, "shards": {}}  # of a part that gives files alone


def open_dataset(path: Path | str) -> Dataset:
    """Return the dataset at ``path``, its shards read from the store (or adopted from beside the manifest)."""
    found = manifest.find(path)
    directory = found.directory.absolute()
    read = execution.reader(locate(directory), (str(directory),), found.manifest)
    return Dataset(found.manifest, read, directory=directory, opener=open_dataset)


def run(request: Request) -> Outcome:
    """Make the dataset that ``request`` asks for, doing only what was not done before."""
    started = time.perf_counter()
    if request.rerun and (request.check or request.compare):
        raise UsageError("--rerun computes and stores; it does not go with --check or --recompute-and-compare.")
    if request.track and (request.check or request.compare):
        raise UsageError("--track follows what is stored; it does not go with --check or --recompute-and-compare.")
    trackers = tracking.open_trackers(request.track) if request.track else {}
    replacing.refuse_inputs(request.output, request.reads)
    store = locate(*request.locations)
    inputs = Inputs(request, store)
    with Chosen(request.executor, request.jobs) as chosen:
        work = _Run(request, store, inputs, inputs.identity(), chosen)
        outcome = work.outcome
        with _tracked(request, trackers, outcome, store) as ended:
            made = output.settle(store, request, inputs.plan(), work)
            if isinstance(made, Manifest):  # else there was nothing to track
                ended(made)
    return _concluded(outcome, inputs, made, started)


def answered(request: Request) -> Outcome | None:
    """Return what `run` would return where there is nothing to do; None where something is to be computed or written.

    It raises what `run` would raise before that. Nothing is computed, and nothing is changed.
    """
    started = time.perf_counter()
    if request.check or request.compare or request.rerun or request.track:  # each has a business of its own
        return None
    replacing.refuse_inputs(request.output, request.reads)
    store = locate(*request.locations)
    inputs = Inputs(request, store)
    with Chosen(request.executor, request.jobs) as chosen:
        work = _Run(request, store, inputs, inputs.identity(), chosen)
        shown = output.shown(store, request, work)
    return None if shown is None else _concluded(work.outcome, inputs, shown, started)


def _concluded(outcome: Outcome, inputs: Inputs, made: Manifest | Unread, started: float) -> Outcome:
    outcome.notes = [*sorted(set(inputs.notes)), *inputs.describe_unread(), *outcome.describe_results(), *outcome.notes]
    outcome.rows = made.rows
    outcome.seconds = round(time.perf_counter() - started, 3)
    return outcome


@contextmanager
def _tracked(
    request: Request, trackers: dict[str, Tracker], outcome: Outcome, store: Store
) -> Iterator[Callable[[Manifest], None]]:
    """Have what is trained in the block followed by trackers; yield what ends their run with the manifest that was made."""
    if not trackers:
        yield lambda made: None
        return
    params = {**params_of.to_json(request.params), "stage": request.name, "fold": request.fold}
    tracked = tracking.Tracking(trackers, tracking.name_of(request.output, outcome.key), tracker.params(params))

    def end(made: Manifest) -> None:
        tracked.finish(request.output, tracking.files(made, store))
        outcome.notes += tracked.failures if progress.is_quiet() else []

    try:
        with following.tracked([tracked]):
            yield end
    except BaseException:
        tracked.abandon()
        raise


class _Run:
    """What a request asks for, of the store or by running what is missing there."""

    def __init__(
        self, request: Request, store: Store, inputs: Inputs, identity: Mapping[str, Any], chosen: Chosen
    ) -> None:
        self.request, self.store, self.inputs, self.identity, self.chosen = request, store, inputs, identity, chosen
        self.stage = inputs.stage
        self.outcome = Outcome(request.output, digest(identity))
        self.reads = [found.digest for found in inputs.used]
        self.previous: Previous | None = None  # of which results are taken over

    @property
    def key(self) -> str:
        """What names the run."""
        return self.outcome.key

    def count(self, made: Manifest) -> int:
        """Return how many results of the store the answer consists of, which gave this manifest."""
        return len(self.inputs.merged.included) if self.stage.part else len(made.recordings) or 1

    def recall(self, manifest_digest: str, reused: int) -> bool:
        """Take over what is known of the run before; return whether it gave the manifest of this digest."""
        record = self.store.record(self.key)
        if record is None or record["result"]["files"][manifest.NAME]["digest"] != manifest_digest:
            return False
        self.outcome.begin()
        self.outcome.restore(record["provenance"])
        self.outcome.reused = reused
        return True

    def answer(self) -> Manifest | None:
        """Return the manifest that this run gave before, if everything it names is still there."""
        self.outcome.begin()
        record = self.store.record(self.outcome.key)
        if record is None:
            return None
        name = record["result"]["files"][manifest.NAME]["digest"]
        self.store.announce([name])
        try:
            found = manifest.stored(self.store, name, "the stored manifest")
            self.store.announce(page.digest for page in (found.pages.pages if found.pages is not None else ()))
            sizes = list(found.sizes())
        except MissingError:  # the manifest, or a page of it
            return None
        self.store.announce(name for name, _ in sizes)
        if not all(self.store.has(name, size) for name, size in sizes):
            return None
        self.outcome.restore(record["provenance"])
        self.outcome.reused = self.count(found)
        return found

    def result(self, *, rerun: bool, previous: Previous | None = None) -> Manifest:
        """Return the manifest as the store answers it, or made and then remembered; ``rerun``: made in any case.

        Of a ``previous`` run what did not change is taken over.
        """
        made = None if rerun else self.answer()
        self.previous = previous if self.stage.mapped and self.stage.argument("Recording") else None
        if made is None:
            self.outcome.begin()
            made = self.make()
            self._remember(made)
        return made

    def make(self) -> Manifest:
        """Return the manifest of the result, having run what was missing."""
        for found in self.inputs.used:
            given = found.manifest  # one edited by hand is refused before anything is written
            if self.store.run:
                given.keep(self.store)  # explain and gc follow a dataset to the manifests it descends from
        made = self._make()
        try:
            manifest.check_pages(made, fresh=True)
        except (ValueError, TypeError, KeyError) as error:
            raise TacpipeError(f"{self.request.name} gave what no dataset can hold: {error}.") from None
        return made

    def _make(self) -> Manifest:
        request, stage = self.request, self.stage
        made = Manifest(request.name, stage.version, params_of.to_json(request.params), self.inputs.lineage())
        if not stage.mapped:
            identity = keys.identity(request.name, stage.version, request.params, self._whole_inputs())
            if stage.part is not None:
                files = {**self._whole(request.name, identity, counted=False)["files"], **self._parts.files}
                return replace(made, files={**files, **self._originals()}, skipped=self._skipped)
            result = self._whole(request.name, identity)
            return replace(made, chain=self._chain(), recordings=result["recordings"], files=result["files"])
        fitted = self._fit() if stage.fit else None
        chain: Sequence[Mapping[str, Any]] = ()
        recordings: Mapping[str, Entry] = {}
        if stage.argument("Recording"):
            given = self.inputs.merged
            step = keys.chain_step(request.name, stage, request.params, fitted)
            recordings = self._by_recording.mapped(given, step, self.inputs.beside)
            chain = [*given.chain, step]
        elif tasks := self._own_tasks():
            recordings = self._by_recording.run(request.name, tasks)
        if not recordings and not self.outcome.bad:
            raise UsageError(f"{request.name} found no recording to work on.")
        return replace(
            made,
            chain=chain,
            recordings=recordings,
            files=fitted or {},
            skipped=self._skipped,
            sources={name: files for name, files in self.inputs.source_digests.items() if name in recordings},
        )

    def _own_tasks(self) -> list[Task]:
        """Return one task a recording of a stage that reads no dataset: of a source, or to simulate."""
        request, stage = self.request, self.stage
        if stage.source:
            found, digests = self.inputs.sources, self.inputs.source_digests
            return keys.source_tasks(self.store, request.name, stage, request.params, found, digests)
        return keys.trial_tasks(self.store, request.name, stage, request.params)

    @property
    def _skipped(self) -> dict[str, str]:
        carried = {name: why for found in self.inputs.datasets for name, why in found.manifest.skipped.items()}
        return {**carried, **self.outcome.bad}

    @property
    def _by_recording(self) -> ByRecording:
        return ByRecording(self.store, self.request, self.outcome, self.chosen, self.previous)

    def _chain(self) -> Sequence[Mapping[str, Any]]:
        if "model" in self.inputs.named:
            return self.inputs.model.chain
        chains = [found.manifest.chain for found in self.inputs.datasets]
        return chains[0] if chains and all(chain == chains[0] for chain in chains) else ()

    # ---- stages over whole datasets

    @cached_property
    def _given(self) -> Manifest:
        """The given datasets read as one, after the stages that the recordings go through first."""
        given, first = self.inputs.merged, self.stage.first
        wanted = first(self.request.params) if first is not None else {}
        if not wanted:
            return given
        chain = list(given.chain)
        for name, options in wanted.items():
            stage = registry.load(name)
            chain.append(keys.chain_step(name, stage, given_params.build(name, stage, options=options), None))
        behind = Manifest(self.request.name, self.stage.version, chain=chain)
        return self._by_recording.replay(given, behind, self.inputs.beside, str(self.request.datasets[0]))

    @cached_property
    def _parts(self) -> Manifest:
        """What the stage's part gave for each recording: tables, and files by their names in the result."""
        given, name = self._given, f"{self.request.name}{registry.PART}"
        assert self.stage.part is not None
        step = keys.chain_step(name, self.stage.part, self.request.params, None)
        tasks = keys.shard_tasks(self.store, given, step, self.inputs.beside)
        if not tasks:
            raise UsageError(f"{self.request.name} found no recording to work on.")
        results = self._by_recording.results(name, tasks)
        recordings = {recording: result["recordings"].get("", _NOTHING) for recording, result in results.items()}
        files = {file: stored for result in results.values() for file, stored in result["files"].items()}
        return Manifest(name, self.stage.part.version, step["params"], recordings=recordings, files=files)

    def _originals(self) -> dict[str, Any]:
        """Return the shards that were given as files of the result, where the stage asks for them; they are in the store."""
        folder = self.stage.originals(self.request.params) if self.stage.originals is not None else ""
        if not folder:
            return {}
        given, found = self.inputs.merged, {}
        read = execution.reader(self.store, self.inputs.beside, dict(given.sizes()))
        for recording, entry in given.included.items():
            for stream, shard in entry["shards"].items():
                path = shard_path(recording, stream)
                if not self.store.has(shard["digest"], shard["bytes"]):
                    read(shard["digest"], path)  # adopts it, or computes it again
                found[f"{folder}/{path}"] = {"digest": shard["digest"], "bytes": shard["bytes"]}
        return found

    def _whole_inputs(self) -> dict[str, Any]:
        return {
            name: self._whole_input(name, kind) for name, kind in self.stage.arguments.items() if kind != "Workspace"
        }

    def _whole_input(self, name: str, kind: str) -> Any:
        inputs, reads = self.inputs, self.stage.reads
        if kind == "Model" and name == "init":
            init = inputs.named.get("init")
            return keys.of_dataset(init.manifest, None, {}) if init else None
        if kind == "Model":
            return keys.of_dataset(inputs.model, None, {})
        if kind == "Datasets":
            return [keys.of_dataset(found.manifest, reads, found.manifest.included) for found in inputs.datasets]
        if kind == "Roles":
            return self._roles(name)
        if kind == "Parts":
            return keys.of_dataset(self._parts, None, self._parts.recordings)
        if self.stage.part is not None:
            given = self.inputs.merged if name == ORIGINALS else self._given
            chosen = {one: entry for one, entry in given.included.items() if one in self._parts.recordings}
            return keys.of_dataset(given, reads, chosen)
        given = inputs.merged
        as_given = self.stage.as_given
        if "model" in inputs.named and not (as_given is not None and as_given(self.request.params)):
            where = str(self.request.datasets[0])
            given = self._by_recording.replay(given, inputs.model, inputs.beside, where)
        if name in ROLES:
            return keys.of_dataset(given, reads, inputs.in_role(given, name, may_lack=self.stage.optional(name)))
        if "split" in inputs.named:
            return keys.of_dataset(given, reads, inputs.in_role(given, self.request.role or "test"))
        if self.request.role is not None:
            raise UsageError(f"--role {self.request.role} has no effect without --split.")
        return keys.of_dataset(given, reads, given.included)

    def _roles(self, name: str) -> Any:
        """Return what identifies the roles of the argument ``name``, None where its option was not given."""
        dataset = self.inputs.named.get(name)
        fold = self.request.fold
        if dataset is None:
            if name == "split" and fold:
                raise UsageError(f"--fold {fold} has no effect without --split.")
            return None
        table = roles.digest(dataset.manifest, str(dataset.directory))
        if name != "split":
            return table
        if not self.inputs.roles.keys() & self.inputs.merged.included.keys():
            raise UsageError(f"No recording of the dataset has a role in {dataset.directory}. Split this dataset.")
        return {"roles": table, "fold": fold}

    def _whole(self, name: str, identity: Mapping[str, Any], *, counted: bool = True) -> Mapping[str, Any]:
        """Return the result of a key over whole datasets, from the store or by running the stage."""
        self.store.expect([digest(identity)])
        record = self.store.record(digest(identity))
        known = record is not None and records.complete(self.store, record)
        if record is not None and known and not self.request.compare and not self.request.rerun:
            self.outcome.reused += counted
            self.outcome.add_record(name, "", record)
            result: Mapping[str, Any] = record["result"]
            return result
        if self.request.check:
            raise WouldChangeError(f"{name} would run: there is no result for these inputs and params.")
        task = Task(
            self.store.place,
            name,
            identity,
            beside=self.inputs.beside,
            replace=record is not None,
            dry=self.request.compare,
            rerun=self.request.rerun,
            device=self.request.device,
            run=self.store.run,
        )
        (done,) = self.chosen.opened().run(computing.compute, [task], [])
        if done.record is None:
            raise by_recording.error(done.exit_code, done.error)
        self.outcome.add_record(name, "", done.record)
        made: Mapping[str, Any] = done.record["result"]
        if self.request.compare and known and record is not None:
            self.outcome.compare(record, done.record, name)
            made = record["result"]  # what else was made rests on what is stored
        elif self.request.compare and not counted:
            raise UsageError(f"Nothing is stored of {name} to compare with. Run the command without it first.")
        self.outcome.ran += done.made and counted
        self.outcome.reused += counted and not done.made
        return made

    def _fit(self) -> dict[str, Any]:
        """Return the files that the stage's fit made of the training recordings, or those of ``--codec``."""
        codec, name, fit = self.inputs.named.get("codec"), self.request.name, self.stage.fit
        if codec is not None:
            step = codec.manifest.chain[-1] if codec.manifest.chain else {}
            if step.get("stage") != name:
                raise UsageError(f"{codec.directory} was not made by {name}, so it holds no codec of its kind.")
            return dict(codec.manifest.files)
        assert fit is not None
        given = self.inputs.merged
        described = keys.of_dataset(given, fit.reads or (), self.inputs.in_role(given, "train"))
        identity = keys.identity(
            f"{name}.fit", fit.version, self.request.params, {next(iter(fit.arguments)): described}
        )
        return dict(self._whole(f"{name}.fit", identity, counted=False)["files"])

    def _remember(self, made: Manifest) -> None:
        """Store the manifest, and the run if every recording was good: then a rerun is answered at once."""
        stored = vars(made.keep(self.store, durable=made.recorded))
        if not self.outcome.bad:
            result = {"recordings": {}, "files": {manifest.NAME: stored}}
            made_by = {**provenance.of(0.0), **self.outcome.of_results()}
            self.store.commit(self.identity, result, made_by, replace=True)
