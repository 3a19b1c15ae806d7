import gzip
import io
import json
import zipfile
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.formats.table import binary, reading, rows, text
from tacpipe.formats.table.layout import StreamLayout
from tacpipe.io import spill
from tacpipe.io.parquet import to_parquet
from tests.formats.table import labs

T_NS = labs.START_S * 10**9 + np.arange(50) * 10_000_000


def expect(table: pa.Table, frame: pd.DataFrame) -> None:
    """Compare a table that was read with what pandas wrote."""
    assert table.column("t_ns").to_pylist() == T_NS.tolist()
    for taxel in range(1, 5):
        column = table.column(f"taxel{taxel}")
        assert column.type == pa.uint16() and column.to_pylist() == frame[f"taxel{taxel}"].tolist()
        assert table.schema.field(f"taxel{taxel}").metadata[b"taxel"] == str(taxel).encode()
    assert np.array_equal(table.column("force_x_n").to_numpy(), frame["fx"].to_numpy())
    assert table.schema.field("force_x_n").metadata[b"unit"] == b"N"


def test_a_csv_that_pandas_wrote_is_read_to_the_bit(tmp_path: Path) -> None:
    (frame,) = labs.write(tmp_path, 1)
    expect(labs.read_stream_table(tmp_path / "trial_0/skin.csv", labs.stream()), frame)


@pytest.mark.parametrize(
    ("options", "extra"),
    [
        ({"sep": ";", "decimal": ","}, 'separator = ";"\ndecimal = ","'),
        ({"sep": "\t"}, 'separator = "\\t"'),
        ({"encoding": "utf-8-sig"}, ""),
        ({"lineterminator": "\r\n"}, ""),
        ({"quoting": 1}, ""),
    ],
)
def test_other_ways_to_write_the_same_table_give_the_same(tmp_path: Path, options: dict[str, str], extra: str) -> None:
    (frame,) = labs.write(tmp_path, 1, **options)
    expect(labs.read_stream_table(tmp_path / "trial_0/skin.csv", labs.stream(extra)), frame)


def test_a_compressed_file_with_comments_and_lines_before_its_header_gives_the_same(tmp_path: Path) -> None:
    frame = labs.frame()
    text = frame.to_csv(index=False).splitlines()
    lines = ["recorded by nobody", "", *text[:1], "# pause", *text[1:20], "", "  # more", *text[20:]]
    (tmp_path / "skin.csv.gz").write_bytes(gzip.compress("\n".join(lines).encode()))
    expect(labs.read_stream_table(tmp_path / "skin.csv.gz", labs.stream('skip_lines = 2\ncomment = "#"')), frame)


def test_a_file_without_header_has_numbered_columns(tmp_path: Path) -> None:
    frame = labs.frame()
    frame.to_csv(tmp_path / "skin.csv", index=False, header=False)
    columns = (
        '{ match = "column6", name = "force_x_n", unit = "N" }, '
        '{ match = "column{taxel}", name = "cell{taxel}", type = "uint16" }'
    )
    table = labs.read_stream_table(
        tmp_path / "skin.csv", labs.stream('header = false\ntime = { column = "column1" }', columns)
    )
    assert table.column("cell2").to_pylist() == frame["taxel1"].tolist()


def test_parquet_npz_and_json_lines_give_the_same_as_csv(tmp_path: Path) -> None:
    frame = labs.frame()
    pq.write_table(pa.Table.from_pandas(frame), tmp_path / "skin.parquet")
    np.savez(tmp_path / "skin.npz", allow_pickle=False, **{str(name): frame[name].to_numpy() for name in frame})
    frame.to_json(tmp_path / "skin.jsonl", orient="records", lines=True, double_precision=15)
    for name in ("skin.parquet", "skin.npz", "skin.jsonl"):
        table = labs.read_stream_table(tmp_path / name, labs.stream())
        expect(table.set_column(0, "t_ns", pa.array(T_NS)), frame)
        assert np.abs(table.column("t_ns").to_numpy() - T_NS).max() < 240  # resolution of Unix seconds in float64


