"""Arrays, workbooks, encodings and stamps as labs write them, compared with what numpy and pandas wrote."""

import datetime
import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.formats.container import Time
from tacpipe.formats.table import guess, layout, stamps
from tacpipe.formats.table.contained import LayoutCommand, Params
from tests.formats.table import labs

SHAPE = "shape = [4, 3], axes = ['x', 'y', 'z']"


def streams_of(text: str, folder: Path) -> dict[str, pa.Table]:
    """Return the streams of the first recording below a folder, read with a layout."""
    command, params = LayoutCommand(None), Params(layout=json.dumps(tomllib.loads(text)))
    source = next(iter(command.discover(params, folder).values()))
    output = command.read(params, source.files, source.values)
    return {name: table.read_all() for name, table in output.streams.items() if isinstance(table, pa.RecordBatchReader)}


def guessed(folder: Path, **answers: str) -> str:
    text = guess.guess_layout(folder)
    for name, answer in {"sensor": "mine", **answers}.items():
        text = text.replace(f'{name} = "?"', f'{name} = "{answer}"')
    return text


def counts(*shape: int) -> np.ndarray[Any, np.dtype[np.uint16]]:
    return np.random.default_rng(7).integers(0, 4096, shape).astype(np.uint16)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("file", ["npy", "npz"])
