"""Test that rows computed while samples arrive equal those of `synchronize` on the full recording."""

from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.channels import schema
from tacpipe.plugins.registry import load
from tacpipe.synchronization.causal import Grid, StreamColumns
from tests.fake_recordings import FakeRecording

T0 = 1_637_771_974_778_354_001
MS = 1_000_000
GAPS = {"a": 50_000_000, "b": 50_000_000}  # ns, by stream
synchronize = load("synchronize")
ROWS: dict[str, dict[str, Any]] = {"uniform": {"rate_hz": 50.0}, "logged": {}, "fresh": {"grid": "fresh"}}


def streams() -> dict[str, pa.Table]:
    """Return a master whose counts wrap around and repeat, and a proximity sensor with stamps that repeat."""
    rng = np.random.default_rng(0)
    t_ns = T0 + np.cumsum(rng.integers(0, 30, 60)) * MS
    counts = np.repeat(np.cumsum(rng.integers(-20_000, 20_000, (30, 3)), axis=0), 2, axis=0) % 65_536
    near_ns = T0 + np.cumsum(rng.integers(0, 8, 250)) * MS
    near = schema.stream(near_ns, [rng.normal(size=250)], [schema.float_field("near_m", "m", "proximity")])
    return {"xela1": schema.stream(t_ns, counts.T, schema.uskin_fields(1)), "near": near}


STREAMS = streams()
READINGS = {"xela1": StreamColumns(3, wraps=(0, 1, 2), compared=(0, 1, 2)), "near": StreamColumns(1, medians=(0,))}


@pytest.mark.parametrize("kind", ["uniform", "logged", "fresh"])
@settings(deadline=None, max_examples=25)
@given(cuts=st.lists(st.integers(0, 900), max_size=20), turned=st.booleans())
def test_rows_are_those_of_the_stage_to_the_last_bit(kind: str, cuts: list[int], turned: bool) -> None:
    result = synchronize(synchronize.params(**ROWS[kind], gap_ms=20.0), FakeRecording(STREAMS))
    expected = result.streams[""]
    grid = Grid(READINGS, "xela1", kind, ROWS[kind].get("rate_hz"), dict.fromkeys(READINGS, 20 * MS))
    last = max(int(table["t_ns"][-1].as_py()) for table in STREAMS.values())
    parts, before = [], T0 - 1
    for until_ns in [*sorted(T0 + cut * MS for cut in cuts if T0 + cut * MS < last), last]:
        for name in sorted(STREAMS, reverse=turned):
            t_ns = STREAMS[name]["t_ns"].to_numpy()
            due = (t_ns > before) & (t_ns <= until_ns)
            columns = [STREAMS[name].column(index).to_numpy()[due] for index in range(1, STREAMS[name].num_columns)]
            grid.push(name, t_ns[due], np.column_stack(columns).astype(np.float64))
        parts.append(grid.rows(until_ns))
        before = until_ns
    sampled_masks = [part.has_samples for part in parts]
    t_ns = np.concatenate([part.t_ns[mask] for part, mask in zip(parts, sampled_masks, strict=True)])
    assert t_ns.tolist() == expected["t_ns"].to_pylist() and len(t_ns) > 20
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
    for block in range(200):
        grid.push("a", T0 + (block * 100 + np.arange(100)) * MS, np.zeros((100, 2)))
        assert len(grid.rows(T0 + (block * 100 + 99) * MS).t_ns) in (5, 6)
    assert all(len(source._t_ns) <= 512 for source in grid._sources.values())


def test_before_a_stream_has_begun_rows_say_so_and_name_who_is_waited_for() -> None:
    grid = Grid({"a": StreamColumns(1), "b": StreamColumns(1)}, "a", "uniform", 50.0, GAPS)
    grid.push("a", T0 + np.arange(0, 100, 10) * MS, np.zeros((10, 1)))
    assert grid.waiting == ("b",)
    rows = grid.rows(T0 + 90 * MS)
    assert rows.t_ns.tolist() == [T0 + ms * MS for ms in (0, 20, 40, 60, 80)] and not rows.has_samples.any()
