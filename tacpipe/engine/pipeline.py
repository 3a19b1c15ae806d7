"""What a command does: find out what is needed, answer from the store, run the rest, publish the dataset."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tacpipe.datasets import manifest, replacing
from tacpipe.datasets.dataset import Dataset
from tacpipe.datasets.manifest import Entry, Manifest
from tacpipe.engine import execution, executors, keys, output, provenance
from tacpipe.engine import request as request_of
from tacpipe.engine.execution import Done, Task
from tacpipe.engine.outcome import Outcome
from tacpipe.engine.request import Inputs, Request
from tacpipe.errors import FAILED, LOCKED, LockedError, TacpipeError, UsageError, WouldChangeError
from tacpipe.io import progress
from tacpipe.io.hashing import digest
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.plugins.stage import ROLES
from tacpipe.store import records
from tacpipe.store.store import MissingError, Store, locate


def open_dataset(path: Path | str) -> Dataset:
    """Return the dataset at ``path``, its shards read from the store (or adopted from beside the manifest)."""
    found = manifest.find(path)
    sizes = dict(found.manifest.sizes())
    return Dataset(found.manifest, execution.reader(locate(found.directory), (str(found.directory.absolute()),), sizes))


def run(request: Request) -> Outcome:
    """Make the dataset that ``request`` asks for, doing only what was not done before."""
    started = time.perf_counter()
    if request.rerun and (request.check or request.compare):
        raise UsageError("--rerun computes and stores; it does not go with --check or --recompute-and-compare.")
    replacing.refuse_inputs(request)
    store = locate()
    inputs = Inputs(request, store)
    identity = inputs.identity()
    outcome = Outcome(request.output, digest(identity))
    hit = None if request.compare or request.rerun else _answer(store, outcome)
    shown = hit is not None and output.shown(store, request, hit)
    if not shown and not request.compare:
        output.refuse(store, request, inputs.plan())
    if hit is not None and (request.check or shown):
        made, outcome.reused = output.settled(store, request, hit), len(hit.recordings) or 1
    elif request.check or request.compare:
        made = output.settled(store, request, _Run(request, store, inputs, outcome).make())
    else:
        with store.at_work([found.digest for found in inputs.used]):
            made = _make(request, store, inputs, identity, outcome)
    outcome.notes = [*sorted(set(inputs.notes)), *outcome.describe_results()]
    outcome.rows = made.rows
    if request.check:
        output.check(store, request, made)
    outcome.seconds = round(time.perf_counter() - started, 3)
    return outcome


def _make(request: Request, store: Store, inputs: Inputs, identity: Mapping[str, Any], outcome: Outcome) -> Manifest:
    """Return the manifest that the output shows afterwards, answered by the store or made; nothing of it is collected."""
    for first in (True, False):
        made = None if request.rerun and first else _answer(store, outcome)
        if made is None:
            made = _Run(request, store, inputs, outcome).make()
            _remember(store, identity, made, outcome)
        else:
            outcome.reused = len(made.recordings) or 1
        try:
            return output.publish(store, request, made)
        except MissingError:  # damaged in the store, which shows when it is linked: then it is made again
            if not first:
                raise
            outcome.ran = outcome.reused = 0
            outcome.restore({})
    raise AssertionError


def _answer(store: Store, outcome: Outcome) -> Manifest | None:
    """Return the manifest that this run gave before, if everything it names is still there."""
    record = store.record(outcome.key)
    if record is None:
        return None
    name = record["result"]["files"][manifest.NAME]["digest"]
    store.announce([name])
    try:
        content = store.read(name)
    except MissingError:
        return None
    found = manifest.parse(content, "the stored manifest", verified=True)
    store.announce(wanted for _, wanted in found.objects())
    if not all(store.has(name, size) for name, size in found.sizes()):
        return None
    outcome.restore(record["provenance"])
    return found


class _Run:
    """One run that the store could not answer whole."""

    def __init__(self, request: Request, store: Store, inputs: Inputs, outcome: Outcome) -> None:
        self.request, self.store, self.inputs, self.outcome = request, store, inputs, outcome
        self.stage = inputs.stage

    def make(self) -> Manifest:
        """Return the manifest of the result, having run what was missing."""
        for found in self.inputs.used:
            found.manifest  # noqa: B018  (a manifest edited by hand is refused before anything is written)
            if self.store.run:
                self.store.put(found.content)  # explain and gc follow a dataset to the manifests it descends from
        made = self._make()
        try:
            manifest.check(made)
        except (ValueError, TypeError, KeyError) as error:
            raise TacpipeError(f"{self.request.name} gave what no dataset can hold: {error}.") from None
        return made

    def _make(self) -> Manifest:
        request, stage = self.request, self.stage
        made = Manifest(request.name, stage.version, params_of.to_json(request.params), self.inputs.lineage())
        if not stage.mapped:
            identity = keys.identity(request.name, stage, request.params, self._whole_inputs())
            result = self._whole(request.name, identity)
            return replace(made, chain=self._chain(), recordings=result["recordings"], files=result["files"])
        fitted = self._fit() if stage.fit else None
        chain: Sequence[Mapping[str, Any]] = ()
        entries: Mapping[str, Entry] = {}
        if stage.argument("Recording"):
            given = self.inputs.merged
            step = keys.chain_step(request.name, stage, request.params, fitted)
            tasks = keys.shard_tasks(self.store, given, step, self.inputs.beside)
            entries, chain = given.included, [*given.chain, step]
        elif stage.source:
            found, digests = self.inputs.sources, self.inputs.source_digests
            tasks = keys.source_tasks(self.store, request.name, stage, request.params, found, digests)
        else:
            tasks = keys.trial_tasks(self.store, request.name, stage, request.params)
        if not tasks:
            raise UsageError(f"{request.name} found no recording to work on.")
        recordings = self._map(request.name, tasks, entries)
        carried = {name: why for found in self.inputs.datasets for name, why in found.manifest.skipped.items()}
        return replace(
            made,
            chain=chain,
            recordings=recordings,
            files=fitted or {},
            skipped={**carried, **self.outcome.bad},
            sources={name: files for name, files in self.inputs.source_digests.items() if name in recordings},
        )

    def _chain(self) -> Sequence[Mapping[str, Any]]:
        if "model" in self.inputs.named:
            return self.inputs.model.chain
        chains = [found.manifest.chain for found in self.inputs.datasets]
        return chains[0] if chains and all(chain == chains[0] for chain in chains) else ()

    # ---- stages over whole datasets

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
            old = inputs.named.get("extend")
            return request_of.split_digest(old) if old else None
        if name in ROLES:
            chosen = inputs.in_role(inputs.merged, name, may_lack=self.stage.optional(name))
            return keys.of_dataset(inputs.merged, reads, chosen)
        given = self._replay() if "model" in inputs.named else inputs.merged
        if "split" in inputs.named:
            return keys.of_dataset(given, reads, inputs.in_role(given, self.request.role or "test"))
        if self.request.role is not None:
            raise UsageError(f"--role {self.request.role} has no effect without --split.")
        return keys.of_dataset(given, reads, given.included)

    def _whole(self, name: str, identity: Mapping[str, Any], *, counted: bool = True) -> Mapping[str, Any]:
        """Return the result of a key over whole datasets, from the store or by running the stage."""
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
            str(self.store.root),
            name,
            identity,
            beside=self.inputs.beside,
            replace=record is not None,
            dry=self.request.compare,
            rerun=self.request.rerun,
            run=self.store.run,
        )
        done = execution.compute(task)
        if done.record is None:
            raise _error(done.exit_code, done.error)
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
        identity = keys.identity(f"{name}.fit", fit, self.request.params, {next(iter(fit.arguments)): described})
        return dict(self._whole(f"{name}.fit", identity, counted=False)["files"])

    # ---- stages recording by recording

    def _again(self, name: str) -> bool:
        """Return whether results of this stage are to be computed although they are stored."""
        return self.request.rerun and name == self.request.name

    def _map(self, name: str, tasks: Sequence[Task], entries: Mapping[str, Entry]) -> dict[str, Entry]:
        """Return what each task gives, from the store or by running it, with the attributes of ``entries`` before."""
        results: dict[str, Mapping[str, Any]] = {}
        stored: dict[str, Mapping[str, Any]] = {}  # records
        missing: list[Task] = []
        for task in tasks:
            record = self.store.record(digest(task.identity))
            if record is not None and not self._again(name) and records.complete(self.store, record):
                stored[task.recording], results[task.recording] = record, record["result"]
                self.outcome.add_record(name, task.recording, record)
            else:
                rerun = self._again(name)
                missing.append(replace(task, replace=record is not None, rerun=rerun, run=self.store.run))
        if missing and self.request.check:
            raise WouldChangeError(f"{name} would run for {len(missing)} of {len(tasks)} recordings.")
        if self.request.compare:
            missing = [replace(task, dry=True) for task in tasks]
        self.outcome.reused += len(tasks) - len(missing)
        results.update(self._compute(name, missing, stored))
        if not results:
            raise _error(
                FAILED, f"{name} could not read any of the {len(tasks)} recordings:\n{_lines(self.outcome.bad)}"
            )
        recordings: dict[str, Entry] = {}
        for recording, result in sorted(results.items()):
            made = result["recordings"][""]
            before = entries[recording]["attributes"] if recording in entries else {}
            recordings[recording] = {"attributes": {**before, **made["attributes"]}, "shards": made["shards"]}
        return recordings

    def _compute(
        self, name: str, tasks: Sequence[Task], stored: Mapping[str, Mapping[str, Any]]
    ) -> dict[str, Mapping[str, Any]]:
        results: dict[str, Mapping[str, Any]] = {}
        bad: dict[str, Done] = {}
        preload = ["tacpipe.io.parquet", "tacpipe.engine.execution", registry.stages()[name].partition(":")[0]]
        with progress.bar(name, len(tasks)) as advance:
            for done in executors.run(execution.compute, tasks, self.request.jobs, preload):
                advance(note=done.recording)
                if done.record is None:
                    bad[done.recording] = done
                    continue
                self.outcome.ran += done.made
                self.outcome.reused += not done.made
                self.outcome.add_record(name, done.recording, done.record)
                results[done.recording] = done.record["result"]
                if self.request.compare and done.recording in stored:
                    self.outcome.compare(stored[done.recording], done.record, done.recording)
        self._refuse(name, bad)
        return results

    def _refuse(self, name: str, bad: Mapping[str, Done]) -> None:
        source = f"{self.request.source}/"  # where the files lay is no part of a manifest
        self.outcome.bad.update({name: bad[name].error.replace(source, "") for name in sorted(bad)})
        others = sorted({(-done.exit_code, done.error) for done in bad.values() if not done.at_fault})
        if others and all(code == -FAILED for code, _ in others):  # the disk fails all alike: once is enough
            raise _error(FAILED, others[0][1])
        if not bad or (self.request.skip_bad and not others):
            return
        waited = [done.error for done in bad.values() if done.exit_code == LOCKED]
        if waited:  # nothing is wrong with the recording, which another process works on
            raise LockedError(waited[0])
        lines = _lines({recording: bad[recording].error for recording in bad})
        plural = "recordings" if len(bad) > 1 else "recording"
        advice = "mend these." if others else "mend these, or leave them out with --skip-bad."
        raise _error(
            max(done.exit_code for done in bad.values()),
            f"{name} could not read {len(bad)} {plural}:\n{lines}\nWhat is good is kept in the store; {advice}",
        )

    # ---- models: the chain that they carry

    def _replay(self) -> Manifest:
        """Return the given dataset after the stages that the model was trained behind, from wherever it stands now."""
        given, wanted = self.inputs.merged, self.inputs.model.chain
        if list(given.chain) != list(wanted[: len(given.chain)]):
            raise UsageError(
                f"The model was trained behind other stages than {self.request.datasets[0]} went through: "
                f"{manifest.chain_difference(wanted, given.chain)}. Give the recordings themselves: the model's own "
                f"stages are then run on them."
            )
        for step in wanted[len(given.chain) :]:
            stage = registry.load(step["stage"])
            if stage.version != step["version"]:
                raise UsageError(
                    f"The model was trained behind version {step['version']} of {step['stage']}; this tacpipe has version "
                    f"{stage.version}. Train it again."
                )
            tasks = keys.shard_tasks(self.store, given, step, self.inputs.beside)
            recordings = self._map(step["stage"], tasks, given.included)
            files = {name: self.inputs.model.files[name] for name in step["fitted"] or {}}
            given = Manifest(
                step["stage"], step["version"], step["params"], {}, [*given.chain, step], recordings, files
            )
        return given


def _lines(bad: Mapping[str, str]) -> str:
    return "\n".join(f"  {recording}: {bad[recording]}" for recording in sorted(bad))


def _error(exit_code: int, sentence: str) -> TacpipeError:
    error = TacpipeError(sentence)
    error.exit_code = exit_code
    return error


def _remember(store: Store, identity: Mapping[str, Any], made: Manifest, outcome: Outcome) -> None:
    """Store the manifest, and the run if every recording was good: then a rerun is answered at once."""
    stored = vars(store.put(made.content, durable=made.recorded))
    if not outcome.bad:
        result = {"recordings": {}, "files": {manifest.NAME: stored}}
        store.commit(identity, result, {**provenance.of(0.0), **outcome.of_results()}, replace=True)
