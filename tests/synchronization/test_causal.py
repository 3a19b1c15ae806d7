"""Test that rows computed while samples arrive equal those of `synchronize` on the full recording."""

from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.arrays import AnyFloats, Times
from tacpipe.channels import schema
from tacpipe.plugins.registry import load
from tacpipe.synchronization.causal import Grid, StreamColumns
from tacpipe.synchronization.placement import Placement
from tests.fake_recordings import FakeRecording

T0 = 1_637_771_974_778_354_001
MS = 1_000_000
GAPS = {"a": 50_000_000, "b": 50_000_000}  # ns, by stream
synchronize = load("synchronize")
ROWS: dict[str, dict[str, Any]] = {"uniform": {"rate_hz": 50.0}, "logged": {}, "fresh": {"grid": "fresh"}}


def streams(least_ms: int) -> dict[str, pa.Table]:
    """Return a master whose counts wrap around and repeat, and a proximity sensor; steps are ``least_ms`` or more."""
    rng = np.random.default_rng(0)
    t_ns = T0 + np.cumsum(rng.integers(least_ms, 30, 60)) * MS
    counts = np.repeat(np.cumsum(rng.integers(-20_000, 20_000, (30, 3)), axis=0), 2, axis=0) % 65_536
    near_ns = T0 + np.cumsum(rng.integers(least_ms, 8, 250)) * MS
    near = schema.stream(near_ns, [rng.normal(size=250)], [schema.float_field("near_m", "m", "proximity")])
    return {"xela1": schema.stream(t_ns, counts.T, schema.uskin_fields(1)), "near": near}


def stated(table: pa.Table, *, arrivals: bool) -> pa.Table:
    """Return a stream whose field of times states that they are arrivals with a period of 15 ms, or sampling times."""
    field = schema.time_field(arrivals=arrivals, period_ns=15 * MS if arrivals else None)
    return table.set_column(0, field, table.column("t_ns"))


STREAMS = {arrivals: streams(0 if arrivals else 1) for arrivals in (True, False)}
READINGS = {"xela1": StreamColumns(3, wraps=(0, 1, 2), compared=(0, 1, 2)), "near": StreamColumns(1, medians=(0,))}


def push(grid: Grid, placement: Placement, name: str, t_ns: Times, values: AnyFloats) -> None:
    grid.push(name, *placement.place({"t_ns": t_ns}), values)


@pytest.mark.parametrize("arrivals", [True, False])
@pytest.mark.parametrize("kind", ["uniform", "logged", "fresh"])
@settings(deadline=None, max_examples=25)
@given(
    cuts=st.lists(st.integers(0, 900), max_size=20),
    turned=st.booleans(),
    early_ms=st.sampled_from(
        [0, 5, 250]
    ),  # samples are passed that early before rows up to their arrival are asked for
)
def test_rows_are_those_of_the_stage_to_the_last_bit(
    kind: str, arrivals: bool, cuts: list[int], turned: bool, early_ms: int
) -> None:
    tables = {name: stated(table, arrivals=arrivals) for name, table in STREAMS[arrivals].items()}
    recording = FakeRecording(tables)
    result = synchronize(synchronize.params(**ROWS[kind], gap_ms=20.0), recording)
    expected = result.streams[""]
    grid = Grid(READINGS, "xela1", kind, ROWS[kind].get("rate_hz"), dict.fromkeys(READINGS, 20 * MS))
    placements = {name: Placement(table.schema, arrivals=arrivals) for name, table in tables.items()}
    last = int(tables["xela1"]["t_ns"][-1].as_py())
    parts, before = [], T0 - 1
    for until_ns in [*sorted(T0 + cut * MS for cut in cuts if T0 + cut * MS < last), last]:
        for name in sorted(tables, reverse=turned):
            t_ns = tables[name]["t_ns"].to_numpy()
            due = (t_ns > before) & (t_ns <= until_ns + early_ms * MS)
            columns = [tables[name].column(index).to_numpy()[due] for index in range(1, tables[name].num_columns)]
            push(grid, placements[name], name, t_ns[due], np.column_stack(columns).astype(np.float64))
        parts.append(grid.rows(until_ns))
        before = until_ns + early_ms * MS
    sampled_masks = [part.has_samples for part in parts]
    t_ns = np.concatenate([part.t_ns[mask] for part, mask in zip(parts, sampled_masks, strict=True)])
    assert t_ns.tolist() == expected["t_ns"].to_pylist() and len(t_ns) > 20
    for column in ("t_arrival_ns", "at_arrival"):
        fields = [getattr(part, column.removeprefix("t_"))[part.has_samples] for part in parts]
        assert np.concatenate(fields).tolist() == expected[column].to_pylist()
    for name, columns in (("xela1", ["taxel01_x", "taxel01_y", "taxel01_z"]), ("near", ["near_m"])):
        values = np.concatenate([part.values[name][mask] for part, mask in zip(parts, sampled_masks, strict=True)])
        gap = np.concatenate([part.gap[name][mask] for part, mask in zip(parts, sampled_masks, strict=True)])
        newest = np.concatenate([part.newest_ns[name][mask] for part, mask in zip(parts, sampled_masks, strict=True)])
        for index, column in enumerate(columns):
            assert values[:, index].tolist() == expected[f"{name}_{column}"].to_pylist()
        assert gap.tolist() == expected[f"{name}_gap"].to_pylist()
        assert (t_ns - newest).tolist() == expected[f"{name}_dt_ns"].to_pylist()
    assert not any(grid.late.values())
    assert result.attributes["xela1_wrapped_channels"] == 3


