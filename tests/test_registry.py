import ast
import re
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins import registry
from tests.conftest import Lab, forget, write_plugin


def test_the_names_are_those_that_importlib_finds() -> None:
    forget()
    for group in registry.GROUPS:
        expected = {point.name: point.value for point in entry_points(group=group)}
        assert {**expected} == {name: registry.entry_points()[group].get(name) for name in expected}
        assert expected


@pytest.mark.parametrize("name", sorted(registry.stages()))
def test_every_built_in_stage_loads_and_has_a_summary_and_help_for_each_param(name: str) -> None:
    from tacpipe.plugins import params

    loaded = registry.load(name)
    assert loaded.version >= 1
    assert registry.summary(name).endswith(".")
    assert set(params.comments(loaded)) >= set(params.fields(loaded))


def test_a_third_party_s_stage_stands_beside_the_built_in_ones(lab: Lab) -> None:
    assert "scale" in lab.run("--help").out
    assert "times" not in lab.run("--help").out
    assert "Every value is multiplied by it" in lab.run("scale --help").out


def test_a_broken_plug_in_spoils_its_own_name_alone(lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = tmp_path / "broken"
    points = "[tacpipe.stages]\nlost = nowhere:f\nwrong = syntax_of:f\nplain = plain_of:f\nsegment.lost = nowhere:g\n"
    write_plugin(broken, "b", points, syntax_of="def f(:\n", plain_of='"""Say nothing."""\n\nf = 3\n')
    monkeypatch.syspath_prepend(broken)
    forget()
    assert lab.call("--help").code == 0
    assert lab.call("segment contacts --help").code == 0
    lab.run("simulate toy -o data/r")
    failed = lab.call("lost data/r -o data/x")
    assert failed.code == 1 and "nowhere" in failed.err
    assert "plain_of:f" in lab.call("plain data/r -o data/x").err


def test_an_unknown_stage_is_a_usage_error() -> None:
    with pytest.raises(UsageError, match="there are"):
        registry.load("polish")
    with pytest.raises(TacpipeError, match="no task"):
        registry.load_task("polish")


OWN_TASK = """
from dataclasses import dataclass

from tacpipe import Dataset, Result, stage
from tacpipe.report.context import TaskReport
from tacpipe.report.blocks import Fold, SmallPrint
from tacpipe.tasks.task import Task


@dataclass(frozen=True)
class Params:
    springs: int = 2  # number of springs


class WeighingReport(TaskReport):
    title = "weights of objects"

    def folds(self, context):
        return [Fold("Scales", [SmallPrint(f"{len(context.bare)} scales")])]


class Weighing(Task):
    name = "weighing"

    @staticmethod
    @stage(version=3)
    def train(params: Params, train: Dataset) -> Result:
        \"\"\"Train a scale.\"\"\"

    def evaluate(self, model, recordings):
        pass

    predict = load = evaluate

    @property
    def report(self):
        return WeighingReport(self.name)


class Unfinished(Task):
    name = "unfinished"
"""


def test_the_parts_of_a_task_come_from_the_plug_in_that_brings_the_task(
    lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import json

    from tacpipe.report import page
    from tests.fake_recordings import FakeDataset

    points = "[tacpipe.tasks]\nweighing = own_task:Weighing\nunfinished = own_task:Unfinished\nold = own_task\n"
    write_plugin(tmp_path / "own", "own", points, own_task=OWN_TASK)
    monkeypatch.syspath_prepend(tmp_path / "own")
    forget()
    files = {"metrics.json": b"{}", "config.json": json.dumps({"task": "weighing"}).encode()}
    result: Any = FakeDataset({}, files, {})
    text = page.render([result, result]).decode()
    assert "Weights of objects" in text and "2 scales" in text
    assert registry.load("train.weighing").version == 3
    assert "Train a scale." in lab.run("train --help").out
    assert "Number of springs" in lab.run("train weighing --help").out
    for name in ("unfinished", "old"):
        with pytest.raises(TacpipeError, match=r"not a task .*subclass of tacpipe\.tasks\.task\.Task"):
            registry.load_task(name)


def test_no_module_outside_of_a_task_s_own_packages_names_a_task() -> None:
    names = "|".join(registry.tasks())
    # words of data, as the label material, are no names of tasks where they stand alone
    literal = re.compile(rf"forward|(?:.*[./])?(?:tasks|report|train|simulate|models|results)[./](?:{names})(?:\..*)?")
    assert _modules_with(literal) == set()


def test_no_module_outside_of_tasks_reports_formats_and_simulation_names_a_stage() -> None:
    # words of data too: a role, kinds of dataset, a message of HID, a key of Croissant's JSON
    data = {"split", "train", "report", "export", "extract"}
    stage_names = {*registry.stages(), *registry.commands()} - data
    # the command line has aliases, groups of commands and a first try of several, guesses name the commands that do what is
    # meant, an export of frames runs synchronize before it, the viewer reads the thresholds of contacts and the pitch of
    # markers, and a live session extracts channels of cameras and reads the params of an earlier version of synchronize
    needed = {
        "cli/first_try.py",
        "cli/guesses.py",
        "cli/help.py",
        "cli/main.py",
        "datasets/guesses.py",
        "exports/frames.py",
        "live/stages.py",
        "viewer/contents.py",
        "viewer/markers.py",
    }

    assert _modules_with(re.compile("|".join(map(re.escape, stage_names)))) == needed


def test_the_demo_runs_the_part_of_every_task_and_one_page_of_their_results(lab: Lab) -> None:
    from tacpipe.cli import demo

    *commands, last = demo.demo_commands(Path("out"))
    with_demo = {name for name in registry.tasks() if registry.load_task(name).demo(Path("out")) is not None}
    assert {words[1] for words in commands if words[0] == "train"} == with_demo > {"forward"}
    evaluated = [words[-1] for words in commands if words[0] == "evaluate"]
    assert last[: len(evaluated) + 1] == ["report", *evaluated]
    assert lab.run("--help").out.index("  simulate ") < lab.run("--help").out.index("  export ")


def test_the_demo_on_a_rig_trains_on_the_recordings_of_the_rig_and_shows_what_it_evaluated() -> None:
    from tacpipe.cli import demo

    commands = demo.demo_rig(Path("out"))
    assert commands[0][0] == "acquire" and commands[2][:2] == ["synchronize", "out/recordings"]
    evaluated = [words[-1] for words in commands if words[0] == "evaluate"]
    assert commands[-1][:2] == ["report", "out/results"] and evaluated == ["out/results"]


def test_the_demo_prints_at_most_80_lines() -> None:
    from tacpipe.cli import demo
    from tacpipe.cli.demo import NEXT

    notes, closing = len(demo.demo_parts(Path("out"))), len(NEXT.splitlines()) + 2
    assert 2 * len(demo.demo_commands(Path("out"))) + notes + closing <= 80  # each command and at most one warning


def test_a_plug_in_states_the_order_and_the_lines_of_its_commands(
    lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = (
        "[tacpipe.commands]\nown = own_stages:COMMANDS\nlost = nowhere:COMMANDS\n\n"
        "[tacpipe.stages]\nweigh.twice = own_stages:f\n"
    )
    stages = '"""Weigh."""\n\nCOMMANDS = {"weigh": "Weigh objects.", "gone": ""}\n'
    write_plugin(tmp_path / "own", "own", points, own_stages=stages)
    monkeypatch.syspath_prepend(tmp_path / "own")
    forget()
    assert registry.commands()["weigh"] == "Weigh objects."
    order = list(registry.commands())
    assert order[0] == "ingest" and "gone" not in order
    assert order.index("export") < order.index("weigh") < order.index("centre") < order.index("scale")
    assert "Weigh objects." in lab.run("--help").out
    assert "Weigh objects." in lab.run("weigh --help").out
    lab.run("simulate toy -o data/r")


def _modules_with(literal: re.Pattern[str]) -> set[str]:
    """Return the modules outside of plug-ins' own packages that have such a text in their code."""
    root = Path(registry.__file__).parents[1]
    plugin_packages = {root / part for part in ("tasks", "report", "formats", "simulation")}
    return {
        str(file.relative_to(root))
        for file in root.rglob("*.py")
        if not plugin_packages & set(file.parents) and any(literal.fullmatch(text) for text in _texts(file))
    }


def _texts(file: Path) -> set[str]:
    """Return the texts in a module's code; its docstrings are other nodes."""
    tree = ast.parse(file.read_text())
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    return {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings
    }
