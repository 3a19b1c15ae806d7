"""Check the output of ``tacpipe compare``: one row per method or run, columns for what differs, the best first."""

import csv
import dataclasses
import io
import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tacpipe.cli import compare
from tacpipe.cli.compare import Compared
from tacpipe.comparison import engine, runs
from tacpipe.comparison.runs import ComparedRun, Question, TaskResults
from tacpipe.engine import pipeline
from tacpipe.scores import headline
from tests import older
from tests.comparison.comparison_fakes import run
from tests.conftest import Ran

BASE = [4.0, 4.0, 4.0, 4.0, 4.0, 4.0, 4.0, 4.0]
SMALL, LARGE = [1.0, 1.5, 1.0, 1.5, 1.0, 1.5, 1.0, 1.5], [2.0, 2.5, 2.0, 2.5, 2.0, 2.5, 2.0, 2.5]


def dataset(data: str = "d" * 64) -> Any:
    return SimpleNamespace(source=SimpleNamespace(inputs={"datasets": [{"dataset": data, "manifest": data}]}))


def weigh(errors: list[float], path: str, data: str = "d" * 64, **about: Any) -> tuple[str, ComparedRun]:
    return path, run({"model": errors, "mean": BASE}, dataset=dataset(data), **about)


def compared(*named_results: tuple[str, ComparedRun], pool: bool = True) -> Compared:
    task, all_runs = TaskResults("weighing"), [result for _, result in named_results]
    methods = runs.grouped(all_runs) if pool else runs.separate(all_runs)
    return Compared({path: result.dataset for path, result in named_results}, engine.comparisons(task, methods), pool)


def lines(comparison: Compared, width: int = 120) -> list[list[str]]:
    ((_, table),) = comparison.tables()
    return [line.split() for line in table.text(width).splitlines()]


WIDTHS = (
    weigh(LARGE, "r/large/0", settings={"width": 8, "deep": True}, seed=0),
    weigh(LARGE, "r/large/1", settings={"width": 8, "deep": True}, seed=1),
    weigh(SMALL, "r/small/0", settings={"width": 4, "deep": True}, seed=0),
)


def test_settings_that_differ_are_columns_and_others_are_not_and_the_best_is_first() -> None:
    head, part, first, second, baseline, *_ = lines(compared(*WIDTHS))

    assert head == ["width", "error", "less", "error", "95", "%", "interval", "n", "runs"]
    assert part == ["known"]
    assert first[:4] == ["net", "4", "1.25", "+68.8"] and first[-2:] == ["8", "1"]
    # 43.75 is rounded either way, as the processor sums; two seeds are pooled
    assert second[:3] == ["net", "8", "2.25"] and second[3] in ("+43.7", "+43.8") and second[-2:] == ["8", "2"]
    assert baseline == ["than", "mean", "4"]


def test_without_pooling_each_result_is_a_row_named_by_its_path_with_its_seed() -> None:
    head, _, *rows = lines(compared(*WIDTHS, pool=False))

    assert head == ["width", "seed", "error", "less", "error", "95", "%", "interval", "n"]
    assert [row[0] for row in rows[:3]] == ["small/0", "large/0", "large/1"]
    assert [row[2] for row in rows[1:3]] == ["0", "1"]


def test_data_is_a_column_where_results_are_of_other_data() -> None:
    alike = compared(weigh(LARGE, "a", "1" * 64), weigh(SMALL, "b", "1" * 64, method="other"))
    other_data = compared(weigh(LARGE, "a", "1" * 64), weigh(SMALL, "b", "2" * 64, method="other"))

    assert "data" not in lines(alike)[0]
    assert lines(other_data)[0][0] == "data" and lines(other_data)[2][1] == "2" * 8
    placed = dataclasses.replace(other_data, places={"2" * 64: "data/fresh"})
    assert lines(placed)[2][1] == "data/fresh" and lines(placed)[3][1] == "1" * 8  # one that is gone


def test_parts_are_below_their_names_and_the_widest_table_keeps_gain_and_interval() -> None:
    named_results = [
        weigh(LARGE, "a", question=Question("known")),
        weigh(SMALL, "b", question=Question("unseen")),
    ]
    comparison = compared(*named_results)

    assert [line for line in lines(comparison) if line in (["known"], ["unseen"])] == [["known"], ["unseen"]]
    ((_, table),) = comparison.tables()
    assert all(len(line) <= 80 for line in table.text(80).splitlines())
    assert "95 % interval" in table.text(40).splitlines()[0]


