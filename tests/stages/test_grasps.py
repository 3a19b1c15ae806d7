"""Test that raw grasps are cut down to the object's points and one reading."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.channels import biotac_sp, schema
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.errors import TacpipeError
from tacpipe.plugins.registry import load
from tacpipe.plugins.stage import RecordingOutput
from tacpipe.simulation.depth_camera import OBJECT
from tests.clouds.scene_fakes import Scene, scene

START_NS = 1_561_629_162_000_000_000
STEP_NS = 10_000_000
CLOSED, SETTLED = 130, 160  # rows: both fingers touch, and press as hard as they will
grasps = load("segment.grasps")
Recording = Callable[..., Any]


def touch(rows: int = 300) -> pa.Table:
    """Return both fingers' stream: channel k has the level 1000 + k, and 300 more from row `SETTLED` on."""
    level = 1000 + np.arange(58)[:, None] + 300 * np.clip((np.arange(rows) - CLOSED) / (SETTLED - CLOSED), 0, 1)
    return schema.stream(START_NS + np.arange(rows) * STEP_NS, list(np.rint(level)), biotac_sp.fields())


def raw(ball_scene: Scene, **extra_streams: pa.Table) -> dict[str, pa.Table]:
    return {
        "scene": ball_scene.cloud.table(),
        "grasp": ball_scene.grasp.table(START_NS),
        "biotac_sp": touch(),
        **extra_streams,
    }


def cut(recording: Any, **params: Any) -> RecordingOutput:
    output = grasps(grasps.params(**params), recording)
    assert isinstance(output, RecordingOutput)
    return output


@pytest.fixture(scope="module")
def simulated() -> list[RecordingOutput]:
    """Raw grasps of the simulated rig, one of each family of objects."""
    simulate = load("simulate.touch")
    params = simulate.params(trials=6, seed=11, objects=1, raw=True)
    return [simulate(params, trial) for trial in range(6)]


def truth_value(recording: RecordingOutput, name: str) -> Any:
    return recording.streams["truth"].column(name)[0].as_py()


def test_of_simulated_scenes_nearly_all_points_of_the_object_and_nearly_no_others_are_found(
    shard: Recording, simulated: list[RecordingOutput]
) -> None:
    for recording in simulated:
        object_points_m = Cloud.from_table(cut(shard(recording.streams)).streams["cloud"]).points_m
        scene_points_m = Cloud.from_table(recording.streams["scene"]).points_m
        is_object = recording.streams["scene_truth"].column("gt_surface").to_numpy() == OBJECT
        true_points = set(map(tuple, scene_points_m[is_object].tolist()))
        true_count = sum(point in true_points for point in map(tuple, object_points_m.tolist()))
        assert true_count >= 0.95 * len(object_points_m) and true_count >= 0.95 * len(true_points)


def test_of_simulated_streams_contact_and_reading_are_those_of_the_truth(
    shard: Recording, simulated: list[RecordingOutput]
) -> None:
    for recording in simulated:
        output, stream = cut(shard(recording.streams)), recording.streams["biotac_sp"]
        t_ns = stream.column("t_ns").to_numpy()
        begin_ns, hold_ns, release_ns = (
            truth_value(recording, f"gt_{name}_ns") for name in ("contact", "hold", "release")
        )
        holding, free = (t_ns > hold_ns) & (t_ns < release_ns), t_ns < begin_ns
        at_ns = []  # the force grows as s²(3 - 2s) from contact to hold; here it has raised the pressure by a count
        for finger in biotac_sp.FINGERS:
            pressure = stream.column(f"{finger}_pdc").to_numpy().astype(float)
            share = np.linspace(0, 1, 100_001)
            rise = (np.median(pressure[holding]) - np.median(pressure[free])) * share**2 * (3 - 2 * share)
            at_ns.append(begin_ns + share[np.searchsorted(rise, 1.0)] * (hold_ns - begin_ns))
        contact_ns = output.attributes["contact_ns"]
        assert isinstance(contact_ns, int)
        assert abs(contact_ns - max(at_ns)) <= 2 * STEP_NS
        reading = output.streams["reading"]
        assert abs(reading.column("t_ns")[0].as_py() - hold_ns) <= 6 * STEP_NS
        for field in biotac_sp.fields():
            channel = stream.column(field.name).to_numpy()[holding].astype(float)
            error = abs(reading.column(field.name)[0].as_py() - np.median(channel))
            assert error <= 1 + 4 * channel.std() / np.sqrt(20 / 1.57)  # the spread of a median of 20 rows


def test_a_raw_grasp_becomes_the_points_of_its_object_and_one_reading(shard: Recording) -> None:
    ball_scene = scene(1)
    truth = pa.table({"t_ns": [START_NS], "gt_force_n": [2.0]})
    output = cut(shard(raw(ball_scene, truth=truth)))
    assert set(output.streams) == {"cloud", "grasp", "reading", "truth"}
    cloud = Cloud.from_table(output.streams["cloud"])
    true_points = {tuple(point) for point in ball_scene.cloud.points_m[ball_scene.ball].tolist()}
    true_count = sum(tuple(point) in true_points for point in cloud.points_m.tolist())
    assert true_count >= 0.95 * len(cloud) and true_count >= 0.95 * len(true_points)
    colour_by_point = dict(
        zip(map(tuple, ball_scene.cloud.points_m.tolist()), np.asarray(ball_scene.cloud.colours), strict=True)
    )
    assert cloud.colours is not None
    for point, colour in zip(cloud.points_m.tolist(), cloud.colours, strict=True):
        assert (colour_by_point[tuple(point)] == colour).all()
    np.testing.assert_array_equal(Grasp.from_table(output.streams["grasp"]).g1_m, ball_scene.grasp.g1_m)
    assert output.streams["truth"].equals(truth)


