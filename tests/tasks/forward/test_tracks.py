"""Test how a forecaster reads a recording: rows, columns, hand velocity, and rate."""

import dataclasses
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.codecs import codec as codecs
from tacpipe.codecs import tactile
from tacpipe.errors import TacpipeError
from tacpipe.io.columns import Columns
from tacpipe.io.parquet import to_parquet
from tacpipe.io.spill import MappedArrays
from tacpipe.signals import kinematics
from tacpipe.tasks.forward import tracks
from tacpipe.tasks.forward.tracks import Levels
from tests.fake_recordings import FakeShard
from tests.stages.learning_fakes import CHANNELS, table
from tests.tasks.forward.trials import panda, track

RNG = np.random.default_rng(0)
TACTILE = RNG.normal(size=(30, len(CHANNELS)))
JOINTED = RNG.normal(size=(60, len(CHANNELS)))


def measure_time(t_ns: np.ndarray) -> pa.Table:
    content = table(RNG.normal(size=(len(t_ns), len(CHANNELS))))
    return content.set_column(0, content.schema.field(0), [t_ns.astype(np.int64)])


def test_a_dataset_without_codec_gives_counts_above_rest() -> None:
    recorded = track(table(TACTILE))
    assert np.allclose(recorded.tactile, TACTILE, atol=2e-3)
    assert np.allclose(recorded.latent, recorded.tactile)


def test_windows_cross_neither_gaps_nor_missing_rows_and_contact_does_not_matter() -> None:
    contact, gap = np.repeat([-1, 0, 1], 10), np.zeros(30, dtype=bool)
    gap[15] = True
    recorded = track(table(TACTILE, contact=contact, gap=gap))
    assert recorded.starts(3, 2).tolist() == [*range(11), *range(16, 26)]
    t_ns = np.arange(30) * 20_000_000
    t_ns[12:] += 60_000_000
    assert track(measure_time(t_ns)).starts(5, 5).tolist() == [0, 1, 2, *range(12, 21)]


def test_windows_in_contact_lie_within_one_contact() -> None:
    contact, gap = np.repeat([-1, 0, 1, -1], [5, 10, 8, 7]), np.zeros(30, dtype=bool)
    gap[18] = True
    recorded = track(table(TACTILE, contact=contact, gap=gap))
    assert recorded.contact_starts(2, 2, 1).tolist() == [*range(5, 12), *range(19, 20)]
    assert recorded.contact_starts(2, 2, 3).tolist() == [5, 8, 11, 19]
    none = track(table(TACTILE, contact=np.full(30, -1)))
    assert none.contact_starts(2, 2, 1).tolist() == []
    assert len(none.starts(2, 2)) == 27


def test_windows_start_every_stride_rows_of_each_run() -> None:
    gap = np.zeros(30, dtype=bool)
    gap[10] = True
    assert track(table(TACTILE, gap=gap)).starts(2, 2, 4).tolist() == [0, 4, 11, 15, 19, 23]


def test_rows_that_are_not_finite_are_unusable_and_rows_without_contact_are_not() -> None:
    pose = np.tile([0.5, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0], (30, 1))
    pose[4, 0], pose[8, 3:] = np.nan, 0.0
    tactile = TACTILE.copy()
    tactile[13, 2] = np.nan
    finger = np.full(30, 0.04)
    finger[20] = np.nan
    contact = np.full(30, -1)
    recorded = track(table(tactile, pose, contact=contact, extra={"robot_finger_m": finger}))
    # the row after one without a pose has no velocity either
    assert np.flatnonzero(~recorded.usable).tolist() == [4, 5, 8, 9, 13, 20]
    assert recorded.finger[0] == pytest.approx(0.04)


def test_the_finger_s_width_is_zero_where_it_is_not_recorded() -> None:
    assert not track(table(TACTILE)).finger.any()


def test_what_is_held_and_the_grid_are_told_by_attributes() -> None:
    recorded = track(table(TACTILE), grid="fresh", object="bottle-200g")
    assert (recorded.timeline, recorded.object) == ("fresh", "bottle-200g")
    recorded = track(table(TACTILE))
    assert (recorded.timeline, recorded.object) == ("uniform", None)


def test_a_recording_without_rows_has_no_windows() -> None:
    recorded = track(table(TACTILE[:0]))
    assert recorded.starts(2, 2).tolist() == []
    assert recorded.contact_starts(2, 2, 1).tolist() == []
    assert tracks.rate_hz([recorded]) == 0.0


