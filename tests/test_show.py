"""`tacpipe show` and `tacpipe explain` summarize what has many files, and `store link` removes leftovers of it."""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest

import tacpipe
from tacpipe.channels import streams
from tacpipe.cli import show, show_recording
from tacpipe.io.columns import Columns
from tacpipe.io.parquet import to_parquet
from tests.conftest import Lab, write_source
from tests.fake_recordings import write_dataset

MANY = 12


def _export(lab: Lab) -> Lab:
    """Have the lab export to many files, in folders within folders."""
    lab.run("simulate forward --trials 1 --duration-s 4 -o data/recordings")
    lab.run("synchronize data/recordings -o data/synced")
    lab.run("export zarr data/synced -o out")
    return lab


def test_of_an_export_the_files_are_counted_and_the_first_are_named(lab: Lab) -> None:
    _export(lab)
    value = lab.run_json("show out")
    assert value["kind"] == "export" and len(value["files"]) > MANY
    text = lab.run("show out").out
    assert f"{len(value['files'])}, together" in text and "README.md" in text
    assert sum(name in text for name in value["files"]) < MANY
    full_text = " ".join(lab.run("show out --full").out.split())
    assert all(name in full_text for name in value["files"])
    traced = lab.run("explain out").out
    assert f"{len(value['files'])} files" in traced and sum(name in traced for name in value["files"]) < MANY


def test_link_removes_the_drafts_in_every_folder_of_an_export(lab: Lab) -> None:
    _export(lab)
    out = lab.folder / "out"
    deep = next(path for path in out.rglob("*") if path.is_file() and len(path.relative_to(out).parts) > 3)
    draft = deep.with_name(f".{deep.name}.0123456789ab.draft")
    draft.write_bytes(b"half")
    lab.run("store link out")
    assert deep.exists() and not draft.exists()


