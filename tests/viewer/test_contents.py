"""Drawn contents of a recording, also as a picture."""

import dataclasses
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

import tacpipe
from tacpipe.cli import view
from tacpipe.errors import UsageError
from tacpipe.plugins.registry import load
from tacpipe.viewer import contents, figure
from tests.conftest import Lab
from tests.fake_recordings import FakeShard
from tests.viewer import hand


def drawn() -> contents.DrawnContents:
    return contents.collect(hand.recording())  # type: ignore[arg-type]


def test_a_recording_has_its_fingers_arm_labels_events_and_camera() -> None:
    drawing_contents = drawn()

    assert [item.name for item in drawing_contents.taxels] == ["xela1", "xela2"]
    assert {item.stream for item in drawing_contents.curves} == {"robot"}
    assert [(item.lane, item.text) for item in drawing_contents.spans] == [("contact", "contact 0"), ("slip", "slip")]
    assert [item.cause for item in drawing_contents.events] == ["cut"] and drawing_contents.gaps == []
    assert [item.name for item in drawing_contents.paths] == ["robot"]
    ((frames),) = drawing_contents.frames
    assert (frames.media_type, frames.content[0]) == ("image/png", hand.PNG)
    assert drawing_contents.duration_s == pytest.approx(hand.SECONDS - 1 / hand.ARM_HZ)


def test_a_cloud_of_each_stamp_is_one_cloud() -> None:
    points = {f"{axis}_m": np.arange(6.0) for axis in "xyz"}
    table = pa.table({"t_ns": [hand.START_NS] * 2 + [hand.START_NS + 5] * 4, **points})

    drawn_contents = contents.collect(hand.recording(scene=table))  # type: ignore[arg-type]

    assert [(item.t_ns, item.points_m.tolist()) for item in drawn_contents.clouds] == [
        (hand.START_NS, [[0, 0, 0], [1, 1, 1]]),
        (hand.START_NS + 5, [[n, n, n] for n in range(2, 6)]),
    ]
    assert {item.stream for item in drawn_contents.curves} == {"robot"}


def test_a_picture_of_a_long_recording_keeps_peaks_spans_and_gaps(monkeypatch: pytest.MonkeyPatch) -> None:
    change = hand.pressed()
    change[170] *= 3  # one row that a plot must not lose
    touched = hand.finger(change)
    lost = pa.concat_tables([touched.slice(0, 60), touched.slice(70)])
    label = pa.table({"t_ns": touched["t_ns"], "contact": hand.labels()["contact"]}, hand.labels().schema.remove(2))
    recording = hand.recording(xela1=lost, marks=label)
    every_row = contents.collect(recording)  # type: ignore[arg-type]
    monkeypatch.setattr(contents, "MAX_VALUES", 100)
    monkeypatch.setattr(contents, "INTERVALS", 10)
    brief = contents.for_picture(recording)  # type: ignore[arg-type]

    assert brief.spans == every_row.spans and brief.gaps == every_row.gaps and brief.ends_ns == every_row.ends_ns
    for thin, full in zip(brief.taxels, every_row.taxels, strict=True):
        assert len(thin.t_ns) < len(full.t_ns) / 2
        assert thin.load.max() == full.load.max() and thin.rest_levels.tolist() == full.rest_levels.tolist()
    assert np.ptp(brief.curves[0].values) == np.ptp(every_row.curves[0].values)


@pytest.mark.parametrize(("unit", "pressure"), [("count", 500.0), ("N", 2.5)])
def test_padding_is_apart_from_the_touch_also_where_neighbours_and_ends_cut_it(unit: str, pressure: float) -> None:
    touches = [(6, 60), (95, 160), (260, 300), (378, 400)]  # rows at 50 Hz; the pad is 25 rows
    touched = np.zeros(400, dtype=bool)
    for start, stop in touches:
        touched[start:stop] = True
    about = {"quantity": "tactile", "unit": unit, "stream": "skin"}
    fields = [pa.field("t_ns", pa.int64()), *(pa.field(f"t{n}", pa.float64(), metadata=about) for n in range(4))]
    noise = np.random.default_rng(0).normal(0, pressure / 1000, (4, 400))
    rows = [np.arange(400) * 20_000_000, *(touched * pressure + noise)]
    segment = load("segment.contacts")
    params = segment.params(rest_s=0.1)
    segmented = segment(params, FakeShard("a", pa.table(rows, pa.schema(fields))))
    chain = [{"stage": "segment.contacts", "params": dataclasses.asdict(params)}]
    shard = FakeShard("a", segmented.streams[""], segmented.attributes)

    drawn = contents.collect(shard, chain=chain).spans  # type: ignore[arg-type]

    by_text = {text: np.zeros(400, dtype=bool) for text in ("contact", "padding")}
    for span in drawn:
        by_text[span.text.split()[0]][span.start_ns // 20_000_000 : span.stop_ns // 20_000_000] = True
    assert by_text["contact"].tolist() == touched.tolist()
    padding = [(0, 6), (60, 95), (160, 185), (235, 260), (300, 325), (353, 378)]
    assert np.flatnonzero(by_text["padding"]).tolist() == [row for ends in padding for row in range(*ends)]


def test_the_first_plot_is_the_touch_of_all_fingers_in_their_unit() -> None:
    first, *other_panels = figure.panels(drawn())

    assert first.names == ("xela1", "xela2") and "count" in first.title
    np.testing.assert_allclose(first.values[:, 1], first.values[:, 0] / 2, atol=0.5)
    assert [panel.title for panel in other_panels] == ["robot position (m)", "robot orientation"]


@pytest.mark.parametrize("ending", [".png", ".svg"])
def test_a_picture_is_drawn_and_its_bytes_are_the_same_each_time(tmp_path: Path, ending: str) -> None:
    for name in ("a", "b"):
        figure.draw(drawn(), tmp_path / f"{name}{ending}")

    content = (tmp_path / f"a{ending}").read_bytes()
    assert content == (tmp_path / f"b{ending}").read_bytes() and len(content) > 10_000
    if ending == ".svg":
        text = content.decode()
        assert text.count("<path") > 20 and "image/png" in text


def test_what_is_no_picture_or_has_nothing_to_plot_is_a_usage_error(lab: Lab, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"\.txt"):
        figure.draw(drawn(), tmp_path / "a.txt")
    lab.run("simulate toy -o data/r")
    assert lab.call("show data/r --plot a.png").code == 2  # several recordings
    lab.run("show data/r trial-000 --plot a.png")
    assert (lab.folder / "a.png").read_bytes().startswith(b"\x89PNG")


def test_a_recording_draws_itself_in_a_notebook(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    recording = tacpipe.open("data/r")["trial-000"]

    html = recording._repr_html_()

    assert "trial-000" in html and "<svg" in html and "<polyline" in html and len(html) < 120_000


def test_conditions_are_read_as_labels_are_set() -> None:
    assert view.conditions(["object=cup", "trial=3", "failed=false", "note=a=b"]) == {
        "object": "cup",
        "trial": 3,
        "failed": False,
        "note": "a=b",
    }
    for wrong in ("cup", "=cup"):
        with pytest.raises(UsageError):
            view.conditions([wrong])
