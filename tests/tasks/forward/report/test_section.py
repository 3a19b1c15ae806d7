"""Check the section of forecasts beyond the comparison."""

import json
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tacpipe.comparison.runs import grouped
from tacpipe.report.blocks import Section, SmallPrint
from tacpipe.tasks.forward.report import methods, representations
from tacpipe.tasks.forward.report.skill import situation_folds, skill_in_situation
from tests.fake_recordings import FakeDataset
from tests.report import parts
from tests.tasks.forward.report.result_fakes import MANIFEST, codec, errors, result
from tests.tasks.forward.report.test_reading import RATIO


def forward(*results: Any, **options: Any) -> Section:
    return parts.section("forward", *results, **options)


def result_on_many(ratio: float | dict[str, float], recordings: int = 8, **options: Any) -> Any:
    """A result on as many recordings of known objects, on which ridge has 0.75 of persistence's squared error."""
    plain = result("raw", **options)
    names = {f"r{index}": 20 for index in range(recordings)}
    by_name = dict.fromkeys(names, ratio) if isinstance(ratio, float) else ratio
    ratios = {"model": by_name, "ridge": dict.fromkeys(names, 0.75), "last_value_linear": dict.fromkeys(names, 0.9)}
    content = errors(ratios, names, known_objects_of=tuple(names))
    return FakeDataset(plain.recordings, {**plain.files, "errors.parquet": content}, plain.manifest)


@pytest.mark.parametrize(
    ("ratio", "verdict", "gain"),
    [
        (0.5, "better", "+0.333"),
        (0.8, "worse", "−0.067"),
        ({f"r{index}": (0.5, 1.125)[index % 2] for index in range(8)}, "unclear", "+0.000"),
    ],
)
def test_a_page_is_green_only_where_the_best_baseline_is_beaten_beyond_the_interval(
    ratio: Any, verdict: str, gain: str
) -> None:
    """The model with 0.8 of persistence's error has 20 % less than it, and the intervals of ridge exclude it."""
    for results in ([result_on_many(ratio)], [result_on_many(ratio), result_on_many(ratio, seed=1)]):
        section = forward(*results)
        assert section.verdict == verdict
        assert gain in section.sentence and "ridge" in section.sentence and "8 recordings" in section.sentence


def test_two_recordings_are_too_few_for_a_verdict() -> None:
    section = forward(result("raw", ratio=RATIO))
    assert section.verdict == "" and "2 recordings" in section.sentence


def test_the_table_of_all_methods_holds_errors_skill_and_what_they_rest_on() -> None:
    section = forward(result("raw", 0, ratio=RATIO), result("raw", 1, ratio=1.0), result("PCA-20", ratio=2.0))
    (table,) = [
        table
        for table in parts.tables([parts.folds(section)["All methods and baselines"]])
        if table.title == "known objects"
    ]

    def cells_of(name: str, *heads: str) -> list[str]:
        return [parts.cell(table, name, head).split(" | ")[0] for head in heads]

    # squared skills 0.6875 and 0 pool to 0.34375, ratios of recordings to 0.125 ** 0.25;
    # MAE is twice the step times 0.65625, MSE the mean step times that
    heads: tuple[str, ...] = (
        "MAE t+1",
        "MAE t+3",
        "squared vs persistence",
        "vs persistence",
        "sd over runs",
        "MSE (counts²)",
        "MSE (standardised)",
    )
    assert cells_of("recurrent · raw", *heads) == ["1.312", "3.938", "0.3438", "0.4054", "0.457", "1.312", "1.312"]
    assert cells_of("persistence", *heads)[:4] == ["2", "6", "0", "0"]
    heads = (
        "skill over persistence t+1",
        "skill over persistence, channels standardised",
        "windows",
        "recordings",
        "runs",
    )
    assert cells_of("recurrent · raw", *heads) == ["+0.405", "+0.405", "40", "2", "2"]
    assert [group.title for group in table.groups] == ["", "Baselines", "Oracles, which use the true future"]


def test_methods_of_a_family_fold_behind_the_best_one() -> None:
    section = forward(*(result("raw", params={"hidden": width}, ratio=width / 100) for width in (25, 50, 75)))
    table = parts.tables([parts.folds(section)["All methods and baselines"]])[0]
    first = table.groups[0]
    assert first.folded and [parts.text(row.cells[0]) for row in first.rows] == [
        "recurrent · raw · hidden 25", "recurrent · raw · hidden 50", "recurrent · raw · hidden 75"
    ]  # fmt: skip


