"""Faults of a log against their ground truth."""

import numpy as np
import pytest

from tacpipe.signals.repairs import repeated_rows
from tacpipe.simulation.faults import DeviceClock, arrivals, device_stamps, hold, samples


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def test_samples_are_evenly_spaced_and_the_share_that_is_lost_is_lost() -> None:
    complete = samples(10_000_000_000, 1000.0, 0.0, rng())
    assert len(complete.true_ns) == 10_000
    assert set(np.diff(complete.true_ns).tolist()) == {1_000_000}
    lossy = samples(10_000_000_000, 1000.0, 0.1, rng())
    assert 8_800 < len(lossy.true_ns) < 9_200


def test_the_numbers_of_the_samples_have_a_gap_where_one_is_lost() -> None:
    complete, lossy = samples(10**10, 400.0, 0.0, rng()), samples(10**10, 400.0, 0.1, rng())
    assert complete.seq.tolist() == list(range(4000))
    assert complete.lost == 0
    assert (lossy.true_ns == complete.true_ns[lossy.seq]).all()
    assert lossy.lost == (np.diff(lossy.seq) - 1).sum()
    assert lossy.lost == 4000 - len(lossy.seq) - lossy.seq[0] - (3999 - lossy.seq[-1])


def test_a_device_clock_shows_offset_and_skew_and_no_jitter() -> None:
    true_ns = np.arange(0, 10**10, 10**7)
    device_ns = device_stamps(true_ns, DeviceClock(offset_ns=-7_000, skew=50e-6))
    assert np.abs(device_ns - (true_ns * (1 + 50e-6) - 7_000)).max() <= 0.5


def test_samples_arrive_after_they_were_taken_as_late_and_as_scattered_as_asked() -> None:
    true_ns = np.arange(0, 10**12, 10**8)
    late_ns = arrivals(true_ns, 2e6, rng()) - true_ns
    assert late_ns.min() >= 0
    assert late_ns.mean() == pytest.approx(2e6, rel=0.05)
    assert late_ns.std() == pytest.approx(2e6, rel=0.05)
    assert (arrivals(true_ns, 0.0, rng()) == true_ns).all()


def test_arrivals_never_run_backwards_even_where_the_delay_exceeds_the_period() -> None:
    arrival_ns = arrivals(np.arange(0, 10**9, 10**6), 5e6, rng())
    assert (np.diff(arrival_ns) >= 0).all()


def test_held_frames_are_those_that_the_detector_finds() -> None:
    values = rng().permutation(3000).reshape(1000, 3)
    for probability in (0.0, 0.07, 0.75):
        logged, repeated = hold(values, probability, rng())
        assert repeated_rows(logged).tolist() == repeated.tolist()
        assert abs(repeated.mean() - probability) < 0.04
        assert (logged[~repeated] == values[~repeated]).all()
