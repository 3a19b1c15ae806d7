"""Check the section of forecasts beyond the comparison."""

import json
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.report.blocks import Section, SmallPrint
from tacpipe.tasks.forward.report import methods, pictures
from tests.fake_recordings import FakeDataset, FakeShard
from tests.report import parts
from tests.tasks.forward.report.result_fakes import MANIFEST, errors, result
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
        (0.5, "better", "33.3 % less"),
        (0.8, "worse", "6.7 % more"),
        ({f"r{index}": (0.5, 1.125)[index % 2] for index in range(8)}, "unclear", "has the same error as"),
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
        "less squared error than persistence",
        "less error than persistence",
        "sd over seeds",
        "MSE (counts²)",
        "MSE (scaled latents²)",
        "recordings",
        "runs",
    )
    assert cells_of("recurrent · raw", *heads) == [
        "1.312", "3.938", "34.4 %", "40.5 %", "0.457", "1.312", "1.312", "2", "2"
    ]  # fmt: skip
    assert "skill over persistence" not in table.heads  # it is vs persistence
    assert cells_of("persistence", *heads)[:4] == ["2", "6", "0.0 %", "0.0 %"]
    assert [group.title for group in table.groups] == ["", "Baselines", "Oracles, which use the true future"]


def test_methods_of_a_family_fold_behind_the_best_one() -> None:
    section = forward(*(result("raw", params={"hidden": width}, ratio=width / 100) for width in (25, 50, 75)))
    table = parts.tables([parts.folds(section)["All methods and baselines"]])[0]
    first = table.groups[0]
    assert first.folded and [parts.text(row.cells[0]) for row in first.rows] == [
        "recurrent · raw · hidden 25", "recurrent · raw · hidden 50", "recurrent · raw · hidden 75"
    ]  # fmt: skip


def test_of_a_labs_own_data_nothing_is_stated_that_the_paper_states_of_its_own() -> None:
    hows: tuple[dict[str, Any], ...] = ({"attributes": {}}, {})
    lab_text, published = (
        parts.words(forward(*(result(name, **options) for name in ("PCA-20", "AE-C1-8", "raw")))) for options in hows
    )
    assert "paper" not in lab_text.lower()
    assert "The paper's own numbers" in published and "Table 1" in published


@pytest.mark.parametrize("has_two_seeds", [False, True])
def test_results_of_a_sensor_in_kilopascal_name_no_count(has_two_seeds: bool) -> None:
    results = [result("raw", seed, attributes={}, inputs={"unit": "kPa"}) for seed in range(2 if has_two_seeds else 1)]
    text = parts.words(forward(*results))
    assert "kPa²" in text and not re.search(r"\bcounts?\b", text.replace("counts, ", ""))


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
    assert parts.cell(unseen_table, "r3", "less error") == "−100.0 %"  # 1.5 next to 0.75


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


def test_skill_is_drawn_by_time_ahead_with_an_arrow_where_it_is_below_the_chart() -> None:
    section = forward(result_on_many(0.5), result_on_many(3.0, params={"hidden": 8}))
    (chart,) = parts.charts([parts.folds(section)["By time ahead"]])
    rows = parts.values(chart)
    assert {row["x"] for row in rows} == {20, 40, 60}  # ms, at 50 rows per second
    assert {(row["name"], row["below"]) for row in rows if "floor" in row} == {
        ("recurrent · raw · hidden 8", "−2 (−2 to −2)")
    }
    assert {row["y"] for row in rows if row["name"] == "recurrent · raw · hidden 200"} == {0.5}


def test_the_number_of_forecasts_is_the_readers_choice() -> None:
    for count in (0, 1, 2):
        section = forward(result(ratio=RATIO, attributes={}), traces=count)
        drawn = [chart for chart in parts.charts(section) if "measured" in json.dumps(chart.spec)]
        assert len(drawn) == count


def test_a_forecast_is_drawn_when_it_is_for_in_a_window_around_the_steepest_change() -> None:
    t = np.arange(300)
    load = np.where(t < 150, 0.0, 100.0)
    columns = {"t_ns": t * 20_000_000, "contact": np.ones(300, np.int32), "quiet": load / 100, "load": load}
    columns |= {f"load_t{step}": np.roll(load, -step) for step in (1, 10)} | {"quiet_t1": load}
    run: Any = SimpleNamespace(details=methods.ForwardResult(result("raw")))
    recording: Any = FakeShard("r", pa.table(columns), {})
    (chart,) = pictures.draw_forecast(run, recording)
    assert chart.title == "r: load"
    rows = {(row["name"], row["x"]): row["y"] for row in parts.values(chart)}
    assert rows["measured", 2.98] == 0 and rows["measured", 3.0] == 100
    assert rows["forecast 10 rows before", 2.98] == 0 and rows["forecast 10 rows before", 3.0] == 100
    assert rows["persistence of 10 rows before", 3.18] == 0 and rows["persistence of 10 rows before", 3.2] == 100
    times = [x for _, x in rows]
    assert max(times) - min(times) == pytest.approx(12 * 0.2, abs=0.05)  # twelve horizons of ten rows
