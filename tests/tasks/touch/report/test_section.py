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
from tacpipe.comparison.runs import Method
from tacpipe.report import context
from tacpipe.report.blocks import Charts, Fold, Section, Table
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch import report
from tacpipe.tasks.touch.report import NO_EVIDENCE, figures
from tacpipe.tasks.touch.report.methods import TouchResult
from tests.fake_recordings import FakeDataset
from tests.report import parts
from tests.tasks.touch.report.touch_fakes import NOVEL, recorded, result

BASELINES = {"object_mean": 0.08, "nearest_in_time": 0.09}
FULL: dict[str, Any] = {"novel": NOVEL, "baselines": BASELINES}
APART = {"bleach": 0.05, "coffee": 0.05, "spam": 0.05}
MANY = tuple("abcdef")


def methods(*results: Any) -> list[Method]:
    return parts.methods("touch", *results)


def touch(*results: Any, **options: Any) -> Section:
    return parts.section("touch", *results, **options)


@pytest.fixture(scope="module")
def full_section() -> Section:
    return touch(
        *(result(seed=seed, **FULL) for seed in (0, 1)),
        result("trees", off=0.06, **FULL),
        result("pointnet", off=0.07, epochs=4, **FULL),
        result("pointnet", head="fc1", targets=("pdc_th",), epochs=4, **FULL),
        others=[recorded()],
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
        "All methods and baselines", "The pressure, predicted and true", "Electrodes", "Clouds and their grasps",
        "The paper's tables and figures", "By object", "Training", "Recordings", "Every run",
        "Basis and limits", "Where it comes from",
    ]  # fmt: skip
    text = parts.words(full_section)
    for sentence in ("R² of each electrode, novel objects", "worst decile by error", "Table I in", "Figures 10 and 11 in",
                 "Figure 8 in", "By object, tree-ensemble", "cd" * 32):  # fmt: skip
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


def test_where_nothing_is_better_than_the_baselines_on_novel_objects_it_is_stated() -> None:
    worse = {**APART, **dict.fromkeys(MANY, 0.12)}
    section = touch(result(off=worse, novel=MANY), result("trees", off=0.11, novel=MANY))
    assert NO_EVIDENCE in section.sentence and section.verdict != "better"
    evident = touch(result(off=worse, novel=MANY), result("trees", off=0.05, novel=MANY, targets=("pdc_th",)))
    assert NO_EVIDENCE not in evident.sentence
    assert NO_EVIDENCE not in touch(result()).sentence


@pytest.mark.parametrize("novel", [("drill",), NOVEL, tuple("abcde")])
def test_a_gain_on_few_novel_objects_is_no_evidence(novel: tuple[str, ...]) -> None:
    section = touch(result(off=0.01, novel=novel))
    assert "too few" in section.sentence and NO_EVIDENCE in section.sentence and section.verdict == "unclear"


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
    for sentence in ("paper", "RGBPose, trained on", "9,000 grasps", "FC6"):
        assert sentence not in text, sentence
    assert "Number of hidden layers of the head" in text
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
    assert "Results marked as simulated are not evidence about real sensors." in text
    assert "simulated" not in section.sentence


def test_one_result_of_one_target_has_nothing_that_it_lacks() -> None:
    section = touch(result("trees", targets=("pdc_mf",), known=(), novel=("drill",)))
    assert "trees on geometry and colour" in section.sentence
    assert not {"Electrodes", "Clouds and their grasps", "The paper's tables and figures"} & set(parts.folds(section))
    assert "known objects" not in parts.words(section)


def test_a_result_without_a_constant_has_no_skill() -> None:
    fake_result = result()
    del fake_result.recordings["predictions"].tables["constant"]
    section = touch(fake_result)
    table = parts.tables([parts.folds(section)["All methods and baselines"]])[0]
    assert parts.cell(table, "tree-ensemble", "skill over the constant") == "–"
    assert section.verdict == ""


def test_a_result_without_unseen_grasps_is_reported_as_its_metrics_name_it() -> None:
    fake_result = result(metrics={"seen": {"n": 7}})
    bare: Any = FakeDataset({}, fake_result.files, fake_result.manifest)
    assert parts.cells(parts.tables(touch(bare)), "seen, n") == ["7"]


