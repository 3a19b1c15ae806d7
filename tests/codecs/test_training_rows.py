import logging

import numpy as np
import pytest

from tacpipe.codecs import training_rows
from tacpipe.codecs.training_rows import TrainingRows
from tests.fake_recordings import FakeShard, decode_few_rows_at_a_time
from tests.stages.learning_fakes import CHANNELS, motion, table


def read(*shards: FakeShard, representation: str = "levels", frames: int = 1) -> TrainingRows:
    return training_rows.read_rows({shard.name: shard for shard in shards}, representation, frames)  # type: ignore[misc]


def counts(rows: int = 20, seed: int = 0) -> np.ndarray:
    values: np.ndarray = np.random.default_rng(seed).integers(-500, 500, (rows, len(CHANNELS))).astype(float)
    return values


def test_rows_outside_of_contact_in_gaps_and_not_finite_are_left_out() -> None:
    values = counts()
    torn = values.copy()
    torn[7, 3] = np.nan
    contact, gap = np.zeros(20), np.zeros(20, dtype=bool)
    contact[:4], gap[12] = -1, True
    inputs = read(FakeShard("a", table(torn, contact=contact, gap=gap))).inputs["a"]
    assert np.allclose(inputs, np.delete(values, [0, 1, 2, 3, 7, 12], axis=0))


def test_a_frame_before_contact_counts_and_one_in_a_gap_leaves_out_what_is_made_of_it() -> None:
    values = counts()
    contact, gap = np.zeros(20), np.zeros(20, dtype=bool)
    contact[:4], gap[12] = -1, True
    shard = FakeShard("a", table(values, contact=contact, gap=gap))
    steps = read(shard, representation="increments").inputs["a"]
    expected = [row for row in range(4, 20) if row not in (12, 13)]
    assert np.allclose(steps, np.diff(values, axis=0, prepend=values[:1])[expected])
    pairs = read(shard, frames=3).inputs["a"]
    expected = [row for row in range(4, 20) if row not in (12, 13, 14)]
    assert np.allclose(pairs, np.hstack([np.roll(values, lag, axis=0) for lag in (2, 1, 0)])[expected])


def test_a_table_without_contacts_counts_whole() -> None:
    content = table(counts())
    assert len(read(FakeShard("a", content.drop_columns(["contact"]))).inputs["a"]) == 20


def test_held_out_recordings_are_always_the_same_and_a_share_of_them() -> None:
    names = [f"trial-{index:02d}" for index in range(20)]
    rows = {name: counts(2, index) for index, name in enumerate(names)}
    first = TrainingRows(tuple(CHANNELS), (), rows)
    second = TrainingRows(tuple(CHANNELS), (), {name: rows[name] for name in reversed(names)})
    assert first.held_out == second.held_out
    assert len(first.held_out) == 3
    train, val = first.parts
    assert np.array_equal(val, np.concatenate([rows[name] for name in sorted(first.held_out)]))
    assert len(train) + len(val) == 40


@pytest.mark.parametrize(("recordings", "count"), [(1, 0), (2, 1), (3, 1), (7, 1), (13, 2)])
def test_few_recordings_hold_out_one_and_a_single_one_none(recordings: int, count: int) -> None:
    rows = TrainingRows(tuple(CHANNELS), (), {f"t{index}": counts(2) for index in range(recordings)})
    assert len(rows.held_out) == count


def test_channels_that_never_move_are_named_in_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    values = [counts(), counts(seed=1)]
    for recording in values:
        recording[:, 4] = 0.0
    with caplog.at_level(logging.WARNING):
        read(*(FakeShard(f"t{index}", table(recording)) for index, recording in enumerate(values)))
    assert f"1 of 12 tactile channels never move in the training recordings: {CHANNELS[4]}." in caplog.text


def test_channels_that_move_in_one_of_the_recordings_are_no_cause_for_a_warning(
    caplog: pytest.LogCaptureFixture,
) -> None:
    constant = counts()
    constant[:, 4] = 0.0
    read(FakeShard("a", table(constant)), motion(0))
    assert caplog.text == ""


@pytest.mark.parametrize("representation", ["levels", "increments"])
@pytest.mark.parametrize("rows", [1, 7, 19, 400])
def test_rows_that_are_read_in_pieces_are_those_of_the_whole_recording(
    monkeypatch: pytest.MonkeyPatch, rows: int, representation: str
) -> None:
    values = counts()
    values[7, 3] = np.nan
    contact, gap = np.zeros(20), np.zeros(20, dtype=bool)
    contact[:4], gap[12] = -1, True
    shard = FakeShard("a", table(values, contact=contact, gap=gap))
    expected = read(shard, representation=representation, frames=2).inputs["a"]
    decode_few_rows_at_a_time(monkeypatch, rows)
    stored = training_rows.stored_rows({"a": shard}, representation, 2)  # type: ignore[dict-item]
    pieces = list(stored.pieces(["a"]))
    assert len(pieces) == -(-20 // rows)
    assert np.array_equal(np.concatenate(pieces), expected)
