"""What help looks like: short and long option, whole summaries, options in panels, versions."""

from __future__ import annotations

import json
import platform
import re
from importlib import metadata

import pytest

from tacpipe.cli import commands
from tacpipe.plugins import registry
from tests.conftest import Lab
from tests.test_docs import BUILT_IN, COMMANDS


@pytest.mark.parametrize("command", ["", "split", "train", "train forward", "store", "store gc", "acquire"])
def test_h_is_help(lab: Lab, command: str) -> None:
    assert lab.run(f"{command} -h").out == lab.run(f"{command} --help").out


@pytest.mark.parametrize("command", ["", "train", "segment", "store", "sensors"])
def test_no_summary_is_cut(lab: Lab, command: str) -> None:
    listed = lab.run(f"{command} --help").out.split("\nCommands:\n")[1]

    assert "..." not in listed
    whole = " ".join(listed.split())
    texts = [*registry.commands().values(), *commands.SUMMARIES.values()] if not command else []
    texts += [registry.summary(name) for name in BUILT_IN if command and name.startswith(f"{command}.")]
    assert not [text for text in texts if text not in whole]
    assert whole.endswith(".")


@pytest.mark.parametrize("command", COMMANDS)
def test_the_first_line_of_every_help_is_a_sentence_of_under_60_characters(lab: Lab, command: str) -> None:
    first = lab.run(f"{command} --help").out.split("\n\n")[1]

    assert re.fullmatch(r"[A-Z][a-z].{8,}\.", first.strip())
    assert len(first.strip()) < 60


def test_every_summary_is_under_60_characters() -> None:
    texts = [*registry.commands().values(), *commands.SUMMARIES.values(), *map(registry.summary, BUILT_IN)]

    assert [text for text in texts if not (text.endswith(".") and len(text) < 60)] == []


def test_options_stand_in_panels_and_what_every_stage_shares_comes_last(lab: Lab) -> None:
    text = lab.run("synchronize --help").out
    titles = re.findall(r"^(\w[\w ]*):$", text, re.MULTILINE)

    assert titles[0] == "Arguments" and titles[-3:] == ["Params", "Run", "Output"]
    run = text.split("\nRun:\n")[1].split("\n\n")[0]
    assert "--jobs" in run and "--rate-hz" not in run
    for command in ("store push", "acquire", "show"):
        assert "\nOutput:\n" in lab.run(f"{command} --help").out


def test_version_names_tacpipe_python_and_what_is_installed(lab: Lab) -> None:
    text = lab.run("version").out
    assert text.splitlines()[0] == f"tacpipe {metadata.version('tacpipe')}"
    assert f"Python {platform.python_version()}" in text
    assert f"numpy {metadata.version('numpy')}" in text
    assert lab.run("--version").out == text

    parts = json.loads(lab.run("version --json").out)["parts"]
    assert parts["core"]["typer"] == metadata.version("typer")
    assert {"core", "learn", "clouds", "devices"} <= set(parts) and "all" not in parts
