"""The simulated slides: levels and spectra follow from force, speed and material; sessions leave a fingerprint."""

from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import polynomial
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

from tacpipe.formats.roboskin import is_time, lag_one, scramble, unscramble
from tacpipe.io.parquet import to_parquet
from tacpipe.plugins.registry import load
from tacpipe.simulation import fingertip, forearm
from tacpipe.simulation.slide import SENSORS, SlideRig, material, nuisance, simulate_trial, slide_trial
from tests.fake_recordings import column

PLAIN = SlideRig(pac=False, arm_every=0)
QUIET = replace(PLAIN, noise_scale=0.0, session_scale=0.0)
APERTURE_M = {"biotac": 0.0006, "roboskin": 0.0018}
stage = load("simulate.material")


def trial(sensor: str, number: int = 0, material_number: int = 1, materials: int = 20) -> int:
    """Return the index of a trial: sensors by turns, then materials, then numbers."""
    return 2 * materials * number + 2 * (material_number - 1) + SENSORS.index(sensor)


def tactile(table: pa.Table) -> np.ndarray:
    """Return the electrodes or taxels of a stream (time, channel)."""
    names = [name for name in table.column_names if name.startswith(("electrode", "triangle"))]
    return np.column_stack([column(table, name) for name in names]).astype(float)


