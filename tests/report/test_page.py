"""One page for results of all tasks, whole and loading nothing."""

import base64
import hashlib
import html
import json
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from tacpipe.comparison import engine
from tacpipe.errors import TacpipeError
from tacpipe.report import page
from tacpipe.report.blocks import Chart, Fold, Section, SmallPrint, table
from tacpipe.report.charts import Spec
from tests.conftest import forget
from tests.fake_recordings import FakeDataset, FakeShard, dataset
from tests.stages.learning_fakes import motion
from tests.tasks.forward.report import result_fakes
from tests.tasks.material.report import material_fakes
from tests.tasks.touch.report import touch_fakes

pytestmark = pytest.mark.usefixtures("unbundled")
VOID = ("meta", "br")
PLUGIN = Path(__file__).parents[1] / "plugin"
TOY_TASK = """
from tacpipe.tasks.task import Task
from toy_report import WeighingReport

class Weighing(Task):
    name = "weighing"

    def evaluate(self, *_):
        raise NotImplementedError

    predict = load = evaluate

    @property
    def report(self):
        return WeighingReport(self.name)
"""


class Elements(HTMLParser):
    """Collects what a page loads, and checks that its elements close."""

    def __init__(self) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.open: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loads += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("script", "style"):
            self.text += data


def check(content: bytes) -> str:
    """A page is whole, loads nothing, and shows no number that is none; return its text."""
    elements = Elements()
    elements.feed(content.decode())
    assert elements.open == []
    assert all(reference.startswith("#") for reference in elements.loads)
    assert not re.search(r"\bnan\b", elements.text, re.IGNORECASE)
    return elements.text


def unknown_result(task: str, **attributes: Any) -> Any:
    """A result of a task that the page knows nothing about."""
    files = {
        "metrics.json": json.dumps(
            {"model": {"error": {"near": 0.25, "far": None}}, "counts": {"trials": 12}}
        ).encode(),
        "config.json": json.dumps({"task": task, "architecture": "graph_net"}).encode(),
    }
    shards = {"r": FakeShard("r", motion(1).content, attributes)} if attributes else {}
    return FakeDataset(shards, files, result_fakes.MANIFEST)


def all_results() -> list[Any]:
    wrong = {"biotac": 1, "roboskin": 2}
    return [
        result_fakes.result(ratio={"r1": 0.5, "r2": 0.25, "r3": 1.5, "r4": 0.5}),
        material_fakes.result("minirocket", wrong=wrong),
        material_fakes.result(wrong=wrong, joint=True, epochs=3),
        material_fakes.recorded(),
        touch_fakes.result(novel=touch_fakes.NOVEL),
        unknown_result("graph"),
    ]


def test_a_page_of_all_tasks_is_whole_and_the_same_results_give_the_same_bytes() -> None:
    content = page.render(all_results(), title="a <b>")
    text = check(content)
    assert content == page.render(all_results(), title="a <b>")
    ids = re.findall(r'<section id="(\w+)"', content.decode())
    assert ids == ["forward", "material", "touch", "graph"]
    assert "a <b>" in text


def test_each_section_opens_with_one_sentence_one_chart_and_one_table_of_at_most_seven_rows() -> None:
    content = page.render(all_results()).decode()
    for name in ("forward", "material", "touch"):
        section = content[content.index(f'<section id="{name}"') :]
        first = section[: section.index('<div class="folds">')]
        assert (first.count('class="answer'), first.count("<figure"), first.count("<table")) == (1, 1, 1)
        assert 1 <= first[first.index("<tbody>") :].count("<tr") <= 7


def test_every_fold_has_its_place_in_the_contents() -> None:
    content = page.render(all_results()).decode()
    linked = set(re.findall(r'<li><a href="#([\w-]+)"', content))
    assert linked and linked == set(re.findall(r'<details class="fold" id="([\w-]+)"', content))


def test_a_task_without_a_specification_has_its_numbers_by_name_and_where_they_come_from() -> None:
    text = check(page.render([unknown_result("weighing", simulated=True), unknown_result("weighing")]))
    assert "model, error, near" in text and "0.25" in text and "simulated" in text and "cd" * 32 in text
    assert "1. weighing: graph net" in text and "2. weighing: graph net" in text


@pytest.mark.parametrize("task", ["page", "blocks", "", "material.methods"])
def test_a_task_named_like_a_module_of_the_page_is_one_without_a_specification(task: str) -> None:
    assert "counts, trials" in check(page.render([unknown_result(task)]))