def test_quaternions_that_flip_their_sign_are_one_pose() -> None:
    angle = np.linspace(0, 3, 30)
    pose = np.zeros((30, 7))
    pose[:, 3], pose[:, 6] = np.sin(angle / 2), np.cos(angle / 2)
    flipped = pose.copy()
    flipped[::3, 3:] *= -1
    arms = [track(table(TACTILE, hand_pose)).arm for hand_pose in (pose, flipped)]
    aligned = [tracks.align_quaternions(arm, pose[0, 3:]) for arm in arms]
    assert np.allclose(aligned[0], aligned[1])
    assert np.allclose(aligned[0][:, :7], pose, atol=1e-6)
    opposite = tracks.align_quaternions(arms[0], -pose[0, 3:])
    assert np.allclose(opposite[:, 3:7], -pose[:, 3:], atol=1e-6)
    assert np.array_equal(opposite[:, 7:], arms[0][:, 7:])


def test_velocities_are_those_of_the_joints_where_the_arm_is_a_panda() -> None:
    pose, joints = panda()
    recorded = track(table(JOINTED, pose, extra=joints)).arm[:, 7:]
    rough = track(table(JOINTED, pose)).arm[:, 7:]
    assert recorded[0].any() and not rough[0].any()
    middle = (rough[1:-1] + rough[2:]) / 2  # central differences
    assert np.allclose(recorded[1:-1], middle, atol=0.01)
    assert np.abs(recorded).max() > 0.1


def test_a_plan_has_the_velocities_of_its_poses_also_where_those_of_the_past_are_of_joints() -> None:
    pose, joints = panda()
    jointed, jointless = track(table(JOINTED, pose, extra=joints)), track(table(JOINTED, pose))
    rows = np.array([[3, 4], [20, 21]])
    steps = (pose[rows, :3] - pose[rows - 1, :3]) / 0.02
    assert np.allclose(jointed.planned_arm(rows)[..., 7:10], steps, atol=1e-5)
    assert np.array_equal(jointed.planned_arm(rows), jointless.planned_arm(rows))
    assert np.array_equal(jointed.rows_between(3, 30).planned_arm(rows[:1] - 3), jointed.planned_arm(rows[:1]))
    assert not np.allclose(jointed.planned_arm(rows)[..., 7:], jointed.arm[rows][..., 7:], atol=1e-3)


@pytest.mark.parametrize("broken", ["another arm", "no speeds", "no joints"])
def test_velocities_are_differences_of_poses_on_any_other_arm(broken: str) -> None:
    pose, joints = panda()
    if broken == "another arm":
        joints = {
            name: values + 0.5 * ("joint2_rad" in name) * np.sin(np.arange(60)) for name, values in joints.items()
        }
    else:
        left_out = "velocity" if broken == "no speeds" else "joint"
        joints = {name: values for name, values in joints.items() if left_out not in name}
    recorded = track(table(JOINTED, pose, extra=joints))
    expected = kinematics.difference_velocity(recorded.t_ns, pose[:, :3], recorded.arm[:, 3:7].astype(float))
    assert np.allclose(recorded.arm[:, 7:], expected, atol=1e-4)


def test_a_gap_in_the_joints_leaves_the_other_rows_their_velocities() -> None:
    pose, joints = panda()
    joints["robot_joint3_rad"][20] = np.nan
    intact, torn = track(table(JOINTED, pose, extra=panda()[1])), track(table(JOINTED, pose, extra=joints))
    assert np.flatnonzero(~torn.usable).tolist() == [20]
    assert np.array_equal(np.delete(torn.arm, 20, 0), np.delete(intact.arm, 20, 0))


@pytest.mark.parametrize(
    ("grid", "step", "windows"),
    [("uniform", 1.4, 25), ("uniform", 1.6, 20), ("logged", 2.9, 25), ("logged", 3.1, 20), ("fresh", 3.1, 20)],
)
def test_how_far_apart_rows_may_be_depends_on_their_grid(grid: str, step: float, windows: int) -> None:
    t_ns = np.arange(30.0) * 20e6
    t_ns[12:] += (step - 1) * 20e6
    assert len(track(measure_time(t_ns), grid=grid).starts(3, 3)) == windows


def test_ground_truth_is_never_read() -> None:
    content = table(TACTILE, extra={"gt_slip": np.zeros(30)})
    with pytest.raises(TacpipeError, match="ground truth"):
        tracks.inputs(content, ["gt_slip"])


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (table(TACTILE, rest=None), "trial: Channel xela1_taxel01_x has no rest level"),
        (table(TACTILE).drop_columns(["contact"]), "trial: There is no column contact"),
        (table(TACTILE).drop_columns(["robot_position_x_m"]), "trial: There is no column robot_position_x_m"),
    ],
)
def test_what_is_absent_is_named_with_its_recording(content: pa.Table, reason: str) -> None:
    with pytest.raises(TacpipeError, match=reason):
        track(content)


