"""The limits of a slide, its retained rows, and the departures of one that is not as it should be."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import TacpipeError
from tacpipe.signals import slides

PROTOCOL = slides.Protocol(speed_m_s=0.025, speed_tolerance=0.05, min_s=5.5, pressure_low=2.0, pressure_high=150.0)


@given(st.lists(st.integers(0, 80), min_size=1, max_size=50))
def test_the_trigger_is_the_first_row_at_or_above_the_threshold(pressure: list[int]) -> None:
    rows = [row for row, count in enumerate(pressure) if count >= 40]
    if rows:
        assert slides.trigger_row(np.array(pressure), 40.0) == rows[0]
    else:
        with pytest.raises(TacpipeError, match=rf"40 counts.*{max(pressure)}"):
            slides.trigger_row(np.array(pressure), 40.0)


def test_a_pressure_without_readings_begins_nothing() -> None:
    with pytest.raises(TacpipeError, match="it has no finite value"):
        slides.trigger_row(np.full(4, np.nan), 40.0)


def test_an_arm_slides_from_its_first_steady_motion_to_its_last() -> None:
    speed = np.r_[np.zeros(20), 0.3, np.zeros(19), np.full(60, 0.025), np.zeros(3), np.full(57, 0.025), np.zeros(40)]
    assert slides.sliding_rows(speed, 0, 0.0125, 5) == (40, 160)  # neither the spike nor the halt counts
    assert slides.sliding_rows(speed, 90, 0.0125, 5) == (90, 160)
    assert slides.sliding_rows(speed, 0, 0.0125, 1) == (20, 160)
    assert slides.sliding_rows(speed, 0, 0.03, 5) is None
    assert slides.sliding_rows(speed, 170, 0.0125, 5) is None


@given(st.integers(0, 50), st.integers(1, 200), st.integers(1, 200))
def test_the_middle_of_a_slide_is_as_far_from_both_ends(first: int, length: int, frames: int) -> None:
    slide = (first, first + length)
    if frames > length:
        with pytest.raises(TacpipeError, match=rf"{length} rows.*row {first} .*{frames}"):
            slides.crop_rows(slide, frames, "middle", 0)
        return
    start, stop = slides.crop_rows(slide, frames, "middle", 0)
    assert stop - start == frames
    assert 0 <= (slide[1] - stop) - (start - slide[0]) <= 1
    assert slides.crop_rows(slide, frames, "none", 0) == slide


def test_the_published_crop_begins_101_rows_behind_the_trigger() -> None:
    assert slides.crop_rows((0, 600), 400, "offset", 101) == (101, 501)
    assert slides.crop_rows((8, 800), 400, "offset", 101) == (101, 501)
    with pytest.raises(TacpipeError, match=r"399 rows.*row 101"):
        slides.crop_rows((0, 500), 400, "offset", 101)
    with pytest.raises(TacpipeError, match=r"0 rows.*row 101"):
        slides.crop_rows((0, 50), 400, "offset", 101)


def test_no_frames_and_unknown_crops_are_refused() -> None:
    with pytest.raises(TacpipeError, match="but 0 are needed"):
        slides.crop_rows((0, 800), 0, "middle", 0)
    with pytest.raises(TacpipeError, match="'end'"):
        slides.crop_rows((0, 800), 400, "end", 0)


def test_phases_are_minus_one_before_zero_within_and_one_behind() -> None:
    phases = slides.phases(6, (2, 4))
    assert phases.dtype == np.int8
    assert phases.tolist() == [-1, -1, 0, 0, 1, 1]
    assert slides.phases(3, (0, 3)).tolist() == [0, 0, 0]


def test_a_slide_is_told_by_its_mean_pressure_and_force_and_its_median_speed() -> None:
    profile = {"speed_m_s": np.array([0.02, 0.025, 0.1]), "force_n": np.array([1.0, 2.0, 6.0])}
    assert slides.slide_statistics(np.array([1, 2, 4]), profile) == {
        "pressure_mean_count": 2.333,
        "speed_m_s": 0.025,
        "force_n": 3.0,
    }
    assert slides.slide_statistics(np.array([1, 2, 3]), {}) == {"pressure_mean_count": 2.0}
    profile["force_n"][1] = np.nan
    assert "force_n" not in slides.slide_statistics(np.array([1, 2, 4]), profile)


@pytest.mark.parametrize(
    ("lasts_s", "pressure", "speed_m_s", "expected"),
    [
        (8.0, 40.0, 0.025, []),
        (8.0, 40.0, None, []),
        (5.5, 2.0, 0.0262, []),
        (5.49, 40.0, 0.025, ["it lasts 5.49 s and not 5.5 or more"]),
        (8.0, 150.2, 0.025, ["its mean pressure is 150.2 counts and not 2 to 150"]),
        (8.0, 40.0, 0.0195, ["its speed is 19.5 mm/s and not 25.0"]),
        (1.0, 0.0, 0.05, ["its speed is", "it lasts", "its mean pressure"]),
    ],
)
def test_each_way_to_leave_the_protocol_is_told(
    lasts_s: float, pressure: float, speed_m_s: float | None, expected: list[str]
) -> None:
    measures = {"pressure_mean_count": pressure, **({} if speed_m_s is None else {"speed_m_s": speed_m_s})}
    departures = slides.protocol_deviations(PROTOCOL, lasts_s, measures)
    assert len(departures) == len(expected)
    assert all(departure.startswith(beginning) for departure, beginning in zip(departures, expected, strict=True))
