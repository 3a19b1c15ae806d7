"""Test that names and labels are text on the results page, and never run."""

import csv
import io
import json
from collections.abc import Callable, Mapping
from html.parser import HTMLParser
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tacpipe.report import charts, page
from tacpipe.report.blocks import Chart, Section
from tacpipe.report.charts import Curve
from tests.fake_recordings import FakeDataset, FakeRecording, FakeShard
from tests.promises.counts import count
from tests.promises.limits import sample_cases
from tests.report.test_page import check, unknown_result
from tests.tasks.forward.report import result_fakes
from tests.tasks.material.report import material_fakes
from tests.tasks.touch.report import touch_fakes

HOSTILE = "\"'><script>alert('x')</script><img src=x onerror=alert(1)>&lt;svg onload=alert(2)> $\\frac{$ </style></svg>"
Words = Mapping[str, str]


class Tags(HTMLParser):
    """Counts the elements of a page, and collects attributes that a browser would run."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.runs: list[str] = []
        self.scripts: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.scripts += [dict(attrs).get("type") or ""] if tag == "script" else []
        self.runs += [name for name, value in attrs if name.startswith("on") or "javascript:" in (value or "")]

    def handle_data(self, data: str) -> None:
        self.text += data


def rename_words(value: Any, words: Words) -> Any:
    """Return a value with these words replaced wherever they stand as a text, a name, or the first part of one."""
    if isinstance(value, str):
        for word, new in words.items():
            if value == word or value.startswith(f"{word}-") or value == f"object of {word}":
                return value.replace(word, new)
    if isinstance(value, Mapping):
        return {rename_words(key, words): rename_words(item, words) for key, item in value.items()}
    if isinstance(value, list):
        return [rename_words(item, words) for item in value]
    return value


def table(content: pa.Table, words: Words) -> pa.Table:
    return pa.table({name: rename_words(content.column(name).to_pylist(), words) for name in content.column_names})


def file(name: str, content: bytes, words: Words) -> bytes:
    if name.endswith(".json"):
        return json.dumps(rename_words(json.loads(content), words)).encode()
    if name.endswith(".jsonl"):
        return b"".join(
            json.dumps(rename_words(json.loads(line), words)).encode() + b"\n" for line in content.splitlines()
        )
    text = io.StringIO()
    if name.endswith(".csv"):
        csv.writer(text).writerows(rename_words(list(csv.reader(io.StringIO(content.decode()))), words))
        return text.getvalue().encode()
    binary = io.BytesIO()
    pq.write_table(table(pq.read_table(io.BytesIO(content)), words), binary)
    return binary.getvalue()


def shard(recording: Any, words: Words) -> Any:
    name, attributes = (
        rename_words(recording.name, words),
        {**rename_words(recording.attributes, words), "note": words[NOTE], "object": words[NOTE]},
    )
    if isinstance(recording, FakeRecording):
        return FakeRecording(
            {stream: table(recording.table(stream), words) for stream in recording.streams}, name, attributes
        )
    return FakeShard(name, recording.content, attributes)


def poison(result: Any, words: Words) -> Any:
    """Return a result in which these words are others; its recordings get labels of the same."""
    shards = [shard(recording, words) for recording in result.recordings.values()]
    files = {name: file(name, content, words) for name, content in result.files.items()}
    return FakeDataset({recording.name: recording for recording in shards}, files, rename_words(result.manifest, words))


pytestmark = pytest.mark.usefixtures("unbundled")
NOTE = "note"
RESULTS: dict[str, tuple[Callable[[], list[Any]], tuple[str, ...]]] = {  # results, and what is named by users in them
    "forward": (lambda: [result_fakes.result()], ("r1", "r3", "PCA-20", "recurrent", "ab" * 32, "synchronize")),
    "several forward": (
        lambda: [result_fakes.result(seed=0), result_fakes.result("PCA-8", seed=1, ratio=0.4)],
        ("r1", "PCA-20", "PCA-8", "rate_hz"),
    ),
    "material": (
        lambda: [
            material_fakes.result("raec", wrong={"biotac": 2, "roboskin": 1}, epochs=2),
            material_fakes.recorded(),
        ],
        ("segment.slides", "cd" * 32),
    ),
    "touch": (
        lambda: [touch_fakes.result("strong", novel=("drill",))],
        ("bleach", "drill", "segment.grasps"),
    ),
    "of another task": (
        lambda: [unknown_result("touch2", simulated=True)],
        ("touch2", "graph_net", "near", "model", "evaluate"),
    ),
}


def render_tags(case: str, new: str) -> Tags:
    make, names = RESULTS[case]
    words = {name: f"{new}{place}" for place, name in enumerate(names)} | {NOTE: new}
    text = page.render([poison(result, words) for result in make()], title=new).decode()
    check(text.replace(" nan", "").encode())
    tags = Tags()
    tags.feed(text)
    return tags


@pytest.mark.filterwarnings("ignore:Glyph")
@pytest.mark.parametrize("case", sample_cases(sorted(RESULTS, key=lambda case: case != "of another task"), 2))
def test_nothing_that_a_label_holds_becomes_an_element_of_the_page(case: str) -> None:
    hostile, harmless = render_tags(case, HOSTILE), render_tags(case, "harmless")
    assert (hostile.tags, hostile.scripts) == (harmless.tags, harmless.scripts)
    assert hostile.runs == []
    assert HOSTILE in hostile.text
    count("hostile inputs refused", len(RESULTS[case][1]))


def test_the_words_of_a_chart_are_text_too() -> None:
    spec = charts.lines([Curve(HOSTILE, [1.0, 2.0], [0.1, 0.2])], HOSTILE, HOSTILE)
    tags = Tags()
    tags.feed(page.page([Section("t", "t", "", chart=Chart(HOSTILE, spec, HOSTILE))], "t").decode())
    assert "img" not in tags.tags and tags.runs == []
    assert tags.scripts == ["application/json", "", ""]  # a chart, the library, the page's own
    assert "alert('x')" in tags.text