def test_the_worth_of_the_plan_is_the_difference_to_a_model_without_it() -> None:
    none = {name: ratio + 0.125 for name, ratio in RATIO.items()}
    section = forward(
        result("raw", ratio=RATIO), result("raw", ratio=none, params={"actions": "none"}), result("PCA-20")
    )
    (table,) = parts.tables([parts.folds(section)["Effects of the plan and the timeline"]])
    cells = [[cell.split(" | ")[0] for cell in parts.cells(table, name)] for name in ("recurrent · raw", "… none")]
    assert cells[0] == ["+0.646", "–", "–", "+0.134", "–", "–", "1"]
    assert cells[1] == ["+0.516", "+0.131", "+0.131", "−0.008", "+0.142", "+0.142", "1"]


def test_timelines_are_next_to_each_other_with_how_long_a_step_lasts() -> None:
    results = [result("raw", seed, ratio=RATIO) for seed in range(2)]
    section = forward(*results, result("raw", ratio=0.25, timeline="fresh", rate_hz=10.0))
    (table,) = parts.tables([parts.folds(section)["Effects of the plan and the timeline"]])
    assert parts.cells(table, "recurrent · raw · fresh (fresh)")[:2] == ["100", "+0.750"]
    assert [cell.split(" | ")[0] for cell in parts.cells(table, "recurrent · raw (uniform)")[:2]] == ["20", "+0.646"]


def test_of_a_labs_own_data_nothing_is_stated_that_the_paper_states_of_its_own() -> None:
    hows: tuple[dict[str, Any], ...] = ({"attributes": {}}, {})
    lab_text, published = (
        parts.words(
            forward(
                *(result(name, seed, **options) for name in ("PCA-20", "AE-C1-8", "raw") for seed in range(2)),
                others=[codec(20)],
            )
        )
        for options in hows
    )
    assert "paper" not in lab_text.lower()
    for phrase in (
        "Table 1 in the paper",
        "in the paper, 20 explain",
        "Figure 5 in the paper",
        "Figure 6 in the paper",
    ):
        assert phrase in published, phrase


def test_table_1_holds_the_papers_numbers_next_to_ours_and_those_not_run() -> None:
    section = forward(result("PCA-20", 0), result("PCA-20", 1), result("PCA-8"))
    table = parts.tables([parts.folds(section)["Representations"]])[0]
    ours = ["0.0150 ± 0.0071", "1.0000 ± 0.0000", "1.0000 ± 0.0000", "2.0000 ± 0.0000", "0.5"]
    assert parts.cells(table, "PCA-20") == [*ours, "0.0298", "0.0363", "2"]
    assert parts.cells(table, "PCA-8") == ["0.0100", "1.0000", "1.0000", "2.0000", "0.5", "–", "–", "1"]
    assert parts.cells(table, "AE-C3") == ["–", "–", "–", "–", "–", "0.0405", "0.0510", "0"]


def test_a_row_of_table_1_has_mean_and_sd_over_runs_in_the_models_own_space() -> None:
    (method,) = grouped(methods.read_runs([result(seed=0, ratio=0.5), result(seed=1, ratio=0.75)]))
    represented = representations.represent_method(method)
    assert represented is not None and represented.known is not None
    assert (represented.validation.mean, represented.validation.sd) == pytest.approx((0.015, 0.01 / np.sqrt(2)))
    assert (represented.test.mean, represented.test.sd) == pytest.approx(
        (1.25, 0.5 / np.sqrt(2))
    )  # ratio times the mean step, 2
    assert represented.known.mean == pytest.approx(1.25)
    assert (represented.persistence.mean, represented.persistence.sd) == pytest.approx((2, 0))
    (method,) = grouped(methods.read_runs([result(validation={"loss": 0.25, "epoch": 3})]))
    represented = representations.represent_method(method)
    assert represented is not None and represented.validation.mean == 0.25  # the recurrent model's loss is that error


def test_in_full_are_the_median_run_of_the_best_method_and_of_the_papers() -> None:
    results = [result("raw", seed, ratio=ratio) for seed, ratio in enumerate((0.5, 0.25, 0.375))]
    section = forward(*results, *(result("PCA-20", seed, ratio=2.0) for seed in range(2)))
    assert [name for name in parts.folds(section) if name.startswith("In full")] == [
        "In full: recurrent · raw", "In full: recurrent · PCA-20"
    ]  # fmt: skip
    table = next(
        table for table in parts.tables([parts.folds(section)["In full: recurrent · raw"]]) if "squared" in table.title
    )
    assert parts.cells(table, "model") == ["0.375", "1.125", "0.75"]  # hidden units of the middle run, times the step


