"""Bringing streams onto one clock, beside pandas.merge_asof on the same streams.

Two tactile streams of 48 channels at 100 Hz and an arm's 22 channels at 1 kHz, all with jitter. merge_asof takes the
nearest sample; linear interpolation does more, and what does the same in pandas stands beside it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import timing

from tacpipe.arrays import AnyArray, Times
from tacpipe.plugins.registry import load
from tacpipe.signals import repairs, resampling
from tacpipe.signals.clocks import fit_clock

RATE_HZ, GAP_NS = 50.0, 50_000_000
START_NS = 1_600_000_000_000_000_000
STREAMS = {"tactile1": (48, 100.0, np.uint16), "tactile2": (48, 100.0, np.uint16), "robot": (22, 1000.0, np.float64)}


@dataclass(frozen=True)
class Stream:
    """Stamps and samples of one sensor, and the same as a frame."""

    t_ns: Times  # (time,)
    values: AnyArray  # (time, channel)
    frame: pd.DataFrame


@dataclass(frozen=True)
class Decoded:
    """Columns that are decoded already."""

    table: pa.Table

    def __getattr__(self, name: str) -> Any:
        return getattr(self.table, name)

    @property
    def row_bytes(self) -> int:
        """The size of a row in bytes."""
        return int(self.table.nbytes // max(1, self.table.num_rows))

    def batches(self, columns: Sequence[str] | None = None) -> Iterator[pa.Table]:
        """Yield all rows at once."""
        yield self.table if columns is None else self.table.select(list(columns))


@dataclass(frozen=True)
class Memory:
    """A recording that lies in memory, as the stage reads one."""

    name: str
    tables: dict[str, pa.Table]

    @property
    def streams(self) -> tuple[str, ...]:
        return tuple(self.tables)

    def columns(self, stream: str) -> Decoded:
        return Decoded(self.tables[stream])


def streams(seconds: int, seed: int = 0) -> dict[str, Stream]:
    """Return streams that jitter by a tenth of their period."""
    random = np.random.default_rng(seed)
    streams_by_name = {}
    for name, (channels, rate_hz, kind) in STREAMS.items():
        count = int(seconds * rate_hz)
        jitter_ns = np.rint(random.normal(0, 0.1e9 / rate_hz, count)).astype(np.int64)
        t_ns = np.sort(START_NS + np.rint(np.arange(count) * 1e9 / rate_hz).astype(np.int64) + jitter_ns)
        walk = np.cumsum(random.normal(0, 5, (count, channels)), axis=0) + 30_000
        values = walk.astype(kind)
        columns = {f"{name}_{i}": values[:, i].copy() for i in range(channels)}
        streams_by_name[name] = Stream(t_ns, values, pd.DataFrame({"t_ns": t_ns, **columns}))
    return streams_by_name


def measure(folder: Path, rounds: int) -> list[timing.Line]:
    """Return how many times as long pandas takes, on a usual recording and on a long one."""
    return [*(line for seconds in (60, 600) for line in _measure(seconds, rounds)), _clock(rounds)]


def _clock(rounds: int) -> timing.Line:
    """Return how long the fit of a device's clock takes beside least squares, which late arrivals bend."""
    rng = np.random.default_rng(0)
    device_ns = np.arange(600_000) * 1_000_000  # ten minutes at 1 kHz
    arrival_ns = START_NS + np.maximum.accumulate(device_ns + rng.exponential(5e5, len(device_ns)).astype(np.int64))
    elapsed_ns = arrival_ns - START_NS
    times = timing.interleaved(
        {"fit": lambda: fit_clock(device_ns, arrival_ns), "polyfit": lambda: np.polyfit(device_ns, elapsed_ns, 1)},
        rounds,
    )
    return timing.at_most("the clock of a device, 600,000 samples (numpy.polyfit)", times, "fit", "polyfit")


def _measure(seconds: int, rounds: int) -> list[timing.Line]:
    inputs = streams(seconds)
    first = max(stream.t_ns[0] for stream in inputs.values())
    last = min(stream.t_ns[-1] for stream in inputs.values())
    grid_ns = resampling.uniform_grid(int(first), int(last), RATE_HZ)
    grid = pd.DataFrame({"t_ns": grid_ns})

    def linear() -> None:
        for stream in inputs.values():
            resampling.linear(stream.t_ns, stream.values, grid_ns)

    def linear_with_masks() -> None:
        for stream in inputs.values():
            resampling.linear(stream.t_ns, stream.values, grid_ns)
            resampling.nearest(stream.t_ns, repairs.repeated_rows(stream.values), grid_ns)
            resampling.in_gap(stream.t_ns, grid_ns, GAP_NS)

    def merge_asof() -> None:
        merged = grid
        for stream in inputs.values():
            merged = pd.merge_asof(merged, stream.frame, on="t_ns", direction="nearest")

    def reindex_and_interpolate() -> None:
        for stream in inputs.values():
            indexed = stream.frame.set_index("t_ns")
            joined_index = indexed.index.union(pd.Index(grid_ns))
            indexed.reindex(joined_index).interpolate(method="index").loc[grid_ns]

    tables = {name: _table(name, stream) for name, stream in inputs.items()}
    stage = load("synchronize")
    params, recording = stage.params(rate_hz=RATE_HZ, master="tactile1"), Memory("benchmark", tables)
    times = timing.interleaved(
        {
            "linear": linear,
            "with masks": linear_with_masks,
            "stage": lambda: stage(params, recording),
            "merge_asof": merge_asof,
            "reindex, interpolate": reindex_and_interpolate,
        },
        rounds,
    )
    return [
        _faster(f"{seconds} s of three streams to {RATE_HZ:g} Hz: linear", times, "linear", "merge_asof", 10.0),
        _faster("linear, the same maths in pandas", times, "linear", "reindex, interpolate"),
        _faster("linear with held, gap and distance", times, "with masks", "merge_asof"),
        _faster("the whole stage, tables with metadata in and out", times, "stage", "merge_asof"),
    ]


def _faster(case: str, times: timing.Times, ours: str, peer: str, aim: float | None = None) -> timing.Line:
    """Return the line of what must be at least ``aim`` times as fast as pandas."""
    line, speedup = timing.at_most(case, times, ours, peer), timing.ratio(times, peer, ours)
    aim_text = "" if aim is None else f"{aim:g} times as fast"
    reached = None if aim is None else speedup >= aim
    return timing.Line(case, line.ours, f"pandas: {line.peer}", f"{speedup:.1f} times as fast", aim_text, reached)


def _table(name: str, stream: Stream) -> pa.Table:
    quantity = "tactile" if name.startswith("tactile") else "position"
    fields = [pa.field("t_ns", pa.int64(), metadata={"quantity": "time", "unit": "ns"})]
    fields += [
        pa.field(column, pa.from_numpy_dtype(stream.values.dtype), metadata={"quantity": quantity, "unit": "count"})
        for column in stream.frame.columns[1:]
    ]
    return pa.table(list(stream.frame.to_dict("series").values()), schema=pa.schema(fields))
