"""One command tried with every fault at every call of the file system.

    python -m tests.promises.operations_trials FOLDER CASE... [--every 2/7]

prints a JSON line for each case: how many operations failed, and which promises did not hold. It is a process of its
own because it changes what ``open`` and the like are.
"""

import argparse
import contextlib
import io
import json
import os
import shlex
import signal
import sys
import traceback
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tacpipe.cli import main as cli
from tacpipe.engine import execution
from tacpipe.errors import DAMAGED, TacpipeError
from tacpipe.io import hashing
from tacpipe.maintenance import repair
from tacpipe.store import projects
from tacpipe.store.store import Store
from tests.promises.operations import Call, Shim
from tests.promises.operations_cases import CASES, Case
from tests.promises.operations_power import Disk
from tests.promises.operations_replay import Replay
from tests.promises.operations_survey import Aftermath, Killer, Survey
from tests.promises.operations_tree import Place, State

CODES = (0, 1, 2, 3, 4, 5, 6, 130)
LIMIT_S = 600  # Limit of one trial, which takes seconds on a quiet computer: only one that hangs meets it.
DEATHS = 4  # how many kills of each command happen in earnest, about


@dataclass(frozen=True)
class Ran:
    """Exit code and output of a command."""

    code: int
    out: str
    err: str


@dataclass
class CaseResults:
    """Results of all trials of a case."""

    case: str
    calls: int = 0
    failed: int = 0
    states: int = 0
    problems: list[str] = field(default_factory=list)