def middle(sensor: str, index: int, rig: SlideRig, seed: int = 0) -> np.ndarray:
    """Return the middle 400 frames of a slide of the BioTac, or all of RoboSkin (time, channel)."""
    streams = simulate_trial(seed, index, rig).streams
    counts = tactile(streams[sensor])
    if sensor == "roboskin":
        return counts
    counts = counts[column(streams["truth"], "gt_phase") == 0]
    middle_counts: np.ndarray = counts[(len(counts) - 400) // 2 :][:400]
    return middle_counts


@pytest.mark.long
@pytest.mark.parametrize(("sensor", "lowest_share"), [("biotac", 1.0), ("roboskin", 0.95)])
@pytest.mark.parametrize("speed_m_s", [0.0125, 0.025, 0.05])
def test_the_dominant_peak_is_the_speed_over_the_wavelength_that_is_felt_most(
    sensor: str, speed_m_s: float, lowest_share: float
) -> None:
    rig = replace(PLAIN, speed_m_s=speed_m_s, roboskin_speed_m_s=speed_m_s)
    right = []
    for number in range(1, 21):
        spectrum = material(0, sensor, number, rig)
        felt = spectrum.amplitude_n * np.exp(-2 * (np.pi * APERTURE_M[sensor] / spectrum.wavelength_m) ** 2)
        # Wear decides between equally strong ones.
        wanted_hz = speed_m_s / spectrum.wavelength_m[felt >= 0.9 * felt.max()]
        found_hz, bin_hz = peak(sensor, number, rig)
        right.append(np.abs(found_hz - wanted_hz).min() <= 1.5 * bin_hz)
    assert np.mean(right) >= lowest_share


def peak(sensor: str, number: int, rig: SlideRig) -> tuple[float, float]:
    """Return the frequency of the largest power of ten trials, summed over adjacent bins, and the bin width, in Hz."""
    speed_m_s, rate_hz, fine = rig.speed_m_s, 100.0 if sensor == "biotac" else 50.0, 8
    power: Any = 0.0
    for index in (trial(sensor, n, number) for n in range(10)):
        counts = middle(sensor, index, rig)
        if sensor == "roboskin":  # The known trend of the moving patch is subtracted.
            truth = simulate_trial(0, index, rig).streams["truth"]
            patch = np.column_stack([column(truth, f"gt_patch_{axis}_m") for axis in ("along", "across")])
            share = forearm.fractions(patch)
            counts = ((counts + forearm.DEAD_COUNT) / share)[:, (share > 0.3).all(axis=0)]
        at = np.linspace(-1, 1, len(counts))
        counts = counts - polynomial.polyval(at, polynomial.polyfit(at, counts, 3)).T
        tapered = counts * np.hanning(len(counts))[:, None]
        power = power + (np.abs(np.fft.rfft(tapered, fine * len(counts), axis=0)) ** 2).sum(axis=1)
    bin_hz = rate_hz / len(counts)
    at_hz = np.arange(len(power)) * bin_hz / fine
    near = np.convolve(np.where(at_hz > speed_m_s / 0.015, power, 0.0), np.ones(2 * fine + 1), "same")
    return float(at_hz[near.argmax()]), bin_hz


@pytest.mark.parametrize("sensor", SENSORS)
def test_without_noise_the_mean_level_is_linear_in_the_force(sensor: str) -> None:
    forces, levels = [], list[Any]()
    for force_n in np.linspace(0.6, 1.4, 9):
        rig = replace(QUIET, force_n=float(force_n))
        index = trial(sensor, 2, 7)
        truth = simulate_trial(0, index, rig).streams["truth"]
        forces.append(column(truth, "gt_force_n")[column(truth, "gt_phase") == 0][-300:].mean())
        levels.append(middle(sensor, index, rig))
    always = (np.min(levels, axis=(0, 1)) > 0) | (sensor == "biotac")  # Taxels that are idle at times are left out.
    levels = [counts[:, always].mean() for counts in levels]
    assert np.corrcoef(forces, levels)[0, 1] ** 2 > 0.99
    assert max(forces) > 2 * min(forces)


def test_the_pressure_is_28_counts_a_newton() -> None:
    forces, pressures = [], []
    for number, force_n in enumerate(np.linspace(0.5, 2.0, 12)):
        streams = simulate_trial(0, trial("biotac", number, 5), replace(PLAIN, force_n=float(force_n))).streams
        settled = column(streams["truth"], "gt_force_n"), column(streams["biotac"], "pdc").astype(float)
        forces.append(settled[0][-500:-100].mean())
        pressures.append(settled[1][-500:-100].mean())
    assert np.polyfit(forces, pressures, 1)[0] == pytest.approx(28.0, rel=0.02)


def test_the_slide_starts_within_one_sample_of_the_pressure_passing_40() -> None:
    for number in range(40):
        streams = simulate_trial(1, trial("biotac", number % 2, number // 2 + 1), PLAIN).streams
        above = int((column(streams["biotac"], "pdc") > 40).argmax())
        start = int((column(streams["truth"], "gt_phase") == 0).argmax())
        assert abs(above - start) <= 1
        assert not column(streams["truth"], "gt_position_m")[: start + 1].any()


def test_the_finger_comes_down_at_half_a_millimetre_a_second() -> None:
    for number in (2, 9, 17):
        truth = simulate_trial(0, trial("biotac", 0, number), QUIET).streams["truth"]
        coming = (column(truth, "gt_phase") < 0) & (column(truth, "gt_force_n") > 0)
        slope = np.polyfit(column(truth, "t_ns")[coming] / 1e9, column(truth, "gt_force_n")[coming], 1)[0]
        assert slope == pytest.approx(0.0005 * material(0, "biotac", number).stiffness_n_m, rel=1e-4)


def test_an_arm_slides_eight_seconds_at_25_mm_a_second_but_six_on_material_one() -> None:
    for number, seconds in ((1, 6), (2, 8), (20, 8)):
        truth = simulate_trial(0, trial("biotac", 3, number), PLAIN).streams["truth"]
        inside = column(truth, "gt_phase") == 0
        assert inside.sum() == 100 * seconds
        assert column(truth, "gt_speed_m_s")[inside][50:-50].mean() == pytest.approx(0.025, rel=0.04)
        assert np.ptp(column(truth, "gt_position_m")) == pytest.approx(0.025 * (seconds - 0.2), rel=0.04)
        moved = np.diff(column(truth, "gt_position_m")) * 100
        np.testing.assert_allclose(moved, column(truth, "gt_speed_m_s")[1:], atol=0.0015)


def test_a_forearm_slides_75_frames_at_a_speed_that_wanders_by_30_percent_at_most() -> None:
    shares = []
    for number in range(60):
        streams = simulate_trial(0, trial("roboskin", number, 4), PLAIN).streams
        assert streams["roboskin"].num_rows == streams["truth"].num_rows == 75
        speed = column(streams["truth"], "gt_speed_m_s") / 0.05
        shares.append(np.abs(speed - 1).max())
        moved = np.diff(column(streams["truth"], "gt_position_m")) * 50 / 0.05
        np.testing.assert_allclose(moved, (speed[1:] + speed[:-1]) / 2, atol=0.01)
    assert 0.1 < max(shares) <= 0.3


def test_half_of_the_taxels_are_idle_and_none_reads_below_zero_or_above_255() -> None:
    counts = np.array([middle("roboskin", index, PLAIN) for index in range(1, 400, 2)])
    assert (counts == 0).mean() == pytest.approx(0.51, abs=0.06)
    assert counts.min() == 0
    assert counts.max() <= 255
    pressed = np.array([middle("roboskin", index, replace(PLAIN, force_n=4.0)) for index in (1, 3)])
    assert pressed.max() == 255


def test_counts_of_a_finger_are_absolute_integers_of_the_size_of_published_ones() -> None:
    counts = np.array([middle("biotac", index, PLAIN) for index in range(0, 80, 2)])
    table = simulate_trial(0, 2, PLAIN).streams["biotac"]
    assert all(kind.type == pa.uint16() for kind in table.schema if kind.name != "t_ns")
    assert counts.max() < 235
    level = counts.mean(axis=(0, 1))
    assert 2 < level.min() < level.max() < 60  # 19 means of published slides: 0 to 60
    steps = np.diff(counts, n=2, axis=1).std(axis=(0, 1)) / np.sqrt(6)
    assert 0.75 < np.median(steps) < 1.0  # 0.8 there
    before = tactile(table)[: fingertip.TARE_ROWS]
    assert before.mean() < 2


def test_roboskin_is_three_times_as_noisy() -> None:
    assert forearm.NOISE_COUNT == 3 * fingertip.NOISE_COUNT
    assert forearm.APERTURE_M == 3 * fingertip.APERTURE_M


def test_time_of_roboskin_is_the_axis_that_the_rule_finds_until_it_is_scrambled() -> None:
    for index in range(1, 200, 2):
        felt = middle("roboskin", index, PLAIN).T.reshape(6, 10, 75)  # (triangle, taxel, time)
        assert is_time(felt, 2)
        assert lag_one(felt, 2) > 0.9
        assert not is_time(scramble(felt), 2)
        np.testing.assert_array_equal(unscramble(scramble(felt)), felt)


@given(st.integers(0, 2000), st.integers(1, 25), st.integers(1, 4))
def test_trials_take_turns_over_sensors_then_materials_then_sessions(index: int, materials: int, sessions: int) -> None:
    placed = slide_trial(index, SlideRig(materials=materials, sessions=sessions))
    assert placed.sensor == ("biotac", "roboskin")[index % 2]
    assert placed.material == index // 2 % materials + 1
    assert placed.number == index // (2 * materials)
    assert placed.session == placed.number % sessions + 1


def test_attributes_say_which_sensor_material_trial_and_session_it_is() -> None:
    slide = stage(stage.params(sessions=2), 2 * 20 * 3 + 9)
    assert slide.attributes == {
        "sensor": "roboskin",
        "simulated": True,
        "material": 5,
        "trial": 4,
        "session": "roboskin-m05-s2",
        "rate_hz": 50.0,
        "layout": "time",
    }
    assert stage(stage.params(), 8).attributes | {"sensor": "biotac", "rate_hz": 100.0} == {
        "sensor": "biotac",
        "simulated": True,
        "material": 5,
        "trial": 1,
        "session": "biotac-m05-s1",
        "rate_hz": 100.0,
    }


def test_materials_that_are_identical_leave_nothing_but_the_session() -> None:
    rig = replace(PLAIN, identical_materials=True, sessions=2)
    for sensor in SENSORS:
        kinds = [material(3, sensor, number, rig) for number in (1, 2, 20)]
        assert len({(*kind.wavelength_m, *kind.amplitude_n, kind.friction, kind.stiffness_n_m) for kind in kinds}) == 1
    lengths = {len(column(simulate_trial(3, trial("biotac", 0, n), rig).streams["truth"], "t_ns")) for n in (1, 2, 3)}
    slides = [
        int((column(simulate_trial(3, trial("biotac", 0, n), rig).streams["truth"], "gt_phase") == 0).sum())
        for n in (1, 2, 3)
    ]
    assert slides == [800, 800, 800]
    assert max(lengths) - min(lengths) < 60  # All have one stiffness: only the hover differs.


def test_the_trials_of_a_session_have_a_fingerprint_in_common_and_those_of_another_have_another() -> None:
    rig = replace(QUIET, session_scale=1.0, identical_materials=True, sessions=2)
    for sensor, number in (("biotac", 19), ("roboskin", 60)):
        offset = {
            (material_number, n): nuisance(0, trial(sensor, n, material_number), number, rig)[1]
            for material_number in (1, 2)
            for n in range(4)
        }
        same_session = [
            np.corrcoef(offset[material_number, n], offset[material_number, n + 2])[0, 1]
            for material_number in (1, 2)
            for n in (0, 1)
        ]
        other_sessions = [np.corrcoef(offset[1, 0], offset[key])[0, 1] for key in ((1, 1), (2, 0), (2, 1))]
        assert min(same_session) > 0.99
        assert max(np.abs(other_sessions)) < 0.7
        gains = {
            nuisance(0, trial(sensor, n, material_number), number, rig)[0]
            for material_number in (1, 2)
            for n in range(4)
        }
        assert len(gains) == 4
        drift = [nuisance(0, trial(sensor, n), number, rig)[1] for n in (0, 2, 48)]
        assert np.abs(drift[1] - drift[0]).max() < np.abs(drift[2] - drift[0]).max()


@pytest.mark.long
@pytest.mark.parametrize("sensor", SENSORS)
def test_a_session_tells_the_class_of_identical_materials_and_another_session_does_not(sensor: str) -> None:
    rig, classes, numbers = replace(PLAIN, identical_materials=True, sessions=2, materials=10), 10, 30
    level = np.array(
        [
            [
                middle(sensor, trial(sensor, number, material_number, classes), rig).mean(axis=0)
                for material_number in range(1, classes + 1)
            ]
            for number in range(numbers)
        ]
    )  # (number, class, channel)

    def accuracy(train: range, test: range) -> float:
        labels = np.tile(np.arange(classes), len(train))
        readout = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto")
        readout.fit(level[train].reshape(len(labels), -1), labels)
        samples = level[test].reshape(len(test) * classes, -1)
        return float((readout.predict(samples) == np.tile(np.arange(classes), len(test))).mean())

    assert accuracy(range(20), range(20, numbers)) > 0.3  # The session is known.
    accuracies = [accuracy(range(first, numbers, 2), range(1 - first, numbers, 2)) for first in (0, 1)]
    assert np.mean(accuracies) < 0.1 + 3 * np.sqrt(0.1 * 0.9 / 20)  # the slides of a class and session are one sample


def test_sensors_share_their_materials_unless_their_spectra_are_independent() -> None:
    independent = SlideRig(spectra="independent")
    for number in (1, 7, 20):
        finger, arm = (material(0, sensor, number) for sensor in SENSORS)
        np.testing.assert_array_equal(finger.wavelength_m, arm.wavelength_m)
        independent_arm = material(0, "roboskin", number, independent)
        assert not np.isin(independent_arm.wavelength_m, arm.wavelength_m).any()
        np.testing.assert_array_equal(material(0, "biotac", number, independent).wavelength_m, finger.wavelength_m)


def test_every_twentieth_slide_of_a_finger_has_the_arm_with_it_on_a_clock_of_its_own() -> None:
    streams = {n: simulate_trial(0, trial("biotac", n, 6)).streams for n in (0, 1, 19, 20)}
    assert [sorted(stream_names) for stream_names in streams.values()] == [
        ["biotac", "truth", "twist", "wrench"],
        ["biotac", "truth"],
        ["biotac", "truth"],
        ["biotac", "truth", "twist", "wrench"],
    ]
    twist, truth = streams[0]["twist"], streams[0]["truth"]
    steps_ms = np.diff(column(twist, "t_ns")) / 1e6
    assert np.median(steps_ms) == pytest.approx(1000 / 150, abs=0.3)
    assert 30 < steps_ms.max() < 600
    assert steps_ms.min() > 0
    speed = np.interp(column(twist, "t_ns"), column(truth, "t_ns"), column(truth, "gt_speed_m_s"))
    assert np.median(np.abs(column(twist, "velocity_x_m_s") + speed)) < 0.001
    assert np.isnan(column(twist, "angular_velocity_x_rad_s")).all()
    force = np.interp(column(streams[0]["wrench"], "t_ns"), column(truth, "t_ns"), column(truth, "gt_force_n"))
    assert np.corrcoef(column(streams[0]["wrench"], "force_z_n"), force)[0, 1] > 0.8
    assert not set(simulate_trial(0, trial("roboskin", 0, 6)).streams) - {"roboskin", "truth"}


def test_frames_of_a_finger_reach_the_host_late_and_in_order() -> None:
    streams = simulate_trial(0, 2, replace(PLAIN, jitter_ms=2.0)).streams
    late_ms = (column(streams["biotac"], "t_ns") - column(streams["truth"], "t_ns")) / 1e6
    assert late_ms.min() >= 0
    assert late_ms.mean() == pytest.approx(2.0, rel=0.2)
    assert (np.diff(column(streams["biotac"], "t_ns")) >= 0).all()
    for index in range(0, 40, 2):
        assert (np.diff(column(simulate_trial(0, index, PLAIN).streams["biotac"], "t_ns")) > 0).all()


def test_vibration_follows_the_texture_and_may_be_left_out() -> None:
    with_pac, without = (simulate_trial(0, 2, replace(PLAIN, pac=pac)).streams for pac in (True, False))
    readings = [name for name in with_pac["biotac"].column_names if name.startswith("pac")]
    assert len(readings) == 22
    sliding = column(with_pac["truth"], "gt_phase") == 0
    pac = np.column_stack([column(with_pac["biotac"], name) for name in readings])
    assert pac[sliding].mean() > 5 * pac[:15].mean()
    assert not any(column(without["biotac"], name).any() for name in readings)
    np.testing.assert_array_equal(tactile(with_pac["biotac"]), tactile(without["biotac"]))


def test_ground_truth_is_in_the_stream_truth_and_nowhere_else() -> None:
    for index in (0, 1):
        slide = simulate_trial(0, index)
        assert all(name.startswith("gt_") for name in slide.streams["truth"].column_names[1:])
        measured = [name for key, table in slide.streams.items() if key != "truth" for name in table.column_names]
        assert not any(name.startswith("gt_") for name in [*measured, *slide.attributes])


@pytest.mark.parametrize("index", [4, 5])
def test_the_same_seed_and_trial_give_the_same_bytes(index: int) -> None:
    first, repeat = (stage(stage.params(seed=5), index) for _ in range(2))
    assert first.attributes == repeat.attributes
    assert all(to_parquet(table) == to_parquet(repeat.streams[name]) for name, table in first.streams.items())
    sensor = SENSORS[index % 2]
    for different in (stage(stage.params(seed=6), index), stage(stage.params(seed=5), index + 40)):
        assert not first.streams[sensor].equals(different.streams[sensor])
    long_run = stage(stage.params(seed=5, trials=5000), index)
    assert long_run.streams[sensor].equals(first.streams[sensor])


def test_materials_sessions_and_trials_have_random_numbers_of_their_own() -> None:
    three_sessions, single = SlideRig(sessions=3), SlideRig(sessions=1)
    assert nuisance(0, trial("biotac", 0), 19, three_sessions)[0] == nuisance(0, trial("biotac", 0), 19, single)[0]
    five_materials = SlideRig(materials=5)
    np.testing.assert_array_equal(
        material(0, "biotac", 4, five_materials).wavelength_m, material(0, "biotac", 4, single).wavelength_m
    )
    calm, strong = (simulate_trial(0, 4, replace(PLAIN, session_scale=scale)) for scale in (0.0, 1.0))
    assert calm.streams["truth"].equals(strong.streams["truth"])
    assert not calm.streams["biotac"].equals(strong.streams["biotac"])
