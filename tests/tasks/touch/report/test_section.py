"""The whole section of touch, and the numbers that go into its charts."""

import io
import json
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from scipy import stats

from tacpipe.channels import biotac_sp
from tacpipe.report import context
from tacpipe.report.blocks import Fold, Section
from tacpipe.tasks.touch import headline as headlines
from tests.fake_recordings import FakeDataset
from tests.report import parts
from tests.tasks.touch.report.touch_fakes import NOVEL, result

BASELINES = {"object_mean": 0.08, "nearest_in_time": 0.09}
FULL: dict[str, Any] = {"novel": NOVEL, "baselines": BASELINES}


def touch(*results: Any, **options: Any) -> Section:
    return parts.section("touch", *results, **options)


@pytest.fixture(scope="module")
def full_section() -> Section:
    return touch(
        *(result(seed=seed, **FULL) for seed in (0, 1)),
        result("trees", off=0.06, **FULL),
        result("pointnet", off=0.07, epochs=4, **FULL),
        result("pointnet", head="fc1", targets=("pdc_th",), epochs=4, **FULL),
    )


def test_the_first_screen_has_a_row_a_target_on_known_and_on_novel_objects(full_section: Section) -> None:
    assert full_section.table is not None
    assert [parts.text(row.cells[0]) for row in full_section.table.rows] == [
        headlines.TARGETS[item] for item in biotac_sp.TARGETS
    ]
    assert len(full_section.table.heads) == 7
    assert full_section.counts[:2] == ["4 methods", "5 results"]


def test_all_that_there_is_has_its_fold(full_section: Section) -> None:
    assert list(parts.folds(full_section)) == [
        "All methods and baselines", "Effects of settings", "The paper's own numbers", "Predicted and measured",
        "By object", "Training", "Recordings", "Every run", "Basis and limits", "Where it comes from",
    ]  # fmt: skip
    text = parts.words(full_section)
    for sentence in ("PDC thumb, novel objects: tree-ensemble", "Table IV", "Figure 11", "cd" * 32):
        assert sentence in text, sentence


def test_the_verdict_is_better_only_where_every_target_is() -> None:
    known_section = touch(result(baselines={"object_mean": 0.2}))
    assert known_section.verdict == "better" and "24 grasps" in known_section.sentence
    assert touch(result(baselines={"object_mean": 0.04})).verdict == "worse"
    fake_result = result(baselines={"object_mean": 0.04})
    one_target = result(targets=("pdc_th",), baselines={"object_mean": 0.04})
    rows = fake_result.recordings["predictions"].tables
    rows["object_mean"] = one_target.recordings["predictions"].tables["object_mean"]  # readings of one target
    mixed = touch(fake_result)
    assert mixed.verdict == "unclear"
    assert mixed.sentence.index("better") < mixed.sentence.index("worse") < mixed.sentence.index("PDC thumb")


@pytest.mark.parametrize("simulated", [False, True])
def test_a_labs_own_grasps_get_nothing_that_the_paper_states_of_its_own(simulated: bool) -> None:
    options: dict[str, Any] = {"published": False, "simulated": simulated}
    section = touch(
        result(**options, **FULL),
        result("pointnet", off=0.07, epochs=4, **options, **FULL),
        *(result("pointnet", head=head, targets=("pdc_th",), epochs=4, **options, **FULL) for head in ("fc1", "fc2")),
        *(result("pointnet", inputs=item, targets=("pdc_th",), epochs=4, **options) for item in ("xyz", "rgbpose")),
    )
    text = parts.words(section)
    for sentence in ("paper", "9,000 grasps", "FC6"):
        assert sentence not in text, sentence
    assert "head: fc1 instead of fc2" in text
    assert (section.simulated, text.count(context.SIMULATED) > 0) == (simulated, simulated)


