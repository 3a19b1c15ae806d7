"""A clock whose offset was measured now and then: its line is found through wrong measurements, and its resets."""

from __future__ import annotations

import numpy as np
import pytest

from tacpipe.arrays import Int64s
from tacpipe.signals.clocks import find_resets, fit_offsets, times_by_offsets

RNG = np.random.default_rng(3)
EVERY_NS = 5_000_000_000


def measure(count: int, drift: float, noise_ns: float = 0.0, start_ns: int = 0) -> tuple[Int64s, Int64s]:
    device_ns = start_ns + np.arange(count, dtype=np.int64) * EVERY_NS
    offset_ns = 123_456_789_012 + np.rint(device_ns * drift + RNG.normal(0, noise_ns, count)).astype(np.int64)
    return device_ns, offset_ns


@pytest.mark.parametrize("drift", [0.0, 50e-6, -200e-6])
def test_the_line_is_the_true_one_within_the_noise_of_its_measurements(drift: float) -> None:
    device_ns, offset_ns = measure(200, drift, noise_ns=200_000)
    offset_ns[[20, 77, 150]] += [40_000_000, -90_000_000, 300_000_000]  # Three measurements were held up on their way

    lines = fit_offsets(device_ns, offset_ns)

    (line,) = lines
    assert line.drift == pytest.approx(drift, abs=0.3e-6)
    at_ns = np.arange(0, 1000 * 10**9, 10**8)
    truth_ns = at_ns + 123_456_789_012 + np.rint(at_ns * drift).astype(np.int64)
    assert np.abs(times_by_offsets(lines, [0], at_ns) - truth_ns).max() < 200_000


@pytest.mark.parametrize("set_by_s", [-3600.0, -100.0, 7.0, 86_400.0])
def test_a_reset_begins_a_line_of_its_own(set_by_s: float) -> None:
    set_by_ns = round(set_by_s * 1e9)
    device_ns, offset_ns = measure(60, 20e-6, noise_ns=100_000, start_ns=10**13)
    device_ns[30:] += set_by_ns
    offset_ns[30:] -= set_by_ns

    assert find_resets(device_ns, offset_ns) == [30]
    first, second = fit_offsets(device_ns, offset_ns)
    assert (first.start, first.stop, second.start, second.stop) == (0, 30, 30, 60)
    assert first.drift == pytest.approx(20e-6, abs=3e-6) and second.drift == pytest.approx(20e-6, abs=3e-6)


def test_a_few_measurements_show_an_offset_and_no_drift() -> None:
    assert fit_offsets(np.zeros(0, np.int64), np.zeros(0, np.int64)) == ()
    (line,) = fit_offsets(np.array([10, 1_000_000_010]), np.array([500, 700]))
    assert (line.drift, line.host_ns) == (0.0, 610)


def test_a_measurement_that_is_garbage_at_the_end_is_no_reset() -> None:
    device_ns, offset_ns = measure(20, 0.0)
    offset_ns[-1] += 10**12
    (line,) = fit_offsets(device_ns, offset_ns)
    assert line.host_ns == 123_456_789_012 and line.drift == 0.0
