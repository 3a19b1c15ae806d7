"""Stages that work recording by recording: each result from the store, or by running the stage on that recording."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from tacpipe.datasets import merging, pages
from tacpipe.datasets.manifest import Entry, Manifest
from tacpipe.datasets.pages import Item
from tacpipe.engine import computing, execution, keys, provenance
from tacpipe.engine.executors.executor import Chosen
from tacpipe.engine.outcome import Outcome
from tacpipe.engine.previous import Previous
from tacpipe.engine.request import Request
from tacpipe.engine.task import Done, Task
from tacpipe.errors import FAILED, LOCKED, LockedError, TacpipeError, UsageError, WouldChangeError
from tacpipe.io import progress
from tacpipe.io.hashing import digest
from tacpipe.plugins import registry
from tacpipe.store import records
from tacpipe.store.store import Store

Answer = Mapping[str, Entry] | pages.Pages  # results of a group of recordings


@dataclass(frozen=True)
class _Asked:
    """A group of recordings: what its key is the digest of, and the recordings."""

    identity: Mapping[str, Any]
    entries: Mapping[str, Entry]


@dataclass(frozen=True)
class ByRecording:
    """What a request wants of results recording by recording; what was done is added to ``outcome``."""

    store: Store
    request: Request
    outcome: Outcome
    chosen: Chosen
    previous: Previous | None = None  # of which results are taken over

    def mapped(self, given: Manifest, step: Mapping[str, Any], beside: tuple[str, ...]) -> Mapping[str, Entry]:
        """Return what the map stage of a link of a chain gives for each recording of ``given``; raises as `run`.

        A group of recordings has a record of its own, besides those of its recordings. So a dataset of which one recording
        changed takes one record a group, and one for each recording of the group that changed. What is answered is kept in
        pages where recordings are many.
        """
        entries, name, stage = given.included, step["stage"], execution.stage_of(step["stage"])
        answered: list[Answer | _Asked] = []
        missing: list[Task] = []
        stored: dict[str, Mapping[str, Any]] = {}  # of groups of which something is missing
        taken = None if self.previous is None else self.previous.taken(entries, step)
        known: Mapping[str, pages.Pages] = {}
        if taken is not None:
            known = taken.pages
            self.outcome.reused += taken.count
            self.outcome.add_group(taken.stated)
        else:
            self.store.expect(digest(keys.of_group(step, stage, group.entries())) for group in pages.groups(entries))
        many = len(entries) > pages.INLINE

        def answer(made: Mapping[str, Entry]) -> Answer:
            return pages.Pages.from_items((one, Item(entry)) for one, entry in made.items()) if many else made

        for group in pages.groups(entries):
            if group.page in known:
                answered.append(known[group.page])
                continue
            some = group.entries()
            asked = _Asked(keys.of_group(step, stage, some), some)
            made = None if self.request.compare or self._reruns(name) else self._of_group(asked)
            if made is None:
                tasks = keys.shard_tasks(self.store, replace(given, recordings=some), step, beside)
                found, lacking = self._stored(name, tasks)
                if lacking:
                    stored |= found
                    missing += lacking
                    answered.append(asked)
                    continue
                made = self._remember_group(name, asked, found)
            answered.append(answer(_after(made, some)))
        computed = self._computed(name, missing, stored, len(entries))

        def parts() -> Iterator[Answer]:
            for one in answered:
                if not isinstance(one, _Asked):
                    yield one
                    continue
                records_of = {recording: computed[recording] for recording in one.entries if recording in computed}
                made = self._remember_group(name, one, records_of)
                yield answer(_after(made, one.entries))

        if many:
            return pages.Recordings(pages.Pages.joined(part for part in parts() if isinstance(part, pages.Pages)))
        return {one: entry for part in parts() if isinstance(part, Mapping) for one, entry in part.items()}

    def _of_group(self, asked: _Asked) -> Mapping[str, Entry] | None:
        """Return what the record of a group holds, None where there is none or an object is gone."""
        record = self.store.record(digest(asked.identity))
        if record is None or not records.complete(self.store, record):
            return None
        self.outcome.reused += len(asked.entries)
        self.outcome.add_group(record["provenance"])
        made: Mapping[str, Entry] = record["result"]["recordings"]
        return made

    def run(self, name: str, tasks: Sequence[Task]) -> dict[str, Entry]:
        """Return what each task of stage ``name`` gives.

        Raises `TacpipeError` where recordings could not be read, and `WouldChangeError` with ``--check`` where the stage
        would run.
        """
        return _after({one: result["recordings"][""] for one, result in self.results(name, tasks).items()}, {})

    def results(self, name: str, tasks: Sequence[Task]) -> dict[str, Mapping[str, Any]]:
        """Return what the record of each task of stage ``name`` holds as its result, by recording; raises as `run`."""
        return {recording: record["result"] for recording, record in self._records(name, tasks).items()}

    def _reruns(self, name: str) -> bool:
        return self.request.rerun and registry.whole(name) == self.request.name

    def _records(self, name: str, tasks: Sequence[Task]) -> dict[str, Mapping[str, Any]]:
        """Return the record of each task, by recording."""
        stored, missing = self._stored(name, tasks)
        return self._computed(name, missing, stored, len(tasks))

    def _stored(self, name: str, tasks: Sequence[Task]) -> tuple[dict[str, Mapping[str, Any]], list[Task]]:
        """Return the records that the store has, by recording, and the tasks that are to be computed."""
        found: dict[str, Mapping[str, Any]] = {}
        missing: list[Task] = []
        rerun = self._reruns(name)
        self.store.expect(digest(task.identity) for task in tasks)
        for task in tasks:
            record = self.store.record(digest(task.identity))
            if record is not None and not rerun and records.complete(self.store, record):
                found[task.recording] = record
                self.outcome.add_record(name, task.recording, record)
            else:
                missing.append(replace(task, replace=record is not None, rerun=rerun, run=self.store.run))
        if self.request.compare:
            missing = [replace(task, dry=True) for task in tasks]
        self.outcome.reused += len(tasks) - len(missing)
        return found, missing

    def _computed(
        self, name: str, missing: Sequence[Task], stored: Mapping[str, Mapping[str, Any]], count: int
    ) -> dict[str, Mapping[str, Any]]:
        """Return the records that are ``stored`` and those of the tasks that are ``missing``, of ``count`` in all."""
        if missing and self.request.check:
            raise WouldChangeError(f"{registry.whole(name)} would run for {len(missing)} of {count} recordings.")
        found = {**stored, **self._compute(name, missing, stored)}
        if missing and not found and len(missing) == count:
            lines = _lines(self.outcome.bad)
            raise error(FAILED, f"{registry.whole(name)} could not read any of the {count} recordings:\n{lines}")
        return found

    def _remember_group(self, name: str, asked: _Asked, made: Mapping[str, Mapping[str, Any]]) -> dict[str, Entry]:
        """Return what the records of a group's recordings hold, and store it under the key of the group if all are there."""
        result = {one: record["result"]["recordings"][""] for one, record in made.items()}
        if self.store.run and len(asked.entries) > 1 and len(made) == len(asked.entries):
            stated = Outcome(self.outcome.output)
            for recording, record in made.items():
                stated.add_record(name, recording, record)
            made_by = {**provenance.of(0.0), **stated.of_results()}
            self.store.commit(asked.identity, {"recordings": result, "files": {}}, made_by, replace=True)
        return result

    def replay(self, given: Manifest, model: Manifest, beside: tuple[str, ...], where: str) -> Manifest:
        """Return ``given`` after the stages that a model was trained behind, from wherever it is among them now.

        ``beside`` are directories whose shards can be adopted, the model's too; ``where`` names the dataset in errors.
        Raises `UsageError` where it went through other stages, or where a stage has another version now.
        """
        wanted = model.chain
        if list(given.chain) != list(wanted[: len(given.chain)]):
            raise UsageError(
                f"The model was trained behind other stages than {where} went through: "
                f"{merging.chain_difference(wanted, given.chain)}. Give the recordings themselves: the model's own "
                f"stages are then run on them."
            )
        for step in wanted[len(given.chain) :]:
            stage = registry.load(step["stage"])
            if stage.version != step["version"]:
                raise UsageError(
                    f"The model was trained behind version {step['version']} of {step['stage']}; this tacpipe has version "
                    f"{stage.version}. Train it again."
                )
            recordings = self.mapped(given, step, beside)
            files = {name: model.files[name] for name in step["fitted"] or {}}
            given = Manifest(
                step["stage"], step["version"], step["params"], {}, [*given.chain, step], recordings, files
            )
        return given

    def _compute(
        self, name: str, tasks: Sequence[Task], stored: Mapping[str, Mapping[str, Any]]
    ) -> dict[str, Mapping[str, Any]]:
        """Return the records of tasks that are computed, and compare them with those that are ``stored``."""
        found: dict[str, Mapping[str, Any]] = {}
        if not tasks:
            return found
        bad: dict[str, Done] = {}
        executor = self.chosen.opened()
        module = registry.stages()[registry.whole(name)].partition(":")[0]
        preload = ["tacpipe.io.parquet", "tacpipe.engine.computing", module]
        with progress.bar(registry.whole(name), len(tasks)) as advance:
            for done in executor.run(computing.compute, tasks, preload):
                advance(note=done.recording)
                if done.record is None:
                    bad[done.recording] = done
                    continue
                self.outcome.ran += done.made
                self.outcome.reused += not done.made
                self.outcome.add_record(name, done.recording, done.record)
                made_by = done.record["provenance"]
                found[done.recording] = {  # what is needed of it: of a million there is no room for more
                    "result": done.record["result"],
                    "provenance": {name: made_by[name] for name in ("notes", "code", "packages") if name in made_by},
                }
                if self.request.compare and done.recording in stored:
                    self.outcome.compare(stored[done.recording], done.record, done.recording)
        self._refuse(name, bad)
        return found

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


def _after(made: Mapping[str, Entry], entries: Mapping[str, Entry]) -> dict[str, Entry]:
    """Return what a stage made of recordings, with the attributes of ``entries`` before its own, in the order of names."""
    return {
        name: {
            "attributes": {**entries[name]["attributes"], **one["attributes"]}
            if name in entries
            else one["attributes"],
            "shards": one["shards"],
        }
        for name, one in sorted(made.items())
    }


def error(exit_code: int, sentence: str) -> TacpipeError:
    """Return an error with the exit code of what it reports."""
    found = TacpipeError(sentence)
    found.exit_code = exit_code
    return found


def _lines(bad: Mapping[str, str]) -> str:
    return "\n".join(f"  {recording}: {bad[recording]}" for recording in sorted(bad))
