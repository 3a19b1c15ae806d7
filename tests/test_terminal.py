"""No control character of a file's content is printed, and no standard stream makes a command fail."""

import ast
import json
import re
import subprocess
import sys
import unicodedata
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe import printable
from tacpipe.errors import TacpipeError
from tacpipe.io import terminal
from tacpipe.store.records import RecordingEntry
from tests.conftest import Lab

HOSTILE = "\x1b]0;owned\x07\x1b[2J\x9b31m\u202etxt.exe\x7f\r\nforged: line"
DANGEROUS = {"Cc", "Cf", "Cs", "Zl", "Zp"}


def harmless(text: str) -> bool:
    return not any(unicodedata.category(c) in DANGEROUS for c in text.replace("\n", ""))


@given(st.text())
def test_what_is_shown_has_no_character_that_a_terminal_obeys_and_is_one_line(text: str) -> None:
    assert harmless(printable.shown(text))
    assert "\n" not in printable.shown(text)
    assert harmless(str(TacpipeError(text)))
    assert printable.shown(printable.shown(text)) == printable.shown(text)


@pytest.mark.parametrize("text", ["trial-木", "Prüfling Ø 5", "木\u3000材", "😀", "back\\slash"])
def test_what_people_write_is_shown_as_it_is(text: str) -> None:
    assert printable.shown(text) == text


@pytest.fixture
def hostile(lab: Lab) -> Lab:
    """A dataset whose labels, names, exclusions and params are untrusted text."""
    lab.run("simulate toy -o data/r --trials 2")
    manifest = lab.manifest("data/r")
    first, second = manifest.recordings
    entry: RecordingEntry = {
        **manifest.recordings[first],
        "attributes": {HOSTILE.replace("\n", ""): HOSTILE, "excluded": HOSTILE},
    }
    forged = replace(
        manifest,
        recordings={"a\x9b31m\u202eb": manifest.recordings[second], first: entry},
        params={"note": HOSTILE},
        skipped={HOSTILE: HOSTILE},
        labels={first: {"note": HOSTILE}},
    )
    (lab.folder / "data/r/manifest.json").write_bytes(forged.content)
    return lab


@pytest.mark.parametrize(
    "command", ["show data/r", "show data/r --full", "explain data/r", "store list", "scale data/r"]
)
def test_no_command_prints_what_a_terminal_obeys(hostile: Lab, command: str) -> None:
    hostile.call("label data/r * --set material=cork")
    ran = hostile.call(command if command != "scale data/r" else "scale data/r -o data/s --refuse 0")
    assert harmless(ran.out + ran.err)
    assert not re.search("^forged: line", ran.out + ran.err, re.MULTILINE)


@pytest.mark.parametrize("command", ["show data/r --json", "explain data/r --json", "store list --json"])
def test_json_carries_the_same_text_and_no_control_character(hostile: Lab, command: str) -> None:
    hostile.call("label data/r * --set material=cork")
    ran = hostile.run(command)
    assert ran.out.isascii()
    assert harmless(ran.out)
    assert json.loads(ran.out)
    assert json.dumps(HOSTILE).replace("\x7f", "\\u007f") in ran.out or "store" in command


def test_nothing_is_printed_but_by_the_terminal() -> None:
    root = Path(terminal.__file__).parent
    for module in [*root.rglob("*.py"), *(root.parent / "stages").rglob("*.py")]:
        if module.name in ("terminal.py", "hid_server.py"):  # the second speaks with a test's own process
            continue
        for node in ast.walk(ast.parse(module.read_text())):
            if isinstance(node, ast.Call):
                assert ast.unparse(node.func) not in ("print", "typer.echo", "click.echo"), f"{module}:{node.lineno}"


def run_redirected(lab: Lab, command: str, redirections: str) -> subprocess.CompletedProcess[str]:
    words = f'"{sys.executable}" -m tacpipe {command} {redirections}'
    return subprocess.run(["sh", "-c", words], cwd=lab.folder, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("redirection", ["2>&-", "2>/dev/full", ">&-", "<&- >&- 2>&-"])
def test_a_command_does_its_work_whatever_stderr_is(lab: Lab, redirection: str) -> None:
    ran = run_redirected(lab, "simulate toy -o data/r", redirection)
    assert ran.returncode == 0
    assert list(lab.manifest("data/r").recordings) == [f"trial-{n:03d}" for n in range(4)]
    assert ran.stdout in ("data/r\n", "")


def test_a_result_that_cannot_be_printed_is_kept_and_named(lab: Lab) -> None:
    ran = run_redirected(lab, "simulate toy -o data/r", ">/dev/full")
    assert ran.returncode == 1
    assert (
        "What the command made is kept, but its result could not be written to standard output: No space" in ran.stderr
    )
    assert len(lab.manifest("data/r").recordings) == 4


def test_a_mistake_keeps_its_exit_code_when_it_cannot_be_printed(lab: Lab) -> None:
    assert run_redirected(lab, "show data/absent", "2>/dev/full").returncode == 2
    assert run_redirected(lab, "show --no-such-option", "2>&-").returncode == 2