def test_a_guess_reads_an_array_of_taxels_with_one_rule_and_stamps_of_their_own(
    tmp_path: Path, file: str, order: Any
) -> None:
    values, seconds = counts(50, 16, 3), 1_700_000_000 + np.arange(50) / 64
    for trial in range(2):
        folder = tmp_path / f"trial_{trial}"
        folder.mkdir()
        if file == "npy":
            np.save(folder / "tactile.npy", np.asarray(values, order=order))
            np.save(folder / "timestamps.npy", seconds)
        else:
            np.savez(folder / "arrays.npz", tactile=np.asarray(values, order=order), timestamps=seconds)
    text = guessed(tmp_path)
    assert text.count("match =") == 1
    (table,) = streams_of(text, tmp_path).values()
    assert table.column("t_ns").to_pylist() == [1_700_000_000 * 10**9 + row * 10**9 // 64 for row in range(50)]
    for taxel in range(16):
        for place, axis in enumerate("xyz"):
            field = table.schema.field(f"taxel{taxel + 1:02d}_{axis}")
            assert field.metadata[b"taxel"] == str(taxel + 1).encode() and field.metadata[b"axis"] == axis.encode()
            assert field.type == pa.uint16()
            assert table.column(field.name).to_pylist() == values[:, taxel, place].tolist()


def test_the_time_of_an_array_is_the_dimension_that_the_layout_names_and_a_guess_takes_the_longest(
    tmp_path: Path,
) -> None:
    values = counts(18, 3, 400)
    (tmp_path / "t1").mkdir()
    np.save(tmp_path / "t1" / "skin.npy", values)
    text = guessed(tmp_path).replace('rate_hz = "?"', "rate_hz = 100")
    assert "time_axis = 2" in text
    (table,) = streams_of(text, tmp_path).values()
    assert table.column("taxel18_z").to_pylist() == values[17, 2].tolist()
    with pytest.raises(TacpipeError, match="dimension 3"):
        streams_of(text.replace("time_axis = 2", "time_axis = 3"), tmp_path)


def test_arrays_of_two_rates_in_one_archive_are_two_streams(tmp_path: Path) -> None:
    skin, place = counts(40, 4, 3), np.random.default_rng(1).normal(size=(100, 3))
    (tmp_path / "t1").mkdir()
    np.savez(
        tmp_path / "t1" / "all.npz", tactile=skin, robot_pos=place, t=np.arange(40) / 10, robot_t=np.arange(100) / 25
    )
    result = streams_of(guessed(tmp_path, unit="m"), tmp_path)
    assert result["tactile"].column("taxel04_z").to_pylist() == skin[:, 3, 2].tolist()
    assert result["robot_pos"].column("robot_pos_y").to_pylist() == place[:, 1].tolist()
    assert result["robot_pos"].schema.field("robot_pos_y").metadata[b"component"] == b"y"
    assert result["robot_pos"].column("t_ns").to_pylist() == [row * 40_000_000 for row in range(100)]


@pytest.mark.parametrize("stamps_file", ["stamps.csv", "stamps.txt"])
def test_stamps_of_a_text_file_next_to_an_array_are_those_of_its_rows(tmp_path: Path, stamps_file: str) -> None:
    np.save(tmp_path / "a.npy", counts(5, 4, 3))
    pd.DataFrame({"clock": range(5)}).to_csv(tmp_path / stamps_file, index=False, header=stamps_file.endswith("csv"))
    text = f"""
    [streams.skin]
    files = "a.npy"
    time = {{ file = "{stamps_file}", unit = "s" }}
    columns = [{{ match = "a_*", {SHAPE} }}]
    """
    assert streams_of(text, tmp_path)["skin"].column("t_ns").to_pylist() == [row * 10**9 for row in range(5)]
    pd.DataFrame({"clock": range(4)}).to_csv(tmp_path / stamps_file, index=False, header=stamps_file.endswith("csv"))
    with pytest.raises(TacpipeError, match="4 stamps"):
        streams_of(text, tmp_path)


def test_columns_without_a_header_are_placed_in_an_array_by_one_rule(tmp_path: Path) -> None:
    values = counts(6, 4, 3)
    np.savetxt(tmp_path / "skin.csv", values.reshape(6, 12), fmt="%d", delimiter=",")
    text = f"""
    [streams.skin]
    files = "skin.csv"
    header = false
    time = {{ rate_hz = 10 }}
    columns = [{{ match = "column*", quantity = "tactile", type = "uint16", {SHAPE}, about = {{ side = "left" }} }}]
    """
    table = streams_of(text, tmp_path)["skin"]
    assert table.column("taxel03_y").to_pylist() == values[:, 2, 1].tolist()
    assert table.schema.field("taxel03_y").metadata[b"side"] == b"left"
    with pytest.raises(TacpipeError, match=r"12 columns.*\[5, 3\]"):
        streams_of(text.replace("[4, 3]", "[5, 3]"), tmp_path)
    with pytest.raises(UsageError, match="axes"):
        layout.parse_layout(text.replace("'z'", "'z', 'v', 'w'"))


def test_a_list_names_the_columns_of_a_file_without_a_header(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("0.5,3\n1.5,4\n")
    stream = labs.stream('header = ["time", "fx"]', '{ match = "fx" }', "{trial}.csv")
    assert labs.read_stream_table(tmp_path / "a.csv", stream).column("fx").to_pylist() == [3.0, 4.0]
    (tmp_path / "a.csv").write_text("0.5,3,1\n1.5,4,1\n")
    with pytest.raises(TacpipeError, match=r"3 cells.*2 columns"):
        labs.read_stream_table(tmp_path / "a.csv", stream)


@pytest.mark.parametrize("encoding", ["cp1252", "utf-16", "utf-8-sig", "utf-8"])
def test_a_guess_finds_the_encoding_and_reads_what_pandas_wrote(tmp_path: Path, encoding: str) -> None:
    frame = pd.DataFrame({"Zeit [s]": 1.7e9 + np.arange(30) / 4, "Kraft X [µN]": np.arange(30) / 8, "Weg (mm)": 0.5})
    (tmp_path / "t1").mkdir()
    frame.to_csv(tmp_path / "t1" / "messung.csv", index=False, sep=";", decimal=",", encoding=encoding)
    text = guessed(tmp_path, quantity="displacement")
    assert ("encoding" in text) == (encoding in ("cp1252", "utf-16"))
    (table,) = streams_of(text, tmp_path).values()
    assert table.column("kraft_x").to_pylist() == frame["Kraft X [µN]"].tolist()
    assert table.schema.field("kraft_x").metadata[b"unit"] == "µN".encode()
    if encoding == "cp1252":
        with pytest.raises(TacpipeError, match="encoding"):
            streams_of(text.replace('encoding = "cp1252"', ""), tmp_path)
    with pytest.raises(UsageError, match="klingon"):
        labs.stream('encoding = "klingon"')


def test_a_row_of_units_below_the_header_states_units_and_is_no_sample(tmp_path: Path) -> None:
    (tmp_path / "t1").mkdir()
    (tmp_path / "t1" / "skin.csv").write_text("# lab\ntime,fx,pad1\ns,mN,counts\n0.5,1.5,3\n0.75,2.5,4\n1.0,3.5,5\n")
    text = guessed(tmp_path)
    (table,) = streams_of(text, tmp_path).values()
    assert table.column("t_ns").to_pylist() == [500_000_000, 750_000_000, 1_000_000_000]
    assert [table.schema.field(name).metadata[b"unit"] for name in ("fx", "pad1")] == [b"mN", b"count"]


@pytest.mark.parametrize("skipped", [0, 2])
def test_a_workbook_is_read_as_openpyxl_wrote_it(tmp_path: Path, skipped: int) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    start = datetime.datetime(2026, 5, 1, 12, 0, 0, 250_000)
    book = openpyxl.Workbook()
    for _ in range(skipped):
        book.active.append(["exported by the lab", None, None])
    book.active.append(["Time", "Fx [N]", "note"])
    for row in range(20):
        book.active.append([start + datetime.timedelta(seconds=row), row / 8, "ok"])
    book.create_sheet("empty")
    (tmp_path / "t1").mkdir()
    book.save(tmp_path / "t1" / "skin.xlsx")
    text = f"""
    [streams.skin]
    files = "{{trial}}/skin.xlsx"
    skip_lines = {skipped}
    time = {{ column = "Time" }}
    columns = [{{ match = "Fx [N]", name = "fx", unit = "N" }}, {{ match = "note", skip = true }}]
    """
    for layout_text in [text, *([] if skipped else [guessed(tmp_path)])]:
        table = streams_of(layout_text, tmp_path)["skin"]
        expected = [
            int(start.replace(tzinfo=datetime.UTC).timestamp() * 4) * 250_000_000 + row * 10**9 for row in range(20)
        ]
        assert table.column("t_ns").to_pylist() == expected
        assert table.column("fx").to_pylist() == [row / 8 for row in range(20)]
    with pytest.raises(TacpipeError, match="sheet nope"):
        streams_of(text.replace("time =", 'sheet = "nope"\ntime ='), tmp_path)
    book["Sheet"].cell(5 + skipped, 2, "broken")
    book.save(tmp_path / "t1" / "skin.xlsx")
    with pytest.raises(TacpipeError, match=rf"row {5 + skipped}, column Fx \[N\] holds 'broken'"):
        streams_of(text, tmp_path)
    (tmp_path / "t1" / "skin.xlsx").write_bytes(b"no workbook")
    with pytest.raises(TacpipeError, match="not an Excel workbook"):
        streams_of(text, tmp_path)


FORMATS = (
    "%d.%m.%Y %H:%M:%S.%f",
    "%m/%d/%y %I:%M:%S,%f %p",
    "%Y%m%d_%H%M%S",
    "%d %b %Y %H:%M",
    "%B %d, %Y at %H-%M-%S",
)


@given(st.datetimes(datetime.datetime(1970, 1, 1), datetime.datetime(2060, 1, 1)), st.sampled_from(FORMATS))
def test_stamps_of_a_format_are_read_as_python_reads_them(time: datetime.datetime, text: str) -> None:
    content = time.strftime(text)
    expected = datetime.datetime.strptime(content, text).replace(tzinfo=datetime.UTC)
    expected_ns = (
        (expected - datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)) // datetime.timedelta(microseconds=1) * 1000
    )
    stamps_ns = stamps.nanoseconds(pa.array([content]), Time(format=text))
    assert stamps_ns.tolist() == [expected_ns]


@pytest.mark.parametrize(
    "wrong", ["31.02.2026 12:00:00", "01.01.2026 25:00:00", "01.13.2026 12:00:00", "yesterday", ""]
)
def test_a_text_that_is_no_time_of_the_format_is_named_by_its_row(wrong: str) -> None:
    with pytest.raises(stamps.StampError) as result:
        stamps.nanoseconds(pa.array(["01.01.2026 12:00:00", wrong]), Time(format="%d.%m.%Y %H:%M:%S"))
    assert result.value.row == 1


def test_times_of_day_go_on_past_midnight_and_have_the_day_that_the_layout_states(tmp_path: Path) -> None:
    rows = ["23:59:59.5,1", "23:59:59.75,2", "00:00:00,3", "00:00:00.25,4"]
    (tmp_path / "a.csv").write_text("\n".join(["clock,fx", *rows]))
    extra = 'time = { column = "clock", format = "%H:%M:%S.%f", start = "1970-01-02", zone = "Europe/Berlin" }'
    table = labs.read_stream_table(tmp_path / "a.csv", labs.stream(extra, '{ match = "fx" }', "{trial}.csv"))
    midnight_ns = (2 * 86_400 - 3600) * 10**9  # midnight of the third of January in Berlin
    assert table.column("t_ns").to_pylist() == [midnight_ns + part * 250_000_000 for part in (-2, -1, 0, 1)]


def test_a_guess_finds_the_format_of_stamps_that_are_text(tmp_path: Path) -> None:
    (tmp_path / "t1").mkdir()
    start = datetime.datetime(2026, 5, 13, 12)
    for text in ("%d.%m.%Y %H:%M:%S.%f", "%H:%M:%S.%f", "%m/%d/%Y %H:%M:%S.%f"):
        times = [(start + datetime.timedelta(seconds=row / 8)).strftime(text) for row in range(20)]
        pd.DataFrame({"Time": times, "pad1": range(20)}).to_csv(tmp_path / "t1" / "skin.csv", index=False)
        assert f'format = "{text}"' in guess.guess_layout(tmp_path)
        (table,) = streams_of(guessed(tmp_path), tmp_path).values()
        assert set(np.diff(table.column("t_ns").to_numpy())) == {125_000_000}


@pytest.mark.parametrize("text", ["%d.%m.%Y", "%H:%M:%Q", "noon"])
def test_a_format_without_an_hour_or_with_an_unknown_directive_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="format"):
        stamps.check_format(text, "here")