def test_known_and_unseen_objects_are_apart_in_a_single_run() -> None:
    section = forward(result(ratio=RATIO))
    tables = parts.tables([parts.folds(section)["In full: recurrent · PCA-20"]])
    row = parts.cells(tables, "known objects (2 recordings), skill")
    assert row[0] == "+0.625 | +0.525 to +0.725"  # 1 - the mean of 0.5 and 0.25


@pytest.mark.parametrize("has_two_seeds", [False, True])
def test_results_of_a_sensor_in_kilopascal_name_no_count(has_two_seeds: bool) -> None:
    results = [result("raw", seed, attributes={}, inputs={"unit": "kPa"}) for seed in range(2 if has_two_seeds else 1)]
    text = parts.words(forward(*results))
    assert "kPa²" in text and not re.search(r"\bcounts?\b", text.replace("counts, ", ""))


def test_the_number_of_traces_is_the_readers_choice_and_they_are_drawn_in_part() -> None:
    drawn = [parts.charts(forward(result(ratio=RATIO, attributes={}), traces=count)) for count in (0, 1, 2)]
    traces = [[chart for chart in charts if "truth now" in json.dumps(chart.spec)] for charts in drawn]
    assert [len(chart) for chart in traces] == [0, 2, 4]  # two latents a recording


def test_codecs_next_to_results_are_drawn_by_their_width() -> None:
    section = forward(result(ratio=RATIO), others=[codec(2, loss=0.75), codec(4, loss=0.5)])
    (chart,) = [chart for chart in parts.charts(section) if chart.title == "Reconstruction error by number of latents"]
    assert [(row["x"], row["y"]) for row in parts.values(chart)] == [(2, 0.75), (4, 0.5)]
    assert parts.cells(parts.tables([parts.folds(section)["Representations"]]), "PCA")[:2] == ["2", "0.7500"]


def test_the_paper_figures_are_of_its_latents() -> None:
    section = forward(result("PCA-20"), result("AE-C1-8"), result("raw"))
    drawn = [chart.title for chart in parts.charts(section) if chart.title.startswith("Figure")]
    assert [chart.rpartition(" ")[2] for chart in drawn] == ["z00", "z01", "z01", "z03"]


def test_a_result_without_errors_by_recording_is_still_reported_next_to_others() -> None:
    plain: Any = FakeDataset(
        files={"metrics.json": b'{"counts": {"recordings": 0}}', "config.json": b'{"task": "forward"}'},
        manifest=MANIFEST,
    )
    for results in ([plain], [result(), plain]):
        assert parts.cells(parts.tables(forward(*results)), "counts, recordings") == ["0"]


def test_recordings_are_listed_worst_first_with_the_command_to_see_each() -> None:
    section = forward(result("raw", ratio={"r1": 0.5, "r2": 0.25, "r3": 1.5, "r4": 0.5}))
    known_table, unseen_table = parts.tables([parts.folds(section)["Recordings"]])
    assert [parts.text(row.cells[0]) for row in (*known_table.rows, *unseen_table.rows)] == ["r1", "r2", "r3", "r4"]
    first = unseen_table.rows[0].cells[0]
    assert not isinstance(first, str) and first.copy.split()[:2] == ["tacpipe", "view"] and "r3" in first.copy
    assert parts.cell(unseen_table, "r3", "skill") == "−1.000"  # 1.5 next to 0.75


def test_a_page_states_how_far_training_rows_look_ahead_and_of_which_methods() -> None:
    ahead, none = ({"mean_ms": mean, "max_ms": largest} for mean, largest in ((9.5, 26.25), (0.0, 0.0)))
    pages = {
        "one": forward(result("raw", look_ahead=ahead)),
        "both": forward(result("raw", look_ahead=ahead), result("PCA-20", look_ahead=none)),
        "hidden": forward(result("raw", look_ahead=ahead), result("raw", look_ahead=none, params={"hidden": 8})),
        "none": forward(result("raw", look_ahead=none), result("PCA-20")),
    }
    texts = {
        name: [
            note.text
            for note in parts.folds(page)["Basis and limits"].blocks
            if isinstance(note, SmallPrint) and "look ahead" in note.text
        ]
        for name, page in pages.items()
    }
    assert texts["none"] == []
    begins = {
        "one": "The rows",
        "both": "recurrent · raw: The rows",
        "hidden": "recurrent · raw · hidden 200: The rows",
    }
    for name in begins:
        (sentence,) = texts[name]
        assert sentence.startswith(begins[name]) and "by 9.5 ms on average and at most 26.25 ms" in sentence