def test_a_lost_connection_after_show_raises_an_error_and_ends_no_process(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    before = signal.getsignal(signal.SIGPIPE)
    lab.run("show data/r")

    assert signal.getsignal(signal.SIGPIPE) == before == signal.SIG_IGN


def test_show_ends_when_nobody_reads_what_it_prints(lab: Lab) -> None:
    lab.run("simulate toy --trials 40 -o data/r")
    readable, writable = os.pipe()
    os.close(readable)
    command = [sys.executable, "-m", "tacpipe", "show", "data/r", "--full"]
    process = subprocess.run(command, cwd=lab.folder, stdout=writable, stderr=subprocess.PIPE, check=False)
    os.close(writable)

    assert (process.returncode, process.stderr) == (-signal.SIGPIPE, b"")


def _skin() -> pa.Table:
    tactile = {b"quantity": b"tactile", b"unit": b"count"}
    rows = {
        pa.field("t_ns", pa.int64()): [0, 10**7, 2 * 10**7, 3 * 10**7, 9 * 10**7],
        pa.field("one", pa.uint16(), metadata=tactile): [0, 0, 65535, 7, 7],
        pa.field("other", pa.int8(), metadata=tactile): [5, 5, 5, None, 127],
        pa.field("force", pa.float32(), metadata={b"quantity": b"force", b"unit": b"N"}): [0.0] * 5,
    }
    return pa.table(list(rows.values()), schema=pa.schema(list(rows)))


FIGURES = {
    "rows": 5,
    "columns": 4,
    "duration_s": 0.09,
    "rate_hz": 100.0,
    "mean_hz": 44.444,  # four steps in 90 ms
    "gaps": 1,
    "held_share": 0.25,  # One of four steps has both channels as before; a missing value is not repeated.
    "saturated": 4,  # 65535, 127 and twice the 0 of an unsigned channel
}


def test_the_numbers_of_a_stream_are_those_of_its_samples() -> None:
    columns = Columns(to_parquet(_skin()))
    assert show_recording.stream_figures(columns, streams.read_clocks(columns)) == FIGURES


def test_a_stream_whose_last_value_is_missing_is_counted_as_any_other() -> None:
    table = _skin().slice(0, 4)
    assert table["other"][-1].as_py() is None
    figures = show_recording.stream_figures(Columns(to_parquet(table)), None)
    assert (figures["held_share"], figures["saturated"]) == (round(1 / 3, 4), 3)


@pytest.mark.parametrize("counted", [False, True])
def test_clocks_that_are_read_in_pieces_have_the_gaps_and_the_rate_of_the_whole(
    monkeypatch: pytest.MonkeyPatch, counted: bool
) -> None:
    steps_ns = [10, 10, 10, 55, 10, 10, 80, 10, 10, 10, 70, 10, 41]
    t_ns = np.cumsum([0, *steps_ns]) * 10**6
    table = pa.table({"t_ns": t_ns, **({"seq": np.cumsum([0, *(step // 10 for step in steps_ns)])} if counted else {})})
    monkeypatch.setattr(streams, "_PIECE_ROWS", 4)
    clocks = streams.read_clocks(Columns(to_parquet(table)))
    assert clocks is not None
    gaps = [(place, place + 1) for place, step in enumerate(steps_ns) if step > 30]
    assert list(zip(clocks.gap_starts_ns, clocks.gap_stops_ns, strict=True)) == [(t_ns[a], t_ns[b]) for a, b in gaps]
    assert clocks.rate_hz == streams.rate_hz(table) and clocks.duration_s == sum(steps_ns) / 1000


def test_a_recording_is_shown_with_streams_columns_rates_gaps_and_labels(lab: Lab) -> None:
    lab.run("simulate forward --trials 1 --duration-s 4 -o data/r")
    robot = tacpipe.open("data/r")["trial-000"].table("robot")
    stamps = robot["t_ns"].to_numpy()
    lost = np.diff(robot["seq"].to_numpy()) - 1
    text = lab.run("show data/r trial-000").out
    value = lab.run_json("show data/r trial-000")

    figures = value["streams"]["robot"]
    assert figures["mean_hz"] == round((len(stamps) - 1) / ((stamps[-1] - stamps[0]) / 1e9), 3)
    assert figures["gaps"] == np.count_nonzero(lost) == sum(gap["name"] == "robot" for gap in value["gaps"])
    assert {"stream": "robot", "name": "finger_m", "quantity": "finger_width", "unit": "m", "type": "double"} in value[
        "columns"
    ]
    assert "taxel01_x … taxel16_z" in text and "median step" in text and "object: bottle" in text
    assert f"robot: {np.count_nonzero(lost)} gaps" in text

    synced = json.loads(lab.run("synchronize data/r -o data/s").out and lab.run("show data/s trial-000 --json").out)
    assert {column["stream"] for column in synced["columns"]} >= {"robot", "xela1", "xela2"}
    recorded_hz = synced["attributes"]["robot_rate_hz"]
    assert abs(figures["mean_hz"] / recorded_hz - 1) < 1e-3  # the fitted clock has its own seconds
    missing = lab.call("show data/r trial-009")
    assert missing.code == 2 and "no recording 'trial-009'" in missing.err


def test_events_and_labels_of_rows_are_shown_at_their_times(lab: Lab) -> None:
    from tests.viewer import hand

    recording = hand.recording()
    write_dataset(lab.folder / "data/r", {recording.name: (recording.tables, recording.attributes)})
    text = show_recording.to_text(show_recording.overview(lab.folder / "data/r", recording.name))

    assert "contact: contact 0 1.000 to 3.000 s" in text and "slip: 2.500 to 3.000 s" in text
    assert "2.000 s  xela1: cut, 1 frames, 7 bytes" in text
    assert "from 2023-11-14 22:13:20 UTC" in text


def test_of_streams_that_are_too_long_only_the_rows_are_listed(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.run("simulate forward --trials 2 --duration-s 4 -o data/r")
    monkeypatch.setattr(show, "READ_BYTES", 0)
    text = lab.run("show data/r").out
    assert "10 streams too long to read here" in text
    (robot, _) = [line.split() for line in text.splitlines() if " robot " in line]
    assert robot == ["trial-000", "robot", f"{tacpipe.open('data/r')['trial-000'].table('robot').num_rows:,}"]
    assert "too long" not in lab.run("show data/r --full").out


def test_recordings_that_fail_for_the_same_reason_are_one_line(lab: Lab) -> None:
    write_source("raw", a="1\n2\n", b="x\n", c="x\n", d="1\ny\n")
    ran = lab.run("ingest numbers raw -o data/r --skip-bad")
    for text in (ran.err, lab.run("show data/r").out):
        (equal, unequal) = [line for line in text.splitlines() if "left out" in line]
        assert "b, c: " in equal and "NAME" in equal and "d: " in unequal


def test_explain_prints_a_layout_as_a_table_and_names_the_part_of_it_that_changed(lab: Lab) -> None:
    (lab.folder / "raw" / "one").mkdir(parents=True)
    (lab.folder / "raw" / "one" / "skin.csv").write_text("t,f_x,f_y\n0.0,1,2\n0.1,3,4\n0.2,3,4\n")
    layout = """
[streams.skin]
files = "{trial}/skin.csv"
time = { column = "t", unit = "s" }
columns = [
    { match = "f_x", quantity = "force", unit = "N", component = "x" },
    { match = "f_y", quantity = "force", unit = "N" },
]
"""
    path = lab.folder / "layout.toml"
    path.write_text(layout)
    lab.run("ingest table raw --layout layout.toml -o data/r")
    text = lab.run("explain data/r").out
    assert "{" not in text.replace("{trial}", "")
    rows = [line.split() for line in text.splitlines()]
    assert ["component", "match", "quantity", "unit"] in rows
    assert ["x", "f_x", "force", "N"] in rows and ["f_y", "force", "N"] in rows
    path.write_text(layout.replace('f_y", quantity = "force"', 'f_y", quantity = "torque"'))
    lab.run("ingest table raw --layout layout.toml -o data/r --replace")
    assert "params.layout.streams.skin.columns.1.quantity: force became torque" in lab.run("explain data/r").out


def test_a_name_that_nearly_exists_is_suggested_wherever_labels_recordings_and_params_are_named(lab: Lab) -> None:
    lab.run("simulate forward --trials 1 --duration-s 4 -o data/r")
    for command, name in {
        "split data/r -o x --stratify objekt": "object",
        "show data/r trial-00": "trial-000",
        "synchronize data/r -o x --set gap_m=3": "gap_ms",
    }.items():
        ran = lab.call(command)
        assert ran.code in (1, 2) and f"Did you mean {name}?" in ran.err, command


def test_print_params_needs_no_dataset(lab: Lab) -> None:
    for command in ("train forward", "synchronize --rate-hz 20", "evaluate", "ingest xela-psc", "simulate toy"):
        assert isinstance(json.loads(lab.run(f"{command} --print-params").out), dict)
    assert lab.call("synchronize -o x").code == 2  # Without it they are required.


def test_each_task_names_what_the_recordings_of_another_lack(lab: Lab) -> None:
    lab.run("simulate forward --trials 3 --duration-s 4 -o data/r")
    lab.run("synchronize data/r -o data/s")
    lab.run("split data/s -o data/split")
    assert (
        "is one table, not separate streams; a grasp has the streams"
        in lab.call("train touch data/s --split data/split -o x").err
    )
    assert "has no label material" in lab.call("train material data/s --split data/split -o x").err


def test_of_a_synchronized_recording_the_share_of_rows_in_gaps_is_shown_by_stream() -> None:
    masks = {"a_gap": [False, True, True, True], "b_gap": [False] * 4}
    figures = show_recording.stream_figures(Columns(to_parquet(pa.table({"t_ns": [0, 10, 20, 30], **masks}))), None)
    assert figures.get("gap_shares") == {"a": 0.75, "b": 0.0} and show_recording.gaps_text(figures) == "75.0%"
