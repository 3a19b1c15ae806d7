"""Stages that work recording by recording: each result from the store, or by running the stage on that recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from tacpipe.datasets import manifest
from tacpipe.datasets.manifest import Entry, Manifest
from tacpipe.engine import execution, keys
from tacpipe.engine.execution import Done, Task
from tacpipe.engine.executors.executor import Chosen
from tacpipe.engine.outcome import Outcome
from tacpipe.engine.request import Request
from tacpipe.errors import FAILED, LOCKED, LockedError, TacpipeError, UsageError, WouldChangeError
from tacpipe.io import progress
from tacpipe.io.hashing import digest
from tacpipe.plugins import registry
from tacpipe.store import records
from tacpipe.store.store import Store


@dataclass(frozen=True)
class ByRecording:
    """What a request wants of results recording by recording; what was done is added to ``outcome``."""

    store: Store
    request: Request
    outcome: Outcome
    chosen: Chosen

    def run(self, name: str, tasks: Sequence[Task], entries: Mapping[str, Entry]) -> dict[str, Entry]:
        """Return what each task of stage ``name`` gives, with the attributes of ``entries`` before its own.

        Raises `TacpipeError` where recordings could not be read, and `WouldChangeError` with ``--check`` where the stage
        would run.
        """
        recordings: dict[str, Entry] = {}
        for recording, result in sorted(self.results(name, tasks).items()):
            made = result["recordings"][""]
            before = entries[recording]["attributes"] if recording in entries else {}
            recordings[recording] = {"attributes": {**before, **made["attributes"]}, "shards": made["shards"]}
        return recordings

    def results(self, name: str, tasks: Sequence[Task]) -> dict[str, Mapping[str, Any]]:
        """Return what the record of each task of stage ``name`` holds as its result, by recording; raises as `run`."""
        results: dict[str, Mapping[str, Any]] = {}
        stored: dict[str, Mapping[str, Any]] = {}  # records
        missing: list[Task] = []
        rerun = self.request.rerun and registry.whole(name) == self.request.name
        for task in tasks:
            record = self.store.record(digest(task.identity))
            if record is not None and not rerun and records.complete(self.store, record):
                stored[task.recording], results[task.recording] = record, record["result"]
                self.outcome.add_record(name, task.recording, record)
            else:
                missing.append(replace(task, replace=record is not None, rerun=rerun, run=self.store.run))
        if missing and self.request.check:
            raise WouldChangeError(f"{registry.whole(name)} would run for {len(missing)} of {len(tasks)} recordings.")
        if self.request.compare:
            missing = [replace(task, dry=True) for task in tasks]
        self.outcome.reused += len(tasks) - len(missing)
        results.update(self._compute(name, missing, stored))
        if not results:
            lines = _lines(self.outcome.bad)
            whole = registry.whole(name)
            raise error(FAILED, f"{whole} could not read any of the {len(tasks)} recordings:\n{lines}")
        return results

    def replay(self, given: Manifest, model: Manifest, beside: tuple[str, ...], where: str) -> Manifest:
        """Return ``given`` after the stages that a model was trained behind, from wherever it is among them now.

        ``beside`` are directories whose shards can be adopted, the model's too; ``where`` names the dataset in errors.
        Raises `UsageError` where it went through other stages, or where a stage has another version now.
        """
        wanted = model.chain
        if list(given.chain) != list(wanted[: len(given.chain)]):
            raise UsageError(
                f"The model was trained behind other stages than {where} went through: "
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
            tasks = keys.shard_tasks(self.store, given, step, beside)
            recordings = self.run(step["stage"], tasks, given.included)
            files = {name: model.files[name] for name in step["fitted"] or {}}
            given = Manifest(
                step["stage"], step["version"], step["params"], {}, [*given.chain, step], recordings, files
            )
        return given

    def _compute(
        self, name: str, tasks: Sequence[Task], stored: Mapping[str, Mapping[str, Any]]
    ) -> dict[str, Mapping[str, Any]]:
        results: dict[str, Mapping[str, Any]] = {}
        if not tasks:
            return results
        bad: dict[str, Done] = {}
        executor = self.chosen.opened()
        module = registry.stages()[registry.whole(name)].partition(":")[0]
        preload = ["tacpipe.io.parquet", "tacpipe.engine.execution", module]
        with progress.bar(registry.whole(name), len(tasks)) as advance:
            for done in executor.run(execution.compute, tasks, preload):
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
            raise error(FAILED, others[0][1])
        if not bad or (self.request.skip_bad and not others):
            return
        waited = [done.error for done in bad.values() if done.exit_code == LOCKED]
        if waited:  # nothing is wrong with the recording, which another process works on
            raise LockedError(waited[0])
        lines = _lines({recording: bad[recording].error for recording in bad})
        plural = "recordings" if len(bad) > 1 else "recording"
        advice = "fix these." if others else "fix these, or leave them out with --skip-bad."
        raise error(
            max(done.exit_code for done in bad.values()),
            f"{registry.whole(name)} could not read {len(bad)} {plural}:\n{lines}\nWhat is good is kept in the store; "
            f"{advice}",
        )


def error(exit_code: int, sentence: str) -> TacpipeError:
    """Return an error with the exit code of what it reports."""
    found = TacpipeError(sentence)
    found.exit_code = exit_code
    return found


def _lines(bad: Mapping[str, str]) -> str:
    return "\n".join(f"  {recording}: {bad[recording]}" for recording in sorted(bad))
