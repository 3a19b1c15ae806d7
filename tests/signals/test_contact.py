"""Load and contact intervals."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tacpipe.errors import TacpipeError
from tacpipe.signals.contact import (
    ContactLimits,
    axis_mean_level,
    contact_intervals,
    contact_row,
    load,
    noise_thresholds,
    rest_level,
    settled_rows,
)
from tacpipe.signals.repairs import repeated_rows

MS = 1_000_000
loads = hnp.arrays(np.float64, st.integers(1, 80), elements=st.floats(0, 10))


def intervals(values: list[float], **params: float) -> list[list[int]]:
    arguments = {"on": 5.0, "off": 3.0, "min_s": 0.0, "merge_s": 0.0, "pad_s": 0.0} | params
    t_ns = np.arange(len(values)) * 10 * MS
    spans: list[list[int]] = contact_intervals(np.array(values, dtype=np.float64), t_ns, **arguments).tolist()
    return spans


def test_one_bad_frame_does_not_shift_the_rest_level() -> None:
    values = np.array([[100, 7], [9000, 7], [101, 7], [5000, 0]])
    assert rest_level(values, np.arange(4) * 100 * MS, rest_s=0.2).tolist() == [101.0, 7.0]
    assert rest_level(values, np.arange(4) * 100 * MS, rest_s=0.0).tolist() == [100.0, 7.0]


def test_the_load_is_the_mean_length_of_the_taxels_vectors() -> None:
    values = np.array([[3, 4, 0, 1, 2, 2]], dtype=np.uint16)
    assert load(values, np.zeros(6)).tolist() == [4.0]
    assert load(values, np.zeros(6), axes=1).tolist() == [2.0]


def test_channels_that_are_no_whole_taxels_are_refused() -> None:
    with pytest.raises(TacpipeError, match=r"4 tactile.*taxels of 3 axes"):
        load(np.zeros((1, 4)), np.zeros(4))


def test_by_the_axis_mean_all_taxels_begin_at_its_whole_part() -> None:
    values = np.random.default_rng(0).integers(14_000, 51_000, (5, 48)).astype(np.uint16)
    tared = values - axis_mean_level(values)
    means = values[0].reshape(16, 3).mean(axis=0)
    assert tared[0].reshape(16, 3).tolist() == [[int(mean) for mean in means]] * 16
    np.testing.assert_array_equal(np.diff(tared, axis=0), np.diff(values.astype(float), axis=0))
    with pytest.raises(TacpipeError, match="taxels of 5 axes"):
        axis_mean_level(values, axes=5)
    with pytest.raises(TacpipeError, match="has no rows"):
        axis_mean_level(values[:0])


def test_between_off_and_on_the_state_stays() -> None:
    assert intervals([4, 5, 4, 3, 2.9, 4, 5, 2]) == [[1, 4], [6, 7]]


def test_contact_that_never_ends_ends_with_the_recording() -> None:
    assert intervals([0, 9, 9]) == [[1, 3]]
    assert intervals([0, 0]) == []


def test_contacts_that_are_near_are_one_and_short_ones_go() -> None:
    assert intervals([9, 9, 0, 9, 9, 0, 0, 0, 9], merge_s=0.02, min_s=0.02) == [[0, 5]]


def test_padding_stops_at_the_ends_and_midway_to_the_next_contact() -> None:
    assert intervals([0, 9, 0, 0, 0, 9, 0], pad_s=10.0) == [[0, 3], [3, 7]]
    assert intervals([0, 0, 9, 0, 0], pad_s=0.01) == [[1, 4]]


def test_thresholds_the_wrong_way_round_are_refused() -> None:
    with pytest.raises(TacpipeError, match="which must be 0 to"):
        intervals([0], on=1.0, off=2.0)


@given(loads, st.floats(0, 0.2), st.floats(0, 0.2))
def test_intervals_are_sorted_disjoint_and_hold_every_row_at_or_above_on(
    values: np.ndarray, merge_s: float, pad_s: float
) -> None:
    t_ns = np.arange(len(values)) * 10 * MS
    spans = contact_intervals(values, t_ns, 5.0, 3.0, 0.0, merge_s, pad_s)
    flat = spans.ravel()
    assert (np.diff(flat) >= 0).all()
    assert (spans[:, 1] > spans[:, 0]).all()
    inside = np.zeros(len(values), dtype=bool)
    for start, stop in spans:
        inside[start:stop] = True
    assert inside[values >= 5.0].all()


def touch(rows: int, peak: float, noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the values (time, channel) of three taxels at 100 Hz, pressed in the second half, and the rows' times."""
    rng = np.random.default_rng(seed)
    values = rng.normal(0, noise, (rows, 9)) + 3.0
    values[rows // 2 :, 2::3] += peak
    return values, np.arange(rows) * 10_000_000


def thresholds(values: np.ndarray, t_ns: np.ndarray) -> tuple[float, float]:
    return noise_thresholds(
        repeated_rows(values), load(values, rest_level(values, t_ns, 0.2)), t_ns <= t_ns[0] + 200_000_000
    )


@pytest.mark.parametrize("scale", [1e-6, 0.004, 1.0, 5000.0])
def test_thresholds_of_the_noise_follow_the_unit(scale: float) -> None:
    values, t_ns = touch(400, 500.0, 1.0)
    unscaled, scaled = thresholds(values, t_ns), thresholds(scale * values, t_ns)
    assert np.allclose(scaled, np.array(unscaled) * scale, rtol=1e-9)
    assert 40 < unscaled[0] < 125 and unscaled[1] == pytest.approx(unscaled[0] * 2 / 3)


@pytest.mark.parametrize(
    ("peak", "noise", "lowest", "highest"),
    [
        (20.0, 1.0, 10.0, 20.0),  # little more than noise: found all the same, above ten times the noise
        (500.0, 0.0, 24.0, 26.0),  # A twentieth of the largest load where there is no noise
        (0.0, 1.0, 10.0, 25.0),  # noise alone does not reach it
    ],
)
def test_thresholds_of_the_noise_lie_between_noise_and_load(
    peak: float, noise: float, lowest: float, highest: float
) -> None:
    values, t_ns = touch(400, peak, noise)
    on, _ = thresholds(values, t_ns)
    assert lowest < on < highest
    distance = load(values, rest_level(values, t_ns, 0.2))
    assert (distance[:200] < on).all() and (distance[200:] >= on).all() == (peak > 0)


def test_repeated_samples_and_one_wrong_frame_at_rest_leave_the_thresholds_of_the_noise() -> None:
    values, t_ns = touch(400, 500.0, 1.0)
    usual, _ = thresholds(values, t_ns)
    repeated = np.repeat(values[::4], 4, axis=0)
    assert 0.4 * usual < thresholds(repeated, t_ns)[0] < 2.5 * usual
    values[7, 4] += 5000
    assert thresholds(values, t_ns)[0] == pytest.approx(usual, rel=0.2)


def test_without_any_load_no_threshold_is_reached() -> None:
    values, t_ns = touch(100, 0.0, 0.0)
    assert thresholds(values, t_ns) == (np.inf, np.inf)
    assert thresholds(np.full_like(values, np.nan), t_ns) == (np.inf, np.inf)


def test_sensors_of_unlike_units_have_thresholds_of_their_own() -> None:
    t_ns = np.arange(10) * 10_000_000
    loads = np.zeros((2, 10))
    loads[0, 2:4], loads[1, 7:9] = 150.0, 0.3
    spans = contact_intervals(loads, t_ns, np.array([120.0, 0.2]), np.array([80.0, 0.1]), 0.0, 0.0, 0.0)
    assert spans.tolist() == [[2, 4], [7, 9]]
    loads[1, 2] = np.nan
    assert contact_intervals(loads, t_ns, 120.0, 80.0, 0.0, 0.0, 0.0).tolist() == [[3, 4]]


LIMITS = ContactLimits(rest_s=0.5, on_count=20.0, settle_s=0.2, settled_count=3.0)
STEP_NS = 10_000_000


def closing(
    middle: int = 150, thumb: int = 160, rows: int = 400, ramp: int = 40, pressed: float = 200.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return pressures (time, finger) that rise from these rows on in ``ramp`` rows, and stamps (time,)."""
    row = np.arange(rows)[:, None]
    rise = np.clip((row - np.array([middle, thumb])) / ramp, 0, 1) * pressed
    return np.array([1676.0, 2779.0]) + rise, row[:, 0] * STEP_NS


def test_contact_is_where_the_later_finger_leaves_rest() -> None:
    pressure, t_ns = closing(150, 160)
    assert contact_row(pressure, t_ns, LIMITS) == 161  # 5 counts a row
    assert contact_row(pressure[:, ::-1], t_ns, LIMITS) == 161
    assert contact_row(pressure, t_ns, replace(LIMITS, on_count=150.0)) == 161


def test_a_finger_that_was_knocked_at_rest_still_touches_where_it_presses() -> None:
    pressure, t_ns = closing()
    pressure[10:30, 1] += 180.0  # three times the noise that this makes is more than the grasp's own rise
    row = contact_row(pressure, t_ns, LIMITS)
    assert 160 <= row <= 164


@settings(max_examples=50, deadline=None)
@given(
    later=st.integers(60, 250), earlier=st.integers(0, 30), pressed=st.floats(100, 700), seed=st.integers(0, 2**32 - 1)
)
def test_contact_is_within_two_rows_of_a_rise_whatever_the_noise(
    later: int, earlier: int, pressed: float, seed: int
) -> None:
    pressure, t_ns = closing(later - earlier, later, pressed=pressed)
    pressure = np.rint(pressure + np.random.default_rng(seed).normal(0, 0.25, pressure.shape))
    assert abs(contact_row(pressure, t_ns, LIMITS) - later) <= 2


def test_noise_at_rest_widens_what_counts_as_rest() -> None:
    pressure, t_ns = closing(150, 160)
    pressure[:, 1] += np.where(np.arange(400) % 2, 4.0, -4.0)
    assert contact_row(pressure, t_ns, LIMITS) == 163  # the rise, 5 counts a row, and the noise are above 12 counts


def test_a_touch_that_is_let_go_is_no_contact() -> None:
    pressure, t_ns = closing(200, 210)
    pressure[80:95] += 30
    assert contact_row(pressure, t_ns, LIMITS) == 211
    pressure[80:101] += 30
    assert contact_row(pressure, t_ns, LIMITS) == 80


def test_the_reading_begins_where_both_pressures_rest() -> None:
    pressure, t_ns = closing(150, 160, ramp=40)
    settled = settled_rows(pressure, t_ns, 161, LIMITS)
    assert settled == slice(200, 220)
    assert settled_rows(pressure, t_ns, 161, replace(LIMITS, settled_count=10.0)) == slice(198, 218)  # 5 counts a row
    assert settled_rows(pressure, t_ns, 250, LIMITS) == slice(250, 270)


def test_the_rows_of_a_reading_follow_from_the_rate() -> None:
    pressure, t_ns = closing()
    settled = settled_rows(pressure, 5 * t_ns, 161, LIMITS)
    assert settled.stop - settled.start == 4


def test_a_finger_that_never_presses_is_told_with_its_rise() -> None:
    pressure, t_ns = closing()
    pressure[:, 1] = 2779 + 3 * (np.arange(400) == 200)
    with pytest.raises(TacpipeError, match=r"200, 3 counts.*20"):
        contact_row(pressure, t_ns, LIMITS)


def test_pressures_that_never_rest_are_told_with_what_they_vary_by() -> None:
    pressure, t_ns = closing()
    pressure[:, 0] += np.arange(400) % 2 * 40.0
    with pytest.raises(TacpipeError, match=r"0\.2 s.*40 counts"):
        settled_rows(pressure, t_ns, 161, LIMITS)
    with pytest.raises(TacpipeError, match="never steady"):
        settled_rows(*closing(rows=195), 161, LIMITS)


@pytest.mark.parametrize("rows", [0, 1, 20])
def test_a_stream_without_rows_to_hold_is_told(rows: int) -> None:
    pressure, t_ns = closing()
    with pytest.raises(TacpipeError, match=rf"{rows} rows"):
        contact_row(pressure[:rows], t_ns[:rows], LIMITS)
