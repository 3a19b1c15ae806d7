"""The whole part of the page that tells of materials."""

from __future__ import annotations

from html import unescape
from typing import Any

import pytest

from tacpipe.report import page
from tacpipe.report.material import wording
from tests.fake_recordings import FakeDataset
from tests.report import elements
from tests.report.material import material_fakes
from tests.report.material.material_fakes import result

BOTH = {"biotac": 1, "roboskin": 2}
PARTNERS = {1: 2, 2: 3, 3: 4, 4: 1}


def everything(simulated: bool = False) -> list[Any]:
    level = {"mean_level": {"biotac": 4, "roboskin": 8}, "permuted_labels": {"biotac": 15, "roboskin": 20}}
    joint = {**level, "swapped": BOTH, "last_epoch": BOTH}
    kind: dict[str, Any] = {"simulated": simulated}
    found = []
    for fold in (0, 1):
        found += [
            result("minirocket", wrong=BOTH, also=level, fold=fold, **kind),
            result("minirocket", wrong=BOTH, train=dict.fromkeys(BOTH, 64), fold=fold, **kind),
            result("x-lstm", wrong=BOTH, fold=fold, epochs=3, **kind),
            result(wrong={"biotac": 2 + fold}, fold=fold, epochs=3, **kind),
            result(wrong={"roboskin": 3}, fold=fold, epochs=3, **kind),
            result(wrong=BOTH, also=joint, joint=True, fold=fold, epochs=3, **kind),
            result(
                wrong=BOTH, also=joint, joint=True, pairing="permuted", partners=PARTNERS, fold=fold, epochs=3, **kind
            ),
            result(wrong={"roboskin": 3}, known="biotac", fold=fold, epochs=3, **kind),
        ]
    found.append(result(wrong=BOTH, joint=True, reduce="biotac", ratio=25, shuffle=False, epochs=3, **kind))
    return found


def test_the_page_is_whole_and_the_same_results_give_the_same_bytes() -> None:
    given = [*everything(), material_fakes.recorded()]
    text = page.render(given, title="t")
    elements.check(text.decode())
    assert text == page.render(given, title="t")


@pytest.mark.usefixtures("undrawn")
def test_the_page_tells_all_that_there_is() -> None:
    text = page.render([*everything(), material_fakes.recorded()], title="t").decode()
    for told in (
        "8 methods in 17 results",
        "Table I in",
        "Table II in",
        "Table III in",
        "Paired comparisons",
        "Few slides",
        "Figure 5",
        "Figure 6",
        "Figure 9",
        "Figure 10",
        "label-driven",
        "All 17 runs",
        "20 slides of BioTac after training on 64, 160 and 576",
        "cd" * 32,
    ):
        assert told in text, told


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("simulated", [False, True])
def test_every_table_of_accuracies_says_what_they_cannot_show(simulated: bool) -> None:
    text = page.render(everything(simulated), title="t").decode()
    accuracies = text.count("<h4>") - text.count("<h4>Stages")
    said, other = (wording.SIMULATED, wording.SESSIONS) if simulated else (wording.SESSIONS, wording.SIMULATED)
    assert text.count(said) >= accuracies
    assert other not in text
    assert ('<span class="badge">simulated</span>' in text) == simulated


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("simulated", [False, True])
def test_a_labs_own_slides_get_nothing_that_the_paper_says_of_its_own(simulated: bool) -> None:
    level = {"mean_level": {"biotac": 4, "roboskin": 8}, "swapped": BOTH}
    how: dict[str, Any] = {"published": False, "simulated": simulated, "sessions": 2}
    given = [
        result("minirocket", wrong=BOTH, also=level, **how),
        result(wrong=BOTH, also=level, joint=True, epochs=3, **how),
        result(wrong=BOTH, also=level, joint=True, reduce="biotac", ratio=25, epochs=3, **how),
    ]
    slides = material_fakes.recorded()
    for shard in slides.recordings.values():
        del shard.attributes["published"]
    text = unescape(page.render([*given, slides], title="").decode()).partition("</style>")[2]
    for told in ("paper", "192 slides", "one session", "mapping to known space", "X-LSTM", "Figure 5", "Materials are"):
        assert told not in text, told
    assert "<h4>Accuracy (%)</h4>" in text and "Force on BioTac" in text
    assert "<h1>Recognition of materials by touch</h1>" in text


@pytest.mark.parametrize(("sessions", "told"), [(1, True), (2, False)])
def test_that_each_material_has_one_session_is_said_where_it_is_so(sessions: int, told: bool) -> None:
    given = result("minirocket", wrong=BOTH, published=False, sessions=sessions)
    assert (wording.SESSIONS in page.render([given], title="t").decode()) == told


def test_one_result_alone_is_told_without_comparisons() -> None:
    text = page.render([result("minirocket", wrong={"biotac": 1})], title="t").decode()
    elements.check(text)
    assert "<h2>MiniRocket</h2>" in text
    assert "Paired comparisons" not in text


def test_results_that_are_all_variants_need_no_table_1() -> None:
    text = page.render(
        [result(wrong=BOTH, labels="permuted"), result(wrong=BOTH, joint=True, pairing="permuted")], title="t"
    )
    elements.check(text.decode())
    assert b"Table I in" not in text


def test_a_result_without_unseen_slides_is_told_as_its_metrics_name_it() -> None:
    given = result("minirocket", wrong=BOTH, metrics={"seen": {"n": 7}})
    bare: Any = FakeDataset({}, given.files, given.manifest)
    text = page.render([bare], title="t").decode()
    assert elements.cells(text, "seen, n") == ["7"]