def test_arrays_of_two_dimensions_are_columns(tmp_path: Path) -> None:
    grid = np.arange(12, dtype=np.uint16).reshape(3, 2, 2)
    np.savez(tmp_path / "skin.npz", stamp=np.arange(3) * 10**9, grid=grid)
    columns = '{ match = "grid_{cell}", type = "uint16" }'
    table = labs.read_stream_table(
        tmp_path / "skin.npz", labs.stream('time = { column = "stamp", unit = "ns" }', columns)
    )
    assert [table.column(f"grid_{cell}").to_pylist() for cell in range(4)] == grid.reshape(3, 4).T.tolist()


def test_long_form_becomes_a_column_a_channel(tmp_path: Path) -> None:
    frame = labs.frame()
    frame.melt("time", var_name="sensor", value_name="reading").to_csv(tmp_path / "skin.csv", index=False)
    table = labs.read_stream_table(
        tmp_path / "skin.csv", labs.stream('long = { channel = "sensor", value = "reading" }')
    )
    expect(table, frame)


def test_a_moment_at_which_a_channel_is_missing_is_nan_in_long_form(tmp_path: Path) -> None:
    (tmp_path / "skin.csv").write_text("time,sensor,reading\n0,fx,1\n0,fy,2\n1,fx,3\n")
    extra = 'long = { channel = "sensor", value = "reading" }\ntime = { column = "time", origin = "start" }'
    table = labs.read_stream_table(tmp_path / "skin.csv", labs.stream(extra, '{ match = "f{component}" }'))
    assert table.column("fx").to_pylist() == [1.0, 3.0]
    assert np.isnan(table.column("fy")[1].as_py())


def test_two_values_of_a_channel_at_one_moment_are_refused(tmp_path: Path) -> None:
    (tmp_path / "skin.csv").write_text("time,sensor,reading\n0,fx,1\n0,fx,2\n")
    with pytest.raises(TacpipeError, match=r"two values of fx .* line 3"):
        labs.read_stream_table(
            tmp_path / "skin.csv", labs.stream('long = { channel = "sensor", value = "reading" }', '{ match = "fx" }')
        )


def test_the_rows_of_one_recording_are_picked_from_a_file_of_many(tmp_path: Path) -> None:
    frames = {f"t{trial}": labs.frame(seed=trial) for trial in range(3)}
    all_items = pd.concat([frame.assign(trial=name) for name, frame in frames.items()])
    all_items.to_csv(tmp_path / "all.csv", index=False)
    stream = labs.stream('recording = "trial"', files="all.csv")
    for name, frame in frames.items():
        expect(labs.read_stream_table(tmp_path / "all.csv", stream, name), frame)


def test_a_rate_makes_the_stamps_where_no_column_has_them(tmp_path: Path) -> None:
    frame = labs.frame().drop(columns="time")
    frame.to_csv(tmp_path / "skin.csv", index=False)
    extra = 'time = { rate_hz = 100, start = "2023-11-14T22:13:20" }'
    table = labs.read_stream_table(tmp_path / "skin.csv", labs.stream(extra))
    expect(table, frame)
    assert table.schema.field("t_ns").metadata[b"made"] == b"from rate"


def test_missing_cells_are_nan_where_they_are_declared(tmp_path: Path) -> None:
    (tmp_path / "skin.csv").write_text("time,fx\n0,1.5\n1,NA\n2,\n")
    table = labs.read_stream_table(tmp_path / "skin.csv", labs.stream('missing = ["NA", ""]', '{ match = "fx" }'))
    assert table.column("fx").to_pylist()[0] == 1.5
    assert np.isnan(table.column("fx").to_numpy()[1:]).all()


def test_a_scaled_column_is_in_its_unit(tmp_path: Path) -> None:
    (tmp_path / "skin.csv").write_text("time,fx\n0,1500\n1,-20\n")
    table = labs.read_stream_table(
        tmp_path / "skin.csv", labs.stream("", '{ match = "fx", unit = "N", scale = 0.001 }')
    )
    assert table.column("fx").to_pylist() == [1.5, -0.02]