def test_grasps_are_chosen_by_their_error_whatever_the_order_of_rows() -> None:
    names = [f"object{number:02d}" for number in range(11)]
    off = {name: 0.01 * (11 - number) for number, name in enumerate(names)}
    fake_result = result(off=off, known=names, per_object=1)
    chosen = figures.choose_grasps(TouchResult(fake_result).predictions)
    assert [(item.place, item.recording) for item in chosen] == [
        ("median", "object05-000"),
        ("best decile", "object09-000"),
        ("worst decile", "object01-000"),
    ]
    assert [item.error for item in chosen] == pytest.approx([0.06, 0.02, 0.10], abs=1e-5)
    shard = fake_result.recordings["predictions"]
    back = list(range(len(names)))[::-1]
    shard.tables = {name: table.take(back) for name, table in shard.tables.items()}
    assert [item.recording for item in figures.choose_grasps(TouchResult(fake_result).predictions)] == [
        item.recording for item in chosen
    ]


def test_electrodes_are_drawn_where_they_are_with_their_values_and_errors_in_counts() -> None:
    (method,) = methods(result(off=0.05, novel=NOVEL))
    drawn = parts.charts(figures.electrode_folds(method))
    assert len(drawn) == 5  # R² on known and novel objects, three grasps
    assert (
        "RMSE 0.0500 of the range" in drawn[2].caption
        and "thumb 175 counts, middle finger 165 counts" in drawn[2].caption
    )
    at = {row["Electrode"]: (row["x"], row["y"]) for row in parts.values(drawn[0]) if row["panel"] == "thumb"}
    # 1 and 11 mirror each other, 10 lies nearer the palm than 1, 21 nearer the tip than 24 on the midline
    assert at[1][0] == pytest.approx(-at[11][0], abs=0.01) and at[1][1] == pytest.approx(at[11][1], abs=0.01)
    assert at[1][1] > at[10][1] and at[21][1] > at[24][1]
    panels = {row["panel"] for row in parts.values(drawn[2])}
    assert panels == {"thumb, true", "thumb, predicted", "middle finger, true", "middle finger, predicted"}
    assert figures.electrode_folds(methods(result(targets=("pdc_th",)))[0]) == []


def test_pressures_are_drawn_for_the_fingers_that_are_predicted() -> None:
    (method,) = methods(result(novel=NOVEL, targets=("pdc_mf", "e_mf")))
    (chart,) = parts.charts(figures.pressure_folds(method))
    assert chart.title == "PDC middle finger" and "40 unseen grasps" in chart.caption
    assert len(parts.values(chart)) == 40 and "drill (novel)" in {row["name"] for row in parts.values(chart)}


def test_a_cloud_is_drawn_with_its_grasp_and_the_chosen_ones_first() -> None:
    (chart,) = parts.charts(figures.cloud_folds([recorded()], {"drill-002": "median by error", "elsewhere": "best"}))
    assert chart.title == "drill-002 (median by error): drill"
    assert chart.caption == "2,000 points, the fingers 70 mm apart."
    assert len(parts.values(chart)) == 2 * (figures.POINTS + 2)  # two views, and both contacts in each
    assert len(parts.charts(figures.cloud_folds([recorded()], {}))) == 2
    assert figures.cloud_folds([], {"drill-002": "median"}) == []


def test_a_dataset_without_clouds_or_grasps_is_not_read() -> None:
    fake_result = recorded(["a"])
    assert figures.holds_grasps(fake_result)
    shard = fake_result.recordings["a"]
    shard.tables = {name: table for name, table in shard.tables.items() if name != "grasp"}
    assert not figures.holds_grasps(fake_result)


def test_losses_are_of_one_target_and_the_mean_of_its_networks() -> None:
    run = TouchResult(result("pointnet", targets=("pdc_th", "e_th"), epochs=4))
    lines = [
        {"epoch": epoch, "train_loss": loss, "val_loss": None, "target": "all", "network": network}
        for network, losses in enumerate(([4.0, 2.0, 1.0], [2.0, 1.0]))
        for epoch, loss in enumerate(losses, 1)
    ]
    with_networks = TouchResult(run.dataset)
    with_networks.__dict__["history"] = [*run.history, *lines]
    assert figures.losses_by_epoch(with_networks, "all", "train_loss") == [3.0, 1.5]
    assert figures.losses_by_epoch(with_networks, "all", "val_loss") == []
    assert len(figures.losses_by_epoch(with_networks, "e_th", "train_loss")) == 4
    assert figures.losses_by_epoch(with_networks, "pdc_mf", "train_loss") == []


