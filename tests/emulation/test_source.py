"""Emulated sensors see one world, the same for the same seed, in their own units and types."""

import itertools

import numpy as np
import pytest

from tacpipe.channels import schema
from tacpipe.plugins import registry
from tacpipe.recording import rig
from tacpipe.sensors.anyskin import AnySkin
from tacpipe.sensors.camera import Camera
from tacpipe.sensors.optoforce import OptoForce
from tacpipe.sensors.tfmini import TfMini
from tacpipe.sensors.xela import Xela
from tacpipe.signals import kinematics
from tacpipe.simulation import pick_and_move, taxels
from tacpipe.simulation.faults import DeviceClock
from tests.emulation import ledger, world
from tests.emulation.camera_source import CameraSource, complete_camera
from tests.emulation.quantities import unit_scale
from tests.emulation.rigs import ALL_SENSORS
from tests.emulation.source import CloudSource, SampleSource, Timing
from tests.emulation.world import CYCLE_NS, World

WORLD = World(3)


def values(source: SampleSource, blocks: int) -> list[np.ndarray]:
    return [np.concatenate(parts) for parts in zip(*(source.block(n).values for n in range(blocks)), strict=True)]


def test_the_same_seed_gives_the_same_values_in_whatever_order_blocks_are_asked_for() -> None:
    forward = SampleSource(Xela(rate_hz=50), World(3), Timing(50), (3, 1))
    backward = SampleSource(Xela(rate_hz=50), World(3), Timing(50), (3, 1))
    later = [backward.block(n).values[0] for n in (5, 2, 0)]
    for n, backward_block in zip((5, 2, 0), later, strict=True):
        assert np.array_equal(forward.block(n).values[0], backward_block)
    other_finger = SampleSource(Xela(rate_hz=50), World(3), Timing(50), (4, 1))
    assert not np.array_equal(other_finger.block(0).values[0], later[-1])


def test_a_uskin_tells_the_force_of_the_contact() -> None:
    source = SampleSource(Xela(rate_hz=50), WORLD, Timing(50), finger=1)
    counts = values(source, 20)[0].astype(float)
    t_ns = source.timing.sample_ns(np.arange(len(counts)))
    pressed_n = taxels.forces(WORLD.skins[1], counts)[:, :, 2].sum(axis=1)
    true_n = WORLD.contact(t_ns, lambda scene: scene.contact.normal_n[:, 1])
    touching = true_n > 1
    assert touching.mean() > 0.5
    assert np.corrcoef(pressed_n, true_n)[0, 1] > 0.98
    assert np.abs(pressed_n - true_n)[touching].mean() < 0.25


def test_the_drift_of_a_uskin_goes_on_from_block_to_block() -> None:
    source = SampleSource(Xela(rate_hz=50), WORLD, Timing(50))
    ends = [source._drift_of_block(n)[[0, -1]] for n in range(40)]
    steps = np.array([after[0] - before[1] for before, after in itertools.pairwise(ends)])
    block_drifts = np.array([end[1] - end[0] for end in ends])
    assert np.abs(steps).std() < np.abs(block_drifts).std()  # one step of 20 ms against those of half a second
    assert np.abs(ends[-1][1]).mean() > np.abs(ends[0][1]).mean()


def test_sensors_of_one_rig_see_the_same_grasp() -> None:
    force = values(SampleSource(OptoForce(axes=3), WORLD, Timing(1000)), 20)[1][::20, 2].astype(float)
    skin = values(SampleSource(Xela(rate_hz=50), WORLD, Timing(50)), 20)[0][:, 2::3].astype(float).sum(axis=1)
    load_n = WORLD.contact(np.arange(len(force)) * 20_000_000, lambda scene: scene.contact.force_n[:, 2])
    assert np.corrcoef(-force, load_n)[0, 1] > 0.95
    assert np.corrcoef(skin, np.abs(force))[0, 1] > 0.5


def test_distance_grows_by_what_the_object_slips() -> None:
    world = World(0, pick_and_move.PickRig(effort=1.15))
    source = SampleSource(TfMini(unit="mm"), world, Timing(100))
    distance_mm = values(source, 20)[0][:, 0].astype(float)
    t_ns = source.timing.sample_ns(np.arange(len(distance_mm)))
    down_m = -world.contact(t_ns, lambda scene: scene.contact.displacement_m[:, 1])
    assert np.ptp(down_m) > 0.001
    assert np.abs(distance_mm - 120 - 1000 * down_m).max() < 6  # noise of 1 mm


def test_the_hand_is_where_the_joints_carry_it() -> None:
    t_ns = np.arange(0, 2 * CYCLE_NS, 50_000_000)
    place, _ = world.hand_pose(kinematics.joint_frames(kinematics.PANDA, WORLD.joint_angles(t_ns)))
    assert np.abs(place - WORLD.arm(t_ns)[:, 1:4]).max() < 5e-4
    angles = WORLD.joint_angles(t_ns)
    assert (angles >= world.MIN_JOINT_RAD).all() and (angles <= world.MAX_JOINT_RAD).all()


