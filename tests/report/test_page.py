"""One page for results of all tasks."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tacpipe.errors import TacpipeError
from tacpipe.report import page
from tests.fake_recordings import FakeDataset, FakeShard, dataset
from tests.report import elements
from tests.report.forward import result_fakes
from tests.report.material import material_fakes
from tests.stages.learning_fakes import motion


def other(task: str, **attributes: Any) -> Any:
    """A result of a task that the page knows nothing about."""
    files = {
        "metrics.json": json.dumps(
            {"model": {"error": {"near": 0.25, "far": None}}, "counts": {"trials": 12}}
        ).encode(),
        "config.json": json.dumps({"task": task, "architecture": "graph_net"}).encode(),
    }
    shards = {"r": FakeShard("r", motion(1).content, attributes)} if attributes else {}
    return FakeDataset(shards, files, result_fakes.MANIFEST)


def test_each_task_tells_of_its_own_results_in_the_order_in_which_they_come() -> None:
    material = material_fakes.result("minirocket", wrong={"biotac": 1})
    text = page.render([material, other("touch"), result_fakes.result()], title="a <b>").decode()
    elements.check(text)
    places = [text.index(told) for told in ("<h2>MiniRocket", "<h2>touch: graph net", "<h2>forward: recurrent")]
    assert places == sorted(places)
    assert "<h1>a &lt;b&gt;</h1>" in text


def test_a_task_without_a_part_of_its_own_has_its_numbers_told_by_name_and_where_they_come_from() -> None:
    text = page.render([other("touch", simulated=True)], title="t").decode()
    elements.check(text)
    assert elements.cells(text, "model, error, near") == ["0.25"]
    assert elements.cells(text, "model, error, far") == ["–"]
    assert elements.cells(text, "counts, trials") == ["12"]
    assert '<span class="badge">simulated</span>' in text
    assert "cd" * 32 in text


def test_several_results_of_such_a_task_are_numbered() -> None:
    text = page.render([other("touch"), other("touch")], title="t").decode()
    assert "<h2>1. touch: graph net" in text and "<h2>2. touch: graph net" in text


@pytest.mark.parametrize("task", ["page", "markup", "", "material.methods"])
def test_a_task_named_like_a_module_of_the_page_is_one_without_a_part_of_its_own(task: str) -> None:
    assert elements.cells(page.render([other(task)], title="t").decode(), "counts, trials") == ["12"]


def test_what_is_no_result_is_refused() -> None:
    with pytest.raises(TacpipeError, match=r"no metrics\.json"):
        page.render([dataset()], title="t")


@pytest.mark.usefixtures("undrawn")
def test_a_dataset_that_no_task_on_the_page_can_use_is_refused() -> None:
    material = material_fakes.result("minirocket", wrong={"biotac": 1})
    page.render([material, material_fakes.recorded()], title="t")
    page.render([result_fakes.result(), result_fakes.codec(8)], title="t")
    for one, besides in ((material, result_fakes.codec(8)), (result_fakes.result(), material_fakes.recorded())):
        with pytest.raises(TacpipeError, match=r"no metrics\.json"):
            page.render([one, besides], title="t")