def test_buffers_stay_small_however_long_samples_come() -> None:
    grid = Grid({"a": StreamColumns(2)}, "a", "uniform", 50.0, GAPS)
    placement = Placement(pa.schema([schema.time_field()]), arrivals=False)
    for block in range(200):
        push(grid, placement, "a", T0 + (block * 100 + np.arange(100)) * MS, np.zeros((100, 2)))
        assert len(grid.rows(T0 + (block * 100 + 99) * MS).t_ns) in (5, 6)
    assert all(len(source._t_ns) <= 512 for source in grid._sources.values())


def test_before_a_stream_has_begun_rows_say_so_and_name_who_is_waited_for() -> None:
    grid = Grid({"a": StreamColumns(1), "b": StreamColumns(1)}, "a", "uniform", 50.0, GAPS)
    placement = Placement(pa.schema([schema.time_field()]), arrivals=False)
    push(grid, placement, "a", T0 + np.arange(0, 100, 10) * MS, np.zeros((10, 1)))
    assert grid.waiting == ("b",)
    rows = grid.rows(T0 + 90 * MS)
    assert rows.t_ns.tolist() == [T0 + ms * MS for ms in (0, 20, 40, 60, 80)] and not rows.has_samples.any()


def test_rows_of_a_session_with_bursts_and_a_stall_are_those_of_the_stage() -> None:
    measured = np.arange(3000)
    burst_ns = (measured // 5 * 5 + 4) * 10 * MS + MS
    stalled = (measured > 1000) & (measured <= 1500)
    stall_ns = np.where(stalled, 15_000 * MS + MS, measured * 10 * MS)
    field = schema.time_field(arrivals=True, period_ns=10 * MS)
    tables = {}
    for name, arrival_ns in (("first", burst_ns), ("second", stall_ns)):
        table = schema.stream(T0 + arrival_ns, [measured % 60_000] * 3, schema.uskin_fields(1))
        tables[name] = table.set_column(0, field, table.column("t_ns"))
    expected = synchronize(synchronize.params(gap_ms=50.0), FakeRecording(tables)).streams[""]

    grid = Grid(
        dict.fromkeys(tables, StreamColumns(3, wraps=(0, 1, 2))),
        "first",
        "logged",
        None,
        dict.fromkeys(tables, 50 * MS),
    )
    placements = {name: Placement(table.schema, arrivals=True) for name, table in tables.items()}
    stamps = {name: table["t_ns"].to_numpy() for name, table in tables.items()}
    parts, rows = [], dict.fromkeys(tables, 0)
    for until_ns in range(T0, T0 + 31_000 * MS, 2 * MS):
        for name, t_ns in stamps.items():
            stop = int(np.searchsorted(t_ns, until_ns, side="right"))
            piece = slice(rows[name], stop)
            values = np.repeat(measured[piece, None] % 60_000, 3, axis=1).astype(np.float64)
            push(grid, placements[name], name, t_ns[piece], values)
            rows[name] = stop
        parts.append(grid.rows(until_ns))
    has_samples = np.concatenate([part.has_samples for part in parts])
    assert np.concatenate([part.t_ns for part in parts])[has_samples].tolist() == expected["t_ns"].to_pylist()
    for name in tables:
        values = np.concatenate([part.values[name] for part in parts])[has_samples]
        gap = np.concatenate([part.gap[name] for part in parts])[has_samples]
        assert values[:, 0].tolist() == expected[f"{name}_taxel01_x"].to_pylist()
        assert gap.tolist() == expected[f"{name}_gap"].to_pylist()
    assert not any(grid.late.values())
