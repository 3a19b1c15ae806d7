"""Rows of `synchronize` for streams that arrive in bursts, late, out of order or from devices without a rate."""

from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.arrays import Times
from tacpipe.channels import schema
from tacpipe.channels.arm import Pose
from tacpipe.codecs.codec import Raw
from tacpipe.errors import TacpipeError
from tacpipe.plugins.registry import load
from tacpipe.plugins.rows import LATE, OUTSIDE
from tacpipe.plugins.stage import RecordingOutput
from tacpipe.tasks.forward import tracks
from tests.fake_recordings import FakeRecording, FakeShard
from tests.signals import deliveries

T0 = 1_637_771_974_778_354_001
MS = 1_000_000
synchronize, contacts = load("synchronize"), load("segment.contacts")


def skin(arrival_ns: Times, *, period_ms: int | None = 10, seq: Any = None, arrivals: bool = True) -> pa.Table:
    """Return a stream of one taxel whose x counts the samples."""
    numbers = np.arange(len(arrival_ns)).astype(np.uint16)
    table = schema.stream(T0 + arrival_ns, [numbers] * 3, schema.uskin_fields(1))
    field = schema.time_field(arrivals=arrivals, period_ns=None if period_ms is None else period_ms * MS)
    table = table.set_column(0, field, table.column("t_ns"))
    if seq is not None:
        table = table.append_column(schema.device_fields(clock=False, counters=["seq"])[0], pa.array(seq))
    return table


def rows_of(streams: dict[str, pa.Table], attributes: dict[str, Any] | None = None, **values: Any) -> RecordingOutput:
    output = synchronize(synchronize.params(**values), FakeRecording(streams, attributes=attributes or {}))
    assert isinstance(output, RecordingOutput)
    return output


def times(output: RecordingOutput) -> tuple[np.ndarray, np.ndarray]:
    table = output.streams[""]
    return table["t_ns"].to_numpy() - T0, table["t_arrival_ns"].to_numpy() - T0


@settings(deadline=None)
@given(
    st.lists(st.sampled_from([0, 0, 1, 9 * MS, 16 * MS, 300 * MS, 5_000 * MS]), min_size=1, max_size=200),
    st.sampled_from([None, 10]),
    st.booleans(),
)
def test_every_sample_of_the_master_is_one_row_however_it_arrived(
    steps: list[int], period_ms: int | None, arrivals: bool
) -> None:
    arrival_ns = np.cumsum(steps)
    output = rows_of({"skin": skin(arrival_ns, period_ms=period_ms, arrivals=arrivals)}, master="skin")
    t_ns, row_arrival_ns = times(output)
    assert row_arrival_ns.tolist() == arrival_ns.tolist()
    assert (np.diff(t_ns) > 0).all()
    assert (t_ns <= arrival_ns + np.arange(len(arrival_ns))).all()
    assert output.streams[""]["skin_taxel01_x"].to_pylist() == list(range(len(steps)))
    assert output.rows is not None and output.rows["skin"].used == len(steps)


def test_a_board_behind_an_adapter_keeps_its_rows_at_their_times() -> None:
    measured_s = np.arange(0, 12, 0.01)
    arrival_ns = np.rint(deliveries.deliver_by_timer(measured_s, 0.016) * 1e9).astype(np.int64)
    assert len(np.unique(arrival_ns)) < 760
    t_ns, _ = times(rows_of({"skin": skin(arrival_ns)}))
    assert len(t_ns) == 1200
    errors_ns = t_ns - np.rint(measured_s * 1e9)
    assert np.abs(errors_ns - np.median(errors_ns))[100:].max() < 3.2 * MS


def test_files_whose_stamps_come_in_batches_keep_their_rows() -> None:
    t_ns, arrival_ns = times(rows_of({"skin": skin(np.repeat(np.arange(1, 21) * 100 * MS, 10), arrivals=False)}))
    assert len(t_ns) == 200 and len(np.unique(arrival_ns)) == 20
    assert np.abs(np.diff(t_ns)[10:] - 10 * MS).max() < MS


def test_a_late_sample_makes_no_row_is_not_held_and_is_counted() -> None:
    seq = [0, 1, 3, 2, 4, 5]
    streams = {"skin": skin(np.arange(6) * 10 * MS, seq=seq), "arm": skin(np.arange(6) * 10 * MS + MS, seq=seq)}
    output = rows_of(streams, master="skin")
    table = output.streams[""]
    assert table["skin_seq"].to_pylist() == [1, 3, 4, 5]  # the first row of the skin is before the arm has started
    assert table["arm_seq"].to_pylist() == [0, 1, 3, 4]
    assert output.rows is not None
    assert output.rows["skin"].unused == {LATE: 1, OUTSIDE: 1}
    assert output.rows["arm"].unused == {LATE: 1, OUTSIDE: 1}


