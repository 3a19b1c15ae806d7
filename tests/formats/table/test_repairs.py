"""Stamps that cannot be right are refused or noted, and a layout repairs them."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from tacpipe.channels import schema
from tacpipe.errors import TacpipeError
from tacpipe.formats.table import guess, layout, reading, recordings, rows, text
from tests.formats.table import labs

ROWS = np.arange(400)
Stamps = Any  # a sequence or an array of numbers or texts
UNIX = [f"{labs.START_S + row / 100:.6f}" for row in ROWS]
COLUMNS = '{ match = "a" }, { match = "b" }'
COUNTER = 2**32  # of microseconds


def read(folder: Path, stamps: Stamps, time: str = "", values: Stamps | None = None) -> tuple[pa.Table, list[str]]:
    """Return the stream of a CSV file with these stamps, read with the entries ``time``, and the notes on it."""
    path = folder / "skin.csv"
    pd.DataFrame({"time": stamps, "a": values or range(len(stamps)), "b": 0.5}).to_csv(path, index=False)
    stream = labs.stream(f'time = {{ column = "time"{time} }}', COLUMNS)
    notes: list[str] = []
    reader = reading.stream_batches(rows.open_rows(path, stream), stream, notes=notes)
    return reader.read_all(), notes


def refusal(folder: Path, stamps: Stamps, time: str = "") -> str:
    """Return the sentence that refuses these stamps, after reading them with the entry that it proposes."""
    with pytest.raises(TacpipeError) as error:
        read(folder, stamps, time)
    sentence = str(error.value)
    entry = sentence.partition("`time = {")[2].partition(" }`")[0].removeprefix(' column = "time"')
    table, _ = read(folder, stamps, entry)
    assert (np.diff(table["t_ns"].to_numpy()) >= 0).all()
    return sentence


def test_batches_are_kept_as_arrivals_with_a_note(tmp_path: Path) -> None:
    table, notes = read(tmp_path, [f"{labs.START_S + row // 10 / 10:.6f}" for row in ROWS])
    assert table.num_rows == 400 and schema.has_arrivals(table.schema.field("t_ns"))
    assert notes == [
        "360 of 400 rows of skin share a stamp with the row before; `synchronize` estimates when each was measured."
    ]


def test_declared_batches_have_the_period_of_their_rate(tmp_path: Path) -> None:
    field = read(tmp_path, UNIX, ", batch = true, rate_hz = 200")[0].schema.field("t_ns")
    assert schema.has_arrivals(field) and schema.declared_period_ns(field) == 5_000_000


def test_a_few_equal_stamps_are_a_note_with_their_lines(tmp_path: Path) -> None:
    table, notes = read(tmp_path, [*UNIX[:5], UNIX[4], *UNIX[5:]])
    assert table.num_rows == 401 and not schema.has_arrivals(table.schema.field("t_ns"))
    assert notes == ["1 of 401 rows of skin share a stamp with the row before (line 7)."]


@pytest.mark.parametrize(
    ("stamps", "cause"),
    [
        (labs.START_S + ROWS // 100, "whole seconds"),
        (100 + (ROWS / 100).astype(np.float16), "float16 has a resolution of 0.0625 s"),
        ((40_000 + ROWS / 1000).astype(np.float32).astype(float), "float32 has a resolution of 0.00390625 s"),
        ([str(stamp) for stamp in (40_000 + ROWS / 1000).astype(np.float32)], "float32"),
        (np.float32(labs.START_S + ROWS).astype(float), "float32 has a resolution of 128 s"),
        ([f"{labs.START_S + row * 100:.5e}" for row in ROWS], "six digits, a resolution of 10000 s"),
        ([f"{1000 + row / 1000:.6g}" for row in ROWS], "six digits, a resolution of 0.01 s"),
        ([f"2024-06-10 06:{13 + row // 100}" for row in ROWS], "whole minutes"),
    ],
    ids=[
        "whole seconds",
        "float16",
        "float32",
        "float32 as text",
        "float32 of today",
        "six digits",
        "digits",
        "minutes",
    ],
)
def test_stamps_coarser_than_the_period_are_refused_with_the_cause(tmp_path: Path, stamps: Stamps, cause: str) -> None:
    stamps = (100 + ROWS / 100).astype(np.float16).astype(float) if cause.startswith("float16") else stamps
    unit = ', unit = "iso8601"' if cause == "whole minutes" else ""
    sentence = refusal(tmp_path, stamps, unit)
    assert cause in sentence and "rate_hz" in sentence and "batch = true" in sentence
    assert read(tmp_path, stamps, f"{unit}, batch = true")[0].num_rows == 400


def test_a_rate_replaces_stamps_from_the_first_on(tmp_path: Path) -> None:
    table, _ = read(tmp_path, labs.START_S + ROWS // 100, ", rate_hz = 100")
    assert table["t_ns"].to_pylist() == (labs.START_S * 10**9 + ROWS * 10**7).tolist()


def test_equal_stamps_of_all_rows_are_refused(tmp_path: Path) -> None:
    assert "all 400 stamps of skin are 2023-11-14T22:13:20" in refusal(tmp_path, [labs.START_S] * 400)


def test_negative_stamps_are_refused_unless_they_count_from_the_start(tmp_path: Path) -> None:
    assert "400 of 400 stamps of skin are before 1970" in refusal(tmp_path, ROWS / 100 - 9)


@pytest.mark.parametrize(
    ("stamps", "time", "wrap"),
    [
        ((COUNTER - 2 * 10**6 + ROWS * 10**4) % COUNTER, ', unit = "us", origin = "start"', COUNTER),
        ((2**31 - 2 * 10**6 + ROWS * 10**4).astype(np.int32), ', unit = "us", origin = "start"', COUNTER),
        ((COUNTER - 2 * 10**6 + ROWS * 10**4) % COUNTER / 1e6, ', origin = "start"', COUNTER / 1e6),
        ((60_000 + ROWS * 50) % 2**16, ', unit = "ms", origin = "start"', 2**16),
    ],
    ids=["32 bits", "signed", "in seconds", "16 bits"],
)
def test_a_counter_that_wraps_is_continued(tmp_path: Path, stamps: Stamps, time: str, wrap: float) -> None:
    assert f"wrap = {wrap} " in refusal(tmp_path, stamps, time)
    steps = np.diff(read(tmp_path, stamps, f"{time}, wrap = {wrap}")[0]["t_ns"].to_numpy())
    assert (np.abs(steps - steps[0]) <= 1).all()


def test_rows_out_of_order_are_sorted_when_the_layout_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(text, "BLOCK_BYTES", 500)
    mixed = np.random.default_rng(0).permutation(400)
    assert "sort = true" in refusal(tmp_path, [UNIX[row] for row in mixed])
    table, _ = read(tmp_path, [UNIX[row] for row in mixed], ", sort = true", mixed.tolist())
    assert table["a"].to_pylist() == ROWS.tolist()


def test_stray_stamps_are_left_out_and_named(tmp_path: Path) -> None:
    stamps = ["4102444800", *UNIX[1:57], "0", *UNIX[58:-1], "1"]
    table, notes = read(tmp_path, stamps)
    assert table["a"].to_pylist() == [row for row in ROWS if row not in (0, 57, 399)]
    assert "3 of 400 rows of skin are left out" in notes[0] and "line 2, line 59, line 401" in notes[0]


def test_a_first_stamp_decades_away_is_noted_and_can_be_dropped(tmp_path: Path) -> None:
    stamps = ["0", *UNIX[1:]]
    (note,) = read(tmp_path, stamps)[1]
    assert "line 3: the stamp is 53.9 years after 1970-01-01T00:00:00" in note and "drop_first = 1" in note
    table, notes = read(tmp_path, stamps, ", drop_first = 1")
    assert table["a"].to_pylist() == ROWS[1:].tolist() and notes == []


def test_an_offset_shifts_all_stamps(tmp_path: Path) -> None:
    table, _ = read(tmp_path, UNIX, ", offset_s = -3600.5")
    assert table["t_ns"][0].as_py() == labs.START_S * 10**9 - 3_600_500_000_000


def local(start: str, step: str = "10ms") -> list[str]:
    """Return local times in Berlin of 400 moments from ``start``, in UTC."""
    stamps = pd.date_range(start, periods=400, freq=step, tz="UTC").tz_convert("Europe/Berlin").tz_localize(None)
    return [str(stamp) for stamp in stamps]


BERLIN = ', unit = "iso8601", zone = "Europe/Berlin"'


@pytest.mark.parametrize(
    ("start", "step", "block"),
    [
        ("2024-10-27 00:59:58.5", "10ms", 1 << 20),  # from one reading of the repeated hour to the other
        ("2024-10-26 23:30:00.5", "30s", 300),  # before, both, after
        ("2024-10-26 23:30:00.5", "30s", 1 << 20),
        ("2024-03-31 00:59:58.5", "10ms", 300),  # the hour that is left out
        ("2024-10-27 01:59:58.5", "10ms", 1 << 20),  # from the repeated hour to the one after it
    ],
)
def test_rows_in_order_settle_the_hour_that_summer_time_repeats(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, start: str, step: str, block: int
) -> None:
    monkeypatch.setattr(text, "BLOCK_BYTES", block)
    table, _ = read(tmp_path, local(start, step), BERLIN)
    expected = pd.date_range(start, periods=400, freq=step).as_unit("ns").asi8
    assert table["t_ns"].to_pylist() == expected.tolist()


@pytest.mark.parametrize(("reading_of_hour", "hour"), [("earlier", 0), ("later", 1)])
def test_a_recording_within_the_repeated_hour_needs_a_choice(tmp_path: Path, reading_of_hour: str, hour: int) -> None:
    stamps = local("2024-10-27 00:10:00.5")
    with pytest.raises(TacpipeError, match=r"line 2.*as CEST it is 00:10:00 UTC, as CET 01:10:00 UTC.*ambiguous"):
        read(tmp_path, stamps, BERLIN)
    table, _ = read(tmp_path, stamps, f'{BERLIN}, ambiguous = "{reading_of_hour}"')
    assert pd.Timestamp(table["t_ns"][0].as_py()) == pd.Timestamp(f"2024-10-27 0{hour}:10:00.5")


def test_a_local_time_that_does_not_exist_is_refused_with_both_readings(tmp_path: Path) -> None:
    stamps = [f"31.03.2024 02:30:0{row // 100}.{row % 100:02d}" for row in ROWS]
    with pytest.raises(TacpipeError, match=r"line 2.*as CET it is 01:30:00 UTC, as CEST 00:30:00 UTC"):
        read(tmp_path, stamps, ', format = "%d.%m.%Y %H:%M:%S.%f", zone = "Europe/Berlin"')


def test_texts_without_a_zone_below_texts_with_one_are_refused_in_any_block(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(text, "BLOCK_BYTES", 300)
    stamps = [f"2024-06-10T06:13:{row // 10:02d}.{row % 10}{'' if row == 300 else '+02:00'}" for row in ROWS]
    with pytest.raises(TacpipeError, match=r"line 302.*with a zone"):
        read(tmp_path, stamps, ', unit = "iso8601"')


def test_each_part_between_resets_of_the_clock_is_a_recording(tmp_path: Path) -> None:
    folder = tmp_path / "trial_0"
    folder.mkdir()
    parts = [100, 150, 50]
    stamps = np.concatenate([np.arange(count) / 100 for count in parts])
    pd.DataFrame({"time": stamps, "a": range(300), "b": 1}).to_csv(folder / "skin.csv", index=False)
    split = labs.skin_layout('time = { column = "time", origin = "start", split_at_reset = true }', COLUMNS)
    found = recordings.find_recordings(split, tmp_path)
    assert [recording.name for recording in found] == ["trial_0-1", "trial_0-2", "trial_0-3"]
    tables = [
        recordings.read_streams(split.streams, recording.files, recording.episode).streams["skin"].read_all()
        for recording in found
    ]
    assert [table["a"].to_pylist() for table in tables] == [
        list(range(100)),
        list(range(100, 250)),
        list(range(250, 300)),
    ]


def test_the_same_columns_in_another_order_are_stored_in_one_order(tmp_path: Path) -> None:
    frame = pd.DataFrame({f"T{taxel}": [taxel, taxel] for taxel in (10, 9, 2, 1)})
    frame = frame.assign(qw=0.5, qx=0.25, time=[0.5, 1.5])
    rules = '{ match = "T{taxel}" }, { match = "q{component}" }'
    schemas = []
    for columns in (list(frame), sorted(map(str, frame))):
        frame[columns].to_csv(tmp_path / "skin.csv", index=False)
        schemas.append(labs.read_stream_table(tmp_path / "skin.csv", labs.stream("", rules)).schema)
    assert schemas[0] == schemas[1]
    assert schemas[0].names == ["t_ns", "T1", "T2", "T9", "T10", "qx", "qw"]


def test_whole_numbers_that_floats_cannot_hold_are_refused_or_noted(tmp_path: Path) -> None:
    ticks = (np.uint64(2**63) + np.arange(4, dtype=np.uint64)).tolist()
    np.savez(tmp_path / "skin.npz", time=np.arange(4.0), a=np.array(ticks, np.uint64))
    npz = labs.stream("", '{ match = "a" }')
    with pytest.raises(TacpipeError, match=f'row 1, column a holds {2**63}.*type = "uint64"'):
        labs.read_stream_table(tmp_path / "skin.npz", npz)
    exact = labs.stream("", '{ match = "a", type = "uint64" }')
    assert labs.read_stream_table(tmp_path / "skin.npz", exact)["a"].to_pylist() == ticks
    _, notes = read(tmp_path, UNIX[:4], values=ticks)
    assert len(notes) == 1 and "a has numbers beyond 2^53" in notes[0]


@pytest.mark.parametrize(("last", "noted"), [("1700000009.50,10", True), ("1700000009.50,1009", False)])
def test_a_last_line_that_may_have_been_cut_is_noted(tmp_path: Path, last: str, noted: bool) -> None:
    lines = ["time,a", *(f"{labs.START_S + row}.50,{1000 + row}" for row in range(9)), last]
    (tmp_path / "skin.csv").write_text("\n".join(lines))
    notes: list[str] = []
    stream = labs.stream("", '{ match = "a" }')
    reading.stream_batches(rows.open_rows(tmp_path / "skin.csv", stream), stream, notes=notes).read_all()
    assert [("its last cell '10' is shorter" in note) for note in notes] == [True] * noted


@pytest.mark.parametrize(
    ("stamps", "entry"),
    [
        (labs.START_S + ROWS // 100, "batch = true"),
        ((COUNTER - 3 * 10**6 + ROWS * 10**4) % COUNTER, "wrap = 4294967296"),
        (np.concatenate([ROWS[:300], ROWS[:100]]) / 100, "split_at_reset = true"),
        (np.where(ROWS == 333, labs.START_S, labs.START_S + ROWS / 100), "sort = true"),
        (np.where(ROWS == 0, 0, labs.START_S + ROWS / 100), "drop_first = 1"),
    ],
    ids=["batch", "wrap", "resets", "sort", "first"],
)
def test_a_guess_has_the_repairs_that_any_file_needs_and_reads_its_folder(
    tmp_path: Path, stamps: Stamps, entry: str
) -> None:
    is_first = entry.startswith("drop")
    for trial in range(3):
        (tmp_path / f"rec_{trial}").mkdir()
        usual = (
            ROWS * 10**4
            if entry.startswith("wrap")
            else ROWS / 100 + (0 if entry.startswith("split") else labs.START_S)
        )
        column = "time_us" if entry.startswith("wrap") else "time_s"
        frame = pd.DataFrame({column: stamps if trial == 2 or is_first else usual, "taxel1": ROWS})
        frame.to_csv(tmp_path / f"rec_{trial}" / "skin.csv", index=False)
    printed = guess.guess_layout(tmp_path)
    assert entry in printed
    guessed = layout.parse_layout(printed.replace('"?"', '"mine"'))
    found = recordings.find_recordings(guessed, tmp_path)
    for recording in found:
        for stream in recordings.read_streams(guessed.streams, recording.files, recording.episode).streams.values():
            assert stream.read_all().num_rows
    assert [recording.name for recording in found][:2] == ["rec_0", "rec_1"]


def test_a_guess_has_the_columns_that_only_some_files_have(tmp_path: Path) -> None:
    for trial in range(3):
        (tmp_path / f"rec_{trial}").mkdir()
        frame = labs.frame() if trial == 1 else labs.frame().drop(columns=["fx", "taxel2"])
        frame.to_csv(tmp_path / f"rec_{trial}" / "skin.csv", index=False)
    guessed = layout.parse_layout(guess.guess_layout(tmp_path).replace('"?"', '"N"'))
    for recording in recordings.find_recordings(guessed, tmp_path):
        output = recordings.read_streams(guessed.streams, recording.files, recording.episode)
        assert output.streams["skin"].read_all().num_rows == 50
        assert output.notes == ([] if recording.name == "rec_1" else ["skin has no column fx."])