def run(**measured: tuple[int, float, float, float]) -> Any:
    """A run with windows, errors of persistence and of the model, and skill by situation."""
    tree = {
        name.replace("_", " "): {
            "windows": windows,
            "mae_counts": {"persistence": {"mean": persistence}, "model": {"mean": model}},
            "skill": {"mean": {"mean": skill, "low": skill - 0.1, "high": skill + 0.1}},
        }
        for name, (windows, persistence, model, skill) in measured.items()
    }
    return SimpleNamespace(details=SimpleNamespace(metrics=SimpleNamespace(situations=tree)))


def test_several_runs_are_weighted_by_their_windows_and_one_has_its_interval() -> None:
    first, second = (
        run(closing=(100, 40.0, 30.0, 0.2), slipping=(50, 80.0, 60.0, 0.3)),
        run(closing=(300, 20.0, 20.0, 0.0)),
    )
    method: Any = SimpleNamespace(name="mixed", runs=[first, second])
    pooled = skill_in_situation(method, "closing")
    assert pooled is not None
    assert pooled["windows"] == 400
    assert (pooled["persistence"], pooled["model"]) == pytest.approx((25.0, 22.5))
    assert pooled["skill"] == pytest.approx(0.05)
    assert pooled["part"] == pytest.approx((4000 + 6000) / (4000 + 6000 + 4000))
    assert np.isnan(pooled["low"])
    single = skill_in_situation(SimpleNamespace(name="mixed", runs=[first]), "slipping")  # type: ignore[arg-type]
    assert single is not None and (single["low"], single["high"]) == pytest.approx((0.2, 0.4))
    assert skill_in_situation(method, "releasing") is None


def test_results_without_situations_have_no_table() -> None:
    empty: Any = SimpleNamespace(methods=[SimpleNamespace(name="gru", runs=[run()])])
    assert situation_folds(empty) == []
    full: Any = SimpleNamespace(methods=[SimpleNamespace(name="mixed", runs=[run(closing=(100, 40.0, 30.0, 0.2))])])
    (fold,) = situation_folds(full)
    assert fold.title == "By situation"
    table: Any = fold.blocks[0]
    assert [getattr(cell, "text", cell) for cell in table.rows[0].cells][:4] == ["closing", "mixed", "100", "100.0 %"]


def test_codecs_are_read_once_each_wherever_they_lie() -> None:
    with_codec = result()
    with_codec.files["codec.json"] = codec(8).files["codec.json"]
    assert [
        codec_read["latents"] for codec_read in representations.read_codecs([with_codec, codec(8), result(), codec(4)])
    ] == [8, 4]


def test_losses_of_one_width_are_averaged_and_series_are_kept_apart() -> None:
    codecs = representations.read_codecs(
        [
            codec(8, loss=0.5),
            codec(8, loss=0.25),
            codec(4),
            codec(8, "autoencoder", frames=2),
            codec(8, of="increments"),
        ]
    )
    losses = {(loss.series, loss.latents): loss for loss in representations.codec_losses(codecs)}
    assert set(losses) == {("PCA", 8), ("PCA", 4), ("AE-C2", 8), ("PCA increments", 8)}
    assert losses["PCA", 8].codecs == 2
    assert losses["PCA", 8].mse_standardised == 0.375
    assert losses["PCA", 8].mae_counts == 7.5
    assert losses["PCA", 8].part == "val"


def test_losses_are_of_the_fits_own_rows_where_one_codec_held_none_out() -> None:
    fitted = codec(8, reconstruction={"train": {"rows": 1, "mse_standardised": 0.125, "mae_counts": 1.0}})
    losses = representations.codec_losses(representations.read_codecs([fitted, codec(4, loss=0.5)]))
    assert [(loss.latents, loss.part, loss.mse_standardised) for loss in losses] == [
        (4, "train", 0.25),
        (8, "train", 0.125),
    ]


def test_the_papers_codec_is_the_one_of_the_nearest_width() -> None:
    paper_codec = representations.paper_codec(
        representations.read_codecs([codec(8), codec(16), codec(20, "autoencoder")]), "PCA", 20
    )
    assert paper_codec is not None and paper_codec["latents"] == 16
    assert representations.paper_codec([], "PCA", 20) is None
