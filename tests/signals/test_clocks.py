"""The fit of a device's clock, on links whose clock and delays are known."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.arrays import Int64s
from tacpipe.errors import TacpipeError
from tacpipe.signals.clocks import (
    STEP_NS,
    clock_steps,
    convert_by_segment,
    find_resets,
    fit_clock,
    fit_offsets,
    host_times,
)

S, MS = 1_000_000_000, 1_000_000
HOST_NS = 1_637_771_974_778_354_001  # odd: as float64 it would be rounded to a multiple of 256
BOOT_NS = 7_000_000_123
Link = tuple[np.ndarray, np.ndarray, np.ndarray]


def link(rate_hz: float, seconds: float, delay_ms: float, *, ppm: float = 50.0, stalls: int = 0, seed: int = 0) -> Link:
    """Return when samples were taken, the device's stamps and the arrivals: delays are exponential, and in order."""
    rng = np.random.default_rng(seed)
    taken_ns = np.rint(np.arange(int(rate_hz * seconds)) * 1e9 / rate_hz).astype(np.int64)
    arrival_ns = taken_ns + rng.exponential(delay_ms * MS, len(taken_ns)).astype(np.int64)
    for begins, lasts in zip(rng.uniform(0, seconds, stalls), rng.uniform(0.05, 1.0, stalls), strict=True):
        ends_ns = int((begins + lasts) * S)  # nothing comes through, and then everything at once
        stalled = (arrival_ns > begins * S) & (arrival_ns < ends_ns)
        arrival_ns[stalled] = ends_ns
    device_ns = BOOT_NS + taken_ns + np.rint(taken_ns * ppm * 1e-6).astype(np.int64)
    return HOST_NS + taken_ns, device_ns, HOST_NS + np.maximum.accumulate(arrival_ns)


@pytest.mark.parametrize(
    ("rate_hz", "seconds", "delay_ms", "drift_ppm", "error_ms"),
    [(50, 10, 2.0, 15.0, 0.2), (400, 10, 0.5, 1.0, 0.02), (1000, 60, 0.5, 0.1, 0.01), (50, 600, 20.0, 0.5, 0.2)],
)
@pytest.mark.parametrize("seed", range(3))
def test_clock_and_times_are_recovered_through_delays_and_stalls(
    rate_hz: float, seconds: float, delay_ms: float, drift_ppm: float, error_ms: float, seed: int
) -> None:
    taken_ns, device_ns, arrival_ns = link(rate_hz, seconds, delay_ms, stalls=int(seconds / 10) + 1, seed=seed)
    fit = fit_clock(device_ns, arrival_ns)
    assert len(fit.segments) == 1
    assert fit.drift_ppm == pytest.approx(-50.0, abs=drift_ppm)
    assert fit.offset_ns == pytest.approx(HOST_NS - BOOT_NS, abs=error_ms * MS)
    assert np.abs(host_times(fit, device_ns, arrival_ns) - taken_ns).max() < error_ms * MS


def test_without_delay_the_times_are_exact_to_the_rounding_of_nanoseconds() -> None:
    taken_ns, device_ns, arrival_ns = link(1000, 600, 0.0, ppm=-73.0)
    fit = fit_clock(device_ns, arrival_ns)
    assert np.abs(host_times(fit, device_ns, arrival_ns) - taken_ns).max() <= 2
    assert fit.median_residual_ns <= 1


def test_the_residual_is_the_delay_beyond_the_least() -> None:
    _, device_ns, arrival_ns = link(1000, 60, 0.5)
    fit = fit_clock(device_ns, arrival_ns)
    assert fit.median_residual_ns == pytest.approx(np.median(np.diff(fit.residual_ns[:3]).sum()), rel=1e-6)
    assert fit.median_residual_ns > 0.5 * np.log(2) * MS  # a link in order only adds to the delays drawn
    assert fit.residual_ns[0] == 0.0


def test_a_device_that_restarts_has_a_line_before_and_one_after() -> None:
    taken_ns, device_ns, arrival_ns = link(400, 20, 0.5, stalls=3)
    device_ns[5000:] -= device_ns[5000] - 1000
    fit = fit_clock(device_ns, arrival_ns)
    assert [(segment.start, segment.stop) for segment in fit.segments] == [(0, 5000), (5000, 8000)]
    assert np.abs(host_times(fit, device_ns, arrival_ns) - taken_ns).max() < 0.05 * MS


