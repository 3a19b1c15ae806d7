"""What the comparison of many results says."""

from __future__ import annotations

import io
import json
import re
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tacpipe.report.forward import overview, section, tables
from tacpipe.report.forward.methods import Run
from tacpipe.report.forward.overview import Overview
from tests.fake_recordings import FakeDataset
from tests.report.forward.result_fakes import WINDOWS, codec, errors, result
from tests.report.forward.test_comparison import RATIO


def over(*results: Any) -> Overview:
    return Overview([Run.read(one) for one in results])


def cells(html: str, name: str) -> list[str]:
    """The cells of the row that begins with ``name``, intervals left out."""
    found = re.search(rf"<tr[^>]*><td>{re.escape(name)}</td>(.*?)</tr>", html)
    assert found, name
    return [re.sub(r"<br>.*", "", cell) for cell in re.findall(r"<td>(.*?)</td>", found[1])]


def many(ratio: float | dict[str, float], recordings: int = 8, **how: Any) -> Any:
    """A result on as many recordings of known objects, on which ridge has 0.75 of persistence's squared error."""
    one = result("raw", **how)
    names = {f"r{index}": 20 for index in range(recordings)}
    by_name = dict.fromkeys(names, ratio) if isinstance(ratio, float) else ratio
    ratios = {"model": by_name, "ridge": dict.fromkeys(names, 0.75), "last_value_linear": dict.fromkeys(names, 0.9)}
    return FakeDataset(
        one.recordings, {**one.files, "errors.parquet": errors(ratios, names, known=tuple(names))}, one.manifest
    )


def test_the_headline_names_the_best_method_the_best_baseline_and_the_papers() -> None:
    said = overview.headline(over(result("raw", ratio=RATIO), result("PCA-20", ratio=2.0)))
    assert len(said) == 2
    assert said[0] == (
        "Known objects: recurrent · raw has skill +0.583 over the baseline ridge, the best of 3 baselines; 2 recordings are "
        "too few for an interval. Over persistence it has skill +0.688 (95 % interval +0.500 to +0.750), averaged over t+1 "
        "and t+3; the paper's method, recurrent · PCA-20, has skill −1.000 (95 % interval −1.000 to −1.000). With every "
        "channel in units of its standard deviation in training, skill +0.688 (95 % interval +0.500 to +0.750).",
        "",
    )
    assert said[1][0].startswith("Unseen objects: recurrent · raw has skill −0.333 over the baseline ridge")


@pytest.mark.parametrize(
    ("ratio", "verdict", "words"),
    [
        (0.5, "better", "is better than the baseline ridge, the best of 3 baselines: skill +0.333"),
        (0.8, "worse", "is worse than the baseline ridge, the best of 3 baselines: skill −0.067"),
        (
            {f"r{index}": 0.5 + 0.5 * (index % 2) for index in range(8)},
            "unclear",
            "does not differ measurably from the baseline ridge, the best of 3 baselines: skill +0.000",
        ),
    ],
)
def test_a_page_is_green_only_where_the_best_baseline_is_beaten_beyond_the_interval(
    ratio: Any, verdict: str, words: str
) -> None:
    """At 0.8 of persistence's error the model has 20 % less than it, and the intervals of ridge exclude it."""
    ((single, word),) = section.sentences(section.headlines(many(ratio)), {})
    assert words in single and word == verdict
    (several,) = overview.headline(over(many(ratio), many(ratio, seed=1)))
    assert words in several[0] and several[1] == verdict
    html = overview.render(over(many(ratio), many(ratio, seed=1)), [], simulated=False)
    assert f'<p class="headline {verdict}">' in html


def test_seeds_are_drawn_anew_too_where_there_are_several() -> None:
    one = over(many(0.5), many(0.5), many(0.5)).headlines()[True]
    alike = over(*(many(0.5, seed=seed) for seed in range(4))).headlines()[True]
    apart = over(*(many(0.2 + 0.3 * seed, seed=seed) for seed in range(4))).headlines()[True]
    assert (one.seeds, alike.seeds, alike.runs) == (1, 4, 4)
    assert alike.interval == "95 % interval over 8 recordings and 4 seeds"
    assert alike.high - alike.low == pytest.approx(0)
    assert apart.high - apart.low > 0.5  # all recordings are alike: what differs is the seed


def test_a_papers_method_that_is_best_is_not_told_twice() -> None:
    ((sentence, _), *_) = overview.headline(over(result("PCA-20", 0), result("PCA-20", 1)))
    assert "it is the paper's method" in sentence


def test_of_a_labs_own_data_nothing_is_said_that_the_paper_says_of_its_own() -> None:
    own = [result(name, seed, attributes={}) for name in ("PCA-20", "AE-C1-8", "raw") for seed in range(2)]
    html = overview.render(over(*own), [json.loads(codec(20).files["codec.json"])], simulated=False)
    assert "paper" not in html.lower()
    published = [result(name, seed) for name in ("PCA-20", "AE-C1-8", "raw") for seed in range(2)]
    html = overview.render(over(*published), [json.loads(codec(20).files["codec.json"])], simulated=False)
    for told in ("the paper's method, ", "Table 1 in the paper", "in the paper 20 hold", "Figure 5 in the paper"):
        assert told in html.replace("&#x27;", "'"), told