def test_that_an_objects_grasps_follow_one_another_is_stated_where_they_do() -> None:
    sentence = "of 23 evaluated grasps follow a grasp of the same object in time"
    assert f"21 {sentence}" in parts.words(touch(result(published=False)))
    turns = result(published=False)
    tables = turns.recordings["predictions"].tables
    t_ns = pa.array([index % 8 * 3 + index // 8 for index in range(24)] + [99], pa.int64())
    place = tables["grasps"].column_names.index("t_ns")
    tables["grasps"] = tables["grasps"].set_column(place, "t_ns", t_ns)
    assert sentence not in parts.words(touch(turns))


def test_simulated_results_next_to_recorded_ones_are_questions_of_their_own() -> None:
    section = touch(result(), result(simulated=True))
    text = parts.words(section)
    assert "PDC thumb, known objects, random" in text and "PDC thumb, known objects, random, simulated" in text
    assert context.SIMULATED in text
    assert "simulated" not in section.sentence


def test_one_result_of_one_target_has_nothing_that_it_lacks() -> None:
    section = touch(result("trees", targets=("pdc_mf",), known=(), novel=("drill",)))
    assert "trees on geometry and colour" in section.sentence
    assert "known objects" not in parts.words(section)


def test_a_result_without_unseen_grasps_is_reported_as_its_metrics_name_it() -> None:
    fake_result = result(metrics={"seen": {"n": 7}})
    bare: Any = FakeDataset({}, fake_result.files, fake_result.manifest)
    assert parts.cells(parts.tables(touch(bare)), "seen, n") == ["7"]


PINBALL = {"model": 3.0, "constant": 4.0, "object_mean": 3.5}
OBJECTS = ("bleach", "coffee", "drill", "shoe")  # the first two are known


def rows(seed: int = 0) -> pd.DataFrame:
    """A row a value of ten grasps an object; of electrode 3 of the thumb the model's band holds none."""
    rng = np.random.default_rng(seed)
    values = [
        {
            **{"recording": f"{name}-{grasp:03d}", "object": name, "known": name in OBJECTS[:2]},
            **{"predictor": predictor, "target": target, "value": value},
            "covered": bool(rng.random() < 0.7) and (predictor, target, value) != ("model", "e_th", 3),
            "width": np.float32(90.0 if predictor == "model" else 180.0),
            "pinball": np.float32(pinball),
        }
        for name in OBJECTS
        for grasp in range(10)
        for predictor, pinball in PINBALL.items()
        for target in biotac_sp.TARGETS
        for value in range(1, biotac_sp.width(target) + 1)
    ]
    return pd.DataFrame(values)


def calibrate(seed: int = 0, **options: Any) -> Any:
    base = result(novel=OBJECTS[2:], seed=seed, **options)
    config = {**json.loads(base.files["config.json"]), "quantiles": {"levels": [10, 50, 90]}}
    file = io.BytesIO()
    rows(seed).to_parquet(file)
    return FakeDataset(
        base.recordings,
        {**base.files, "config.json": json.dumps(config).encode(), "coverage.parquet": file.getvalue()},
        base.manifest,
    )


def folds(*results: Any) -> list[Fold]:
    return [
        section_fold for section_fold in parts.section("touch", *results).folds if section_fold.title == "Uncertainty"
    ]


def test_the_part_has_the_coverage_by_target_of_known_and_novel_objects() -> None:
    (uncertainty_fold,) = folds(calibrate(), calibrate(1))
    known, novel = parts.charts([uncertainty_fold])
    assert [chart.title for chart in (known, novel)] == [
        "Coverage of the 10 to 90 % band: tree-ensemble, known objects",
        "Coverage of the 10 to 90 % band: tree-ensemble, novel objects",
    ]
    assert {row["panel"] for row in parts.values(known)} == set(headlines.TARGETS.values())
    assert {row["level"] for row in parts.values(known)} == {80.0}
    table, novel_table = parts.tables([uncertainty_fold])
    assert len(table.rows) == len(novel_table.rows) == 4 * 3
    cells = [getattr(cell, "text", cell) for cell in table.rows[0].cells]
    assert cells[:2] == ["PDC thumb: model", "40"]
    assert cells[3:] == ["90", "3", "25"]  # counts, and 3 against 4


def test_coverage_is_pooled_over_runs_and_certain_by_grasp_or_by_novel_object() -> None:
    runs = pd.concat([rows(0), rows(1)])
    tables = parts.tables(folds(calibrate(), calibrate(1)))
    for is_known, table in zip((True, False), tables, strict=True):
        model_rows = runs[(runs.known == is_known) & (runs.target == "e_mf") & (runs.predictor == "model")]
        means = model_rows.groupby("recording" if is_known else "object").covered.mean().to_numpy()
        cell = parts.cells(table, "electrodes middle finger: model")[1]
        assert cell.startswith(f"{100 * model_rows.covered.mean():.0f}")
        if is_known:
            low, high = stats.t.interval(0.95, len(means) - 1, means.mean(), stats.sem(means))
            ends = [float(end) for end in cell.split(" | ")[1].split(" to ")]
            assert 100 * low - 2 < ends[0] < 100 * low + 0.5 and 100 * high - 0.5 < ends[1] < 100 * high + 2
        else:
            assert "|" not in cell  # two objects show nothing of how much objects vary


def test_every_target_is_drawn_as_predicted_against_measured_with_novel_objects_marked() -> None:
    section = touch(result(novel=NOVEL, targets=("pdc_mf", "e_mf")))
    pressure, electrodes = parts.charts([parts.folds(section)["Predicted and measured"]])
    assert pressure.title == "PDC middle finger" and pressure.caption.startswith("40 of 40 values")
    assert {row["shape"] for row in parts.values(pressure) if row["name"] == "drill"} == {"novel objects"}
    assert len(parts.values(electrodes)) == 800 and electrodes.caption.startswith("800 of 960 values")


def test_results_without_quantiles_have_no_such_part() -> None:
    assert folds(result()) == []
    assert "quantiles" not in json.loads(result().files["config.json"])
