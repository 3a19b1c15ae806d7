"""`tacpipe run`: a chain gives what its commands give one by one, and does again only what has something to do."""

import json
import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

from tacpipe.cli import run
from tacpipe.engine import chains
from tacpipe.errors import UsageError
from tests.conftest import Lab, tacpipe

ROOT = Path(__file__).parents[1]
STAGES: dict[str, dict[str, Any]] = {
    "total": {"cmd": "tacpipe total data/scaled -o total", "deps": ["data/scaled/manifest.json"], "outs": ["total"]},
    "scaled": {
        "cmd": "tacpipe scale data/toy -o data/scaled --factor ${factor}",
        "deps": ["data/toy/manifest.json"],
        "outs": ["data/scaled/manifest.json"],
    },
    "toy": {"cmd": "tacpipe simulate toy -o data/toy", "outs": [{"data/toy/manifest.json": {"persist": True}}]},
}


def write_chain(stages: Mapping[str, Any], folder: Path = Path(), **params: Any) -> Path:
    """Return a chain's file, with its params next to it."""
    (folder / "dvc.yaml").write_text(yaml.safe_dump({"stages": stages}, sort_keys=False))
    (folder / "params.yaml").write_text(yaml.safe_dump({"factor": 3, **params}))
    return folder / "dvc.yaml"


