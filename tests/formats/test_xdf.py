"""Test that handmade XDF files are read according to the specification, up to damage."""

import gzip
import json
import logging
import mmap
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import pyxdf

from tacpipe.errors import TacpipeError
from tacpipe.formats import xdf_streams
from tacpipe.formats.table.contained import LayoutCommand, Params
from tacpipe.plugins import registry
from tacpipe.plugins.stage import RecordingOutput
from tests.formats.xdf_writer import Writer

XDF = LayoutCommand("xdf")
xdf = registry.load("ingest.xdf")
RNG = np.random.default_rng(8)
SAMPLE_DATA = os.environ.get("TACPIPE_SAMPLE_DATA")


@pytest.fixture(autouse=True)
def _quiet() -> None:
    logging.getLogger("pyxdf").setLevel(logging.CRITICAL)


def read(path: Path, layout: str = "") -> RecordingOutput:
    params = Params(json.dumps(tomllib.loads(layout)) if layout else "")
    (source,) = XDF.discover(params, path.parent).values()
    recording: RecordingOutput = xdf(params, source.files, source.values)
    return recording


def theirs(path: Path, **options: Any) -> dict[str, Mapping[str, Any]]:
    """Return what pyxdf reads, by the name of the stream."""
    options = {"synchronize_clocks": False, "dejitter_timestamps": False, **options}
    streams, _ = pyxdf.load_xdf(str(path), **options)
    return {stream["info"]["name"][0]: stream for stream in streams}


def stamps(table: pa.Table, name: str = "t_ns") -> Any:
    return table.column(name).to_numpy()


def force(
    path: Path, drift: float = 0.0, set_by_s: float = 0.0, rows: int = 6000, noise_s: float = 0.0, later: int = 0
) -> Any:
    """Write a stream of 100 Hz whose clock drifts, and is set ``later`` rows than halfway; return the true times in s."""
    true_s = 1000.0 + np.arange(rows) / 100
    sent_s = 50_000.0 + (true_s - 1000.0) / (1 + drift)
    reset = rows // 2 + later
    sent_s[reset:] += set_by_s
    writer = Writer()
    writer.stream(1, "force", "float32", 3, labels=[("Fx", "N", ""), ("Fy", "newtons", ""), ("Fz", "N", "")])
    for start in range(0, rows, 50):
        if start % 500 == 0:
            offset = true_s[start] - sent_s[start] + RNG.normal(0, noise_s)
            writer.offset(1, sent_s[start], offset)
        part = slice(start, start + 50)
        writer.numbers(1, "float32", sent_s[part].tolist(), np.outer(np.arange(rows)[part], [1, 2, 3]))
    writer.footer(1, rows)
    writer.write(path)
    return true_s


def test_channels_have_the_names_units_and_values_that_the_file_states(tmp_path: Path) -> None:
    force(tmp_path / "run.xdf", rows=1000)
    result = read(tmp_path / "run.xdf")
    table = result.streams["force"]
    assert table.column_names == ["t_ns", "t_device_ns", "fx", "fy", "fz"]
    assert table.schema.field("fy").metadata == {b"quantity": b"force", b"unit": b"N", b"component": b"y"}
    assert table.schema.field("fz").type == pa.float32()
    assert table.column("fz").to_pylist() == [3.0 * row for row in range(1000)]
    assert result.attributes["recorded_at"] == "2026-05-04T10:00:00+0200"


@pytest.mark.parametrize("kind", ["float32", "double64", "int8", "int16", "int32", "int64"])
def test_stamps_and_values_are_those_that_pyxdf_reads_to_the_bit(tmp_path: Path, kind: str) -> None:
    writer = Writer()
    writer.stream(7, "a", kind, 2, rate_hz=250.0)
    writer.numbers(7, kind, [10.0, None, None, None], [[1, -2], [3, 4], [5, 6], [100, -100]])
    writer.boundary()
    writer.numbers(7, kind, [None, 11.123456789, None], [[1, 1], [2, 2], [3, 3]])
    writer.numbers(7, kind, [12.0, 12.5], [[4, 4], [5, 5]])
    writer.numbers(7, kind, [None, None], [[6, 6], [7, 7]])
    path = writer.write(tmp_path / "a.xdf")
    table, second = read(path).streams["a"], theirs(path)["a"]
    assert np.array_equal(stamps(table, "t_device_ns"), np.rint(second["time_stamps"] * 1e9))
    assert np.array_equal(
        np.column_stack([table.column(name) for name in ("value01", "value02")]), second["time_series"]
    )
    assert table.schema.field("value01").type == pa.from_numpy_dtype(second["time_series"].dtype)


