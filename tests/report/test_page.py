from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from tacpipe.errors import TacpipeError
from tacpipe.report import page
from tacpipe.tasks import forward
from tests.stages.learning_fakes import FakeDataset, FakeShard, dataset, motion
from tests.tasks.test_forward import PARAMS

MANIFEST = {
    "stage": "evaluate",
    "version": 1,
    "params": {},
    "digest": "ab" * 32,
    "chain": [{"stage": "synchronize", "version": 2, "params": {"rate_hz": 50.0}, "fitted": None}],
    "inputs": {"model": [{"dataset": "cd" * 32, "manifest": "ef" * 32}]},
}


def result(folder: Path, **attributes: Any) -> FakeDataset:
    params = {**PARAMS, "epochs": 3}
    files = forward.train(params, dataset(*map(motion, range(3))), dataset(motion(9)), folder)
    shards = [FakeShard(one.name, one.content, attributes) for one in map(motion, (20, 21, 22, 0))]
    made = forward.evaluate(files, dataset(*shards))
    told = {name: FakeShard(name, one.streams[""], dict(one.attributes)) for name, one in made.recordings.items()}
    return FakeDataset(told, made.files, MANIFEST)


class Elements(HTMLParser):
    """Collects what a page loads, and checks that its elements close."""

    def __init__(self) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loads += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href")]
        if tag not in ("meta", "br"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        self.handle_endtag(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in ("meta", "br"):
            assert self.open.pop() == tag


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return result(tmp_path_factory.mktemp("checkpoint"), simulated=True)


def test_the_page_is_whole_and_loads_nothing(judged: Any) -> None:
    elements = Elements()
    elements.feed(page.render([judged], title="a <b>").decode())
    assert elements.open == []
    assert all(one.startswith("#") for one in elements.loads)


def test_the_same_results_give_the_same_bytes(judged: Any) -> None:
    assert page.render([judged], title="t") == page.render([judged], title="t")


def test_the_page_says_what_came_out_and_where_it_comes_from(judged: Any) -> None:
    text = page.render([judged, judged], title="a <b>").decode()
    assert "a &lt;b&gt;" in text
    assert text.count('class="headline') == 2
    for told in ("3 recordings that the model has not seen", "rate_hz = 50.0", "cd" * 32, "ab" * 32, "persistence"):
        assert told in text
    assert "1 recordings that the model was trained or stopped on" in text
    assert "nan" not in re.sub(r"<svg.*?</svg>", "", text, flags=re.DOTALL).lower()


def test_simulated_results_say_so_and_others_do_not(judged: Any) -> None:
    badge = '<span class="badge">simulated</span>'
    assert badge in page.render([judged], title="t").decode()
    measured: Any = FakeDataset(
        {name: FakeShard(name, one.content) for name, one in judged.shards.items()}, judged.files
    )
    assert badge not in page.render([measured], title="t").decode()


def test_the_number_of_traces_is_the_readers_choice(judged: Any) -> None:
    drawn = [page.render([judged], title="t", traces=count).decode().count("Predictions beside") for count in (0, 1, 2)]
    assert drawn == [0, 1, 2]


@pytest.mark.parametrize(
    ("interval", "told", "word"),
    [
        ((0.3, 0.1, 0.5), "The model is 30 % better than persistence at t+10 (200 ms ahead)", "better"),
        ((-2.0, -3.0, -1.0), "The model is 200 % worse than persistence", "worse"),
        ((0.02, -0.1, 0.1), "The model cannot be told from persistence", "unclear"),
    ],
)
def test_the_headline_claims_no_more_than_the_interval(interval: tuple[float, ...], told: str, word: str) -> None:
    skill = dict(zip(("mean", "low", "high"), interval, strict=True))
    metrics = {"skill": {"mse_counts": {"t1": skill, "t10": skill, "mean": skill}}, "counts": {"recordings": 8}}
    sentence, found = page.headline(metrics, 50.0)
    assert told in sentence
    assert found == word
    assert "95 % interval" in sentence


def test_a_single_recording_and_none_are_told_as_such() -> None:
    single = {"skill": {"mse_counts": {"t4": {"mean": 0.5}}}, "counts": {"recordings": 1}}
    assert "single recording: no interval" in page.headline(single)[0]
    assert "No recording was left" in page.headline({"counts": {"recordings": 0}})[0]


def test_what_is_no_result_is_refused() -> None:
    with pytest.raises(TacpipeError, match=r"no metrics\.json"):
        page.render([dataset()], title="t")