WRONG = {  # content of a file, and what the sentence about it must name
    "time,taxel1,fx\n0,1,1\n1,x,1\n": ("line 3", "taxel1", "'x'"),
    "time,taxel1,fx\n0,1,1\n\n1,2\n": ("line 4", "2 cells instead of 3"),
    "time,taxel1,fx\n0,1,1\n1,70000,1\n": ("line 3", "taxel1", "70000", "65535"),
    "time,taxel1,fx\n0,1,1\n1,1.5,1\n": ("line 3", "taxel1", "1.5"),
    "time,taxel1,fx\n0,1,1\n1,2,nan\n": ("line 3", "fx", "nan"),
    "time,taxel1,fx\n0,1,1\n1,2,inf\n": ("line 3", "fx", "inf"),
    "time,taxel1,fx\n0,1,1\n1,,1\n": ("line 3", "taxel1"),
    "time,taxel1,fx\n0,1,1\n,2,1\n": ("line 3", "time"),
    "time,taxel1,fx\n5,1,1\n4,2,1\n": ("line 3", "1 s before"),
    "time,taxel1,fx\n": ("no row",),
    "": ("no row",),
    "time,taxel1,taxel1,fx\n0,1,1,1\n": ("taxel1", "more than one"),
    "time,taxel1,fx,extra\n0,1,1,1\n": ("extra", "[streams.skin]"),
    "time,taxel1\n0,1\n": ("fx", "[streams.skin]"),
    "stamp,taxel1,fx\n0,1,1\n": ("time", "stamp"),
    'time,taxel1,fx\n0,"1,1\n': ("line 2",),
    "time,taxel1,fx\r0,1,1\r": ("line 1", "carriage return alone", r"tr '\r' '\n'"),
}


@pytest.mark.parametrize("content", WRONG)
def test_a_wrong_file_is_one_sentence_with_its_place(tmp_path: Path, content: str) -> None:
    path = tmp_path / "skin.csv"
    path.write_text(content)
    with pytest.raises(TacpipeError) as result:
        labs.read_stream_table(path, labs.stream())
    assert all(part in str(result.value) for part in (str(path), *WRONG[content])), str(result.value)
    assert "\n" not in str(result.value)


def test_a_value_that_is_wrong_in_a_later_block_is_named_by_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tacpipe.formats.table.text.BLOCK_BYTES", 64)
    rows = [f"{row},1,0.5" for row in range(100)]
    rows[80] = "80,1,inf"
    (tmp_path / "skin.csv").write_text("\n".join(["time,taxel1,fx", *rows]))
    with pytest.raises(TacpipeError, match="line 82"):
        labs.read_stream_table(tmp_path / "skin.csv", labs.stream())


def test_a_wrong_stamp_of_one_recording_in_long_form_is_named_by_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tacpipe.formats.table.text.BLOCK_BYTES", 64)
    rows = [f"{row},fx,0.5,{'ab'[row % 2]}" for row in range(100)]
    rows[80] = "NA,fx,0.5,a"
    (tmp_path / "skin.csv").write_text("\n".join(["time,sensor,reading,trial", *rows]))
    extra = 'recording = "trial"\nmissing = ["NA"]\nlong = { channel = "sensor", value = "reading" }'
    with pytest.raises(TacpipeError, match="line 82"):
        labs.read_stream_table(tmp_path / "skin.csv", labs.stream(extra, '{ match = "fx" }'), "a")


def same_in_blocks(
    monkeypatch: pytest.MonkeyPatch, path: Path, stream: StreamLayout, recording: str | None = None
) -> pa.Table:
    """Return what a file holds, which is read to the same bytes in one block and in many."""
    table = labs.read_stream_table(path, stream, recording)
    for module in (text, binary):
        monkeypatch.setattr(module, "BLOCK_BYTES", 200)
    batches = list(reading.stream_batches(rows.open_rows(path, stream), stream, recording))
    assert len(batches) > 1 and to_parquet(pa.Table.from_batches(batches)) == to_parquet(table)
    return table