def content(folder: Path) -> dict[str, bytes]:
    """Return every file of a project's datasets."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for place in ("data", "total")
        for path in sorted((folder / place).rglob("*"))
        if path.is_file()
    }


def stage_that_adds(value: str) -> dict[str, Any]:
    """Return a stage whose command adds a line to the file ``ran``."""
    return {"cmd": f"echo {value} >> ran"}


def test_a_chain_gives_the_bytes_that_its_commands_give_one_by_one(lab: Lab, tmp_path: Path) -> None:
    write_chain(STAGES)
    lab.run("run dvc.yaml")
    separate = tmp_path / "alone"
    (separate / ".tacpipe").mkdir(parents=True)
    for name in ("toy", "scaled", "total"):
        command = str(STAGES[name]["cmd"]).removeprefix("tacpipe ").replace("${factor}", "3")
        assert tacpipe(separate, command).returncode == 0

    assert content(separate) and content(lab.folder) == content(separate)


def test_with_nothing_to_do_no_process_is_started_and_each_command_reports_as_by_itself(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_chain(STAGES)
    lab.run("run dvc.yaml")
    before = content(lab.folder)
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("a process was started"))
    ran = lab.run("run dvc.yaml")

    by_itself = lab.run("scale data/toy -o data/scaled --factor 3")
    assert ran.out.split() == ["data/toy", "data/scaled", "total"]
    assert by_itself.err.partition(",")[0] in ran.err and "0 ran, 4 reused" in by_itself.err
    assert content(lab.folder) == before


def test_a_stage_is_run_where_its_params_its_input_or_a_file_of_its_output_changed(lab: Lab) -> None:
    write_chain(STAGES)
    lab.run("run dvc.yaml")
    before = content(lab.folder)

    (shard,) = (lab.folder / "data/scaled").glob("trial-000*")
    shard.unlink()
    assert "1 ran" in lab.run("run dvc.yaml").err.splitlines()[-1]
    assert content(lab.folder) == before

    write_chain(STAGES, factor=4)
    assert lab.run("run dvc.yaml").err.splitlines()[-1] == "1 unchanged, 2 ran"
    lab.run("scale data/toy -o expected --factor 4")
    assert (Path("expected") / shard.name).read_bytes() == (Path("data/scaled") / shard.name).read_bytes()


def test_a_failing_stage_keeps_back_what_depends_on_it_and_nothing_else(lab: Lab) -> None:
    scaled = {**STAGES["scaled"], "cmd": "tacpipe scale data/toy -o data/scaled --factor many"}
    write_chain({**STAGES, "scaled": scaled, "other": stage_that_adds("other")})
    failed = lab.call("run dvc.yaml")

    assert failed.code == 2
    assert Path("data/toy/manifest.json").exists() and Path("ran").read_text() == "other\n"
    assert not Path("data/scaled").exists() and not Path("total").exists()
    assert "total was not run" in failed.err


def test_the_commands_of_a_stage_end_with_the_first_that_fails(lab: Lab) -> None:
    write_chain({"several": {"cmd": ["echo first >> ran", "exit 7", "echo third >> ran"]}})

    assert lab.call("run dvc.yaml").code == 7
    assert Path("ran").read_text() == "first\n"


def test_named_stages_run_with_all_that_they_depend_on(lab: Lab) -> None:
    write_chain({**STAGES, "other": stage_that_adds("other")})
    lab.run("run dvc.yaml scaled")

    assert Path("data/scaled/manifest.json").exists()
    assert not Path("total").exists() and not Path("ran").exists()


def test_a_chain_elsewhere_runs_in_its_own_folder(lab: Lab) -> None:
    (lab.folder / "project").mkdir()
    write_chain({"here": stage_that_adds("here")}, lab.folder / "project")
    lab.run("run project/dvc.yaml")

    assert (lab.folder / "project/ran").exists() and not (lab.folder / "ran").exists()


def test_patterns_of_paths_are_expanded_as_a_shell_expands_them(lab: Lab) -> None:
    for name in ("b", "a", ".hidden"):
        Path(f"data-{name}").mkdir() if name[0] != "." else Path(name).mkdir()

    assert run._words("tacpipe scale data-* -o x") == ["tacpipe", "scale", "data-a", "data-b", "-o", "x"]
    assert run._words("tacpipe scale none-* -o 'a b'") == ["tacpipe", "scale", "none-*", "-o", "a b"]
    for shell in (
        "tacpipe a | tee b",
        "tacpipe $A",
        "tacpipe 'data-*'",
        "tacpipe {a,b}",
        "tacpipe a\ntacpipe b",
        "echo",
    ):
        assert run._words(shell) is None


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("stages: [1]", "stages"),
        ("stages: {a: {cmd: x, wdir: sub}}", "wdir"),
        ("stages: {a: {cmd: 'x ${nothing.here}'}}", "nothing.here"),
        ("stages: {a: {deps: [b]}}", "cmd"),
        ("stages: {a: {cmd: x, deps: [one], outs: [two]}, b: {cmd: x, deps: [two], outs: [one]}}", "a -> b -> a"),
        ("stages: {a: {cmd: x, outs: [one]}, b: {cmd: x, outs: [one]}}", "both write one"),
        ("stages: {a: {foreach: 3, do: {cmd: x}}}", "foreach"),
        ("stages: {a: {matrix: [1], cmd: x}}", "matrix"),
        ("stages: {a: {cmd: x}}\nvars: [hydra.json]", "hydra.json"),
        ("[", "YAML"),
    ],
)
def test_a_chain_that_cannot_be_run_is_refused_before_anything_runs(lab: Lab, text: str, part: str) -> None:
    Path("dvc.yaml").write_text(text)
    refused = lab.call("run dvc.yaml")

    assert refused.code == 2 and part in refused.err


def dvc_errors() -> Any:
    return pytest.importorskip("dvc.exceptions")


def stages_of_dvc(folder: Path) -> tuple[list[str], list[tuple[str, str]]]:
    """Return the stages that DVC reads in a folder, and which depends on which."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # DVC itself uses what it warns of.
        index = pytest.importorskip("dvc.repo").Repo(str(folder), uninitialized=True).index
        edges = sorted((after.name, before.name) for after, before in index.graph.edges)
    return sorted(stage.name for stage in index.stages), edges


