"""Pages as a browser shows them: the text that readers see, and whether it is whole, in a wide and a narrow window."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tacpipe.report import page
from tests.fake_recordings import FakeDataset, FakeShard
from tests.report import browser
from tests.report.browser import Browser
from tests.report.test_page import unknown_result
from tests.tasks.forward.report import result_fakes
from tests.tasks.material.report import material_fakes
from tests.tasks.touch.report import touch_fakes

INSPECTION = (Path(__file__).parent / "inspection.js").read_text()
WIDTHS = (1280, 400)
LONG = "2026-11-22T10-32-33_gripper-left_carpet-with-long-pile_operator-two_trial"  # how a lab names a recording
BOTH = {"biotac": 1, "roboskin": 2}
LEVEL = {"mean_level": {"biotac": 4, "roboskin": 8}}
PARTNERS = {1: 2, 2: 3, 3: 4, 4: 1}

pytestmark = pytest.mark.skipif(
    browser.PROGRAM is None, reason="Chromium is missing; `make test` installs Debian's package chromium"
)


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser.browser(tmp_path_factory.mktemp("chromium")) as opened:
        yield opened


def forward_single() -> list[Any]:
    base = result_fakes.result(ratio={"r1": 0.5, "r2": 0.25, "r3": 1.5, "r4": 0.5}, attributes={"simulated": True})
    lines = [
        f'{{"epoch": {epoch}, "train_loss": {0.4 / epoch**0.5}, "val_loss": {0.42 / epoch**0.5}}}'
        for epoch in range(1, 9)
    ]
    return [FakeDataset(base.recordings, {**base.files, "history.jsonl": "\n".join(lines).encode()}, base.manifest)]


def forward_of_long_names() -> list[Any]:
    base = result_fakes.result()
    windows = {f"{LONG}-{name}": count for name, count in result_fakes.WINDOWS.items()}
    ratios = {"model": dict.fromkeys(windows, 0.5), "ridge": dict.fromkeys(windows, 0.75)}
    shards = {f"{LONG}-{name}": FakeShard(f"{LONG}-{name}", shard.content) for name, shard in base.recordings.items()}
    return [FakeDataset(shards, {**base.files, "errors.parquet": result_fakes.errors(ratios, windows)}, base.manifest)]


def forward_many() -> list[Any]:
    ratios = (("PCA-20", 1.5), ("AE-C1-8", 1.2), ("raw", 0.5))
    return [result_fakes.result(name, seed, ratio=ratio) for name, ratio in ratios for seed in range(2)]


def material_single() -> list[Any]:
    return [material_fakes.result("minirocket", wrong={"plush": 2}, also={"mean_level": {"plush": 6}})]


def material_many() -> list[Any]:
    joint: dict[str, Any] = {"joint": True, "epochs": 6, "also": {**LEVEL, "swapped": BOTH}}
    return [
        material_fakes.result("minirocket", wrong=BOTH, also=LEVEL),
        material_fakes.result("raec", wrong=BOTH, **joint),
        material_fakes.result("raec", wrong=BOTH, **joint, pairing="permuted", partners=PARTNERS),
        *(material_fakes.result("raec", wrong={name: 3}, epochs=6) for name in BOTH),
        material_fakes.recorded(),
    ]


def touch_single() -> list[Any]:
    return [touch_fakes.result(novel=touch_fakes.NOVEL, baselines={"object_mean": 0.06})]


def touch_many() -> list[Any]:
    heads = [touch_fakes.result("pointnet", head=head, epochs=12, off=0.06) for head in ("fc1", "fc2")]
    inputs = [touch_fakes.result("pointnet", inputs=columns, epochs=12) for columns in ("xyz", "rgbpose")]
    return [touch_fakes.result(), touch_fakes.result(seed=1), touch_fakes.result("trees", off=0.02), *heads, *inputs]


def mix() -> list[Any]:
    return [*forward_single(), *material_single(), *touch_single(), unknown_result("graph")]


PAGES: dict[str, Callable[[], list[Any]]] = {
    one.__name__: one
    for one in (
        forward_single,
        forward_of_long_names,
        forward_many,
        material_single,
        material_many,
        touch_single,
        touch_many,
        mix,
    )
}


def inspect_page(chromium: Browser, content: bytes, width: int, *, dark: bool) -> list[str]:
    """Return the problems of a page as it opens, and again with all folds open."""
    chromium.dark(dark)
    chromium.show(content, width)
    problems: list[str] = chromium.run(INSPECTION)
    chromium.run("showAll().then(() => true)")
    return [*problems, *chromium.run(INSPECTION)]


def test_a_page_of_all_tasks_is_whole_as_a_reader_sees_it(chromium: Browser) -> None:
    content = page.render(mix(), title="")
    assert inspect_page(chromium, content, 400, dark=False) == []
    assert (
        chromium.run("document.querySelectorAll('section')[0].querySelector('table').getBoundingClientRect().top") > 0
    )


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(PAGES))
def test_pages_are_whole_at_both_widths_light_and_dark(chromium: Browser, name: str) -> None:
    content = page.render(PAGES[name](), title="")
    for width in WIDTHS:
        for dark in (False, True):
            assert inspect_page(chromium, content, width, dark=dark) == [], (width, dark)


@pytest.mark.long
def test_the_answer_is_on_the_first_screen_at_both_widths(chromium: Browser) -> None:
    for name in ("forward_many", "material_many", "touch_many"):
        content = page.render(PAGES[name](), title="")
        for width in WIDTHS:
            chromium.show(content, width)
            selectors = (".answer", "figure .plot", *(["table"] if width > 400 else []))
            ends = [
                chromium.run(f"document.querySelector('{selector}').getBoundingClientRect().bottom")
                for selector in selectors
            ]
            assert max(ends) <= 800, (name, width, ends)


def test_tables_sort_families_unfold_and_charts_answer_the_cursor(chromium: Browser) -> None:
    content = page.render(
        [*(result_fakes.result("raw", params={"hidden": width}, ratio=width / 100) for width in (25, 75, 50))]
    )
    chromium.show(content, 1280)
    chromium.run("showAll().then(() => true)")
    table = "document.querySelector('#forward-1 table')"
    visible_rows = (
        f"[...{table}.tBodies[0].rows].filter((row) => !row.hidden).map((row) => row.cells[0].firstChild.data)"
    )
    assert [row_name.rpartition(" ")[2] for row_name in chromium.run(visible_rows)] == ["25"]
    chromium.run(f"{table}.querySelector('button.more').click()")
    assert [row_name.rpartition(" ")[2] for row_name in chromium.run(visible_rows)] == ["25", "50", "75"]
    chromium.run(f"{table}.tHead.rows[0].cells[1].click()")
    assert [row_name.rpartition(" ")[2] for row_name in chromium.run(visible_rows)] == ["75", "50", "25"]
    chromium.run(f"{table}.tHead.rows[0].cells[1].click()")
    assert [row_name.rpartition(" ")[2] for row_name in chromium.run(visible_rows)] == ["25", "50", "75"]
    script = """(() => {
      const point = document.querySelector(".plot svg .mark-symbol path"), box = point.getBoundingClientRect();
      const at = { bubbles: true, clientX: box.left + 3, clientY: box.top + 3 };
      point.dispatchEvent(new PointerEvent("pointermove", at));
      point.dispatchEvent(new MouseEvent("mousemove", at));
    })()"""
    chromium.run(script)
    assert "recurrent" in chromium.run("document.getElementById('tip').textContent")


def test_charts_are_drawn_under_the_policy_which_stops_scripts_of_others(chromium: Browser) -> None:
    chromium.show(page.render(forward_single()), 1280)
    chromium.run(
        "window.refused = []; document.addEventListener('securitypolicyviolation', (event) => refused.push(event))"
    )
    chromium.run("showAll().then(() => true)")
    assert chromium.run("document.querySelectorAll('.plot:not([data-ready])').length") == 0
    assert chromium.run("refused.length") == 0
    injected = """new Promise((done) => {
      const script = document.createElement('script'), image = new Image();
      script.textContent = 'window.injected = true';
      image.src = 'https://example.org/pixel.png';
      document.body.append(script, image);
      setTimeout(() => done([window.injected, refused.map((event) => event.effectiveDirective).sort()]), 200);
    })"""
    assert chromium.run(injected) == [None, ["img-src", "script-src-elem"]]


def test_paper_shows_what_is_folded_on_the_screen(chromium: Browser) -> None:
    chromium.show(page.render(forward_single()), 1280)
    chromium.run("window.dispatchEvent(new Event('beforeprint'))")
    assert chromium.run("[...document.querySelectorAll('details.fold')].every((one) => one.open)")
    assert chromium.run("getComputedStyle(document.querySelector('nav')).display") != "none"
    chromium.media("print")
    try:
        assert chromium.run("getComputedStyle(document.querySelector('nav')).display") == "none"
    finally:
        chromium.media("")


def test_charts_drawn_for_a_wide_screen_fit_the_paper(chromium: Browser) -> None:
    chromium.show(page.render(forward_single()), 1280)
    chromium.run("showAll().then(() => true)")
    chromium.media("print")
    try:
        chromium.run("document.body.style.width = '700px'")  # the width of an A4 page within its margins
        over = """[...document.querySelectorAll('.plot svg')].filter((one) => one.getBoundingClientRect().right
          > one.closest('figure').getBoundingClientRect().right + 1).length"""
        assert chromium.run(over) == 0
    finally:
        chromium.media("")


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("<p>$\\mathdefault{10^{-1}}$</p>", "raw mathtext"),
        ("<svg width=80 height=20><text y=15>$\\times$</text></svg>", "raw mathtext"),
        ("<p>a &amp;lt;b&amp;gt; c</p>", "raw HTML"),
        ("<p>&lt;b&gt;bold&lt;/b&gt;</p>", "raw HTML"),
        ("<p>error None</p>", "None"),
        ("<p>mean {value:.3f}</p>", "a format leftover"),
        ("<table><tr><td>nan</td></tr></table>", "a number that is none"),
        ("<p>skill −inf</p>", "a number that is none"),
        ("<details><summary>more</summary><p>NaN</p></details>", "a number that is none"),
        ("<p style='width: 3000px'>wide</p>", "wider than"),
        (f"<p>{'x' * 900}</p>", "wider than"),
        ("<div style='width: 40px; overflow: hidden; white-space: nowrap'>cut off text</div>", "cut by its box"),
        ("<svg width=80 height=20><text x=60 y=15>outside</text></svg>", "outside its figure"),
        ("<svg width=80 height=20><text x=5 y=15>one</text><text x=9 y=15>two</text></svg>", "over each other"),
        ("<div class=plot><svg width=99 height=20><text y=15>long na…</text></svg></div>", "a text cut in a chart"),
        (
            """<div class=plot><svg width=99 height=20><g aria-label="X-axis titled 'epoch' for a scale">
            <g class=role-axis-label><text y=15>1.5</text></g></g></svg></div>""",
            "epochs that are not whole",
        ),
    ],
)
def test_the_inspection_finds_what_is_wrong(chromium: Browser, content: str, problem: str) -> None:
    chromium.show(f"<!doctype html><meta charset=utf-8><body>{content}".encode(), 400)
    assert any(message.startswith(problem) for message in chromium.run(INSPECTION))


def test_the_inspection_finds_nothing_in_a_sound_page(chromium: Browser) -> None:
    content = (
        "<p>Infinite, financial, nanometre; no one.</p>"
        "<div style='overflow-x: auto'><p style='width: 900px'>wide, but it scrolls</p></div>"
    )
    chromium.show(f"<!doctype html><meta charset=utf-8><body>{content}".encode(), 400)
    assert chromium.run(INSPECTION) == []