def test_tables_and_codecs_that_do_not_belong_together_are_refused() -> None:
    bare = table(TACTILE)
    latent = bare.append_column(bare.schema.field(0).with_name("z00").with_metadata({"quantity": "latent"}), bare[0])
    with pytest.raises(TacpipeError, match="1 latent columns but its dataset no codec"):
        tracks.codec_of(latent.schema, {})
    with pytest.raises(TacpipeError, match="quantity tactile"):
        tracks.codec_of(bare.select(["t_ns"]).schema, {})
    reversed_codec = codecs.Raw(tuple(reversed(CHANNELS)), ())
    with pytest.raises(TacpipeError, match=r"trial: The tactile columns differ .* they come in another order"):
        tracks.track(FakeShard("trial", bare), reversed_codec)  # type: ignore[arg-type]


def at(name: str, found_hz: float, timeline: str) -> tracks.Track:
    """A track without anything but its rows' times."""
    t_ns = np.rint(np.arange(30) * 1e9 / found_hz).astype(np.int64)
    return dataclasses.replace(track(table(TACTILE), name), t_ns=t_ns, timeline=timeline)


@pytest.mark.parametrize("timeline", ["logged", "fresh"])
def test_rows_as_logged_or_fresh_may_come_at_different_rates(timeline: str) -> None:
    recorded = [at(name, found_hz, timeline) for name, found_hz in (("a", 32.0), ("b", 41.0), ("c", 46.0))]
    assert tracks.rate_hz(recorded) == pytest.approx(41.0, rel=1e-6)


def test_rates_on_a_grid_that_differ_are_named_with_their_recordings() -> None:
    slow = at("slow", 25.0, "uniform")
    assert tracks.rate_hz([slow, slow]) == 25.0
    with pytest.raises(TacpipeError, match=r"slow runs at 25\.00 Hz and fast at 50\.00 Hz"):
        tracks.rate_hz([slow, at("fast", 50.0, "uniform")])


def test_grids_of_several_kinds_do_not_mix() -> None:
    with pytest.raises(TacpipeError, match="not of one grid: raw is logged, even is uniform"):
        tracks.rate_hz([at("raw", 50.0, "logged"), at("even", 50.0, "uniform")])


ROWS, REST = 50, (16000.3, 0.1)


def levels_table(kind: pa.DataType) -> pa.Table:
    values = np.random.default_rng(0).integers(0, 200, (2, ROWS))
    fields = [
        pa.field(f"x{number}", kind, metadata={"quantity": "tactile", "rest": str(level)})
        for number, level in enumerate(REST)
    ]
    return pa.Table.from_arrays(
        [pa.array(values_of_channel).cast(kind) for values_of_channel in values], schema=pa.schema(fields)
    )


@pytest.mark.parametrize(
    ("kind", "bytes_each"), [(pa.float32(), 4), (pa.uint16(), 4), (pa.int32(), 8), (pa.float64(), 8)]
)
def test_every_index_gives_the_bits_that_an_array_gives(kind: pa.DataType, bytes_each: int) -> None:
    columns = levels_table(kind)
    expected = tactile.above_rest(columns, ["x0", "x1"])
    lazy = tracks.above_rest(Columns(to_parquet(columns)), ["x0", "x1"], MappedArrays(0))
    assert lazy.stored.nbytes == ROWS * 2 * bytes_each
    windows = np.arange(6)[:, None] + np.arange(4)
    for at in (slice(None), slice(3, 9), windows, np.arange(ROWS) > 7, (slice(None), [1, 0]), (windows[:, 0], 1)):
        assert np.array_equal(lazy[at], expected[at]) and lazy[at].dtype == np.float64
        assert np.array_equal(lazy.astype(np.float32)[at], expected[at].astype(np.float32))
    assert np.array_equal(lazy.rows_between(4, 20)[windows], expected[4:20][windows])
    assert np.array_equal(np.asarray(lazy), expected) and lazy.shape == expected.shape


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_row_with_a_level_that_is_not_finite_is_known_in_every_block(
    monkeypatch: pytest.MonkeyPatch, value: float
) -> None:
    monkeypatch.setattr(tracks, "BLOCK_ROWS", 7)
    stored: np.ndarray[Any, Any] = np.zeros((20, 3), np.float32)
    stored[[0, 6, 7, 19], [0, 1, 2, 0]] = value
    assert np.flatnonzero(~Levels(stored, np.zeros(3)).finite(MappedArrays(0))).tolist() == [0, 6, 7, 19]