@pytest.mark.parametrize(
    ("definition", "words"),
    [
        ("outs: data", "its outs is 'data'; it must be a list of paths"),
        ("outs: 5", "its outs is 5; it must be a list of paths"),
        ("outs: [5]", "its outs is"),
        ("outs: ", "its outs is None"),
        ("deps: data", "its deps is 'data'; it must be a list of paths"),
        ("deps: [{data: {}}]", "its deps is"),
        ("outs: [{one: {cash: false}}]", "its outs is"),
        ("outs: [{one: {cache: maybe}}]", "its outs is"),
        ("outs: [{one: }]", "its outs is"),
        ("plots: [{p.csv: [{x: a}]}]", "its plots is"),
        ("params: [5]", "its params is"),
        ("frozen: 'false'", "its frozen is 'false'; it must be true or false"),
        ("dep: [p]", "there is no key 'dep'; there are cmd"),
        ("deps: [p], deps: [q]", "the key deps occurs twice"),
        ("outs: [p], metrics: [p]", "it has p twice"),
        ("deps: [p], outs: [./p]", "it has p twice"),
        ("outs: [d], metrics: [d/f]", "writes d/f within d"),
        ("outs: [.]", "the folder of dvc.yaml"),
        ("outs: [..]", "the folder of dvc.yaml"),
        ("desc: 5", "its desc is 5"),
        ("do: {cmd: y}", "do"),
        ("matrix: {1: [1]}", "its matrix is"),
    ],
)
def test_a_stage_that_dvc_refuses_is_refused_with_what_is_wrong(lab: Lab, definition: str, words: str) -> None:
    Path("dvc.yaml").write_text(f"stages: {{a: {{cmd: x, {definition}}}}}")
    with pytest.raises((dvc_errors().DvcException, ValueError)):
        stages_of_dvc(lab.folder)
    refused = lab.call("run dvc.yaml")
    assert refused.code == 2 and words in refused.err and len(refused.err.splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("stages: {a: {cmd: x}, a: {cmd: y}}", "the key a occurs twice"),
        ("stages: {1: {cmd: x}, true: {cmd: y}}", "the key true occurs twice"),
        ("stages: {1: {cmd: x}}", "its stages is"),
        ("stages: {a@b: {cmd: x}}", "without @"),
        ("stages: {'': {cmd: x}}", "a name"),
        ("stages: {a: }", "its stages is"),
        ("stages: {a: {cmd: x}}\nstage: {}", "there is no key 'stage'"),
        ("stages: {a: {cmd: '${l}'}}\nvars: [{l: [x, y]}]", "its cmd is"),
    ],
)
def test_a_file_that_dvc_refuses_is_refused_with_what_is_wrong(lab: Lab, text: str, words: str) -> None:
    Path("dvc.yaml").write_text(text)
    with pytest.raises((dvc_errors().DvcException, ValueError)):
        stages_of_dvc(lab.folder)
    refused = lab.call("run dvc.yaml")
    assert refused.code == 2 and words in refused.err and len(refused.err.splitlines()) == 1


@pytest.mark.parametrize(
    "text",
    [
        "stages: {a: {cmd: x, outs: [{p: {cache: false}, q: {push: true}}]}, b: {cmd: x, deps: [q]}}",
        "stages: {a/b: {cmd: x, outs: [p]}, a_b: {cmd: y, deps: [p/q]}}",
        "stages: {%s: {cmd: x}}" % ("a" * 300),
        "stages: {a: {foreach: [u, u], do: {cmd: x}}, b: {cmd: x, deps: [./c/../d], wdir: ./}, c: {cmd: x, outs: [d]}}",
        "stages: {a: {cmd: x, plots: [{p: {x: t, header: true}}], desc: d, meta: {a: 1}, always_changed: true}}",
        "stages: {a: {cmd: x}}\nplots: [p]\nparams: [params.yaml]\nmetrics: [m]\nartifacts: {m: {path: m}}\ndatasets: []",
    ],
)
def test_a_file_that_dvc_reads_has_the_same_stages_in_the_same_dependencies(lab: Lab, text: str) -> None:
    Path("dvc.yaml").write_text(text)
    Path("params.yaml").write_text("{}")
    chain = chains.load(Path("dvc.yaml"))
    edges = sorted((name, before) for name, predecessors in chain.after.items() for before in predecessors)
    assert (sorted(stage.name for stage in chain.stages), edges) == stages_of_dvc(lab.folder)


def test_an_unknown_stage_and_a_missing_file_are_refused(lab: Lab) -> None:
    write_chain(STAGES)

    assert "scaled" in lab.call("run dvc.yaml polish").err
    assert lab.call("run nowhere.yaml").code == 2


