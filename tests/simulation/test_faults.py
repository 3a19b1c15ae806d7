"""Faults of a log against their ground truth."""

from __future__ import annotations

import numpy as np

from tacpipe.signals.holds import held
from tacpipe.simulation.faults import Clock, hold, sample_times, stamps


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def test_samples_are_evenly_spaced_and_the_share_that_is_lost_is_lost() -> None:
    whole = sample_times(10_000_000_000, 1000.0, 0.0, rng())
    assert len(whole) == 10_000
    assert set(np.diff(whole).tolist()) == {1_000_000}
    lossy = sample_times(10_000_000_000, 1000.0, 0.1, rng())
    assert 8_800 < len(lossy) < 9_200


def test_a_clock_without_jitter_shows_offset_and_skew_alone() -> None:
    true_ns = np.arange(0, 10**10, 10**7)
    found = stamps(true_ns, Clock(offset_ns=-7_000, skew=50e-6), rng())
    assert np.abs(found - (true_ns * (1 + 50e-6) - 7_000)).max() <= 0.5


def test_stamps_never_run_backwards_even_where_jitter_exceeds_the_period() -> None:
    found = stamps(np.arange(0, 10**9, 10**6), Clock(jitter_ns=5e6), rng())
    assert (np.diff(found) >= 0).all()


def test_held_frames_are_those_that_the_detector_finds() -> None:
    values = rng().permutation(3000).reshape(1000, 3)
    for probability in (0.0, 0.07, 0.75):
        logged, repeated = hold(values, probability, rng())
        assert held(logged).tolist() == repeated.tolist()
        assert abs(repeated.mean() - probability) < 0.04
        assert (logged[~repeated] == values[~repeated]).all()