def test_arrivals_that_are_not_certain_move_nothing_and_their_rows_are_mapped_all_the_same() -> None:
    taken_ns, device_ns, arrival_ns = link(400, 20, 0.5)
    device_ns[5000:] -= device_ns[5000] - 1000
    late = np.zeros(len(taken_ns), dtype=bool)
    late[[*range(1000, 4990), *range(5200, 7900)]] = True
    delayed_ns = np.where(late, arrival_ns + np.arange(len(late)) * 100_000, arrival_ns)
    fit = fit_clock(device_ns, delayed_ns, ~late)
    assert [(segment.start, segment.stop) for segment in fit.segments] == [(0, 5000), (5000, 8000)]
    assert np.abs(host_times(fit, device_ns, delayed_ns) - taken_ns).max() < 0.1 * MS
    assert fit_clock(device_ns, delayed_ns, late & ~late) == fit_clock(device_ns, delayed_ns)


def test_after_a_restart_too_short_to_show_a_drift_that_of_the_long_segment_holds() -> None:
    taken_ns, device_ns, arrival_ns = link(50, 60, 1.0, ppm=200.0)
    device_ns[-20:] -= device_ns[-20]
    fit = fit_clock(device_ns, arrival_ns)
    assert [segment.stop - segment.start for segment in fit.segments] == [2980, 20]
    assert fit.segments[1].drift == fit.segments[0].drift
    assert np.abs(host_times(fit, device_ns, arrival_ns) - taken_ns)[-20:].max() < 1.0 * MS


def test_stalls_gaps_and_packets_out_of_order_are_no_steps() -> None:
    _, device_ns, arrival_ns = link(50, 60, 2.0, stalls=10)
    rows = np.r_[0:500, 1200:3000]  # fourteen seconds are missing in both clocks
    device_ns = device_ns[rows]
    device_ns[[100, 101]] = device_ns[[101, 100]]
    assert clock_steps(device_ns, arrival_ns[rows]) == []


def test_a_few_wrong_stamps_move_neither_the_line_nor_what_follows_them() -> None:
    taken_ns, device_ns, arrival_ns = link(50, 60, 2.0)
    device_ns[[300, 1500]] += 3600 * S
    device_ns[[700, 2200]] -= 3600 * S
    fit = fit_clock(device_ns, arrival_ns)
    times_ns = host_times(fit, device_ns, arrival_ns)
    assert len(fit.segments) == 1
    assert np.abs(np.delete(times_ns - taken_ns, [300, 700, 1500, 2200])).max() < 25 * MS
    assert np.median(np.abs(times_ns - taken_ns)) < 0.2 * MS
    assert np.array_equal(times_ns[[300, 1500]], arrival_ns[[300, 1500]])


@settings(deadline=None, max_examples=60)
@given(st.lists(st.tuples(st.integers(-5 * MS, 60 * MS), st.integers(0, 50 * MS)), min_size=1, max_size=80))
def test_mapped_times_never_run_backwards_nor_far_ahead_of_their_arrival(steps: list[tuple[int, int]]) -> None:
    device_ns, delay_ns = np.cumsum([step for step, _ in steps]), np.array([delay for _, delay in steps])
    arrival_ns = HOST_NS + np.maximum.accumulate(device_ns + delay_ns)
    if len(steps) > 1 and not np.any(device_ns != device_ns[0]):
        return
    try:
        times_ns = host_times(fit_clock(device_ns, arrival_ns), device_ns, arrival_ns)
    except TacpipeError:
        return  # a clock that is none
    assert times_ns.dtype == np.int64
    assert (np.diff(times_ns) >= 0).all()
    assert (times_ns - arrival_ns <= STEP_NS).all()


@given(st.integers(-(10**18), 10**18), st.integers(-(10**18), 10**18))
def test_where_the_two_clocks_begin_changes_nothing_but_the_offset(host_ns: int, boot_ns: int) -> None:
    _, device_ns, arrival_ns = link(50, 5, 2.0)
    fit, moved = fit_clock(device_ns, arrival_ns), fit_clock(device_ns + boot_ns, arrival_ns + host_ns)
    assert moved.offset_ns == fit.offset_ns + host_ns - boot_ns
    assert moved.drift_ppm == fit.drift_ppm


DELAYS: dict[str, Callable[[np.random.Generator, int], np.ndarray]] = {  # The mean delay is one, except for none
    "none": lambda rng, count: np.zeros(count),
    "exponential": lambda rng, count: rng.exponential(1.0, count),
    "uniform": lambda rng, count: rng.uniform(0.0, 2.0, count),
    "heavy": lambda rng, count: np.minimum(rng.lognormal(-0.5, 1.0, count), 10.0),
    "constant": lambda rng, count: np.ones(count),
}