def test_stages_of_foreach_and_matrix_have_the_names_and_values_that_the_format_gives_them(tmp_path: Path) -> None:
    stages = {
        "each": {"foreach": ["a", 2], "do": {"cmd": "x ${item}"}},
        "keyed": {"foreach": "${sets}", "do": {"cmd": "x ${key} ${item.n}"}},
        "grid": {"matrix": {"m": ["u", {"v": True}], "fold": [0, 1]}, "cmd": "x ${item.fold}"},
    }
    expanded = chains.load(write_chain(stages, tmp_path, sets={"one": {"n": 1}, "two": {"n": 2}})).stages

    assert {stage.name: stage.commands[0] for stage in expanded} == {
        "each@a": "x a",
        "each@2": "x 2",
        "keyed@one": "x one 1",
        "keyed@two": "x two 2",
        "grid@u-0": "x 0",
        "grid@u-1": "x 1",
        "grid@m1-0": "x 0",
        "grid@m1-1": "x 1",
    }


def test_dvc_reads_the_stages_of_this_project_in_the_same_way() -> None:
    parsing = pytest.importorskip("dvc.parsing")
    repo = pytest.importorskip("dvc.repo").Repo(str(ROOT), uninitialized=True)
    resolver = parsing.DataResolver(repo, str(ROOT), yaml.safe_load((ROOT / "dvc.yaml").read_text()))
    expected = resolver.resolve()["stages"]
    actual = {stage.name: stage for stage in chains.load(ROOT / "dvc.yaml").stages}

    assert set(actual) == set(expected) and len(actual) > 100
    for name, stage in actual.items():
        commands = expected[name]["cmd"]
        assert list(stage.commands) == ([commands] if isinstance(commands, str) else commands)
        assert list(stage.reads) == expected[name].get("deps", [])


def test_each_stage_of_this_project_comes_after_those_whose_outputs_it_reads() -> None:
    chain = chains.load(ROOT / "dvc.yaml")
    earlier: list[str] = []
    for stage in chain.stages:
        assert set(chain.after[stage.name]) <= set(earlier)
        earlier.append(stage.name)
    assert "forward-synced" in chain.after["forward-segments"]
    assert any(name.startswith("forward-raw") or name.startswith("forward-latent") for name in chain.after["forward"])


def test_names_with_values_that_are_missing_are_named() -> None:
    with pytest.raises(UsageError, match=r"a\.c"):
        chains.fill_template("${a.c}", {"a": {"b": 1}}, "dvc.yaml")
    assert chains.fill_template(r"\${a} ${a}", {"a": False}, "dvc.yaml") == "${a} false"


@pytest.mark.long
def test_an_interrupt_ends_the_stage_at_work_and_the_chain_with_the_exit_code_of_interrupts(lab: Lab) -> None:
    work = "import pathlib, time; pathlib.Path('began').touch(); time.sleep(600)"
    write_chain(
        {"slow": {"cmd": f'exec {sys.executable} -c "{work}"'}, "after": {**stage_that_adds("after"), "deps": ["x"]}}
    )
    command = [sys.executable, "-m", "tacpipe", "run", "dvc.yaml"]
    process = subprocess.Popen(command, env=dict(os.environ), stderr=subprocess.PIPE, text=True)
    while not Path("began").exists():
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    _, printed = process.communicate(timeout=60)

    assert process.returncode == 130
    assert 'File "' not in printed.replace('File "<string>"', "")  # the only traceback is that of what ran
    assert not Path("ran").exists()


def test_json_of_a_command_within_a_chain_is_what_it_prints_by_itself(lab: Lab) -> None:
    write_chain({"toy": {"cmd": "tacpipe simulate toy -o data/toy --json --quiet"}})
    lab.run("run dvc.yaml")
    value, by_itself = (
        json.loads(lab.run(command).out) for command in ("run dvc.yaml", "simulate toy -o data/toy --json")
    )

    assert {**value, "seconds": 0} == {**by_itself, "seconds": 0}
