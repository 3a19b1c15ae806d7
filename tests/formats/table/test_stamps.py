import datetime
from decimal import ROUND_HALF_EVEN, Decimal
from fractions import Fraction
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tacpipe.errors import TacpipeError
from tacpipe.formats.container import Time, TimeUnit
from tacpipe.formats.table import stamps
from tacpipe.formats.table.layout import ColumnRule, StreamLayout
from tests.formats.table import labs

YEAR_2262_NS = 2**63 - 1


@given(st.integers(0, YEAR_2262_NS), st.sampled_from(["s", "ms", "us", "ns"]))
def test_text_of_any_unit_is_read_to_the_nanosecond(t_ns: int, unit: TimeUnit) -> None:
    text = format(Decimal(t_ns).scaleb(-stamps.DIGITS[unit]), "f")
    column = pa.array([text]).cast(stamps.DECIMAL)
    assert stamps.nanoseconds(column, Time(unit=unit)).tolist() == [t_ns]


def test_more_decimals_than_nanoseconds_are_rounded() -> None:
    column = pa.array(["1.0000000004999", "1.0000000005001"]).cast(stamps.DECIMAL)
    assert stamps.nanoseconds(column, Time()).tolist() == [1_000_000_000, 1_000_000_001]


@given(
    st.integers(-(10**10) + 1, 10**10 - 1),
    st.integers(0, 10**9 - 1),
    st.sampled_from([0, 1, 499_999_999, 500_000_000, 500_000_001, 999_999_999]) | st.integers(0, 10**9 - 1),
)
def test_seconds_of_eighteen_decimals_are_rounded_half_to_even(seconds: int, ns: int, beyond: int) -> None:
    text = f"{seconds}.{ns:09d}{beyond:09d}"
    expected = int((Decimal(text) * 10**9).quantize(Decimal(1), ROUND_HALF_EVEN))
    column = pa.array(["0", text, "1.5"]).cast(stamps.DECIMAL).slice(1, 1)
    if abs(expected) <= YEAR_2262_NS:
        assert stamps.nanoseconds(column, Time()).tolist() == [expected]
    else:
        with pytest.raises(stamps.StampError):
            stamps.nanoseconds(column, Time())


@given(st.integers(0, 2**33), st.integers(0, 2**20 - 1))
def test_float_seconds_are_read_as_near_as_the_float_is(seconds: int, part: int) -> None:
    value = seconds + part / 2**20  # exact in float64
    (result,) = stamps.nanoseconds(pa.array([value]), Time()).tolist()
    assert abs(result - Decimal(value).scaleb(9)) <= Decimal("0.5")


@pytest.mark.parametrize(
    ("text", "zone", "hours"),
    [
        ("2024-07-01T12:00:00Z", "UTC", 12),
        ("2024-07-01 12:00:00", "UTC", 12),
        ("2024-07-01 12:00:00", "Europe/Berlin", 10),
        ("2024-07-01T12:00:00+05:30", "UTC", 6.5),
    ],
)
def test_iso_stamps_are_read_in_their_zone(text: str, zone: str, hours: float) -> None:
    day = datetime.datetime(2024, 7, 1, tzinfo=datetime.UTC).timestamp()
    expected = int((day + hours * 3600) * 10**9)
    assert stamps.nanoseconds(pa.array([text]), Time(unit="iso8601", zone=zone)).tolist() == [expected]


def test_the_comma_of_pythons_logging_is_a_decimal_one() -> None:
    stamps_ns = stamps.nanoseconds(pa.array(["1970-01-01 00:00:01,250"]), Time(unit="iso8601"))
    assert stamps_ns.tolist() == [1_250_000_000]