@pytest.mark.parametrize("name", ["skin.csv", "skin.csv.gz", "skin.parquet", "skin.npz", "skin.jsonl", "skin.jsonl.gz"])
def test_a_file_is_read_block_by_block_to_the_same_bytes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str
) -> None:
    frame, path = labs.frame(), tmp_path / name
    frame.loc[7, "fx"] = np.nan
    if "csv" in name:
        frame.to_csv(path, index=False, na_rep="NA", lineterminator="\r\n")
    elif "jsonl" in name:
        frame.to_json(path, orient="records", lines=True, double_precision=15)
    elif name == "skin.npz":
        np.savez_compressed(path, allow_pickle=False, **{str(entry): frame[entry].to_numpy() for entry in frame})
    else:
        pq.write_table(pa.Table.from_pandas(frame), path)
    provided = labs.stream('missing = ["NA", "nan"]')
    result = same_in_blocks(monkeypatch, path, provided)
    assert result.column("taxel3").to_pylist() == frame["taxel3"].tolist()
    assert np.array_equal(result.column("force_x_n").to_numpy(), frame["fx"].to_numpy(), equal_nan=True)


def test_the_stamps_of_a_rate_go_on_from_block_to_block(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    labs.frame().drop(columns="time").to_csv(tmp_path / "skin.csv", index=False)
    provided = labs.stream('time = { rate_hz = 30, start = "2024-02-29T12:00:00Z" }')
    t_ns = same_in_blocks(monkeypatch, tmp_path / "skin.csv", provided).column("t_ns").to_numpy()
    assert (t_ns - t_ns[0]).tolist() == [round(row * 1e9 / 30) for row in range(50)]


def test_stamps_that_run_backwards_between_two_blocks_are_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    frame = labs.frame()
    frame.loc[30:, "time"] -= 1
    frame.to_csv(tmp_path / "skin.csv", index=False)
    monkeypatch.setattr(text, "BLOCK_BYTES", len(frame[:30].to_csv(index=False)) - len(frame[:0].to_csv(index=False)))
    with pytest.raises(TacpipeError, match=r"line 32: the stamp is 0\.99"):
        labs.read_stream_table(tmp_path / "skin.csv", labs.stream())


@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_of_an_archive_are_read_in_either_order(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, order: Literal["C", "F"]
) -> None:
    values = np.arange(600, dtype=">u2").reshape(200, 3)
    np.savez(tmp_path / "skin.npz", allow_pickle=False, time=np.arange(200), taxel=np.array(values, order=order))
    columns = '{ match = "taxel_{taxel}", type = "uint16" }'
    result = same_in_blocks(monkeypatch, tmp_path / "skin.npz", labs.stream("", columns))
    assert [result.column(f"taxel_{index}").to_pylist() for index in range(3)] == values.T.tolist()


def test_an_archive_that_declares_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (3, 10**9)})
    with zipfile.ZipFile(tmp_path / "skin.npz", "w") as archive:
        archive.writestr("time.npy", header.getvalue())
    with pytest.raises(TacpipeError, match="more values than it has bytes for"):
        labs.read_stream_table(tmp_path / "skin.npz", labs.stream())


