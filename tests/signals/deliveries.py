"""Samples whose true sampling times are known, delivered in the ways of real links, and the errors of their estimates.

``python -m tests.signals.deliveries`` prints the table of docs/benchmarks/sampling-time.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Floats, Int64s, Times
from tacpipe.signals.sampling import PlacedSamples, SamplingClock

START_NS = 1_700_000_000_000_000_000
LINK_S = 0.0005  # smallest delay of every link
PPM = 200.0


@dataclass(frozen=True)
class Delivery:
    """Samples of a device in order of arrival."""

    name: str
    measured_ns: Times  # (time,), the true times
    arrival_ns: Times  # (time,)
    period_s: float
    lost: int = 0  # number of lost samples that no counter shows
    counter: Int64s | None = None
    device_ns: Times | None = None
    regular: bool = True  # False if the device does not measure at a constant rate

    def place(self, *, declared: bool = True) -> PlacedSamples:
        """Return the estimates, with or without a declared period."""
        clock = SamplingClock(self.period_s * 1e9 if declared else None)
        return clock.place(self.arrival_ns, self.counter, self.device_ns)

    def errors_ms(self, t_ns: Times) -> Floats:
        """Return the errors of times (time,); the smallest delay is indistinguishable from an offset, so it is none."""
        smallest = (self.arrival_ns - self.measured_ns).min()
        return np.asarray(np.abs(t_ns - self.measured_ns - smallest) / 1e6)


def delivery(
    name: str,
    measured_s: Floats,
    arrival_s: Floats,
    period_s: float,
    lost: int = 0,
    counter: Int64s | None = None,
    device_s: Floats | None = None,
    *,
    regular: bool = True,
) -> Delivery:
    """Return a delivery from times in seconds."""
    device_ns = None if device_s is None else _to_ns(device_s)
    arrivals = START_NS + _to_ns(np.maximum.accumulate(arrival_s))
    return Delivery(name, START_NS + _to_ns(measured_s), arrivals, period_s, lost, counter, device_ns, regular)


def _to_ns(seconds: Floats) -> Times:
    return np.asarray(np.rint(seconds * 1e9), np.int64)


def deliver_evenly(measured_s: Floats, random: np.random.Generator) -> Floats:
    """Return arrivals over a link with delays of 0.3 ms and more."""
    return np.asarray(measured_s + 0.0003 + random.exponential(0.0002, len(measured_s)))


def deliver_in_bursts(measured_s: Floats, size: int) -> Floats:
    """Return arrivals of ``size`` samples at a time, with the last of them."""
    last = np.minimum((np.arange(len(measured_s)) // size + 1) * size, len(measured_s)) - 1
    return np.asarray(measured_s[last] + LINK_S)


def deliver_by_timer(measured_s: Floats, timer_s: float) -> Floats:
    """Return arrivals over an adapter that passes on what it has each ``timer_s``."""
    return np.asarray(np.ceil(measured_s / timer_s) * timer_s + LINK_S)


def deliver_after_stall(measured_s: Floats, first_s: float, stall_s: float) -> Floats:
    """Return arrivals with one stall, after which everything measured meanwhile arrives at once."""
    stalled = (measured_s > first_s) & (measured_s < first_s + stall_s)
    return np.where(stalled, first_s + stall_s, measured_s) + LINK_S


def deliver_over_hub(measured_s: Floats, random: np.random.Generator) -> Floats:
    """Return arrivals in frames of 1 ms, over a hub that another device uses for 20 ms in some of each 50 ms."""
    frame = (measured_s // 0.05).astype(np.int64)
    is_busy = random.random(int(frame.max()) + 1)[frame] < 0.6
    waits_s = np.where(is_busy, np.maximum(0.02 - measured_s % 0.05, 0), 0)
    return np.asarray(np.ceil((measured_s + waits_s) / 0.001) * 0.001 + LINK_S)


def links(rate_hz: float, random: np.random.Generator) -> Iterator[Delivery]:
    """Yield what a device of this rate with a clock that drifts sends over each kind of link."""
    period_s = 1 / rate_hz
    t = np.arange(0, max(60, 200 / rate_hz), period_s) * (1 + PPM * 1e-6)
    arrivals = {
        "even": deliver_evenly(t, random),
        "adapter of 16 ms": deliver_by_timer(t, 0.016),
        **{f"bursts of {size}": deliver_in_bursts(t, size) for size in (2, 5, 20, 50)},
        "jitter of 3 ms": t + random.exponential(0.003, len(t)),
        "hub with a second device": deliver_over_hub(t, random),
        **{f"stall of {stall_s:g} s": deliver_after_stall(t, 20.003, stall_s) for stall_s in (0.1, 0.5, 2, 5)},
    }
    for name, arrival_s in arrivals.items():
        yield delivery(f"{rate_hz:g} Hz, {name}", t, arrival_s, period_s)


def losses() -> Iterator[Delivery]:
    """Yield deliveries of a device of 100 Hz with lost samples."""
    t = np.arange(0, 60, 0.01)
    for lost_s in (1.0, 5.0):
        present = ~((t > 20) & (t < 20 + lost_s))
        lost, received = int((~present).sum()), t[present]
        arrivals, numbers = received + LINK_S, np.flatnonzero(present)
        yield delivery(f"{lost_s:g} s lost", received, arrivals, 0.01, lost)
        yield delivery(f"{lost_s:g} s lost, counter", received, arrivals, 0.01, counter=numbers)
        yield delivery(f"{lost_s:g} s lost, device clock", received, arrivals, 0.01, device_s=received + 7)
    present = np.arange(len(t)) % 50 != 7
    yield delivery("2 % lost, counter", t[present], t[present] + LINK_S, 0.01, counter=np.flatnonzero(present))
    backlog = deliver_after_stall(t, 20.003, 2.0)
    present = ~((t > 20) & (t < 21))
    yield delivery("stall of 2 s, half lost", t[present], backlog[present], 0.01, int((~present).sum()))


def irregular(random: np.random.Generator) -> Iterator[Delivery]:
    """Yield deliveries of devices whose rate or delay is not constant."""

    def even(name: str, t: Floats, period_s: float = 0.01) -> Delivery:
        return delivery(name, t, deliver_evenly(t, random), period_s, regular=False)

    for rate_hz in (50, 90, 99, 101, 110, 200):
        t = np.concatenate([np.arange(0, 30, 0.01), np.arange(30, 90, 1 / rate_hz)])
        yield even(f"rate from 100 to {rate_hz} Hz", t)
    for pause_s in (0.5, 3, 30):
        t = np.arange(0, 60, 0.01)
        yield even(f"pause of {pause_s:g} s", np.where(t < 30, t, t + pause_s))
    yield even("period varies by 2 % over 30 s", np.cumsum(0.01 * (1 + 0.02 * np.sin(np.arange(9000) * 0.00209))))
    yield even("loop that sleeps 10 ms and works 1 ms", np.cumsum(0.01 + random.gamma(2, 0.0005, 9000)))
    yield even("loop with hiccups of 30 ms", np.cumsum(0.01 + (random.random(9000) < 0.02) * 0.03))
    yield even("random times (Poisson)", np.cumsum(random.exponential(0.01, 9000)))
    t = np.arange(0, 60, 0.01)
    late = np.where((t > 20) & (t < 25), 0.3, 0.0)
    yield delivery("delay of 0.3 s for 5 s", t, t + LINK_S + late, 0.01, regular=False)
    yield delivery("delay larger by 30 ms from 20 s on", t, t + LINK_S + (t > 20) * 0.03, 0.01, regular=False)


def percentile_ms(errors: Floats) -> float:
    """Return the 95th percentile of errors; NaN without any."""
    return float(np.percentile(errors, 95)) if len(errors) else float("nan")


def main() -> None:
    """Print the table."""
    random = np.random.default_rng(0)
    print("| delivery | estimate, ms | arrival, ms | marked | estimated losses |")
    print("| --- | --- | --- | --- | --- |")
    sources = [*(links(rate_hz, random) for rate_hz in (1, 10, 100, 1000, 2000)), losses(), irregular(random)]
    for case in (case for source in sources for case in source):
        placed = case.place()
        errors = case.errors_ms(placed.t_ns)[~placed.at_arrival & ~placed.late]
        estimated = sum(loss.samples for loss in placed.losses)
        print(
            f"| {case.name} | {percentile_ms(errors):.2f} | {percentile_ms(case.errors_ms(case.arrival_ns)):.2f} | "
            f"{placed.at_arrival.mean():.1%} | {estimated} of {case.lost} |"
        )


if __name__ == "__main__":
    main()
