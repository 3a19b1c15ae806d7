"""Test the results and the errors of the strict CSV reader."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tacpipe.errors import TacpipeError
from tacpipe.formats.csv_table import place, read_csv, read_record


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "table.csv"


def test_columns_come_in_the_order_asked_for_and_others_are_left_out(file: Path) -> None:
    file.write_text(" a,b,c \r\n1,2.5,3e2\r\n-4, 5 ,.6\r\n")
    assert read_csv(file, ["c", "a"]).to_pydict() == {"c": [300.0, 0.6], "a": [1.0, -4.0]}


def test_whole_numbers_written_as_floats_become_integers(file: Path) -> None:
    file.write_text("a\n0.0\n65535.0\n")
    table = read_csv(file, ["a"], integers=pa.uint16())
    assert table.schema.field("a").type == pa.uint16()
    assert table.column("a").to_pylist() == [0, 65535]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(hnp.arrays(np.float64, st.tuples(st.integers(1, 9), st.just(3)), elements=st.floats(allow_infinity=False)))
def test_what_python_writes_is_read_to_the_last_bit(file: Path, values: np.ndarray) -> None:
    file.write_text("a,b,c\n" + "".join(",".join(map(repr, row)) + "\n" for row in values.tolist()))
    table = read_csv(file, ["a", "b", "c"], allow_nan=True)
    np.testing.assert_array_equal(np.column_stack([column.to_numpy() for column in table.columns]), values)


@pytest.mark.parametrize("header", ["a,b", "a,b,", " a,b"])
def test_rows_that_end_in_a_comma_do_not_shift_columns(file: Path, header: str) -> None:
    file.write_text(f"{header}\n1,2,\n3,4,\n")
    assert read_csv(file, ["a", "b"], trailing_comma=True).to_pydict() == {"a": [1.0, 3.0], "b": [2.0, 4.0]}


def test_a_byte_order_mark_is_no_part_of_a_name(file: Path) -> None:
    file.write_text("a,b\n1,2\n", encoding="utf-8-sig")
    assert read_csv(file, ["a"]).to_pydict() == {"a": [1.0]}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is empty"),
        ("\n\n", "is empty"),
        ("a,b\n", "has a header and no rows"),
        ("a,c\n1,2\n", "lacks the column b; its header begins with a, c"),
        ("a,a,b\n1,2,3\n", "more than one column a"),
        ("a,b\n1,2\n3\n", "line 3 has 1 cells instead of 2; it was cut short"),
        ("a,b\n1,2\n\n3,", "line 4, column b holds '', which is not a number"),
        ("a,b\n1,2\n3,4,5\n", "line 3 has 3 cells instead of 2; a cell or a separator is too much"),
        ("a,b\n1,2,\n3,4,\n", "line 2 has 3 cells instead of 2"),
        ("a,b\n1,2\nx,4\n", "line 3, column a holds 'x', which is not a number"),
        ("a,b\n1,2\n1_0,4\n", "line 3, column a holds '1_0'"),
        ("a,b\n1,NA\n", "line 2, column b holds 'NA'"),
        ("a,b\n\n1,2\n\n1,-nan\n", "line 5, column b holds nan; it must be a finite number"),
        ("a,b\n1,inf\n", "line 2, column b holds inf"),
        ("a,b\n1,1e400\n", "line 2, column b holds inf"),
    ],
)
def test_a_fault_is_named_with_file_and_row(file: Path, content: str, message: str) -> None:
    file.write_text(content)
    with pytest.raises(TacpipeError) as caught:
        read_csv(file, ["a", "b"])
    assert str(file) in str(caught.value)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("a,b\n1,2,\n3,4\n", "line 3 has 2 cells instead of 3; it was cut short"),
        ("a,b\n1,2,\n3,4,5\n", "line 3 ends in '5' and other rows in a comma"),
        ("a,b\n1,2,5\n3,4,\n", "line 2 ends in '5' and other rows in a comma"),
        ("a,b\n1,2,\n3\n", "line 3 has 1 cells instead of 3; it was cut short"),
    ],
)
def test_a_row_unlike_those_that_end_in_a_comma_is_named(file: Path, content: str, message: str) -> None:
    file.write_text(content)
    with pytest.raises(TacpipeError, match=message):
        read_csv(file, ["a", "b"], trailing_comma=True)


@pytest.mark.parametrize("cell", ["0.5", "-1", "65536", "nan"])
def test_what_is_no_unsigned_16_bit_number_is_named(file: Path, cell: str) -> None:
    file.write_text(f"a\n1\n{cell}\n")
    with pytest.raises(TacpipeError, match=rf"line 3, column a .*{cell}"):
        read_csv(file, ["a"], integers=pa.uint16())


def test_nan_is_let_through_where_it_is_allowed_and_infinity_is_not(file: Path) -> None:
    file.write_text("a\nnan\n-nan\n")
    assert np.isnan(read_csv(file, ["a"], allow_nan=True).column("a").to_numpy()).all()
    file.write_text("a\nnan\n-inf\n")
    with pytest.raises(TacpipeError, match=r"line 3, column a .*-inf"):
        read_csv(file, ["a"], allow_nan=True)


def test_bytes_that_are_no_text_and_a_file_that_is_not_there_are_named(file: Path) -> None:
    with pytest.raises(TacpipeError, match="cannot be read"):
        read_csv(file, ["a"])
    file.write_bytes(b"a\n\xff\xfe\n")
    with pytest.raises(TacpipeError, match="line 2, column a"):
        read_csv(file, ["a"])


def test_a_row_is_counted_as_an_editor_counts(file: Path) -> None:
    file.write_text("a\n1\n\n2\n")
    assert [place(file, index) for index in (0, 1)] == ["line 2", "line 4"]


def test_a_record_is_its_cells_by_name(file: Path) -> None:
    file.write_text("a,b\n\n 1 ,x y,,\n\n")
    assert read_record(file) == {"a": "1", "b": "x y"}


def test_commas_in_notes_are_put_together_again(file: Path) -> None:
    file.write_text("dropped,notes,rate\n1,slipped, then fell,60\n")
    assert read_record(file) == {"dropped": "1", "notes": "slipped, then fell", "rate": "60"}


@pytest.mark.parametrize(
    ("content", "message"),
    [("a\n", "has 0 rows"), ("a\n1\n2\n", "has 2 rows"), ("a,b\n1,2,3\n", "line 2 has 3 cells under a header of 2")],
)
def test_a_record_of_another_shape_is_refused(file: Path, content: str, message: str) -> None:
    file.write_text(content)
    with pytest.raises(TacpipeError, match=message):
        read_record(file)


@given(st.lists(st.integers(0, 9_223_372_036 * 10**9), min_size=1, max_size=9))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_unix_seconds_are_read_to_the_last_nanosecond(file: Path, stamps: list[int]) -> None:
    rows = [f"{stamp // 10**9}.{stamp % 10**9:09d},7" for stamp in stamps]
    file.write_text("time,a\n" + "\n".join(rows) + "\n")
    table = read_csv(file, ["a"], seconds="time")
    assert table.column_names == ["t_ns", "a"]
    assert table.column("t_ns").to_pylist() == stamps


def test_seconds_may_have_fewer_decimals_and_stand_in_any_column(file: Path) -> None:
    file.write_text("a,time\n7,12\n8,12.5\n")
    assert read_csv(file, ["a"], seconds="time").to_pydict() == {"t_ns": [12 * 10**9, 12_500_000_000], "a": [7.0, 8.0]}


@pytest.mark.parametrize("cell", ["12.0123456789", "-12.5", "nan", "9999999999", "99999999999"])
def test_what_is_no_unix_time_is_told_with_its_row(file: Path, cell: str) -> None:
    file.write_text(f"time,a\n11.0,1\n\n{cell},2\n")
    with pytest.raises(TacpipeError, match=r"line 4, column time"):
        read_csv(file, ["a"], seconds="time")
