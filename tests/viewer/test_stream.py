"""Files of `tacpipe view`, read back with Rerun's own reader; `make test-viewer` has the environment for it."""

import importlib.util
import os
import subprocess
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

import tacpipe
from tacpipe.traces import drawing, taxels
from tacpipe.viewer import contents, session
from tacpipe.viewer.markers import MarkerTrack
from tests.conftest import Lab
from tests.traces.test_predictions import predictions
from tests.viewer import hand

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(
        importlib.util.find_spec("rerun") is None, reason="needs Rerun, the extra view: make test-viewer"
    ),
]


@pytest.fixture(autouse=True)
def own_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a separate home, in which files that Rerun's programs keep would be found."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for name in ("XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path / "home"


def read(file: Path, store: int = 0) -> dict[str, list[pa.RecordBatch]]:
    """Return the tables of each entity of a recording in a file."""
    from rerun.chunk import RrdReader

    reader = RrdReader(file)
    batches_by_entity: dict[str, list[pa.RecordBatch]] = {}
    for chunk in reader.stream(store=reader.recordings()[store]):
        batches_by_entity.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return batches_by_entity


def measure_time(batches: list[pa.RecordBatch], component: str) -> tuple[np.ndarray, list[Any]]:
    """Return the times, nanoseconds since the start, and the values of a component."""
    rows: list[tuple[int, Any]] = []
    for batch in batches:
        if "time" in batch.schema.names and component in batch.schema.names:
            stamps = batch["time"].cast(pa.int64()).to_pylist()
            rows += zip(stamps, batch[component].to_pylist(), strict=True)
    rows.sort(key=lambda time_and_value: time_and_value[0])
    return np.array([time_and_value[0] for time_and_value in rows]), [time_and_value[1] for time_and_value in rows]


def static(batches: list[pa.RecordBatch], component: str) -> Any:
    """Return the values of a component that hold for the whole recording."""
    (value,) = [
        batch[component][0].as_py()
        for batch in batches
        if "time" not in batch.schema.names and component in batch.schema.names
    ]
    return value


def write_and_read(
    folder: Path, **extra_streams: pa.Table
) -> tuple[contents.DrawnContents, dict[str, list[pa.RecordBatch]]]:
    drawn = contents.collect(hand.recording(**extra_streams))  # type: ignore[arg-type]
    (file,) = session.write([drawn], folder, "data/hand")
    return drawn, read(file)


def test_the_touch_of_each_finger_is_written_at_its_times(tmp_path: Path) -> None:
    _, entities = write_and_read(tmp_path)

    t_ns, values = measure_time(entities["/touch/xela1"], "Scalars:scalars")
    np.testing.assert_array_equal(t_ns, hand.times(hand.SKIN_HZ) - hand.START_NS)
    expected = np.linalg.norm(hand.pressed(), axis=2).mean(axis=1)
    np.testing.assert_allclose(np.ravel(values), expected)
    assert static(entities["/touch/xela1"], "SeriesLines:names") == ["xela1"]


def test_maps_have_a_disc_a_taxel_in_the_colour_of_its_change_and_an_arrow_of_its_shear(tmp_path: Path) -> None:
    drawn, entities = write_and_read(tmp_path)

    taxel_map = drawn.taxels[0]
    places = np.array(static(entities["/taxels/xela1/discs"], "Points2D:positions"))
    np.testing.assert_allclose(places, taxel_map.places * (1, -1), rtol=1e-6)
    t_ns, colours = measure_time(entities["/taxels/xela1/discs"], "Points2D:colors")
    assert len(t_ns) == hand.SECONDS * hand.SKIN_HZ
    low, high = taxels.scale(np.concatenate([taxel_map.magnitude.ravel() for taxel_map in drawn.taxels]))
    last = np.array(colours[-1], np.uint32)
    rgb = np.stack([last >> 24, (last >> 16) & 255, (last >> 8) & 255], axis=-1)
    np.testing.assert_array_equal(rgb, drawing.map_colours(taxel_map.magnitude[-1], low, high))
    _, vectors = measure_time(entities["/taxels/xela1/shear"], "Arrows2D:vectors")
    assert np.array(vectors[0]).any() == np.False_
    right, up = np.array(vectors[-1]).T
    assert (right > 0).all() and not up.any()  # The shear is only along x.


