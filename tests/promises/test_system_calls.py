"""Let system calls fail: a command ends with a sentence, nothing is damaged, and a rerun gives the same bytes."""

import shlex
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tacpipe import errors
from tests.conftest import Lab, make_once
from tests.promises import specimen, tracing
from tests.promises.counts import count

pytestmark = [
    pytest.mark.faults,
    pytest.mark.skipif(bool(tracing.lacking()), reason=f"faults of system calls need strace: {tracing.lacking()}"),
]
ENDS = (errors.FAILED, errors.USAGE, errors.DAMAGED, errors.LOCKED)


def leave_as_is(lab: Lab) -> None:
    """Take the project as it is."""


def empty_stores(lab: Lab) -> None:
    """Leave what was recorded, and nothing of tacpipe's."""
    shutil.rmtree(lab.folder / ".tacpipe")
    (lab.folder / ".tacpipe").mkdir()
    shutil.rmtree(lab.folder / "data")


def leave_unneeded_dataset(lab: Lab) -> None:
    """Leave a dataset that nobody needs."""
    shutil.rmtree(lab.folder / "data/total")
    specimen.age(lab.folder / ".tacpipe")


def push_manifests(lab: Lab) -> None:
    """Leave manifests alone, whose objects lie in another store."""
    lab.run("store push remote data/recordings")
    shutil.rmtree(lab.folder / ".tacpipe")
    (lab.folder / ".tacpipe").mkdir()  # the project's mark
    for path in specimen.beneath(lab.folder / "data"):
        if path.parts[-2] != "recordings" or path.name != "manifest.json":
            path.unlink()


@dataclass(frozen=True)
class Case:
    """A command, and what comes before it."""

    command: str
    before: Callable[[Lab], None] = leave_as_is


CASES = {
    "ingest": Case("ingest numbers src -o data/recordings --jobs 1", empty_stores),
    "a stage": Case("scale data/recordings -o data/tripled --factor 3 --jobs 1"),
    "label": Case("label data/recordings b --label material=cork"),
    "push": Case("store push remote data/recordings data/scaled"),
    "pull": Case("store pull remote data/recordings", push_manifests),
    "gc": Case("store gc --grace-days 0", leave_unneeded_dataset),
}


@dataclass(frozen=True)
class Clean:
    """Project of a case before its command, and what the command does where nothing fails."""

    before: Path
    written_files: dict[str, bytes]  # the files of datasets, and the objects of a store that was pushed to
    calls: list[tracing.Call]


def read_written_files(folder: Path) -> dict[str, bytes]:
    """Return all that a command should have written, whatever its store's records say of the way there."""
    written = specimen.files(folder / "data")
    remote = specimen.files(folder / "remote/objects") if (folder / "remote").exists() else {}
    return {**written, **{f"remote/{name}": content for name, content in remote.items()}}


@pytest.fixture
def clean(request: pytest.FixtureRequest, original: Path, lab: Lab, tmp_path_factory: pytest.TempPathFactory) -> Clean:
    """Run the case that a test names where nothing fails."""
    name: str = request.param
    case = CASES[name]

    def make(folder: Path) -> None:
        restore(lab, original)
        case.before(lab)
        specimen.clone(lab.folder, folder)

    before = make_once(tmp_path_factory, f"system-calls-{name.replace(' ', '-')}", make)
    restore(lab, before)
    ran = tracing.run(lab.folder, shlex.split(case.command), tmp_path_factory.mktemp("trace") / "log")
    assert ran.code == 0, ran.err
    return Clean(before, read_written_files(lab.folder), ran.calls)


def restore(lab: Lab, source: Path) -> None:
    """Put a kept project in place of what is there."""
    for path in lab.folder.iterdir():
        shutil.rmtree(path)
    specimen.clone(source, lab.folder)


def struck(calls: list[tracing.Call], name: str) -> Iterator[tuple[tracing.Call, str, bool]]:
    """Yield the calls of a name that are to fail, how, and whether for good: the first, one in the middle and the last."""
    ours = [call for call in calls if call.name == name]
    places = sorted({0, len(ours) // 2, len(ours) - 1}) if ours else []
    for fault in tracing.FAULTS[name]:
        yield from ((ours[place], fault, False) for place in places)
        if ours and name in tracing.LASTING and fault.startswith("E"):
            yield ours[0], fault, True


@pytest.mark.parametrize("name", tracing.FAULTS)
@pytest.mark.parametrize(("clean", "case"), [(name, CASES[name]) for name in CASES], indirect=["clean"], ids=CASES)
def test_whatever_a_system_call_answers_nothing_is_wrong_and_a_rerun_gives_the_same_bytes(
    clean: Clean, case: Case, name: str, lab: Lab, tmp_path_factory: pytest.TempPathFactory
) -> None:
    log = tmp_path_factory.mktemp("trace") / "log"
    for call, fault, lasting in struck(clean.calls, name):
        restore(lab, clean.before)
        expression = tracing.injection(call, fault, lasting=lasting)
        ran = tracing.run(lab.folder, shlex.split(case.command), log, expression)
        if not ran.struck:  # it met a call of the interpreter's own, because one came more or less than before
            continue
        about = f"{case.command} with {expression} at {call.description}: {ran.code} {ran.err}"
        assert ran.code in (0, *ENDS), about
        assert "Traceback" not in ran.err, about
        if ran.code == 0:
            assert read_written_files(lab.folder) == clean.written_files, about
        verified = lab.call("store verify")
        assert verified.code == 0, f"{about}; verify: {verified}"
        rerun = lab.call(case.command)
        assert rerun.code == 0, f"{about}; rerun: {rerun}"
        assert read_written_files(lab.folder) == clean.written_files, about
        count("system calls failed")