def test_the_reading_is_the_median_after_contact_in_the_columns_of_a_finished_one(shard: Recording) -> None:
    output = cut(shard(raw(scene(1))))
    reading = output.streams["reading"]
    assert reading.schema.equals(
        schema.stream(np.array([0]), [[0]] * 58, biotac_sp.fields()).schema, check_metadata=True
    )
    assert reading.num_rows == 1
    values = [reading.column(field.name)[0].as_py() for field in biotac_sp.fields()]
    assert values == (1300 + np.arange(58)).tolist()
    contact_ns = output.attributes["contact_ns"]
    assert isinstance(contact_ns, int)
    assert abs(contact_ns - START_NS - CLOSED * STEP_NS) <= 2 * STEP_NS
    assert SETTLED - 1 <= (reading.column("t_ns")[0].as_py() - START_NS) / STEP_NS <= SETTLED


def test_single_wrong_readings_in_the_window_do_not_count(shard: Recording) -> None:
    stream = touch()
    column = stream.column("mf_electrode07").to_numpy().copy()
    column[[SETTLED + 3, SETTLED + 9]] = 4095
    place = stream.column_names.index("mf_electrode07")
    stream = stream.set_column(place, stream.schema.field(place), pa.array(column))
    output = cut(shard(raw(scene(1), biotac_sp=stream)))
    assert output.streams["reading"].column("mf_electrode07")[0].as_py() == 1306


def test_a_scene_without_colours_gives_a_cloud_without_them(shard: Recording) -> None:
    ball_scene = scene(1)
    output = cut(shard(raw(ball_scene, scene=Cloud(ball_scene.cloud.points_m).table())))
    assert output.streams["cloud"].column_names == ["x_m", "y_m", "z_m"]


def test_a_finished_grasp_stays_as_it_is(shard: Recording) -> None:
    ball_scene = scene(1)
    first = cut(shard(raw(ball_scene)))
    second = cut(shard(first.streams))
    assert set(second.streams) == set(first.streams)
    for name, table in second.streams.items():
        assert table.equals(first.streams[name], check_metadata=True)
    assert second.attributes == {}


def test_a_grasp_that_was_not_made_yet_has_its_object_cut_out_and_no_reading(shard: Recording) -> None:
    streams = raw(scene(1))
    grasped = cut(shard(streams))
    planned = cut(shard({name: table for name, table in streams.items() if name != "biotac_sp"}))
    assert set(planned.streams) == set(grasped.streams) - {"reading"}
    assert planned.streams["cloud"].equals(grasped.streams["cloud"])
    assert planned.attributes == {}
    assert set(cut(shard(planned.streams)).streams) == set(planned.streams)


def test_an_object_that_was_cut_out_already_needs_no_scene(shard: Recording) -> None:
    streams = raw(scene(1))
    first = cut(shard(streams))
    second = cut(shard({"cloud": first.streams["cloud"], "grasp": streams["grasp"], "biotac_sp": streams["biotac_sp"]}))
    assert second.streams["cloud"].equals(first.streams["cloud"])
    assert second.streams["reading"].equals(first.streams["reading"])


def test_a_sample_that_is_missing_is_no_reading_of_0(shard: Recording) -> None:
    streams = raw(scene(1))
    stream, name = streams["biotac_sp"], "th_electrode07"
    at = stream.column_names.index(name)
    values = stream.column(name).to_pylist()
    values_with_gaps = [None if row % 3 == 0 else value for row, value in enumerate(values)]
    holed = stream.set_column(at, stream.schema.field(name), pa.array(values_with_gaps, pa.uint16()))
    assert cut(shard({**streams, "biotac_sp": holed})).streams["reading"].column(name)[0].as_py() == values[-1]
    empty = stream.set_column(at, stream.schema.field(name), pa.array([None] * len(values), pa.uint16()))
    with pytest.raises(TacpipeError, match="The column th_electrode07 of biotac_sp holds no value"):
        cut(shard({**streams, "biotac_sp": empty}))


def test_what_a_raw_grasp_lacks_is_told(shard: Recording) -> None:
    streams = raw(scene(1))
    with pytest.raises(TacpipeError, match="Recording trial has no scene; a grasp has the streams scene and grasp"):
        cut(shard({"grasp": streams["grasp"]}))
    with pytest.raises(TacpipeError, match="lacks 1 of 58 columns, as th_pdc"):
        cut(shard({**streams, "biotac_sp": streams["biotac_sp"].drop_columns("th_pdc")}))


def test_what_cannot_be_found_is_told_with_the_recording(shard: Recording) -> None:
    ball_scene = scene(1)
    away = ball_scene.grasp.moved(np.eye(3), 0.3 * ball_scene.normal)
    with pytest.raises(TacpipeError, match=r"Recording trial: No object is near the grasp: .* mm from the lines"):
        cut(shard(raw(ball_scene, grasp=away.table(START_NS))))
    with pytest.raises(TacpipeError, match="Recording trial: No table was found"):
        cut(shard(raw(ball_scene, scene=Cloud(ball_scene.cloud.points_m[ball_scene.ball]).table())))
    with pytest.raises(TacpipeError, match="Recording trial: There is no contact"):
        cut(shard(raw(ball_scene, biotac_sp=touch(CLOSED))))
    with pytest.raises(TacpipeError, match="Recording trial: There is no contact"):
        cut(shard(raw(ball_scene)), on_count=400.0)
    with pytest.raises(TacpipeError, match="Recording trial: No table was found"):
        cut(shard(raw(ball_scene)), plane_fraction=0.99)