def test_spans_begin_and_end_at_their_moments(tmp_path: Path) -> None:
    _, entities = write_and_read(tmp_path)

    for lane, states in {"contact": [(1.0, "contact 0"), (3.0, "")], "slip": [(2.5, "slip"), (3.0, "")]}.items():
        t_ns, values = measure_time(entities[f"/spans/{lane}"], "StateChange:state")
        assert [(t / 1e9, state[0]) for t, state in zip(t_ns.tolist(), values, strict=True)] == states
    _, texts = measure_time(entities["/events"], "TextLog:text")
    assert "cut" in texts[0][0]


def test_long_lines_are_envelopes_unless_all_rows_are_wanted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tacpipe.viewer.stream.MAX_ROWS", 500)
    drawn = contents.collect(hand.recording())  # type: ignore[arg-type]
    path = next(iter(name for name in write_and_read(tmp_path)[1] if name.startswith("/series/robot/robot\\ position")))
    for all_rows, row_limit in ((False, 500), (True, hand.SECONDS * hand.ARM_HZ)):
        (tmp_path / str(all_rows)).mkdir()
        (file,) = session.write([drawn], tmp_path / str(all_rows), "hand", all_rows=all_rows)
        values = np.array(measure_time(read(file)[path], "Scalars:scalars")[1])
        assert row_limit - 2 <= len(values) <= row_limit
        assert values[:, 0].max() == drawn.paths[0].position_m[:, 0].max()


def test_arm_clouds_and_cameras_are_written(tmp_path: Path) -> None:
    scene = pa.table({f"{axis}_m": np.arange(6.0) for axis in "xyz"})
    drawn, entities = write_and_read(tmp_path, scene=scene)

    _, places = measure_time(entities["/space/robot/now"], "Transform3D:translation")
    np.testing.assert_allclose(places[-1][0], drawn.paths[0].position_m[-1], rtol=1e-6)
    assert len(static(entities["/space/scene"], "Points3D:positions")) == 6
    t_ns, blobs = measure_time(entities["/cameras/camera"], "EncodedImage:blob")
    np.testing.assert_array_equal(t_ns, hand.times(hand.SKIN_HZ)[::10] - hand.START_NS)
    assert bytes(blobs[0][0]) == hand.PNG


def test_forecasts_stand_next_to_what_came_with_their_error(tmp_path: Path) -> None:
    (measured, _) = contents.collect(hand.recording()).taxels  # type: ignore[arg-type]
    drawn = contents.collect(hand.recording(), predictions(measured, (1, 10), 4.0))  # type: ignore[arg-type]
    (file,) = session.write([drawn], tmp_path, "hand")
    entities = read(file)

    t_ns, values = measure_time(entities["/error/xela1/t\\+10"], "Scalars:scalars")
    np.testing.assert_allclose(np.ravel(values), 4.0)
    assert t_ns[0] == 10 * 1_000_000_000 // hand.SKIN_HZ
    assert "/taxels/xela1\\ residual\\ t\\+10/discs" in entities and "/forecast/xela1/measured" in entities


def test_the_names_of_a_recording_are_bars_as_long_as_their_scores(tmp_path: Path) -> None:
    about = {"model": "prediction", "material": "label", "score_1": "score", "score_2": "score"}
    fields = [
        pa.field(name, pa.float32() if "_" in name else pa.int32(), metadata={"quantity": quantity})
        for name, quantity in about.items()
    ]
    row = pa.Table.from_pylist([{"model": 2, "material": 1, "score_1": 0.25, "score_2": 1.0}], pa.schema(fields))
    drawn = contents.collect(hand.recording(), row=row)  # type: ignore[arg-type]
    (file,) = session.write([drawn], tmp_path, "hand")
    entities = read(file)

    strips = static(entities["/named/bars"], "LineStrips2D:strips")
    assert [strip[-1][0] - strip[0][0] for strip in strips] == pytest.approx([8.0, 2.0])
    assert static(entities["/named/names"], "Points2D:labels") == ["2   1", "1 (label)   0.25"]
    origins = [view.origin for view in views(session.blueprint(drawn).root_container)]
    assert "named" in [origin.strip("/") for origin in origins]


