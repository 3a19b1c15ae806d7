"""The moment of contact in pressures whose course is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.errors import TacpipeError
from tacpipe.signals.contact import ContactLimits, contact_row, settled_rows

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