@pytest.mark.parametrize("drift", [0.0, 80e-6, -300e-6])
def test_stamps_on_the_recorders_clock_are_true_and_near_those_of_pyxdf(tmp_path: Path, drift: float) -> None:
    true_s = force(tmp_path / "run.xdf", drift, rows=30_000, noise_s=100e-6)
    result = read(tmp_path / "run.xdf")
    second = theirs(tmp_path / "run.xdf", synchronize_clocks=True)["force"]["time_stamps"]
    t_s = stamps(result.streams["force"]) / 1e9
    assert np.abs(t_s - true_s).max() < 150e-6
    assert np.abs(t_s - second).max() < 150e-6
    assert result.attributes["force_lsl_drift_ppm"] == pytest.approx(drift * 1e6, abs=2)
    assert result.attributes["force_lsl_clock_resets"] == 0


@pytest.mark.parametrize("later", [0, 1, 237, 499])
@pytest.mark.parametrize("set_by_s", [-49_000.0, -60.0, 500.0])
def test_after_a_reset_of_the_senders_clock_stamps_are_true_as_those_of_pyxdf_are(
    tmp_path: Path, set_by_s: float, later: int
) -> None:
    true_s = force(tmp_path / "run.xdf", 50e-6, set_by_s, rows=20_000, noise_s=50e-6, later=later)
    result = read(tmp_path / "run.xdf")
    second = theirs(tmp_path / "run.xdf", synchronize_clocks=True)["force"]["time_stamps"]
    t_s = stamps(result.streams["force"]) / 1e9
    assert np.abs(t_s - true_s).max() < 300e-6
    if abs(set_by_s) > 100:  # pyxdf confuses two clocks that show the same times
        assert np.abs(t_s - second).max() < 300e-6
    assert result.attributes["force_lsl_clock_resets"] == 1
    raw = theirs(tmp_path / "run.xdf")["force"]["time_stamps"]
    assert np.abs(stamps(result.streams["force"], "t_device_ns") - raw * 1e9).max() <= 1


def test_labels_of_tactile_channels_state_taxel_and_axis(tmp_path: Path) -> None:
    writer = Writer()
    labels = [(f"pad {taxel}.{axis}", "counts", "") for taxel in (1, 12) for axis in "xz"]
    writer.stream(1, "skin", "int16", 4, labels=labels, type_="Tactile")
    writer.numbers(1, "int16", [1.0], [[1, 2, 3, 4]])
    field = read(writer.write(tmp_path / "a.xdf")).streams["skin"].schema.field("pad_12_z")
    assert field.metadata == {b"unit": b"count", b"quantity": b"tactile", b"taxel": b"12", b"axis": b"z"}


def test_clock_offsets_are_a_stream_as_they_were_measured(tmp_path: Path) -> None:
    force(tmp_path / "run.xdf", 50e-6, noise_s=1e-3)
    table = read(tmp_path / "run.xdf").streams["force_clock_offsets"]
    second = theirs(tmp_path / "run.xdf")["force"]
    assert table.column("offset_s").to_pylist() == second["clock_values"]
    assert np.allclose(stamps(table, "t_device_ns") / 1e9, second["clock_times"], atol=1e-9)


def test_markers_are_events_as_text(tmp_path: Path) -> None:
    writer = Writer()
    writer.stream(3, "Trial markers", "string", rate_hz=0, type_="Markers")
    writer.texts(3, [5.0, 6.25], ["grasp ✓", ""])
    writer.texts(3, [7.0], ["x" * 300])
    table = read(writer.write(tmp_path / "a.xdf")).streams["Trial_markers"]
    assert table.column("event").to_pylist() == ["grasp ✓", "", "x" * 300]
    assert table.schema.field("event").metadata[b"quantity"] == b"text"
    assert stamps(table).tolist() == [5 * 10**9, 6_250_000_000, 7 * 10**9]


def test_streams_of_one_name_and_channels_without_labels_are_told_apart_by_number(tmp_path: Path) -> None:
    writer = Writer()
    for number in (4, 9):
        writer.stream(number, "skin", "int16", 3, type_="Tactile")
        writer.numbers(number, "int16", [1.0, 2.0], np.full((2, 3), number))
    streams = read(writer.write(tmp_path / "a.xdf")).streams
    assert sorted(streams) == ["skin_4", "skin_9"]
    assert streams["skin_9"].column("value03").to_pylist() == [9, 9]
    assert streams["skin_9"].schema.field("value01").metadata[b"quantity"] == b"tactile"