@st.composite
def restarting_links(draw: st.DrawFn) -> tuple[Link, list[int], float, int]:
    """Draw a link of any drift and any delays whose device restarts, where, its drift in ppm and its mean delay in ns."""
    rate_hz, seconds = draw(st.sampled_from([25, 50, 120, 400])), draw(st.integers(12, 30))
    ppm, delay_ns = draw(st.floats(-500, 500)), draw(st.sampled_from([20_000, 500_000, 2 * MS]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    taken_ns = np.rint(np.arange(rate_hz * seconds) * 1e9 / rate_hz).astype(np.int64)
    late_ns = DELAYS[draw(st.sampled_from(sorted(DELAYS)))](rng, len(taken_ns)) * delay_ns
    device_ns = BOOT_NS + taken_ns + np.rint(taken_ns * ppm * 1e-6).astype(np.int64)
    restarts = sorted(draw(st.sets(st.sampled_from([4, 8]), max_size=2)))
    rows = [rate_hz * second for second in restarts if second + 4 <= seconds]
    for row in rows:
        device_ns[row:] -= device_ns[row] - draw(st.integers(0, S))
    arrival_ns = np.maximum.accumulate(taken_ns + late_ns.astype(np.int64))
    return (HOST_NS + taken_ns, device_ns, HOST_NS + arrival_ns), rows, ppm, delay_ns


@settings(deadline=None, max_examples=60)
@given(restarting_links())
def test_whatever_the_drift_the_delays_and_the_restarts_times_are_right_within_a_few_delays(
    drawn: tuple[Link, list[int], float, int],
) -> None:
    (taken_ns, device_ns, arrival_ns), restarts, ppm, delay_ns = drawn
    fit = fit_clock(device_ns, arrival_ns)
    assert [segment.start for segment in fit.segments] == [0, *restarts]
    times_ns = host_times(fit, device_ns, arrival_ns)
    longest = fit.longest
    assert np.abs(times_ns - taken_ns).max() <= 4 * delay_ns + 2
    span_ns = taken_ns[longest.stop - 1] - taken_ns[longest.start]
    assert abs(fit.drift_ppm + ppm) <= 0.5 + 1e6 * 4 * delay_ns / span_ns  # half a ppm: 1 / (1 + x) is not 1 - x
    assert (
        times_ns <= arrival_ns + delay_ns
    ).all()  # nothing is felt before it happens, but for stamps held for wrong ones


@settings(deadline=None, max_examples=60)
@given(restarting_links(), st.floats(-200, 200))
def test_how_fast_the_device_counts_changes_its_drift_and_no_time(
    drawn: tuple[Link, list[int], float, int], faster_ppm: float
) -> None:
    (_, device_ns, arrival_ns), *_ = drawn
    factor = 1 + faster_ppm * 1e-6
    other_ns = np.rint((device_ns - device_ns[0]) * factor).astype(np.int64) + device_ns[0]
    fit, scaled = fit_clock(device_ns, arrival_ns), fit_clock(other_ns, arrival_ns)
    apart_ns = host_times(scaled, other_ns, arrival_ns) - host_times(fit, device_ns, arrival_ns)
    assert np.abs(apart_ns).max() <= 2_000
    assert (1 + scaled.longest.drift) * factor == pytest.approx(1 + fit.longest.drift, abs=1e-7)


@settings(deadline=None, max_examples=40)
@given(restarting_links(), st.integers(-(10**17), 10**17))
def test_a_link_that_is_slower_by_a_constant_shifts_every_time_by_it(
    drawn: tuple[Link, list[int], float, int], later_ns: int
) -> None:
    (_, device_ns, arrival_ns), *_ = drawn
    times = host_times(fit_clock(device_ns, arrival_ns), device_ns, arrival_ns)
    later = arrival_ns + later_ns
    assert np.array_equal(host_times(fit_clock(device_ns, later), device_ns, later), times + later_ns)


def test_one_sample_is_where_it_came() -> None:
    fit = fit_clock(np.array([5]), np.array([HOST_NS]))
    assert host_times(fit, np.array([5]), np.array([HOST_NS])).tolist() == [HOST_NS]
    assert (fit.offset_ns, fit.drift_ppm) == (HOST_NS - 5, 0.0)


def test_clocks_that_are_none_are_refused() -> None:
    _, device_ns, arrival_ns = link(50, 10, 2.0)
    with pytest.raises(TacpipeError, match=r"3 ns.*500 rows"):
        fit_clock(np.full(500, 3), arrival_ns)
    with pytest.raises(TacpipeError, match=r"0\.001.*0\.009\d* s"):
        fit_clock(device_ns // 1000, arrival_ns)
    with pytest.raises(TacpipeError, match=r"499 device.*500 arrival"):
        fit_clock(device_ns[1:], arrival_ns)


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
    assert np.abs(convert_by_segment(lines, [0], at_ns) - truth_ns).max() < 200_000


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