def test_figure_8_is_of_the_papers_network_trained_longest() -> None:
    heads = (("fc3", 3), ("fc1", 8))
    fake_result = [result("pointnet", head=head, epochs=epochs, targets=("pdc_th",)) for head, epochs in heads]
    (chart,) = figures.figure_8(methods(*fake_result, result(epochs=20)))
    assert "PointNet · head fc1" in chart.title and "paper schedule" in chart.caption
    assert figures.figure_8(methods(result(epochs=20))) == []


def test_losses_without_validation_grasps_are_reported_as_such() -> None:
    watched, unwatched = result(epochs=3), result(epochs=3)
    unwatched.files["config.json"] = unwatched.files["config.json"].replace(b'"val": 10', b'"val": 0')
    drawn = [figures.loss_charts(methods(item))[0] for item in (watched, unwatched)]
    assert [figures.UNWATCHED in item.caption for item in drawn] == [False, True]
    assert figures.loss_charts(methods(result())) == []


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


def test_coverage_is_pooled_over_runs_and_certain_by_grasp_or_by_novel_object() -> None:
    runs = pd.concat([rows(0), rows(1)])
    for is_known, cluster in ((True, "recording"), (False, "object")):
        part = runs[runs.known == is_known]
        band = report.measure_bands(part, is_known)["e_mf", "model"]
        model_rows = part[(part.target == "e_mf") & (part.predictor == "model")]
        assert band.values == len(model_rows) == 2 * 2 * 10 * 24
        assert band.coverage[0] == model_rows.covered.mean()
        means = model_rows.groupby(cluster).covered.mean().to_numpy()  # clusters are of one size
        ends = (
            stats.t.interval(0.95, len(means) - 1, means.mean(), stats.sem(means)) if len(means) > 2 else (np.nan,) * 2
        )
        assert band.coverage[1:] == pytest.approx(np.clip(ends, 0, 1), nan_ok=True)
        gains = (0.25, 0.25, 0.25) if len(means) > 2 else (0.25, np.nan, np.nan)
        assert band.gain == pytest.approx(gains, nan_ok=True) and (band.width, band.pinball) == (90, 3)


def test_the_part_has_coverage_by_target_a_table_and_the_electrodes_of_known_and_novel_objects() -> None:
    (uncertainty_fold,) = folds(calibrate(), calibrate(1))
    titles = [chart.title for block in uncertainty_fold.blocks if isinstance(block, Charts) for chart in block.charts]
    assert titles == [
        "Coverage: known objects", "Coverage: novel objects",
        "Coverage of each electrode, known objects", "Coverage of each electrode, novel objects",
    ]  # fmt: skip
    (table,) = [table_block for table_block in uncertainty_fold.blocks if isinstance(table_block, Table)]
    assert len(table.rows) == 2 * 4 * 3
    cells = [getattr(cell, "text", cell) for cell in table.rows[0].cells]
    assert cells[0] == "known objects, PDC thumb: model" and cells[1] == "40"
    assert cells[3:] == ["10", "3", "25"]  # 90 of 900 counts, and 3 against 4


def test_an_electrode_whose_band_holds_nothing_is_drawn_so() -> None:
    (uncertainty_fold,) = folds(calibrate())
    *_, electrodes = [block for block in uncertainty_fold.blocks if isinstance(block, Charts)]
    for chart in electrodes.charts:
        drawn = {(mark["panel"], mark["Electrode"]): mark for mark in chart.spec["data"]["values"]}
        assert len(drawn) == 2 * 24
        assert drawn["thumb", 3]["text"] == "0" and drawn["thumb", 3]["side"] == "b"


def test_results_without_quantiles_have_no_such_part() -> None:
    assert folds(result()) == []
    assert "quantiles" not in json.loads(result().files["config.json"])