def test_a_stream_without_samples_is_named_and_a_file_of_such_alone_refused(tmp_path: Path) -> None:
    writer = Writer()
    writer.stream(1, "silent")
    writer.footer(1, 0)
    path = writer.write(tmp_path / "a.xdf")
    with pytest.raises(TacpipeError, match="silent"):
        read(path)
    writer.stream(2, "loud")
    writer.numbers(2, "float32", [1.0], np.ones((1, 1)))
    result = read(writer.write(path))
    assert list(result.streams) == ["loud"]
    assert "silent" in str(result.attributes["skipped"])


def test_a_file_that_was_cut_off_gives_what_stands_before_wherever_it_is_cut(tmp_path: Path) -> None:
    writer = Writer()
    writer.stream(1, "a", "int16", 2)
    writer.stream(2, "m", "string", rate_hz=0)
    for start in range(0, 40, 8):
        rows = np.arange(start, start + 8)
        writer.numbers(1, "int16", (100 + rows / 100).tolist(), np.column_stack([rows, -rows]))
        writer.texts(2, [100 + start / 100], [f"m{start}"])
        writer.offset(1, 100 + start / 100, 0.0)
        writer.boundary()
    full = writer.bytes
    first = full.index(writer.parts[3]) + 24
    path = tmp_path / "a.xdf"
    observed = set()
    for stop in range(first, len(full), 5):
        path.write_bytes(full[:stop])
        result = read(path)
        values = result.streams["a"].column("value01").to_pylist()
        assert values == list(range(len(values)))
        assert stop == len(full) or result.notes or full[:stop].endswith(tuple(writer.parts))
        observed.add(len(values))
    assert observed == set(range(1, 41))


def test_bytes_that_are_wrong_cost_what_stands_up_to_the_next_boundary(tmp_path: Path) -> None:
    writer = Writer()
    writer.stream(1, "a", "int32", 1)
    for start in range(0, 30, 10):
        writer.numbers(1, "int32", (start + np.arange(10)).tolist(), np.arange(start, start + 10)[:, None])
        writer.boundary()
    broken = bytearray(writer.bytes)
    place = writer.bytes.index(writer.parts[4])
    broken[place] = 77  # the length of the second chunk of samples
    path = tmp_path / "a.xdf"
    path.write_bytes(broken)
    result = read(path)
    assert result.streams["a"].column("value").to_pylist() == [*range(10), *range(20, 30)]
    assert any(f"{place:,}" in note for note in result.notes)


def test_samples_that_the_footer_counts_and_the_file_lacks_are_named(tmp_path: Path) -> None:
    writer = Writer()
    writer.stream(1, "a", "int32", 1)
    writer.numbers(1, "int32", [1.0], np.ones((1, 1)))
    writer.footer(1, 12)
    assert any("12" in note for note in read(writer.write(tmp_path / "a.xdf")).notes)


def test_a_clock_that_goes_back_without_a_measurement_is_not_read_as_if_it_had_not(tmp_path: Path) -> None:
    writer = Writer()
    writer.stream(1, "a", "int32", 1)
    writer.stream(2, "b", "int32", 1)
    writer.numbers(1, "int32", [500.0, 500.01, 3.0, 3.01, 3.02], np.ones((5, 1)))
    writer.numbers(2, "int32", [1.0, 1.02, 1.01, 1.03], np.ones((4, 1)))
    result = read(writer.write(tmp_path / "a.xdf"))
    assert list(result.streams) == ["b"]
    assert "sample 3" in str(result.attributes["skipped"])
    assert stamps(result.streams["b"]).tolist() == [10**9, 1_020_000_000, 1_020_000_000, 1_030_000_000]
    assert stamps(result.streams["b"], "t_device_ns").tolist() == [10**9, 1_020_000_000, 1_010_000_000, 1_030_000_000]


