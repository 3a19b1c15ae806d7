import json
from pathlib import Path

import pytest

from tacpipe.cli import commands
from tacpipe.datasets.manifest import parse
from tacpipe.plugins import registry
from tests.conftest import Lab

COMMANDS = [*(name.replace(".", " ") for name in registry.stages()), *commands.NAMES]
STORE = ["status", "verify", "repair", "gc", "link", "push", "pull"]


@pytest.mark.parametrize("command", [*COMMANDS, *(f"store {verb}" for verb in STORE)])
def test_every_command_has_help_and_all_but_groups_an_example(lab: Lab, command: str) -> None:
    printed = lab.run(f"{command} --help").out
    assert "Usage: tacpipe" in printed
    assert command in ("sensors", "store") or f"tacpipe {command}" in printed.split("Example")[1]


def test_help_lists_every_command(lab: Lab) -> None:
    printed = lab.run("--help").out
    for name in {command.split()[0] for command in COMMANDS}:
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
