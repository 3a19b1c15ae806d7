"""Counters that wrap, lose, restart and are interrupted are made sense of as arithmetic and the clock say."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.arrays import Int64s
from tacpipe.recording.reading import CounterUnroller, UnrolledCounters

WRAP = 1 << 16
RATE_HZ = 1000.0
PERIOD_NS = 1_000_000


def count_items(counting: CounterUnroller, first: int, count: int, at_s: float) -> UnrolledCounters:
    """Feed counters from ``first`` on, one a period from ``at_s`` on, as a device sends them that wraps."""
    rows: Int64s = np.arange(count, dtype=np.int64)
    return counting.feed((first + rows) * counting.step % counting.modulus, round(at_s * 1e9) + rows * PERIOD_NS)


def interrupt(
    first: int, outage_s: float, after: int, modulus: int = WRAP, rate_hz: float = RATE_HZ
) -> UnrolledCounters:
    """Return what is made of 10 counters from ``after`` on, behind one of ``first`` and an outage."""
    counting = CounterUnroller(modulus, rate_hz)
    count_items(counting, first, 1, 0)
    counting.note_reopened()
    return count_items(counting, after, 10, outage_s)


def test_a_device_that_began_anew_while_it_was_away_is_reset_and_the_clock_tells_the_loss() -> None:
    counters = interrupt(60_000, outage_s=10, after=0)

    assert counters.missing.tolist() == [9_999] + [0] * 9
    assert counters.reset.tolist() == [True] + [False] * 9
    assert counters.seq.tolist() == list(range(70_000, 70_010))


@given(first=st.integers(0, WRAP - 1), lost_count=st.integers(1, 1_000_000), drift=st.floats(-0.04, 0.04))
def test_a_device_that_went_on_counting_while_the_link_was_away_loses_what_its_counter_says(
    first: int, lost_count: int, drift: float
) -> None:
    counters = interrupt(first, outage_s=lost_count * (1 + drift) / RATE_HZ, after=first + lost_count)

    # Beyond 5 % of 655 s the clock cannot show how often a counter of 65 s wrapped.
    if lost_count * abs(drift) < WRAP / 2 - 100:
        assert counters.missing.tolist() == [lost_count - 1] + [0] * 9
        assert not counters.reset.any()


@given(first=st.integers(0, WRAP - 1), after=st.integers(0, WRAP - 1), outage_s=st.floats(0.1, 600))
def test_whatever_a_device_begins_with_the_loss_is_about_what_the_clock_says(
    first: int, after: int, outage_s: float
) -> None:
    counters = interrupt(first, outage_s, after)

    expected = outage_s * RATE_HZ
    assert abs(int(counters.missing[0]) + 1 - expected) <= 33 + 0.05 * expected
    assert np.diff(counters.seq).tolist() == [1] * 9
    assert not counters.duplicate.any() and not counters.late.any()


@pytest.mark.parametrize("after", [95, 100])
def test_a_counter_that_stands_or_is_a_little_back_after_an_outage_began_anew(after: int) -> None:
    counters = interrupt(100, outage_s=0.005, after=after)

    assert counters.reset[0] and counters.missing[0] == 4
    assert not counters.duplicate.any() and not counters.late.any()


def test_only_the_first_sample_after_an_outage_is_doubted() -> None:
    counting = CounterUnroller(WRAP, RATE_HZ)
    counting.note_reopened()  # Before the first sample there is nothing to doubt.
    assert not count_items(counting, 500, 3, 0).reset.any()
    counting.note_reopened()
    assert len(count_items(counting, 0, 0, 1).seq) == 0  # nothing came yet
    assert count_items(counting, 0, 3, 1).reset.tolist() == [True, False, False]
    lost = count_items(counting, 38, 2, 1.004)  # 36 in 2 ms: a burst may bring so many, but no outage was before

    assert lost.missing.tolist() == [35, 0] and not lost.reset.any()


def test_where_no_rate_is_known_a_counter_that_grew_is_believed() -> None:
    assert interrupt(10, 5, after=30, rate_hz=0).missing.tolist() == [19] + [0] * 9
    counters = interrupt(10, 5, after=0, rate_hz=0)
    assert counters.reset[0] and counters.missing[0] == 0


def test_a_counter_that_grows_by_more_than_one_is_doubted_in_samples() -> None:
    counting = CounterUnroller(1 << 16, RATE_HZ, step=4)
    count_items(counting, 0, 1, 0)
    counting.note_reopened()
    went_on = count_items(counting, 3_000, 2, 3)
    counting.note_reopened()
    off = counting.feed(np.array([(6_000 * 4 + 1) % WRAP]), np.array([6_001_000_000]))

    assert went_on.missing.tolist() == [2_999, 0] and not went_on.reset.any()
    assert off.reset.tolist() == [True] and off.missing.tolist() == [2_999]


FALSE = 999_999_999_999


@pytest.mark.parametrize("rate_hz", [RATE_HZ, 0.0])
@pytest.mark.parametrize("modulus", [1 << 62, 1 << 32, 1 << 16])
@pytest.mark.parametrize("place", [1, 50, 99])
@pytest.mark.parametrize("halves", [1, 2])
def test_a_count_that_jumps_beyond_what_time_allows_is_a_reset_and_no_loss(
    rate_hz: float, modulus: int, place: int, halves: int
) -> None:
    counting = CounterUnroller(modulus, rate_hz)
    raw = np.arange(300, 400, dtype=np.int64)
    raw[place] = FALSE % modulus if modulus > 1 << 16 else 30_000
    t_ns = np.arange(100, dtype=np.int64) * PERIOD_NS
    parts = [counting.feed(*part) for part in zip(np.split(raw, halves), np.split(t_ns, halves), strict=True)]
    seq, missing, reset = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("seq", "missing", "reset")
    )

    assert seq.tolist() == list(range(300, 400))
    assert missing.sum() == 0
    assert np.flatnonzero(reset).tolist() == [place, place + 1][: 100 - place]


@given(gap_s=st.floats(0.001, 3600), rate_hz=st.floats(1, 5e4))
def test_a_program_of_unknown_rate_loses_what_its_count_says_up_to_what_time_allows(
    gap_s: float, rate_hz: float
) -> None:
    elapsed_count = max(1, round(gap_s * rate_hz))
    for reopened in (False, True):
        counting = CounterUnroller(1 << 62, 0.0)
        counting.feed(np.array([7]), np.array([0]))
        if reopened:
            counting.note_reopened()
        counters = counting.feed(np.array([7 + elapsed_count]), np.array([round(gap_s * 1e9)]))

        assert counters.missing.tolist() == [elapsed_count - 1] and not counters.reset.any()


def test_a_false_count_behind_a_lost_sample_costs_that_one_alone() -> None:
    raw = np.array([9911, 9912, 999_914, 9915, 9916])  # 9913 is lost, 9914 garbled
    t_ns = np.array([0, 10, 30, 40, 50]) * 1_000_000
    counting = CounterUnroller(1 << 32, 100.0)

    batches = [counting.feed(raw[row : row + 1], t_ns[row : row + 1]) for row in range(len(raw))]

    assert [int(batch.seq[0]) for batch in batches] == [9911, 9912, 9914, 9915, 9916]
    assert sum(int(batch.missing.sum()) for batch in batches) == 1
