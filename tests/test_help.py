"""Help has short and long options, uncut summaries, options in panels, and versions."""

from __future__ import annotations

import platform
import re
from importlib import metadata

import pytest

from tacpipe.cli import commands
from tacpipe.cli import help as help_text
from tacpipe.plugins import registry
from tests.conftest import Lab
from tests.test_docs import BUILT_IN, COMMANDS


@pytest.mark.parametrize("command", COMMANDS)
def test_h_shows_the_common_options_in_40_lines_and_what_must_be_given_first(lab: Lab, command: str) -> None:
    text = lab.run(f"{command} -h").out
    complete = lab.run(f"{command} --help").out
    assert len(text.splitlines()) <= 40
    options, common_options = (
        set(re.findall(r"^  (?:-\w, )?(--[\w-]+)", page.partition("\nExample")[2], re.MULTILINE))
        for page in (complete, text)
    )
    assert common_options <= options and "--help" in common_options
    remark = re.search(r"^(\d+) more options?: (.+)$", text, re.MULTILINE)
    assert int(remark[1] if remark else 0) == len(options - common_options)
    assert (remark is None) or remark[2] == f"tacpipe {command} --help"
    if "\nRequired:\n" in complete:
        assert complete.split("\nRequired:\n")[1].split("\n\n")[0].split()[0] in text.split("\nRequired:\n")[1]


def test_help_is_as_wide_as_the_terminal_and_an_example_is_one_line(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    for columns in (60, 80, 150):
        monkeypatch.setenv("COLUMNS", str(columns))
        for option in ("-h", "--help"):
            head, after_head = lab.run(f"train material {option}").out.split("\nExample:\n")
            example, text = after_head.split("\n", 1)
            assert example.startswith("  tacpipe train material data/slides ") and " -o " in example
            longest = max(map(len, (head + text).splitlines()))
            assert columns - 15 < longest <= columns


def test_options_of_an_architecture_are_shown_with_it_and_those_of_the_default_without(lab: Lab) -> None:
    default, chosen = (lab.run(f"train material {words}--help").out for words in ("", "--architecture raec "))
    assert "--features" in default and "--decoder" not in default
    assert "--decoder" in chosen and "--features" not in chosen
    assert "--decoder" in lab.run("train material --architecture=raec --help").out
    assert "--architecture NAME --help" in " ".join(default.split())


def test_commands_are_grouped_and_one_of_another_package_is_among_the_plug_ins(lab: Lab) -> None:
    text = lab.run("--help").out
    titles = re.findall(r"^(\w[\w ,-]*):$", text, re.MULTILINE)
    assert titles == ["Options", *help_text.SECTIONS, help_text.PLUG_INS]
    assert "  scale " in text.split("\nPlug-ins:\n")[1]
    assert set().union(*help_text.SECTIONS.values()) == {command.split()[0] for command in COMMANDS}


def test_help_has_no_markup(lab: Lab) -> None:
    assert [command for command in ["", *COMMANDS] if "`" in lab.run(f"{command} --help").out] == []


def test_a_missing_output_is_a_missing_option(lab: Lab) -> None:
    ran = lab.call("simulate toy")
    assert (ran.code, ran.err) == (2, "tacpipe: Missing option -o. Give the directory to write, as -o data/output.\n")


@pytest.mark.parametrize("command", ["", "train", "segment", "store", "sensors"])
def test_no_summary_is_cut(lab: Lab, command: str) -> None:
    listed = lab.run(f"{command} --help").out.split("\nCommands:\n" if command else "\nRecord:\n")[1]

    assert "..." not in listed
    summaries = " ".join(re.sub(r"^\w[\w ,-]*:$", "", listed, flags=re.MULTILINE).split())
    texts = [*registry.commands().values(), *map(commands.summary, commands.NAMES)] if not command else []
    texts += [registry.summary(name) for name in BUILT_IN if command and name.startswith(f"{command}.")]
    assert not [text for text in texts if text not in summaries]
    assert summaries.endswith(".")


@pytest.mark.parametrize("command", COMMANDS)
def test_the_first_line_of_every_help_is_a_sentence_of_under_60_characters(lab: Lab, command: str) -> None:
    first = lab.run(f"{command} --help").out.split("\n\n")[1]

    assert re.fullmatch(r"[A-Z][a-z].{8,}\.", first.strip())
    assert len(first.strip()) < 60


def test_every_summary_is_under_60_characters() -> None:
    texts = [*registry.commands().values(), *map(commands.summary, commands.NAMES), *map(registry.summary, BUILT_IN)]

    assert [text for text in texts if not (text.endswith(".") and len(text) < 60)] == []


def test_options_stand_in_panels_and_what_every_stage_shares_comes_last(lab: Lab) -> None:
    text = lab.run("synchronize --help").out
    titles = re.findall(r"^(\w[\w ]*):$", text, re.MULTILINE)

    assert titles[:3] == ["Example", "Arguments", "Required"] and titles[-3:] == ["Params", "Run", "Output"]
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

    parts = lab.run_json("version")["parts"]
    assert parts["core"]["typer"] == metadata.version("typer")
    assert {"core", "learn", "clouds", "devices"} <= set(parts) and "all" not in parts
