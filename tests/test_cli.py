import json
import platform
import re
from importlib import metadata
from pathlib import Path

import pytest

from tacpipe.cli import commands
from tacpipe.cli import help as help_text
from tacpipe.datasets.manifest import parse
from tacpipe.plugins import registry
from tests.conftest import Lab, run_python, tacpipe
from tests.test_docs import BUILT_IN, COMMANDS

ALL_COMMANDS = [*(name.replace(".", " ") for name in registry.stages()), *commands.NAMES]
STORE = ["status", "verify", "repair", "gc", "link", "push", "pull"]


@pytest.mark.parametrize("command", [*ALL_COMMANDS, *(f"store {verb}" for verb in STORE)])
def test_every_command_has_help_and_all_but_groups_an_example(lab: Lab, command: str) -> None:
    printed = lab.run(f"{command} --help").out
    assert "Usage: tacpipe" in printed
    assert command in ("sensors", "store") or f"tacpipe {command}" in printed.split("Example")[1]


def test_help_lists_every_command(lab: Lab) -> None:
    printed = lab.run("--help").out
    for name in {command.split()[0] for command in ALL_COMMANDS}:
        assert f"  {name} " in printed


@pytest.mark.parametrize(("alias", "command"), [("eval", "evaluate"), ("sync", "synchronize")])
def test_what_people_type_is_understood_and_not_listed(lab: Lab, alias: str, command: str) -> None:
    assert lab.run(f"{alias} --help").out == lab.run(f"{command} --help").out
    assert f"  {alias} " not in lab.run("--help").out


@pytest.mark.parametrize(
    ("command", "code", "sentence"),
    [
        ("polish", 2, "polish"),
        ("scale", 2, "Missing argument 'datasets'"),
        ("scale nowhere -o x", 2, "nowhere does not exist or is empty"),
        ("scale . -o x", 2, "has no manifest.json"),
        ("scale data/r -o x --factor many", 2, "--factor is 'many'; it must be a whole number."),
        ("scale data/r -o x --set factor=1.5", 2, "whole number"),
        ("scale data/r -o x --set speed=1", 2, "no param speed"),
        ("scale data/r", 2, "-o"),
        ("ingest numbers nowhere -o x", 2, "no nowhere"),
        ("ingest numbers empty -o x", 2, "found no recording"),
        ("centre data/r -o x", 2, "--split"),
        ("centre data/r --split data/r -o x", 2, "data/r"),
        ("scale data/r -o x --block a.b", 2, "params.yaml"),
        ("label data/r nobody --set a=1", 2, "no recording nobody"),
        ("label data/r trial-000", 2, "Nothing to change"),
        ("label data/s trial-000 --set a=1", 2, "next run would undo"),
        ("evaluate data/s data/r -o x", 2, "data/s is not a model: scale made it. Give what `tacpipe train`"),
        ("predict data/r data/s -o x", 2, "data/r is not a model: simulate.toy made it. Give what `tacpipe train`"),
        ("explain nowhere", 2, "nowhere"),
        ("store pull nowhere data/r", 2, "is not a store"),
    ],
)
def test_a_mistake_is_a_sentence_with_the_documented_code_and_leaves_nothing_behind(
    lab: Lab, command: str, code: int, sentence: str
) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    Path("empty").mkdir()
    failed = lab.call(command)
    assert failed.code == code, failed.err
    assert sentence in failed.err and "Traceback" not in failed.err
    assert not Path("x").exists()


def test_stdout_holds_the_path_or_one_json_object_and_nothing_else(lab: Lab) -> None:
    assert lab.run("simulate toy -o data/r").out == "data/r\n"
    value = lab.run_json("scale data/r -o data/s")
    assert {"schema_version", "output", "key", "ran", "reused", "rows", "seconds", "bad"} <= set(value)
    assert (value["output"], value["ran"], value["rows"], value["bad"]) == ("data/s", 4, 80, {})
    assert lab.run("scale data/r -o data/s --quiet").err == ""


def test_params_come_from_the_file_beside_the_command_and_print_params_shows_them(lab: Lab) -> None:
    Path("params.yaml").write_text("scale: {factor: 5}\nlab: {scale: {factor: 6}}\n")
    assert json.loads(lab.run("scale data/r --print-params").out)["factor"] == 5
    assert json.loads(lab.run("scale data/r --block lab.scale --print-params").out)["factor"] == 6
    assert json.loads(lab.run("scale data/r --factor 7 --print-params").out)["factor"] == 7


