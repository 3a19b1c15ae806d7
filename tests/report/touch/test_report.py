"""The page as a whole."""

from __future__ import annotations

from html import unescape
from typing import Any

import pyarrow as pa
import pytest

from tacpipe.report import page
from tacpipe.report.touch import wording
from tests.fake_recordings import FakeDataset
from tests.report import elements
from tests.report.touch.touch_fakes import NOVEL, recorded, result

BASELINES = {"object_mean": 0.08, "nearest_in_time": 0.09}
FULL: dict[str, Any] = {"novel": NOVEL, "baselines": BASELINES}


def everything(simulated: bool = False) -> list[Any]:
    return [
        *(result(seed=seed, simulated=simulated, **FULL) for seed in (0, 1)),
        result("trees", off=0.06, simulated=simulated, **FULL),
        result("pointnet", off=0.07, epochs=4, simulated=simulated, **FULL),
        result("pointnet", head="fc1", targets=("pdc_th",), epochs=4, simulated=simulated, **FULL),
    ]


@pytest.mark.long
def test_all_parts_are_told_on_one_page_that_is_the_same_each_time() -> None:
    given = [*everything(), recorded()]
    told = page.render(given, title="t")
    assert told == page.render(given, title="t")
    text = told.decode()
    elements.check(text)
    for part in (
        "4 methods in 5 results",
        "Known objects:",
        "Novel objects:",
        "PDC thumb, known objects",
        "electrodes middle finger, novel objects",
        "By object, tree-ensemble",
        "R² of each electrode on novel objects",
        "Worst decile by error",
        "Clouds and their grasps",
        "Table I in",
        "Figures 10 and 11 in",
        "Figure 8 in",
        "All 5 runs",
        "cd" * 32,
    ):
        assert part in text, part


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("simulated", [False, True])
def test_the_page_says_what_its_errors_cannot_show(simulated: bool) -> None:
    text = unescape(page.render(everything(simulated), title="t").decode())
    recorded_so = wording.RECORDED.partition("} evaluated")[2][:60]
    assert (wording.SIMULATED in text) == simulated
    assert (recorded_so in text) == (not simulated)
    assert ('<span class="badge">simulated</span>' in text) == simulated


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("simulated", [False, True])
def test_a_labs_own_grasps_get_nothing_that_the_paper_says_of_its_own(simulated: bool) -> None:
    how: dict[str, Any] = {"published": False, "simulated": simulated}
    given = [
        result(**how, **FULL),
        result("pointnet", off=0.07, epochs=4, **how, **FULL),
        *(result("pointnet", head=head, targets=("pdc_th",), epochs=4, **how, **FULL) for head in ("fc1", "fc2")),
        *(result("pointnet", inputs=one, targets=("pdc_th",), epochs=4, **how) for one in ("xyz", "rgbpose")),
    ]
    text = unescape(page.render(given, title="").decode()).partition("</style>")[2]
    for told in ("paper", "RGBPose, trained on", "recorded together", "9,000 grasps", "FC6"):
        assert told not in text, told
    assert "<h3>What settings change</h3>" in text and "Number of hidden layers of the head" in text
    assert "<h1>Prediction of fingertip readings from point clouds</h1>" in text


def test_that_an_objects_grasps_follow_one_another_is_said_where_they_do() -> None:
    told = "of 23 evaluated grasps follow one of the same object in time"
    assert f"21 {told}" in page.render([result(published=False)], title="t").decode()
    turns = result(published=False)
    tables = turns.recordings["predictions"].tables
    t_ns = pa.array([index % 8 * 3 + index // 8 for index in range(24)] + [99], pa.int64())
    place = tables["grasps"].column_names.index("t_ns")
    tables["grasps"] = tables["grasps"].set_column(place, "t_ns", t_ns)
    assert told not in page.render([turns], title="t").decode()


def test_simulated_results_beside_recorded_ones_are_marked_and_kept_apart() -> None:
    text = page.render([result(), result(simulated=True)], title="t").decode()
    elements.check(text)
    assert text.count('<span class="badge">simulated</span>') == 1
    assert "What is marked simulated is not evidence about a real sensor." in text
    assert text.count("<h4>PDC thumb, known objects") == 2


def test_one_result_of_one_target_is_told_without_what_it_lacks() -> None:
    text = page.render([result("trees", targets=("pdc_mf",), known=(), novel=("drill",))], title="t").decode()
    elements.check(text)
    assert "<h2>trees on geometry and colour</h2>" in text
    text = unescape(text)
    for lacking in ("in the paper's form", "Electrodes", "Clouds and", "known objects</h4>"):
        assert lacking not in text, lacking


def test_a_result_without_a_constant_is_told_without_skill() -> None:
    given = result()
    del given.recordings["predictions"].tables["constant"]
    elements.check(page.render([given], title="t").decode())


def test_a_result_without_unseen_grasps_is_told_as_its_metrics_name_it() -> None:
    given = result(metrics={"seen": {"n": 7}})
    bare: Any = FakeDataset({}, given.files, given.manifest)
    text = page.render([bare], title="t").decode()
    assert elements.cells(text, "seen, n") == ["7"]
