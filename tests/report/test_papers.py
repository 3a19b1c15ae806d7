"""The numbers that papers print, next to ours."""

from tacpipe.report.papers import read_papers
from tests.report import parts
from tests.tasks.forward.report import result_fakes
from tests.tasks.material.report import material_fakes
from tests.tasks.touch.report import touch_fakes

TITLE = "The paper's own numbers"
BOTH = {"biotac": 1, "roboskin": 2}


def test_every_number_has_a_name_of_its_own_a_unit_and_a_source() -> None:
    for paper in read_papers().values():
        keys = [(printed.name, printed.unit, printed.source) for printed in paper.numbers]
        assert len(set(keys)) == len(keys) and all(all(key) for key in keys) and paper.paper and paper.note


def test_ours_is_the_number_of_the_same_method_on_the_same_question() -> None:
    swapped = {"swapped": {"biotac": 3, "roboskin": 2}}
    section = parts.section(
        "material",
        material_fakes.result(wrong=BOTH, joint=True, also=swapped),
        material_fakes.result(wrong={"biotac": 5}, joint=True, subsample_sensor="roboskin", subsample_percent=11),
    )
    tables = parts.tables([parts.folds(section)[TITLE]])
    assert parts.cells(tables, "RAEC joint, BioTac") == ["96.01", "95 | RAEC joint", "%", "Table I"]
    assert parts.cells(tables, "X-LSTM, BioTac")[:2] == ["94.5", "–"]
    exchanged = parts.cells(tables, "RAEC joint, classifiers exchanged, BioTac")
    assert exchanged[:2] == ["95.31", "85 | RAEC joint · classifiers exchanged"]
    reduced = parts.cells(tables, "RAEC joint, 11 % of RoboSkin, BioTac")
    assert reduced[:2] == ["96.88", "75 | RAEC joint · RoboSkin 11 %"]


def test_numbers_without_a_column_have_none_of_ours_and_may_have_a_deviation() -> None:
    section = parts.section("touch", touch_fakes.result("pointnet", off=0.04, novel=touch_fakes.NOVEL))
    tables = parts.tables([parts.folds(section)[TITLE]])
    assert parts.cells(tables, "test, PDC thumb")[:2] == ["0.05496", "0.04 | PointNet"]
    assert parts.cells(tables, "novel objects, PDC thumb")[:2] == ["0.08289", "0.04 | PointNet"]
    assert parts.cells(tables, "head FC1: 1024")[:2] == ["0.02598 ± 0.00043", "–"]


def test_a_number_may_be_that_of_a_column_of_the_task() -> None:
    section = parts.section("forward", result_fakes.result("PCA-20", ratio=0.5))
    tables = parts.tables([parts.folds(section)[TITLE]])
    assert parts.cells(tables, "PCA, test")[:2] == ["0.0363", "1 | recurrent · PCA-20"]


def test_a_labs_own_recordings_have_no_numbers_of_a_paper() -> None:
    section = parts.section("material", material_fakes.result(wrong=BOTH, joint=True, published=False))
    assert TITLE not in parts.folds(section) and "paper" not in parts.words(section)
