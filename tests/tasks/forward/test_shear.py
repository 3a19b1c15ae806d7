"""The score for slips, on forecasts made by hand: rise to the peak, fall behind it, over what presses."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.arrays import Floats
from tacpipe.tasks.forward.slips import floors, pressing, rise_and_fall, shear, skins

# two taxels of each axis on the left, a pad that only presses, one taxel along the skin alone on the right
LAYOUT = [
    *({"stream": "left", "axis": axis, "taxel": str(taxel)} for taxel in (1, 2) for axis in "xyz"),
    {"stream": "pad", "axis": "z", "taxel": "1"},
    *({"stream": "right", "axis": axis, "taxel": "1"} for axis in "xy"),
]
LEAST = np.array([10.0, 2.0])


def levels(left_means: tuple[float, float, float], right_means: tuple[float, float] = (0.0, 0.0)) -> list[float]:
    """Channels whose means on the left and right are these."""
    x, y, z = left_means
    return [x - 1, y + 2, z - 3, x + 1, y - 2, z + 3, 7000.0, *right_means]


def score(now: list[float], *ahead: list[float]) -> float:
    scores: Floats = rise_and_fall(np.array([ahead]), np.array([now]), LAYOUT, LEAST)
    assert scores.shape == (1,)
    return float(scores[0])


def test_the_shear_load_is_the_length_of_the_mean_of_a_skin() -> None:
    assert skins(LAYOUT) == ("left", "right")
    values = np.array([levels((3.0, -4.0, -50.0), (5.0, 12.0))])
    assert shear(values, LAYOUT).tolist() == [[5.0, 13.0]]
    assert pressing(values, LAYOUT).tolist() == [[50.0, 0.0]]  # the right one does not measure what presses


def test_the_score_is_the_rise_to_a_step_and_the_fall_behind_it_over_what_presses() -> None:
    now = levels((30.0, 40.0, 200.0))  # a shear load of 50
    ahead = [levels((36.0, 48.0, 0.0)), levels((60.0, 80.0, 0.0)), levels((42.0, 56.0, 0.0))]  # 60, 100, 70
    assert score(now, *ahead) == pytest.approx((100 - 50 + 100 - 70) / 200)


def test_a_peak_before_a_dip_counts_by_the_lowest_step_behind_it() -> None:
    now = levels((0.0, 10.0, 100.0))
    loads = (30.0, 5.0, 32.0)  # start 10: rise of 20 and fall of 25, or rise of 22 and no fall
    assert score(now, *(levels((0.0, load, 0.0)) for load in loads)) == pytest.approx((20 + 25) / 100)


def test_what_does_not_rise_has_no_score_and_persistence_neither() -> None:
    now = levels((0.0, 50.0, 100.0), (3.0, 4.0))
    assert score(now, now, now, now) == 0.0
    falling = (levels((0.0, load, 100.0), (3.0, 4.0)) for load in (50.0, 40.0, 30.0))
    assert score(now, *falling) == pytest.approx(20 / 100)  # a peak of 50 in the first step, and a fall of 20
    assert score(now, levels((0.0, 49.0, 100.0)), levels((0.0, 49.0, 100.0))) == 0.0


def test_next_to_no_pressure_divides_by_the_floor() -> None:
    now = levels((0.0, 0.0, 0.5))
    assert score(now, levels((0.0, 6.0, 0.5))) == pytest.approx(6 / 10)


def test_the_skin_with_the_largest_score_counts_each_over_its_own_load() -> None:
    now = levels((0.0, 0.0, 1000.0))
    assert score(now, levels((0.0, 100.0, 1000.0), (0.0, 1.0))) == pytest.approx(1.0 / 2.0)  # right: 1 over its floor


def test_a_forecast_that_is_not_finite_or_a_sensor_without_shear_has_no_score() -> None:
    now = levels((0.0, 0.0, 100.0))
    assert math.isnan(score(now, levels((0.0, math.nan, 0.0))))
    only = [{"stream": "pad", "axis": "z"}]
    assert np.isnan(rise_and_fall(np.ones((2, 3, 1)), np.ones((2, 1)), only, np.zeros(0))).all()
    assert floors(np.ones(1), only).shape == (0,)


@given(st.floats(1e-3, 1e6), st.integers(0, 1000))
def test_the_score_is_the_same_in_every_unit(scale: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    ahead, now, spread = rng.normal(0, 50, (3, 5, 9)), rng.normal(0, 50, (3, 9)), rng.uniform(1, 9, 9)
    in_counts = rise_and_fall(ahead, now, LAYOUT, floors(spread, LAYOUT))
    scaled = rise_and_fall(scale * ahead, scale * now, LAYOUT, floors(scale * spread, LAYOUT))
    assert np.allclose(in_counts, scaled)