def test_the_joints_speeds_are_those_of_their_angles() -> None:
    t_ns = np.arange(CYCLE_NS // 2, CYCLE_NS, 10_000_000)
    step = (WORLD.joint_angles(t_ns + 10_000_000) - WORLD.joint_angles(t_ns - 10_000_000)) / 0.02
    assert np.abs(step - WORLD.joint_speeds(t_ns)).max() < 0.02


def test_joint_torques_do_the_work_of_the_load() -> None:
    angle = WORLD.joint_angles(np.array([4_000_000_000]))
    force = np.array([[1.0, -2.0, 3.0]])
    torque = world.joint_torques(angle, force)[0]
    for joint in range(7):
        moved = angle.copy()
        moved[0, joint] += 1e-5
        way = (
            world.hand_pose(kinematics.joint_frames(kinematics.PANDA, moved))[0]
            - world.hand_pose(kinematics.joint_frames(kinematics.PANDA, angle))[0]
        )
        assert torque[joint] * 1e-5 == pytest.approx(-float((way @ force[0])[0]), abs=1e-8)


def test_nothing_jumps_from_a_cycle_to_the_next() -> None:
    around = np.arange(CYCLE_NS - 50_000_000, CYCLE_NS + 50_000_000, 1_000_000)
    assert np.abs(np.diff(WORLD.arm(around), axis=0)).max() < 2e-4
    assert WORLD.contact(around, lambda scene: scene.contact.normal_n).max() < 1.5


def test_counters_go_round_when_they_are_told_to() -> None:
    source = SampleSource(OptoForce(), WORLD, Timing(1000, wrap_s=1.0))
    counts = np.concatenate([source.block(n).seq for n in range(3)])
    assert counts[999] == 65_535
    assert counts[1000] == 0


def test_a_fast_clock_takes_samples_faster_and_shows_their_nominal_spacing() -> None:
    timing = Timing(100, clock=DeviceClock(offset_ns=7_000_000, skew=1e-3))
    source = SampleSource(Xela(rate_hz=100), WORLD, timing)
    stamps = source.block(1).t_device_ns
    assert stamps is not None
    assert set(np.diff(stamps).tolist()) <= {9_999_999, 10_000_000, 10_000_001}
    assert np.diff(timing.sample_ns(np.arange(1001)))[:1000].sum() == pytest.approx(1e10 / 1.001, abs=2)
    assert timing.first_after(int(timing.sample_ns(np.array([500]))[0]) + 1000) == 501


@pytest.mark.parametrize("name", sorted(ALL_SENSORS.streams))
def test_every_registered_sensor_sends_what_its_driver_reads(name: str) -> None:
    sensor = ALL_SENSORS.streams[name].sensor
    if name == "clouds":
        samples = CloudSource(sensor, Timing(2), (0,)).block(0)
    elif isinstance(sensor, Camera):
        sensor = complete_camera(sensor, "")
        samples = CameraSource(sensor, WORLD, Timing(sensor.rate_hz), (0,), 0, "").block(8)
    else:
        samples = SampleSource(sensor, WORLD, Timing(sensor.rate_hz), (0,)).block(8)
    decoded_samples = ledger.decode_frames(sensor, sensor.encode(samples))
    assert len(decoded_samples) == len(samples)
    for sent, read in zip(samples.values, decoded_samples.values, strict=True):
        if sent.dtype.kind == "f":  # The wire carries float32 values, or four digits.
            assert np.allclose(sent, read, atol=2e-4, rtol=1e-5)
        elif name != "tap":
            assert np.array_equal(sent, read)


def test_the_rig_of_all_sensors_has_them_all() -> None:
    # outlets that pylsl makes; what a live session records itself
    served = set(registry.sensors()) - {"lsl", "live", "plan", "grasps"}
    assert {stream.kind for stream in ALL_SENSORS.streams.values()} == served


@pytest.mark.parametrize(
    ("unit", "scale"), [("m", 1.0), ("cm", 100.0), ("mN", 1000.0), ("0.1 N", 10.0), ("count", None)]
)
def test_units_are_told_in_those_of_si(unit: str, scale: float | None) -> None:
    assert unit_scale(unit) == (None if scale is None else pytest.approx(scale))


def test_a_board_of_counts_stays_within_its_type() -> None:
    text = 'numbers = [{ name = "taxel", type = "u8", count = 16, unit = "count" }], marker = "AA 55", rate_hz = 100'
    board = rig.parse(
        f'[[stream]]\nname = "a"\nsensor = "generic"\ntransport = "serial:/dev/x"\noptions = {{ {text} }}\n'
    )
    counts = values(SampleSource(board.streams["a"].sensor, WORLD, Timing(100)), 20)[0]
    assert counts.dtype == np.uint8
    assert 60 < counts.max() < 255
    assert counts[:20].max() < 10


def test_a_magnetometer_sends_multiples_of_its_resolution() -> None:
    (values,) = SampleSource(AnySkin(), World(1), Timing(100.0)).block(0).values
    flux = values.reshape(len(values), -1, 4)[..., 1:] / 0.15  # (sample, taxel, axis)

    assert np.abs(flux - np.rint(flux)).max() < 1e-3 and np.abs(flux).max() > 1


def test_columns_keep_the_names_of_published_recordings() -> None:
    assert [field.name for field in Xela().fields()] == [field.name for field in schema.uskin_fields()]