def test_a_key_that_only_later_lines_have_is_a_column_and_lists_of_two_lengths_are_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(binary, "BLOCK_BYTES", 30)
    lines = [{"time": row, **({"fx": row / 2} if row > 30 else {})} for row in range(50)]
    (tmp_path / "skin.jsonl").write_text("\n".join(map(json.dumps, lines)))
    table = labs.read_stream_table(tmp_path / "skin.jsonl", labs.stream("", '{ match = "fx" }')).column("fx").to_numpy()
    assert np.isnan(table[:31]).all() and table[31:].tolist() == [row / 2 for row in range(31, 50)]
    uneven = [{"time": row, "x": [1] * (2 + row // 30)} for row in range(50)]
    (tmp_path / "skin.jsonl").write_text("\n".join(map(json.dumps, uneven)))
    with pytest.raises(TacpipeError, match="lists of x have 2 lengths"):
        labs.read_stream_table(tmp_path / "skin.jsonl", labs.stream("", '{ match = "x_*" }'))


def test_a_key_that_is_not_utf8_is_refused(tmp_path: Path) -> None:
    (tmp_path / "skin.jsonl").write_bytes(b'{"time": 1, "f\xff": 2}\n')
    with pytest.raises(TacpipeError, match="not JSON lines"):
        labs.read_stream_table(tmp_path / "skin.jsonl", labs.stream())


def test_a_file_that_is_one_endless_line_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(text, "MAX_LINE_BYTES", 1000)
    monkeypatch.setattr(text, "BLOCK_BYTES", 400)
    for start in ("", "time,fx\n1,2\n"):
        (tmp_path / "skin.csv").write_text(start + "1" * 3000)
        with pytest.raises(TacpipeError, match="a line of over 1000 bytes"):
            labs.read_stream_table(tmp_path / "skin.csv", labs.stream("", '{ match = "fx" }'))


def test_pickles_in_an_archive_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "skin.npz", time=np.array([{}, {}], dtype=object))
    with pytest.raises(TacpipeError, match=r"skin\.npz"):
        labs.read_stream_table(tmp_path / "skin.npz", labs.stream())


def test_json_lines_with_lists_are_columns(tmp_path: Path) -> None:
    lines = [json.dumps({"time": row, "taxels": [row, row + 1]}) for row in range(3)]
    (tmp_path / "skin.jsonl").write_text("\n".join(lines))
    table = labs.read_stream_table(
        tmp_path / "skin.jsonl", labs.stream("", '{ match = "taxels_{taxel}", type = "uint16" }')
    )
    assert table.column("taxels_1").to_pylist() == [1, 2, 3]


@pytest.mark.parametrize("order", ["melted", "by time", "mixed"])
def test_a_long_form_of_many_runs_is_the_table_that_pandas_pivots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, order: str
) -> None:
    monkeypatch.setattr(reading, "RUN_ROWS", 60)
    monkeypatch.setattr(reading, "GRID_VALUES", 20)
    monkeypatch.setattr(spill, "PIECE_ROWS", 7)
    monkeypatch.setattr(text, "BLOCK_BYTES", 400)
    rows = labs.frame(rows=100).melt("time", var_name="sensor", value_name="reading")
    rows = rows.sample(frac=0.9, random_state=1).sort_index() if order == "melted" else rows
    rows = rows.sort_values(["time", "sensor"]) if order == "by time" else rows
    rows = rows.sample(frac=1.0, random_state=2) if order == "mixed" else rows
    rows.to_csv(tmp_path / "skin.csv", index=False)
    columns = '{ match = "*" }'
    table = labs.read_stream_table(
        tmp_path / "skin.csv", labs.stream('long = { channel = "sensor", value = "reading" }', columns)
    )
    expected = rows.pivot(index="time", columns="sensor", values="reading")
    assert table.column_names == ["t_ns", *sorted(rows["sensor"].unique())]
    assert table.column("t_ns").to_pylist() == [round(time * 1000) * 10**6 for time in expected.index]
    for name in expected:
        np.testing.assert_array_equal(table.column(name).to_numpy(), expected[name].to_numpy())


def test_of_a_long_form_of_many_runs_the_second_of_two_values_is_named_by_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "RUN_ROWS", 10)
    monkeypatch.setattr(text, "BLOCK_BYTES", 40)
    rows = [f"{row},fx,1" for row in range(50)] + ["7,fx,2"]
    (tmp_path / "skin.csv").write_text("\n".join(["time,sensor,reading", *rows]) + "\n")
    stream = labs.stream('long = { channel = "sensor", value = "reading" }', '{ match = "fx" }')
    with pytest.raises(TacpipeError, match=r"two values of fx .* line 52\b"):
        labs.read_stream_table(tmp_path / "skin.csv", stream)


def test_a_row_of_a_long_form_that_names_no_channel_is_named_by_its_line(tmp_path: Path) -> None:
    (tmp_path / "skin.csv").write_text("time,sensor,reading\n0,fx,1\n1,,2\n")
    stream = labs.stream('long = { channel = "sensor", value = "reading" }', '{ match = "fx" }')
    with pytest.raises(TacpipeError, match=r"line 3, column sensor"):
        labs.read_stream_table(tmp_path / "skin.csv", stream)


def test_a_long_form_whose_channels_are_numbers_without_end_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "MAX_CHANNELS", 5)
    (tmp_path / "skin.csv").write_text("time,sensor,reading\n" + "".join(f"{row},{row}.5,1\n" for row in range(9)))
    stream = labs.stream('long = { channel = "sensor", value = "reading" }', '{ match = "*" }')
    with pytest.raises(TacpipeError, match=r"column sensor names more than 5 channels"):
        labs.read_stream_table(tmp_path / "skin.csv", stream)