@pytest.mark.parametrize(
    ("column", "unit", "row"),
    [
        (pa.array(["1", None]).cast(stamps.DECIMAL), "s", 1),
        (pa.array(["1", "9999999999999"]).cast(stamps.DECIMAL), "s", 1),
        (pa.array([1.0, 2.0, np.nan]), "s", 2),
        (pa.array([2**62]), "s", 0),
        (pa.array(["2024-01-01T00:00:00Z", "2024-01-01T00:00:00"]), "iso8601", 1),
        (pa.array(["2024-01-01", "yesterday"]), "iso8601", 1),
    ],
)
def test_a_stamp_that_is_none_is_named_by_its_row(column: pa.Array, unit: TimeUnit, row: int) -> None:
    with pytest.raises(stamps.StampError) as result:
        stamps.nanoseconds(column, Time(unit=unit))
    assert result.value.row == row


@pytest.mark.parametrize(("text", "unit"), [("1744849152016", "ms"), ("1744849152016136.5", "us"), ("1e25", None)])
def test_a_unix_time_in_a_smaller_unit_is_told_with_that_unit(tmp_path: Path, text: str, unit: TimeUnit | None) -> None:
    path = tmp_path / "skin.csv"
    path.write_text(f"time,a\n{text},2\n")
    stream = StreamLayout("skin", time=Time(column="time", unit="s"), columns=(ColumnRule(match="a"),))
    with pytest.raises(TacpipeError) as raised:
        labs.read_stream_table(path, stream)
    assert (f'write unit = "{unit}"' in str(raised.value)) == (unit is not None)
    assert unit is None or f"holds '{text}';" in str(raised.value)


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
@pytest.mark.parametrize("text", ["1e25", "-1e25"])
def test_a_stamp_beyond_every_range_is_refused_and_names_its_row(tmp_path: Path, text: str, unit: TimeUnit) -> None:
    path = tmp_path / "skin.csv"
    path.write_text(f"time,a\n0,1\n{text},2\n")
    stream = StreamLayout("skin", time=Time(column="time", unit=unit), columns=(ColumnRule(match="a"),))
    with pytest.raises(TacpipeError, match=r"line 3, column time holds .*2262"):
        labs.read_stream_table(path, stream)


@given(
    digits=st.from_regex(r"[-+]?[1-9]\d{0,29}(\.\d{1,9})?", fullmatch=True),
    exponent=st.integers(-60, 400),
    unit=st.sampled_from(["s", "ms", "us", "ns"]),
)
@example(digits="10000000000000000000000", exponent=0, unit="ns")  # 22 zeros wrap without an exponent
@example(digits="15", exponent=24, unit="s")
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_number_with_any_exponent_is_its_exact_time_or_refused(
    tmp_path: Path, digits: str, exponent: int, unit: TimeUnit
) -> None:
    text = f"{digits}e{exponent}" if exponent else digits
    path = tmp_path / "skin.csv"
    path.write_text(f"time,a\n{text},2\n")
    stream = StreamLayout("skin", time=Time(column="time", unit=unit), columns=(ColumnRule(match="a"),))
    exact = Fraction(text) * 10 ** stamps.DIGITS[unit]
    try:
        t_ns = labs.read_stream_table(path, stream)["t_ns"].to_pylist()
    except TacpipeError as error:
        assert "line 2, column time" in str(error)
        return
    assert t_ns == [round(exact)]


@pytest.mark.parametrize("cell", ["90363683947689815409865596", "995747533096360050131451e3"])
def test_a_number_that_128_bits_hold_as_a_stamp_of_today_is_refused(tmp_path: Path, cell: str) -> None:
    assert int(Decimal(cell)) * 10**18 % 2**128 // 10**18 == 1_744_849_152
    path = tmp_path / "skin.csv"
    path.write_text(f"time,a\n0,1\n{cell},2\n")
    stream = StreamLayout("skin", time=Time(column="time"), columns=(ColumnRule(match="a"),))
    with pytest.raises(TacpipeError, match=r"line 3, column time holds .*2262"):
        labs.read_stream_table(path, stream)
