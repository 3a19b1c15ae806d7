"""Sampling times that are estimated from arrivals, against the times at which the samples were measured."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.arrays import Times
from tacpipe.signals.sampling import PlacedSamples, SamplingClock
from tests.signals import deliveries
from tests.signals.deliveries import Delivery, percentile_ms

RANDOM = np.random.default_rng(1)
LINKS = [case for rate_hz in (1, 10, 100, 1000, 2000) for case in deliveries.links(rate_hz, RANDOM)]
LOSSES = list(deliveries.losses())
IRREGULAR = list(deliveries.irregular(RANDOM))


def by_name(cases: list[Delivery]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("case", cases, ids=[case.name for case in cases])


steps_ns = st.lists(
    st.one_of(st.sampled_from([0, 1, 10_000_000, 16_000_000, 1_000_000_000]), st.integers(0, 40_000_000_000)),
    min_size=1,
    max_size=300,
)
counter_steps = st.sampled_from([1, 1, 1, 1, 2, 0, -1, -500, 30])


@given(steps_ns, st.data(), st.sampled_from([None, 1e7, 1e9]), st.sampled_from(["count", "counter", "clock"]))
def test_times_increase_are_never_after_arrival_and_do_not_depend_on_how_reads_were_cut(
    steps: list[int], data: st.DataObject, period_ns: float | None, axis: str
) -> None:
    arrival_ns = np.cumsum(steps, dtype=np.int64)
    positions = np.cumsum([data.draw(counter_steps) for _ in steps], dtype=np.int64)
    counter = positions if axis == "counter" else None
    device_ns = positions * 10_000_000 if axis == "clock" else None
    cuts = sorted(data.draw(st.lists(st.integers(0, len(steps)), max_size=6)))
    placed = SamplingClock(period_ns).place(arrival_ns, counter, device_ns)
    clock = SamplingClock(period_ns)
    parts = [
        clock.place(
            arrival_ns[start:stop],
            None if counter is None else counter[start:stop],
            None if device_ns is None else device_ns[start:stop],
        )
        for start, stop in zip([0, *cuts], [*cuts, len(steps)], strict=True)
    ]

    received = ~placed.late
    assert (np.diff(placed.t_ns[received]) > 0).all()
    assert (np.diff(placed.arrival_ns) > 0).all()
    assert (placed.t_ns <= placed.arrival_ns)[received].all()
    for name in ("t_ns", "arrival_ns", "at_arrival", "late"):
        pieces = np.concatenate([getattr(part, name) for part in parts])
        assert np.array_equal(pieces, getattr(placed, name)), name
    assert sum(part.restarts for part in parts) == placed.restarts
    assert _total(*parts) == _total(placed)


def _total(*parts: PlacedSamples) -> int:
    return sum(loss.samples for part in parts for loss in part.losses)


@by_name([*LINKS[12:24], *LOSSES, *IRREGULAR])
def test_later_samples_do_not_change_estimates(case: Delivery) -> None:
    placed = case.place()
    for stop in (1, 100, len(case.arrival_ns) // 2):
        counter = None if case.counter is None else case.counter[:stop]
        device_ns = None if case.device_ns is None else case.device_ns[:stop]
        first = SamplingClock(case.period_s * 1e9).place(case.arrival_ns[:stop], counter, device_ns)
        assert np.array_equal(first.t_ns, placed.t_ns[:stop])
        assert np.array_equal(first.at_arrival, placed.at_arrival[:stop])


@by_name([*LINKS, *LOSSES])
@pytest.mark.parametrize("declared", [True, False])
def test_estimates_of_unmarked_rows_are_no_worse_than_arrivals(case: Delivery, declared: bool) -> None:
    placed = case.place(declared=declared)
    errors = case.errors_ms(placed.t_ns)[~placed.at_arrival & ~placed.late]
    limit_ms = percentile_ms(case.errors_ms(case.arrival_ns)) + case.period_s * 1e3 / 4
    assert not len(errors) or percentile_ms(errors) <= limit_ms


@by_name([case for case in LINKS if case.period_s in (0.01, 0.001) and "stall" not in case.name])
def test_bursts_and_jitter_are_removed_once_the_line_is_known(case: Delivery) -> None:
    placed = case.place()
    settled = case.arrival_ns > case.arrival_ns[0] + 5_000_000_000
    assert not placed.at_arrival.any()
    assert percentile_ms(case.errors_ms(placed.t_ns)[settled]) < 2.5


@by_name([case for case in LINKS if "stall" in case.name and case.period_s < 0.1])
def test_a_backlog_that_arrives_late_keeps_its_times_and_loses_nothing(case: Delivery) -> None:
    placed = case.place()
    assert not placed.losses
    assert case.errors_ms(placed.t_ns).max() < 2.5


@by_name(LOSSES)
def test_losses_without_a_counter_are_estimated(case: Delivery) -> None:
    placed = case.place()
    assert _total(placed) == case.lost
    misplaced = case.errors_ms(placed.t_ns)[~placed.at_arrival] > 20
    assert misplaced.sum() <= (150 if case.lost else 0)


@by_name(IRREGULAR)
def test_most_rows_of_an_irregular_device_are_at_their_arrival_or_near(case: Delivery) -> None:
    placed = case.place()
    errors = case.errors_ms(placed.t_ns)
    near = errors <= np.maximum(case.errors_ms(case.arrival_ns), 1e3 * case.period_s)
    assert near.mean() > 0.85


def test_samples_that_come_after_all_take_estimated_losses_back() -> None:
    case = next(case for case in IRREGULAR if case.name == "delay of 0.3 s for 5 s")
    placed = case.place()
    assert placed.losses[0].samples == 30
    assert _total(placed) == 0
    assert case.errors_ms(placed.t_ns)[-3000:].max() < 1


def test_a_single_late_sample_is_no_restart_and_three_are() -> None:
    arrival_ns = np.arange(12) * 10_000_000
    counter = np.array([5, 6, 8, 7, 9, 9, 10, 0, 1, 2, 3, 4])
    placed = SamplingClock(1e7).place(arrival_ns, counter)
    assert np.flatnonzero(placed.late).tolist() == [3, 5, 7, 8]
    assert placed.restarts == 1


def test_a_device_clock_in_another_unit_is_not_used() -> None:
    t = np.arange(0, 20, 0.01)
    arrival_ns = np.rint(deliveries.deliver_by_timer(t, 0.016) * 1e9).astype(np.int64)
    placed = SamplingClock(1e7).place(arrival_ns, device_ns=np.rint(t * 1e6).astype(np.int64))
    errors_ns: Times = placed.t_ns - np.rint((t + deliveries.LINK_S) * 1e9).astype(np.int64)
    assert np.abs(errors_ns[t > 5]).max() < 4_000_000


def test_equal_arrivals_are_spread_by_a_nanosecond() -> None:
    placed = SamplingClock().place(np.array([5, 5, 5, 6, 9]))
    assert placed.arrival_ns.tolist() == [5, 6, 7, 8, 9]
    assert placed.t_ns.tolist() == [5, 6, 7, 8, 9]
    assert placed.at_arrival.all()