def test_every_view_of_the_layout_shows_an_entity_that_is_written(tmp_path: Path) -> None:
    drawn, entities = write_and_read(tmp_path)
    origins = [view.origin for view in views(session.blueprint(drawn).root_container)]

    assert len(origins) > 8
    missing = [
        origin for origin in origins if not any(f"{path}/".startswith(f"/{origin.strip('/')}/") for path in entities)
    ]
    assert missing == []


def views(part: Any) -> list[Any]:
    contents_of = getattr(part, "contents", None)
    if isinstance(contents_of, list | tuple):
        return [view for child in contents_of for view in views(child)]
    return [part]


def test_view_saves_the_recordings_that_are_chosen_as_one_file(lab: Lab, own_home: Path) -> None:
    lab.run("simulate forward --trials 4 --duration-s 4 -o data/r")
    lab.run("label data/r trial-002 --set object=cup")
    lab.run("view data/r --where object=cup --save cup.rrd")
    lab.run("view data/r trial-00[013] --save three")
    from rerun.chunk import RrdReader

    assert [recording.recording_id for recording in RrdReader("cup.rrd").recordings()] == ["trial-002"]
    files = sorted(Path("three").iterdir())
    assert [file.name for file in files] == ["trial-000.rrd", "trial-001.rrd", "trial-003.rrd"]
    assert [recording.recording_id for file in files for recording in RrdReader(file).recordings()] == [
        file.stem for file in files
    ]
    trial = tacpipe.open("data/r")["trial-002"]
    t_ns, values = measure_time(read(Path("cup.rrd"))["/touch/xela1"], "Scalars:scalars")
    assert len(values) == trial.table("xela1").num_rows and (np.diff(t_ns) >= 0).all()
    lab.run("view data/r trial-000 --save cup.rrd")  # its own file is replaced
    assert lab.call("view data/r --save cup.rrd").code == 2  # one file, four recordings
    (lab.folder / "other.rrd").write_text("mine")
    assert lab.call("view data/r trial-000 --save other.rrd").code == 2
    assert lab.call("view data/r nobody --save x.rrd").code == 2
    assert lab.call("view data/r --where object=nothing --save x.rrd").code == 2
    leftovers = [path for path in own_home.rglob("*") if "analytics" in path.name]
    assert leftovers == []


def test_the_page_of_the_web_viewer_forbids_connections_to_other_computers(tmp_path: Path) -> None:
    from tacpipe.viewer import session

    files = session.write([contents.collect(hand.recording())], tmp_path, "hand")  # type: ignore[arg-type]
    with session.serve(files, None) as address, urllib.request.urlopen(address, timeout=60) as answer:
        policy = answer.headers["Content-Security-Policy"]
        assert b"Rerun" in answer.read()
    sources = {word for part in policy.split(";") for word in part.split()[1:] if "://" in word}
    assert sources == {"http://localhost:*", "http://127.0.0.1:*"}


def test_the_viewer_s_program_keeps_and_sends_no_statistics(
    tmp_path: Path, own_home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CI", raising=False)
    (file,) = session.write([contents.collect(hand.recording())], tmp_path, "hand")  # type: ignore[arg-type]
    # The second environment is the default one.
    for environment, expected in ((session.environment(), False), (dict(os.environ), True)):
        subprocess.run([session.program(), "rrd", "verify", file], env=environment, check=True)
        assert any("analytics" in path.name for path in own_home.rglob("*")) == expected


def test_markers_of_a_gel_and_their_displacement_are_written_over_its_frames(tmp_path: Path) -> None:
    rest_px = np.array([[10.0, 20.0], [30.0, 20.0]])
    positions_px = np.array([rest_px, [[11.0, 22.0], [np.nan, np.nan]]])  # the second marker is hidden at last
    track = MarkerTrack("gel", np.array([0, 40_000_000]), rest_px, positions_px)
    drawn = contents.DrawnContents("trial", {}, {}, markers=[track])
    (file,) = session.write([drawn], tmp_path, "data")
    entities = read(file)
    t_ns, positions = measure_time(entities["/cameras/gel/markers"], "Points2D:positions")
    assert t_ns.tolist() == [0, 40_000_000]
    assert positions == [rest_px.tolist(), [[11.0, 22.0]]]
    _, vectors = measure_time(entities["/cameras/gel/displacement"], "Arrows2D:vectors")
    assert vectors == [[[0.0, 0.0], [0.0, 0.0]], [[3.0, 6.0]]]