def test_show_tells_rows_rates_and_labels(lab: Lab) -> None:
    lab.run("simulate toy -o data/r --trials 25 --rows 11")
    printed = lab.run("show data/r").out
    assert "and 5 more" in printed and "material: cork (25)" in printed and "25 recordings, 550 rows" in printed
    value = lab.run_json("show data/r")
    assert value["recordings"]["trial-003"]["left"]["rate_hz"] == 100.0
    assert value["recordings"]["trial-003"]["left"]["duration_s"] == 0.1
    lab.run("scale data/r -o data/s")
    assert "trial-000" in lab.run("show data/s").out


@pytest.mark.inline
def test_a_label_is_kept_in_the_manifest_and_numbers_are_numbers(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("label data/r trial-000 trial-002 --set force_n=1.5 --set wet=true --set note='rough side'")
    manifest = parse(Path("data/r/manifest.json").read_bytes(), "r")
    attributes = manifest.recordings["trial-002"]["attributes"]
    assert (attributes["force_n"], attributes["wet"], attributes["note"]) == (1.5, True, "rough side")
    lab.run("label data/r trial-002 --set wet=null")
    assert "wet" not in parse(Path("data/r/manifest.json").read_bytes(), "r").recordings["trial-002"]["attributes"]


def test_an_option_with_its_earlier_name_still_works_and_no_help_shows_it(lab: Lab) -> None:
    lab.run("simulate toy --trials 2 -o data/recordings --jobs 1")
    lab.run("label data/recordings trial-000 --set material=foam")
    lab.run("label data/recordings trial-001 --set=material=cork")
    labels = lab.manifest("data/recordings").labels
    listed = lab.run("store list --store .tacpipe --json").out

    assert labels == {"trial-000": {"material": "foam"}, "trial-001": {"material": "cork"}}
    assert listed == lab.run("store list --remote .tacpipe --json").out
    assert "--duration-s must be above 0" in lab.call("live no-rig.toml --duration 0").err
    for command, old in (
        ("acquire", "--duration"),
        ("live", "--duration"),
        ("label", "--set"),
        ("store list", "--store"),
    ):
        assert f"{old} " not in lab.run(f"{command} --help").out


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


HEAVY = {"torch", "pyarrow", "pandas", "sklearn", "open3d", "numpy", "scipy", "matplotlib"}
PROBE = """
import sys
from tacpipe.cli import main as cli
sys.argv = ["tacpipe"]
try:
    cli.main()
except SystemExit:
    pass
print("IMPORTED", *sorted({name.partition(".")[0] for name in sys.modules}))
"""


def completion_variables(shell: str, line: str) -> dict[str, str]:
    """Return what a shell's script sets when TAB is pressed behind ``line``."""
    variables = {"_TACPIPE_COMPLETE": f"complete_{shell}"}
    if shell == "bash":
        return variables | {"COMP_WORDS": line, "COMP_CWORD": str(len(line.split()) - (not line.endswith(" ")))}
    return variables | {"_TYPER_COMPLETE_ARGS": line, "_TYPER_COMPLETE_FISH_ACTION": "get-args"}


def complete(folder: Path, shell: str, line: str) -> set[str]:
    process = tacpipe(folder, "", **completion_variables(shell, line))
    assert "Traceback" not in process.stderr
    return {word.partition("\t")[0].strip('(")*:') for word in process.stdout.replace('":"', "\t").split("\n")}


@pytest.mark.parametrize("shell", ["bash", *(pytest.param(name, marks=pytest.mark.long) for name in ("zsh", "fish"))])
def test_commands_methods_and_options_are_completed_in_every_shell(tmp_path: Path, shell: str) -> None:
    names = {name.partition(".")[0] for name in registry.stages()} | set(commands.NAMES)
    words = complete(tmp_path, shell, "tacpipe ")
    assert {name for name in names if any(word.endswith(name) for word in words)} == names
    assert any("material" in word for word in complete(tmp_path, shell, "tacpipe train m"))
    options = complete(tmp_path, shell, "tacpipe split --s")
    for option in ("--seed", "--scheme", "--set", "--skip-bad"):
        assert any(word.endswith(option) for word in options)


def test_a_group_of_commands_completes_its_verbs(tmp_path: Path) -> None:
    assert complete(tmp_path, "bash", "tacpipe store p") - {""} == {"push", "pull"}


@pytest.mark.parametrize("line", ["tacpipe ", "tacpipe train forward --", "tacpipe synchronize --r"])
def test_completion_imports_nothing_heavy(tmp_path: Path, line: str) -> None:
    process = run_python(tmp_path, "-c", PROBE, environment=completion_variables("bash", line), check=True)
    printed, _, imported = process.stdout.partition("IMPORTED ")
    assert printed.strip()
    assert set(imported.split()) & HEAVY == set()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_for_a_shell_asks_tacpipe(tmp_path: Path, shell: str) -> None:
    process = tacpipe(tmp_path, "", _TACPIPE_COMPLETE=f"source_{shell}")
    assert f"_TACPIPE_COMPLETE=complete_{shell}" in process.stdout