def test_rows_during_a_stall_of_one_stream_hold_its_last_sample_and_are_in_a_gap() -> None:
    measured = np.arange(0, 3000)
    stalled = (measured > 1000) & (measured <= 1500)
    late_ns = np.where(stalled, 15_000 * MS + MS, measured * 10 * MS)
    output = rows_of({"first": skin(measured * 10 * MS + MS), "second": skin(late_ns)}, master="first")
    table = output.streams[""]
    newest = table["second_taxel01_x"].to_numpy().astype(np.int64)
    gap = table["second_gap"].to_numpy(zero_copy_only=False)
    t_ns, arrival_ns = times(output)
    in_stall = (arrival_ns > 10_010 * MS) & (arrival_ns < 15_000 * MS)
    assert set(newest[in_stall]) == {1000}
    assert gap[in_stall & (arrival_ns > 10_060 * MS)].all() and not gap[arrival_ns > 15_010 * MS].any()
    after = arrival_ns > 15_001 * MS
    assert (newest[after] * 10 * MS <= t_ns[after] + MS).all() and newest[after][0] >= 1500


def test_a_delayed_master_is_not_joined_with_values_that_were_measured_after_it() -> None:
    measured = np.arange(0, 3000)
    stalled = (measured > 1000) & (measured <= 1200)
    late_ns = np.where(stalled, 12_000 * MS + MS, measured * 10 * MS + MS)
    output = rows_of({"master": skin(late_ns), "other": skin(measured * 10 * MS)}, master="master")
    t_ns, _ = times(output)
    other = output.streams[""]["other_taxel01_x"].to_numpy().astype(int)
    assert len(t_ns) == 3000
    assert np.abs(other - output.streams[""]["master_taxel01_x"].to_numpy().astype(int)).max() <= 1


def test_a_uniform_row_holds_what_had_arrived_by_then_and_ends_with_the_master() -> None:
    output = rows_of(
        {"skin": skin(np.arange(100) * 10 * MS), "arm": skin(np.repeat(np.arange(1, 30) * 50 * MS, 5))},
        master="skin",
        rate_hz=100.0,
    )
    t_ns, arrival_ns = times(output)
    assert t_ns.tolist() == arrival_ns.tolist() and t_ns[-1] == 990 * MS
    assert not output.streams[""]["at_arrival"].to_numpy(zero_copy_only=False).any()
    assert output.streams[""]["arm_taxel01_x"].to_numpy()[t_ns == 160 * MS].tolist() == [14]


def irregular() -> RecordingOutput:
    steps = np.random.default_rng(0).exponential(10 * MS, 2000).astype(np.int64)
    return rows_of({"skin": skin(np.cumsum(steps), period_ms=None)})


def test_rows_of_a_device_without_a_rate_are_marked_and_the_command_says_so() -> None:
    output = irregular()
    marked = output.streams[""]["at_arrival"].to_numpy(zero_copy_only=False)
    assert marked.mean() > 0.8
    assert any(
        "of the rows are at the arrival of their sample" in note and "--rate-hz" in note for note in output.notes
    )


def track(table: pa.Table) -> tracks.Track:
    """Return the track of rows of one taxel."""
    names = tuple(f"skin_taxel01_{axis}" for axis in "xyz")
    layout = tuple({"stream": "skin", "taxel": "1", "axis": axis} for axis in "xyz")
    shard: Any = FakeShard("a", table, {"grid": "logged"})
    return tracks.track(shard, Raw(names, layout), Pose())


def test_marked_rows_are_neither_rest_nor_trained_or_scored_on() -> None:
    synced = irregular().streams[""]
    marked = synced["at_arrival"].to_numpy(zero_copy_only=False)
    segmented = contacts(contacts.params(), FakeRecording({"": synced}))
    table = segmented.streams[""]
    first = synced["skin_taxel01_x"].to_numpy()[~marked]
    t_ns = synced["t_ns"].to_numpy()[~marked]
    expected = np.median(first[t_ns <= t_ns[0] + 200 * MS])
    assert float(table.schema.field("skin_taxel01_x").metadata[b"rest"]) == expected
    assert (track(table).usable == ~marked).all()


def test_without_any_row_of_known_time_the_error_names_the_option() -> None:
    synced = rows_of({"skin": skin(np.arange(20) * 10 * MS, period_ms=None)}).streams[""]
    with pytest.raises(TacpipeError, match="--rate-hz"):
        contacts(contacts.params(), FakeRecording({"": synced}))


def test_a_window_whose_target_had_already_arrived_is_no_forecast() -> None:
    synced = rows_of({"skin": skin(np.repeat(np.arange(1, 101) * 50 * MS, 5))}).streams[""]
    table = contacts(contacts.params(), FakeRecording({"": synced})).streams[""]
    newest_rows = track(table).starts(4, 2) + 3
    assert len(newest_rows) > 90 and (newest_rows % 5 == 4).all()