def test_too_few_recordings_for_a_verdict_are_stated() -> None:
    comparison = compared(weigh(SMALL[:3], "a"))
    assert f"below {headline.MIN_CLUSTERS}" in comparison.tables()[0][1].caption
    assert "below" not in compared(*WIDTHS).tables()[0][1].caption


def test_json_holds_every_row_with_its_results_and_csv_a_line_for_each() -> None:
    comparison = compared(*WIDTHS)
    ((compared_json,), rows) = (
        comparison.to_json()["comparisons"],
        list(csv.DictReader(io.StringIO(comparison.to_csv()))),
    )
    first, second, third = (
        compared_json["rows"]
        if compared_json["rows"][-1]["kind"] == "baseline"
        else sorted(compared_json["rows"], key=str)
    )

    assert (first["settings"], first["results"]) == ({"width": 4}, ["r/small/0"])
    assert second["results"] == ["r/large/0", "r/large/1"] and second["runs"] == 2
    assert first["gain"] == pytest.approx(1 - 1.25 / 4)
    low, gain, high = first["low"], first["gain"], first["high"]
    assert low is not None and gain is not None and high is not None and low <= gain <= high
    assert third["kind"] == "baseline" and third["gain"] is None and third["errors"] == {"error": 4.0}
    assert len(rows) == 3
    assert {row["width"]: float(row["gain"]) for row in rows[:2]} == {
        "4": pytest.approx(first["gain"]),
        "8": pytest.approx(second["gain"]),
    }


def test_a_result_of_an_older_version_compares_by_the_sums_that_it_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: Callable[[str], Ran]
) -> None:
    older.unpack(tmp_path)
    monkeypatch.chdir(tmp_path)
    called = call("compare results/forward --json")
    assert called.code == 0, called.err
    (comparison,) = json.loads(called.out)["comparisons"]
    (stored,) = json.loads((tmp_path / "results/forward/headline.json").read_text())["headlines"]
    (model,) = [row for row in comparison["rows"] if row["kind"] == "model"]

    pooled = list(model["errors"].values())[:-1]  # the skill that is not pooled is newer than the result
    assert pooled == pytest.approx(stored["model"]["values"], rel=1e-5)
    assert model["baseline"] in {row["name"] for row in stored["baselines"]}
    assert call("compare models/forward").code == 2  # a model is not a result
    assert call("compare results/forward --json --csv").code == 2


def test_a_result_without_errors_of_recordings_is_left_out_by_name(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    named = compared(*WIDTHS)
    opened = {**named.results, "r/old": dataset()}
    for result in opened.values():
        result.files = {compare.METRICS: b"{}"}
    monkeypatch.setattr(pipeline, "open_dataset", lambda path: opened[str(path)])
    monkeypatch.setattr(engine, "compare", lambda results, pool: named.comparisons)

    comparison = compare.run([Path(path) for path in opened], pool=True)
    assert comparison.unused() == ["r/old"]
    assert "left out r/old" in capsys.readouterr().err


def test_errors_in_other_units_are_other_comparisons_with_their_own_unit() -> None:
    """The runs share method, settings and question, and one of them has ten times the error in another unit."""

    def in_millinewton(path: str, errors: list[float]) -> tuple[str, ComparedRun]:
        place, newton = weigh(errors, path)
        question, of_question = next(iter(newton.questions.items()))
        measure = dataclasses.replace(of_question.measure, unit="mN")
        return place, dataclasses.replace(
            newton, questions={question: dataclasses.replace(of_question, measure=measure)}
        )

    comparison = compared(weigh(SMALL, "r/n"), in_millinewton("r/mn", [10 * error for error in SMALL]))
    first, second = (table for _, table in comparison.tables())
    assert "Units: N." in first.caption and "Units: mN." in second.caption
    assert [[float(row.cells[1]) for row in table.groups[0].rows] for table in (first, second)] == [
        [1.25, 4.0],
        [12.5, 4.0],
    ]
    assert [compared_json["unit"] for compared_json in comparison.to_json()["comparisons"]] == ["N", "mN"]
