from __future__ import annotations

import json
import re
from typing import Any

import pytest

from tacpipe.errors import TacpipeError
from tacpipe.report import page
from tacpipe.report.forward import section
from tests.fake_recordings import FakeDataset, FakeShard
from tests.report.elements import Elements
from tests.report.forward import result_fakes


@pytest.fixture
def judged() -> Any:
    return result_fakes.result(ratio={"r1": 0.5, "r2": 0.25, "r3": 1.5, "r4": 0.5}, attributes={"simulated": True})


def test_the_page_is_whole_and_loads_nothing(judged: Any) -> None:
    elements = Elements()
    elements.feed(page.render([judged], title="a <b>").decode())
    assert elements.open == []
    assert all(one.startswith("#") for one in elements.loads)


def test_the_same_results_give_the_same_bytes(judged: Any) -> None:
    assert page.render([judged], title="t") == page.render([judged], title="t")


@pytest.mark.usefixtures("undrawn")
def test_the_page_says_what_came_out_and_where_it_comes_from(judged: Any) -> None:
    text = page.render([judged], title="a <b>").decode()
    assert "a &lt;b&gt;" in text
    assert text.count('class="headline') == 2  # known objects, unseen ones
    for told in ("4 recordings that the model has not seen", "rate_hz = 50.0", "cd" * 32, "ab" * 32, "persistence"):
        assert told in text
    assert "1 recording that the model was trained or stopped on" in text
    assert "nan" not in re.sub(r"<svg.*?</svg>", "", text, flags=re.DOTALL).lower()


@pytest.mark.usefixtures("undrawn")
def test_a_single_result_tells_known_objects_and_unseen_ones_apart(judged: Any) -> None:
    text = page.render([judged], title="t").decode()
    row = re.search(r"<td>known objects \(2 recordings\), skill</td><td>([^<]+)</td>", text)
    assert row and row[1] == "+0.625 (+0.525 to +0.725)"  # 1 - the mean of 0.5 and 0.25
    assert "unseen objects (2 recordings), skill" in text


@pytest.mark.usefixtures("undrawn")
def test_results_of_before_groups_were_renamed_are_still_read(judged: Any) -> None:
    old = json.loads(judged.files["metrics.json"])
    for name in ("model", "persistence", "train_mean", "codec"):
        for measure in ("mse_counts", "mae_counts"):
            old[name][measure]["all"] = old[name][measure].pop("both")
    del old["known"], old["unseen"]
    files = {**judged.files, "metrics.json": json.dumps(old).encode()}
    text = page.render([FakeDataset(judged.recordings, files, judged.manifest)], title="t").decode()  # type: ignore[list-item]
    assert "model, sensor1" in text
    assert "model, all" not in text


@pytest.mark.usefixtures("undrawn")
def test_simulated_results_say_so_and_others_do_not(judged: Any) -> None:
    badge = '<span class="badge">simulated</span>'
    assert badge in page.render([judged], title="t").decode()
    measured: Any = FakeDataset(
        {name: FakeShard(name, one.content) for name, one in judged.recordings.items()}, judged.files
    )
    assert badge not in page.render([measured], title="t").decode()


@pytest.mark.usefixtures("undrawn")
def test_the_number_of_traces_is_the_readers_choice(judged: Any) -> None:
    drawn = [
        page.render([judged], title="t", traces=count).decode().count("Predictions next to") for count in (0, 1, 2)
    ]
    assert drawn == [0, 1, 2]


def test_results_without_sums_by_recording_name_the_best_baseline_and_claim_nothing(judged: Any) -> None:
    metrics = json.loads(judged.files["metrics.json"])
    metrics["ridge"] = {"mse_counts": {"both": {"t1": 0.3, "t2": 0.3, "t3": 0.3, "mean": 0.3}}}
    ((sentence, word),) = section.sentences([], metrics)
    assert "0.3 for ridge, the best of 3 baselines" in sentence and "no interval" in sentence
    assert word == ""  # and codec, which knows the future, is no baseline


def test_a_result_without_unseen_recordings_is_told_as_such() -> None:
    assert "No recording was left" in section.sentences([], {"counts": {"recordings": 0}})[0][0]


def test_a_dataset_of_latents_alone_is_no_result() -> None:
    with pytest.raises(TacpipeError, match=r"no metrics\.json"):
        page.render([result_fakes.codec(8)], title="t")


def test_many_results_begin_with_a_comparison_and_only_a_few_are_told_in_full() -> None:
    several = [
        result_fakes.result(name, seed, ratio=ratio)
        for name, ratio in (("PCA-20", 1.5), ("AE-C1-8", 1.2), ("raw", 0.5))
        for seed in range(3)
    ]
    text = page.render(several, title="t", traces=1).decode()
    assert "<h2>3 methods in 9 results</h2>" in text
    assert re.findall(r"<h2>\d\. ([^<]+)</h2>", text) == ["forward: recurrent · raw", "forward: recurrent · PCA-20"]
    elements = Elements()
    elements.feed(text)
    assert elements.open == []
    assert all(one.startswith("#") for one in elements.loads)
    assert "nan" not in re.sub(r"<svg.*?</svg>", "", text, flags=re.DOTALL).lower()
    assert page.render(several, title="t", traces=1).decode() == text


@pytest.mark.usefixtures("undrawn")
def test_two_results_are_compared_and_both_told_in_full(judged: Any) -> None:
    text = page.render([judged, result_fakes.result("raw")], title="t").decode()
    assert "2 methods in 2 results" in text
    assert re.findall(r"<h2>(\d)\. ", text) == ["1", "2"]
    assert text.index('<span class="badge">') < text.index("<h2>1.")  # one simulated result marks the comparison


@pytest.mark.usefixtures("undrawn")
def test_results_without_error_sums_stand_beside_those_that_are_compared() -> None:
    plain: Any = FakeDataset(
        files={"metrics.json": b'{"counts": {"recordings": 0}}', "config.json": b'{"task": "forward"}'},
        manifest={"stage": "evaluate"},
    )
    text = page.render([*(result_fakes.result(seed=seed) for seed in range(3)), plain], title="t").decode()
    assert "Below, 2 of the 4 results in full." in text
    assert "No recording was left" in text
    assert "2 methods" not in page.render([result_fakes.result(), plain], title="t").decode()


@pytest.mark.usefixtures("undrawn")
def test_results_on_recordings_that_were_all_trained_on_are_not_compared() -> None:
    seen = []
    for seed in range(2):
        one = result_fakes.result(seed=seed)
        ratios = {"model": dict.fromkeys(result_fakes.WINDOWS, 0.5)}
        files = {**one.files, "errors.parquet": result_fakes.errors(ratios, seen=tuple(result_fakes.WINDOWS))}
        seen.append(FakeDataset(one.recordings, files, one.manifest))
    assert "methods in" not in page.render(seen, title="t").decode()  # type: ignore[arg-type]


@pytest.mark.usefixtures("undrawn")
def test_latents_given_besides_results_tell_of_the_sweep_alone(judged: Any) -> None:
    text = page.render([judged, result_fakes.codec(2, loss=0.75), result_fakes.codec(4, loss=0.5)], title="t").decode()
    assert "Reconstruction error by number of latents" in text
    assert "<td>PCA</td><td>2</td><td>0.7500</td>" in text
    assert text.count('class="headline') == 2