@pytest.fixture
def weighing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The task of the plug-in of a third party, as its entry point gives it."""
    (tmp_path / "toy.egg-info").mkdir()
    (tmp_path / "toy_task.py").write_text(TOY_TASK)
    (tmp_path / "toy.egg-info" / "entry_points.txt").write_text("[tacpipe.tasks]\nweighing = toy_task:Weighing\n")
    with monkeypatch.context() as paths:
        paths.syspath_prepend(tmp_path)
        paths.syspath_prepend(PLUGIN)
        forget()
        yield
    forget()


def weigh(name: str, off: float, seed: int = 0) -> Any:
    weights = [f"w{place}" for place in range(9)]
    model = {thing: off + 0.01 * place for place, thing in enumerate(weights)}
    errors = {"model": model, "mean_weight": dict.fromkeys(weights, 1.0)}
    config = {"task": "weighing", "architecture": name, "params": {"springs": 2}, "seed": seed}
    files = {"metrics.json": {}, "config.json": config, "errors.json": errors}
    return FakeDataset(
        {}, {path: json.dumps(content).encode() for path, content in files.items()}, result_fakes.MANIFEST
    )


@pytest.mark.usefixtures("weighing")
def test_a_third_partys_task_gets_the_same_page_by_its_specification() -> None:
    content = page.render([weigh("scale", 0.54), weigh("scale", 0.56, seed=1), weigh("spring", 1.5)])
    text = check(content)
    assert "Weights of things" in text and "light things" in text and "mean weight" in text
    assert '<p class="answer better">' in content.decode() and "tacpipe view DATASET w8" in content.decode()
    (compared,) = engine.compare([weigh("scale", 0.54), weigh("scale", 0.56, seed=1), weigh("spring", 1.5)])
    assert [(compared_method.name, compared_method.runs) for compared_method in compared.models] == [
        ("scale", 2),
        ("spring", 1),
    ]
    assert compared.models[0].gain.mean == pytest.approx(1 - 0.59)


def test_the_documentation_shows_that_very_specification() -> None:
    page_text = (PLUGIN.parents[1] / "docs" / "howto" / "report.md").read_text()
    assert (PLUGIN / "toy_report.py").read_text() in page_text


def test_what_is_not_a_result_is_refused() -> None:
    with pytest.raises(TacpipeError, match=r"no metrics\.json"):
        page.render([dataset()], title="t")


def test_a_dataset_that_no_task_on_the_page_can_use_is_refused() -> None:
    with pytest.raises(TacpipeError, match=r"no metrics\.json"):
        page.render([result_fakes.result(), material_fakes.recorded()], title="t")


def test_the_policy_of_a_page_permits_its_own_scripts_and_style_and_nothing_else() -> None:
    content = page.render(all_results()).decode()
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', content)
    directives = dict(part.strip().split(" ", 1) for part in html.unescape(policy).split(";"))
    texts = {
        "script-src": re.findall(r"<script>(.*?)</script>", content, re.DOTALL),
        "style-src": re.findall(r"<style>(.*?)</style>", content, re.DOTALL),
    }
    assert [len(found) for found in texts.values()] == [2, 1]
    for name, found in texts.items():
        digests = {base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in found}
        assert set(directives.pop(name).split()) == {f"'sha256-{digest}'" for digest in digests}
    assert directives == {
        "default-src": "'none'", "img-src": "data:", "base-uri": "'none'", "form-action": "'none'"
    }  # fmt: skip


def test_text_that_looks_like_markup_stays_text() -> None:
    name = "</script><b>& `rm x`"
    spec: Spec = {"data": {"values": [{"name": name, "x": 1.5}]}, "mark": {"type": "point"}}
    section = Section(
        "t",
        name,
        name,
        chart=Chart(name, spec, name),
        folds=[Fold(name, [SmallPrint(name), table(name, [name], [[name]])])],
    )
    content = page.page([section], name)
    assert name.replace("`", "") in check(content).replace("`", "")
    (data,) = re.findall(r'application/json">(.*?)</script>', content.decode())
    assert json.loads(data)["data"]["columns"]["name"]["of"] == [name]


def test_a_number_that_is_not_defined_cannot_enter_a_chart() -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        page.page([Section("t", "t", "", chart=Chart("t", {"data": {"values": [{"x": float("nan")}]}}))], "t")
