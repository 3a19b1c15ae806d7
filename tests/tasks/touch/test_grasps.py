"""Reading grasps of a dataset: what they become, and what is refused with the recording's name."""

from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.channels import biotac_sp
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.errors import TacpipeError
from tacpipe.tasks.touch import grasps as grasps_of
from tests.tasks.touch.handmade import GraspShard, cloud, dataset, grasp, recording, recordings


def without(shard: GraspShard, stream: str, column: str = "") -> GraspShard:
    tables = dict(shard.tables)
    if column:
        tables[stream] = tables[stream].drop_columns([column])
    else:
        del tables[stream]
    return GraspShard(tables, shard.name, shard.attributes)


def with_table(shard: GraspShard, stream: str, table: pa.Table) -> GraspShard:
    return GraspShard({**shard.tables, stream: table}, shard.name, shard.attributes)


def test_grasps_come_in_the_order_of_their_names_with_all_that_was_felt() -> None:
    later, earlier = recording(7, "melon"), recording(3)
    grasps = grasps_of.read(dataset(later, earlier))
    assert grasps.names == ("ball-003", "melon-007")
    assert grasps.objects == ("ball", "melon")
    assert grasps.sessions == ("ball-s01", "melon-s01")
    assert grasps.t_ns.tolist() == [180_000_000_000, 420_000_000_000]
    assert grasps.digests == (earlier.digest, later.digest)
    assert {target: felt.shape for target, felt in grasps.readings.items()} == {
        "pdc_th": (2, 1),
        "pdc_mf": (2, 1),
        "e_th": (2, 24),
        "e_mf": (2, 24),
    }
    row = later.tables["reading"].to_pylist()[0]
    assert grasps.readings["pdc_mf"][1].tolist() == [row["mf_pdc"]]
    assert grasps.readings["e_th"][1].tolist() == [row[f"th_electrode{n:02d}"] for n in range(1, 25)]
    np.testing.assert_array_equal(grasps.clouds[0].points_m, cloud(3).points_m)


def test_grasps_need_no_reading_where_none_is_asked_for() -> None:
    grasps = grasps_of.read(recordings(felt=False), with_readings=False)
    assert len(grasps) == 12
    assert grasps.readings == {}


def test_objects_and_sessions_that_are_not_told_are_empty() -> None:
    grasps = grasps_of.read(dataset(recording(0, object=None, session=None)))
    assert (grasps.objects, grasps.sessions) == (("",), ("",))


def test_joined_grasps_stand_one_after_the_other() -> None:
    first, second = grasps_of.read(recordings(0, 2)), grasps_of.read(recordings(5, 1))
    joined = first.joined(second)
    assert joined.names == first.names + second.names
    assert len(joined.clouds) == len(joined.grasps) == len(joined.digests) == len(joined) == 6
    np.testing.assert_array_equal(joined.t_ns[-2:], second.t_ns)
    for target in biotac_sp.TARGETS:
        np.testing.assert_array_equal(
            joined.readings[target], np.concatenate([first.readings[target], second.readings[target]])
        )


FAR = Grasp(np.array([0.02, -0.1, 0.8]), np.array([0.02, -0.1, 1.2]))
NAN = pa.table({name: np.array([0.0, np.nan, 1.0, 2.0], np.float32) for name in ("x_m", "y_m", "z_m")})


@pytest.mark.parametrize(
    ("shard", "sentence"),
    [
        (
            without(recording(0), "cloud"),
            "ball-000 has the streams grasp, reading; a grasp has the streams cloud, grasp.*segment grasps",
        ),
        (
            without(recording(0), "grasp"),
            "ball-000 has the streams cloud, reading; a grasp has the streams cloud, grasp",
        ),
        (without(recording(0), "reading"), "ball-000 has no tactile reading.*tacpipe predict"),
        (without(recording(0), "cloud", "y_m"), "ball-000: The column y_m is missing"),
        (without(recording(0), "grasp", "g2_z_m"), "ball-000: The column g2_z_m is missing"),
        (without(recording(0), "reading", "th_pdc"), "ball-000: The column th_pdc is missing"),
        (without(recording(0), "reading", "mf_electrode24"), "ball-000: The column mf_electrode24 is missing"),
        (
            recording(0, cloud=Cloud(np.zeros((0, 3), np.float32))),
            "ball-000 has a cloud of 0 points; at least 3 are needed",
        ),
        (recording(0, cloud=Cloud(np.ones((2, 3), np.float32))), "ball-000 has a cloud of 2 points"),
        (with_table(recording(0), "cloud", NAN), "ball-000: 1 of 4 points are not finite"),
        (
            with_table(recording(0), "grasp", pa.concat_tables([grasp(0).table(0)] * 2)),
            "ball-000: A grasp's table has 2 rows",
        ),
        (
            with_table(recording(0), "reading", pa.concat_tables([recording(0).tables["reading"]] * 3)),
            "ball-000 has 3 readings; a grasp has one",
        ),
        (recording(0, grasp=FAR), "Recording ball-000: grasp point g2 lies 3[0-9][0-9] mm from the nearest point"),
    ],
)
def test_what_is_no_grasp_is_refused_by_name(shard: GraspShard, sentence: str) -> None:
    with pytest.raises(TacpipeError, match=sentence):
        grasps_of.read(dataset(shard))


@pytest.mark.parametrize("value", [None, float("nan"), float("inf")])
def test_a_reading_that_is_not_finite_is_refused_by_column(value: Any) -> None:
    shard = recording(0)
    table = shard.tables["reading"]
    index = table.column_names.index("th_electrode05")
    broken = table.set_column(index, "th_electrode05", pa.array([value], pa.float64()))
    with pytest.raises(TacpipeError, match="ball-000 has no finite reading in the column th_electrode05"):
        grasps_of.read(dataset(with_table(shard, "reading", broken)))


def test_a_grasp_point_may_lie_on_a_hidden_side_but_not_beyond() -> None:
    surface = Cloud(np.array([[0, 0, 1.0], [0.01, 0, 1.0], [0, 0.01, 1.0]], np.float32))
    limit = grasps_of.FARTHEST_M
    hidden = Grasp(np.array([0, 0, 1.0]), np.array([0, 0, 1.0 + 0.99 * limit]))
    grasps_of.check("The grasp", surface, hidden)
    far = Grasp(np.array([0, 0, 1.0 - 1.01 * limit]), np.array([0, 0, 1.0]))
    with pytest.raises(TacpipeError, match=f"The grasp: grasp point g1 lies {1010 * limit:.0f} mm from the nearest"):
        grasps_of.check("The grasp", surface, far)