def main() -> None:
    """Try the cases that are named."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("cases", nargs="+")
    parser.add_argument("--every", default="1", help="K/N: try each Nth call from the Kth; N: from the first")
    options = parser.parse_args()
    os.environ.pop("TACPIPE_STORE", None)
    os.environ["TACPIPE_LOCK_TIMEOUT_S"] = "10"
    # Calls must not depend on which thread is first.
    os.environ |= {"ZARR_ASYNC__CONCURRENCY": "1", "ZARR_THREADING__MAX_WORKERS": "1"}
    hashing.SETTLED_NS = 0  # calls must not depend on what time it is
    projects.new_id = lambda: "ab" * 16  # Identities must not depend on chance.
    os.fsync = os.fdatasync = lambda handle: None  # type: ignore[assignment]  # nobody takes the power away here
    first, _, step = options.every.rpartition("/")
    chosen = range(int(first or 1), sys.maxsize, int(step))
    for name in options.cases:
        lab = options.folder.absolute() / name.replace(" ", "-")
        print(json.dumps(asdict(Trials(CASES[name], lab).run(chosen))), flush=True)


class Trials:
    """The trials of one case, in an empty folder."""

    def __init__(self, case: Case, lab: Path) -> None:
        self.case, self.lab = case, lab
        self.results = CaseResults(case.name)
        self._proven: dict[tuple[str, str], list[str]] = {}
        (lab / ".tacpipe").mkdir(parents=True)
        os.chdir(lab)
        case.sources(lab)
        for command in case.before:
            _succeed(command)
        case.spoil(lab)
        replay = Replay()
        replay.install()
        self.place = Place(lab)
        self.before = self._files_outside_stores(self.place.before)
        _succeed(case.command)
        replay.listening = False
        self.clean_files, self.clean_store = self._files_outside_stores(self.place.look()), self._store_content()

    def run(self, chosen: range) -> CaseResults:
        """Try every fault at the calls of the ``chosen`` numbers, and a loss of power at the end."""
        self.place.restore()
        survey = Survey(Disk.from_state(self.lab, self.place.before), chosen)
        with Shim(self.lab, watch=survey) as shim:
            ran = call(self.case.command)
        assert ran.code == 0, f"{self.case.command}: {ran.err}"
        problems = _differences("the folder", _plain(survey.disk.killed()), _plain(self.place.look()))
        assert not problems, f"a change was not seen: {problems}"
        survey.end()
        self.results.calls = len(shim.calls)
        self._die(survey)
        for remaining in survey.remains:
            self._evaluate(remaining, [])
        for number in range(chosen.start, len(shim.calls) + 1, chosen.step):
            for fault in shim.calls[number - 1].errors:
                self._fail(number, shim.calls[number - 1], fault)
        self.results.states = len(self._proven)
        return self.results

    def _fail(self, number: int, expected: Call, fault: str) -> None:
        """Run the command with one call failing."""
        self.place.restore()
        with Shim(self.lab, at=number, fault=fault) as shim:
            ran = call(self.case.command)
        met = shim.calls[number - 1] if len(shim.calls) >= number else Call("none", "")
        assert met.name == expected.name, f"call {number} is {met} now, and was {expected}"
        description = f"{fault} at call {number}, {met.name} {met.path.removeprefix(f'{self.lab}/')}"
        self._evaluate(Aftermath(self.place.look(), description, "failed" if ran.code else "done"), _wrong(ran))

    def _die(self, survey: Survey) -> None:
        """Kill the command in earnest at some calls, and see that this leaves what the survey says."""
        numbers = sorted(survey.kills)
        for number in numbers[:: max(1, len(numbers) // DEATHS)]:
            self.place.restore()
            child = os.fork()
            if child == 0:
                with Shim(self.lab, watch=Killer(number)):
                    call(self.case.command)
                os._exit(0)
            _, status = os.waitpid(child, 0)
            assert os.WIFSIGNALED(status), f"call {number} was not reached"
            descriptions = [state.described(self.place.before) for state in (self.place.look(), survey.kills[number])]
            assert descriptions[0] == descriptions[1], (
                f"a kill at call {number} leaves something else than the calls before it made"
            )

    def _evaluate(self, remaining: Aftermath, problems: list[str]) -> None:
        self.results.failed += 1
        key = remaining.state.described(self.place.before), remaining.outcome
        if key not in self._proven:
            self._proven[key] = self._disproved(remaining)
        self.results.problems += [f"{remaining.fault}: {problem}" for problem in [*problems, *self._proven[key]]]

    def _disproved(self, remaining: Aftermath) -> list[str]:
        """Return which promises do not hold for what a fault left behind."""
        store, problems = Store(self.lab / ".tacpipe"), []
        files_now = self._files_outside_stores(remaining.state)
        inputs = {path: content for path, content in self.before.items() if not self._ours(path)}
        problems += [f"the input {path} changed" for path, was in inputs.items() if files_now.get(path) != was]
        if not remaining.dark:
            versions = {
                path: (self.before.get(path), self.clean_files.get(path)) for path in files_now if not _draft(path)
            }
            problems += [
                f"{path} is half written" for path, either in versions.items() if files_now[path] not in either
            ]
        if remaining.outcome == "done" or (remaining.outcome == "done, dark" and self.case.durable):
            problems += _differences("what was reported as done", self.clean_files, files_now)
        self.place.restore_state(remaining.state)
        if self.case.sound and (not remaining.dark or (remaining.outcome.startswith("done") and self.case.durable)):
            problems += _unsound("the store", store)
        rerun = call(self.case.command)
        if rerun.code:
            return [*problems, f"the rerun ended with {rerun.code}: {rerun.err[-900:]}"]
        problems += _differences(
            "the output of the rerun", self.clean_files, self._files_outside_stores(self.place.look())
        )
        problems += _unsound("the store after the rerun", store)
        return problems + _differences("the store after the rerun", self.clean_store, self._store_content())

    # ---- what there is to see

    def _ours(self, path: str) -> bool:
        return any(path == output or path.startswith(f"{output}/") for output in self.case.output_paths)

    def _files_outside_stores(self, state: State) -> dict[str, bytes]:
        """Return every file outside of stores by path."""
        stores = (".tacpipe/", "remote/")
        return {path: file.content for path, file in state.files.items() if not path.startswith(stores)}

    def _store_content(self) -> dict[str, Any]:
        """Return all that the stores know, apart from where and when it was made."""
        contents: dict[str, Any] = {}
        for root in (self.lab / ".tacpipe", self.lab / "remote"):
            if not root.exists():
                continue
            store = Store(root)
            contents |= {f"{root.name} object {path.name}": True for path in root.glob("objects/*/*")}
            contents |= {f"{root.name} record {key}": record["result"] for key, record in store.records()}
            contents |= {
                f"{root.name} root {root_entry['path']}": root_entry["manifest"] for root_entry in store.roots.all()
            }
            contents |= {f"{root.name} spool {path.parent.name}": True for path in root.glob("spool/*/header.json")}
            checkpoints = (path.name for path in root.glob("checkpoints/*"))  # gc removes those of keys that are made
            contents |= {f"{root.name} checkpoint {key}": True for key in checkpoints if store.record(key) is None}
        return contents


def call(command: str) -> Ran:
    """Run a command as the program does."""
    hashing._remembered.clear()  # A new process has nothing in memory.
    execution._makers_by_object.clear()
    out, err = io.StringIO(), io.StringIO()
    sys.argv = ["tacpipe", *shlex.split(command)]
    signal.alarm(LIMIT_S)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = cli.answer(sys.argv[1:])
        except BaseException as error:
            ours = [frame for frame in traceback.extract_tb(error.__traceback__) if "/promises/" not in frame.filename]
            places = [f"{Path(frame.filename).name}:{frame.lineno} {frame.name}" for frame in ours]
            print(f"Traceback: {type(error).__name__}: {error}, by {', '.join(places[-4:])}", file=err)
            code = 1
    signal.alarm(0)
    return Ran(code, out.getvalue(), err.getvalue())


def _succeed(command: str) -> None:
    ran = call(command)
    assert ran.code == 0, f"{command}: {ran.err}"


def _wrong(ran: Ran) -> list[str]:
    """Return what is wrong with how a command ended."""
    notes = ("created the store", "; training continues without it.")
    sentences = [
        line
        for line in ran.err.splitlines()
        if line.startswith("tacpipe: ") and not any(note in line for note in notes)
    ]
    if ran.code not in CODES or "Traceback" in ran.err:
        return [f"ended with {ran.code}: {ran.err[-900:]}"]
    if ran.code == DAMAGED and ran.out:
        return []  # the findings of `store verify` and `store repair` are what these commands print
    if ran.code and len(sentences) != 1:
        return [f"ended with {ran.code} and {len(sentences)} sentences: {ran.err[-900:]}"]
    return []


def _unsound(place: str, store: Store) -> list[str]:
    try:
        soundness = repair.verify(store)
    except TacpipeError as error:  # it is a store no more
        return [f"{place} is damaged: {error}"]
    return [] if soundness.clean else [f"{place} is damaged: {soundness.to_text()}"]


def _draft(path: str) -> bool:
    return path.rpartition("/")[2].startswith(".")


def _plain(state: State) -> dict[str, Any]:
    return {**{path: file.content for path, file in state.files.items()}, **dict.fromkeys(state.folders)}


def _differences(place: str, expected: Mapping[str, Any], actual: Mapping[str, Any]) -> list[str]:
    lost = sorted(set(expected) - set(actual))
    unexpected = sorted(set(actual) - set(expected))
    changed = sorted(name for name in set(expected) & set(actual) if expected[name] != actual[name])
    kinds = (("lacks", lost), ("has besides", unexpected), ("has other content in", changed))
    return [f"{place} {problem} {', '.join(names[:3])}" for problem, names in kinds if names]


if __name__ == "__main__":
    main()
