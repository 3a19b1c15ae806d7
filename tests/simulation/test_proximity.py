"""The proximity sensor against the slip that it sees."""

import numpy as np
import pytest

from tacpipe.simulation.pick_and_move import proximity_readings


def test_a_reading_falls_by_eight_counts_a_millimetre_and_saturates() -> None:
    counts = proximity_readings(np.array([0.0, -0.001, -0.010, -0.0245, -0.3]), 0.0, np.random.default_rng(0))
    assert counts.tolist() == [740, 732, 660, 544, 544]


def test_the_noise_is_the_published_one() -> None:
    counts = proximity_readings(np.zeros(100_000), 1.0, np.random.default_rng(0))
    assert counts.std() == pytest.approx(np.hypot(0.8, np.sqrt(1 / 12)), rel=0.02)  # rounding adds 1 / 12