def test_recordings_whose_objects_nobody_named_are_neither_known_nor_unseen() -> None:
    one = result()
    table = pq.read_table(io.BytesIO(one.files["errors.parquet"]))
    none = pa.array([None] * table.num_rows, pa.string())
    content = io.BytesIO()
    pq.write_table(table.set_column(table.column_names.index("object"), "object", none), content)
    unnamed = FakeDataset(one.recordings, {**one.files, "errors.parquet": content.getvalue()}, one.manifest)
    found = over(unnamed, unnamed)
    assert found.parts == [None]
    html = overview.render(found, [], simulated=False)
    assert "nown objects" not in html and "unseen objects" not in html
    assert "Evaluated on 4 recordings (80 windows)" in html


def test_told_in_full_are_the_median_run_of_the_best_method_and_of_the_papers() -> None:
    results = [result("raw", seed, ratio=ratio) for seed, ratio in enumerate((0.5, 0.25, 0.375))]
    results += [result("PCA-20", seed, ratio=2.0) for seed in range(2)]
    told = over(*results).representative_runs()
    assert [(run.config["codec"]["name"], run.config["params"]["seed"]) for run in told] == [("raw", 2), ("PCA-20", 0)]


def test_table_1_holds_the_papers_numbers_beside_ours_and_says_what_was_not_run() -> None:
    html = tables.representations(over(result("PCA-20", 0), result("PCA-20", 1), result("PCA-8")).methods, True)
    ours = ["0.0150\xa0±\xa00.0071", "1.0000\xa0±\xa00.0000", "1.0000\xa0±\xa00.0000", "2.0000\xa0±\xa00.0000", "0.5"]
    assert cells(html, "PCA-20") == [*ours, "0.0298", "0.0363", "2"]
    assert cells(html, "PCA-8") == ["0.0100", "1.0000", "1.0000", "2.0000", "0.5", "–", "–", "1"]
    assert cells(html, "AE-C3") == ["–", "–", "–", "–", "–", "0.0405", "0.0510", "0"]
    assert html.index("<td>AE-C3") > html.index("<td>PCA-8")


def test_the_comparable_table_holds_errors_skill_and_what_they_rest_on() -> None:
    found = over(result("raw", 0, ratio=RATIO), result("raw", 1, ratio=1.0), result("PCA-20", ratio=2.0))
    html = tables.comparable(found.rows[True], found.steps, True)
    # skills 0.6875 and 0 pool to 0.34375; MAE is twice the step times 0.65625, MSE the mean step times that
    assert cells(html, "recurrent · raw") == [
        *("+0.344", "0.486", "+0.344", "1.312", "3.938", "1.312", "1.312", "+0.344", "+0.344"),
        *("2", "2", "40"),
    ]
    assert cells(html, "persistence") == [
        *("+0.000", "0.000", "+0.000", "2", "6", "2", "2", "+0.000", "+0.000"),
        *("2", "2", "40"),
    ]
    assert '<tr class="best"><td>recurrent · raw' in html


def test_the_worth_of_the_plan_is_the_difference_to_a_model_without_it() -> None:
    none = {name: ratio + 0.125 for name, ratio in RATIO.items()}
    found = over(result("raw", ratio=RATIO), result("raw", ratio=none, params={"actions": "none"}), result("PCA-20"))
    html = tables.actions(found.methods, found.steps, found.parts)
    assert cells(html, "recurrent · raw") == ["+0.688", "–", "–", "+0.000", "–", "–", "1"]
    assert cells(html, "… none") == ["+0.562", "+0.125", "+0.125", "−0.125", "+0.125", "+0.125", "1"]
    assert "PCA-20" not in html
    assert tables.actions(over(result("raw"), result("PCA-20")).methods, found.steps, found.parts) == ""


def test_other_timelines_are_told_apart_from_the_main_one() -> None:
    results = [result("raw", seed, ratio=RATIO) for seed in range(2)]
    found = over(*results, result("raw", ratio=0.25, timeline="fresh", rate_hz=10.0))
    assert found.timeline == "uniform"
    assert [one.name for one in found.main] == ["recurrent · raw"]
    html = tables.timelines(found.methods, found.steps, found.parts)
    assert cells(html, "recurrent · raw · fresh")[:2] == ["100", "+0.750"]
    assert cells(html, "recurrent · raw")[:2] == ["20", "+0.688"]
    whole = overview.render(found, [], simulated=False)
    assert "On the fresh timeline, whose steps last differently" in whole
    assert "recurrent · raw has skill +0.583 over the baseline ridge" in whole


def test_the_page_says_what_it_rests_on() -> None:
    html = overview.render(over(result(seed=3), result(seed=11)), [], simulated=True)
    for told in (
        "2 recordings of known objects (40 windows) and 2 recordings of unseen objects (40 windows)",
        "epochs 5; hidden 200; seed 3, 11",
        "an arm that follows its plan perfectly",
        "nothing here is evidence about a real sensor",
        '<span class="badge">simulated</span>',
        "<td>persistence</td><td>8</td><td>0</td>",  # anticipation: 4 events a run
    ):
        assert told in html


def test_without_unseen_objects_only_known_ones_are_told() -> None:
    known = [result(seed=seed) for seed in range(2)]
    for one in known:
        one.files["errors.parquet"] = errors({"model": dict.fromkeys(WINDOWS, 0.5)}, known=tuple(WINDOWS))
    found = over(*known)
    assert found.parts == [True]
    assert len(overview.headline(found)) == 1
    best = found.best()
    assert best is not None and best.name == "recurrent · PCA-20"


def test_figures_5_and_6_are_drawn_from_the_papers_representations() -> None:
    html = overview.render(over(result("PCA-20"), result("AE-C1-8"), result("raw")), [], simulated=False)
    assert html.count("Predictions next to the truth") == 2
    figure_6 = html[html.index("Figure 5 in the paper") :]
    assert ">z01<" in figure_6 and ">z03<" in figure_6 and ">z00<" not in figure_6