@pytest.mark.parametrize("name", ["a.xdfz", "a.xdf.gz"])
def test_a_compressed_file_reads_the_same(tmp_path: Path, name: str) -> None:
    force(tmp_path / "plain.xdf", rows=200)
    plain = read(tmp_path / "plain.xdf").streams["force"]
    content = (tmp_path / "plain.xdf").read_bytes()
    (tmp_path / "packed").mkdir()
    (tmp_path / "packed" / name).write_bytes(gzip.compress(content))
    assert read(tmp_path / "packed" / name).streams["force"].equals(plain)
    (tmp_path / "packed" / name).write_bytes(gzip.compress(content)[:-200])
    assert 0 < read(tmp_path / "packed" / name).streams["force"].num_rows <= 200


@pytest.mark.parametrize("content", [b"", b"XD", b"not an XDF file", b"XDF:", b"XDF:\x01\x02\x01\x00"])
def test_what_is_no_xdf_is_refused_by_name(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.xdf").write_bytes(content)
    with pytest.raises(TacpipeError, match=r"a\.xdf"):
        read(tmp_path / "a.xdf")


def test_a_description_that_cannot_be_read_costs_its_stream_alone(tmp_path: Path) -> None:
    writer = Writer()
    writer.stream(1, "odd", "uint128")
    writer.numbers(1, "int32", [1.0], np.ones((1, 1)))
    writer.stream(2, "a", "int32")
    writer.numbers(2, "int32", [1.0], np.ones((1, 1)))
    result = read(writer.write(tmp_path / "a.xdf"))
    assert list(result.streams) == ["a"]
    assert "uint128" in str(result.attributes["skipped"])


def test_a_layout_replaces_what_the_file_states_wrongly(tmp_path: Path) -> None:
    force(tmp_path / "run.xdf", rows=100)
    layout = '[streams.wrist]\nsource = "force"\ncolumns = [{ match = "f{axis}", unit = "mN" }]'
    (table,) = read(tmp_path / "run.xdf", layout).streams.values()
    assert table.schema.field("fx").metadata[b"unit"] == b"mN"


@pytest.mark.data
@pytest.mark.skipif(SAMPLE_DATA is None, reason="TACPIPE_SAMPLE_DATA is not set")
def test_a_published_file_reads_as_pyxdf_does() -> None:
    path = Path(str(SAMPLE_DATA)) / "foreign" / "xdf" / "minimal.xdf"
    result, second = read(path), theirs(path)
    synced = theirs(path, synchronize_clocks=True)
    for name, entry in second.items():
        table = result.streams[name]
        assert np.array_equal(stamps(table, "t_device_ns"), np.rint(entry["time_stamps"] * 1e9))
        assert np.allclose(stamps(table) / 1e9, synced[name]["time_stamps"], atol=1e-8)
        channels = [table.column(column).to_pylist() for column in table.column_names[2:]]
        assert np.column_stack(channels).tolist() == np.asarray(entry["time_series"]).tolist()


def test_samples_that_were_put_aside_are_those_that_were_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    force(tmp_path / "run.xdf", rows=1000)
    expected = read(tmp_path / "run.xdf").streams["force"]
    monkeypatch.setattr(xdf_streams, "SPILL_ROWS", 64)
    monkeypatch.setattr(xdf_streams, "RELEASE_BYTES", mmap.PAGESIZE)
    streams = read(tmp_path / "run.xdf").streams["force"]
    assert isinstance(streams, pa.RecordBatchReader)
    assert streams.read_all().equals(expected, check_metadata=True)


TRUE_S = 5000 + np.arange(1000) / 100


def skin(stamps_s: Any, with_offsets: bool = True) -> Writer:
    """Return a file of one stream with these stamps; its clock is that of the recorder."""
    writer = Writer()
    writer.stream(1, "Skin", "int32")
    writer.numbers(1, "int32", stamps_s.tolist(), np.arange(len(stamps_s))[:, None])
    for reading in TRUE_S[::400] if with_offsets else ():
        writer.offset(1, reading, 0.0)
    return writer


@pytest.mark.parametrize("with_offsets", [True, False])
@pytest.mark.parametrize(
    "jumps",
    [
        [(400, 700, 2e5)],
        [(400, 700, -2e5)],
        [(100, 900, 2e5)],
        [(500, 501, 2e5)],
        [(500, 501, 0.5)],
        [(999, 1000, 2e5)],
        [(0, 1, 2e5)],
        [(200, 300, 2e5), (600, 700, -1e3)],
        [(300, 600, 2e5), (400, 500, 1e5)],
        [(300, 500, 100), (500, 700, -100)],
        [(400, 700, 0.5)],
    ],
)
def test_a_clock_that_jumps_and_comes_back_changes_no_other_time(
    tmp_path: Path, jumps: list[tuple[int, int, float]], with_offsets: bool
) -> None:
    stamps_s = TRUE_S.copy()
    for start, stop, jump_s in jumps:
        stamps_s[start:stop] += jump_s
    count = np.count_nonzero(stamps_s != TRUE_S)
    result = read(skin(stamps_s, with_offsets).write(tmp_path / "a.xdf"))
    table = result.streams["Skin"]
    assert np.abs(stamps(table) / 1e9 - TRUE_S).max() < 1e-6
    assert np.abs(stamps(table, "t_device_ns") / 1e9 - stamps_s).max() < 1e-6
    assert f"has {count:,} stamps that jump" in " ".join(result.notes)


def test_pauses_and_samples_out_of_order_are_no_jumps(tmp_path: Path) -> None:
    stamps_s = TRUE_S + 30 * (np.arange(1000) > 300) + 0.3 * (np.arange(1000) > 305)
    stamps_s[[600, 601]] = stamps_s[[601, 600]]
    result = read(skin(stamps_s).write(tmp_path / "a.xdf"))
    assert np.abs(stamps(result.streams["Skin"]) / 1e9 - np.maximum.accumulate(stamps_s)).max() < 1e-6
    assert "jump" not in " ".join(result.notes)


def parts(path: Path, spans: list[tuple[int, int, int, str]], value: int | None = None) -> RecordingOutput:
    """Write streams named Skin with these first and last samples, channels and computers; return what is read."""
    writer = Writer()
    for number, (start, stop, channels, host) in enumerate(spans, 1):
        writer.stream(number, "Skin", "int32", channels, host=host)
        writer.offset(number, TRUE_S[start], 0.0)
        values = np.full((stop - start, channels), number if value is None else value)
        writer.numbers(number, "int32", TRUE_S[start:stop].tolist(), values)
    return read(writer.write(path))


def test_the_streams_of_an_outlet_that_restarted_are_one_with_gaps(tmp_path: Path) -> None:
    spans = [(600, 700, 2, "pc"), (0, 200, 2, "pc"), (300, 500, 2, "pc")]
    result = parts(tmp_path / "a.xdf", spans)
    assert set(result.streams) == {"Skin", "Skin_clock_offsets"}
    ordered = sorted(spans)
    expected = np.concatenate([TRUE_S[start:stop] for start, stop, _, _ in ordered])
    assert np.abs(stamps(result.streams["Skin"]) / 1e9 - expected).max() < 1e-6
    numbers = [number for number, count in ((2, 200), (3, 200), (1, 100)) for _ in range(count)]
    assert result.streams["Skin"].column("value01").to_pylist() == numbers
    assert result.streams["Skin_clock_offsets"].num_rows == 3
    assert any("1.010 s, 1.010 s" in note for note in result.notes)


@pytest.mark.parametrize(
    ("second", "part"),
    [
        ((350, 900, 2, "pc"), "0.490 s before"),
        ((600, 900, 3, "pc"), "2.010 s after"),
        ((600, 900, 2, "laptop"), "2.010 s after"),
    ],
)
def test_streams_of_one_name_that_are_not_one_outlet_stay_apart_with_a_note(
    tmp_path: Path, second: tuple[int, int, int, str], part: str
) -> None:
    result = parts(tmp_path / "a.xdf", [(0, 400, 2, "pc"), second])
    assert [result.streams[name].num_rows for name in ("Skin_1", "Skin_2")] == [400, second[1] - second[0]]
    assert any(part in note and "--without" in note for note in result.notes)


def test_a_stream_that_was_recorded_twice_is_noted_and_two_sensors_are_not(tmp_path: Path) -> None:
    twice = parts(tmp_path / "a.xdf", [(0, 900, 2, "pc")] * 2, value=7)
    assert any("recorded twice" in note for note in twice.notes)
    assert not parts(tmp_path / "a.xdf", [(0, 900, 2, "pc")] * 2).notes


def test_a_restarted_outlet_of_many_samples_is_read_as_of_few(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spans = [(0, 200, 2, "pc"), (300, 500, 2, "pc")]
    expected = parts(tmp_path / "a.xdf", spans).streams["Skin"]
    monkeypatch.setattr(xdf_streams, "SPILL_ROWS", 64)
    streams = parts(tmp_path / "a.xdf", spans).streams["Skin"]
    assert isinstance(streams, pa.RecordBatchReader)
    assert streams.read_all().equals(expected, check_metadata=True)
