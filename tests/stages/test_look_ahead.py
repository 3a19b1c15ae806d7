"""Test that stages without look-ahead give a truncated recording the same rows as the full one."""

import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.codecs import codec as codecs
from tacpipe.plugins.registry import load, stages
from tacpipe.plugins.stage import RecordingOutput
from tacpipe.signals.contact import contact_intervals
from tacpipe.tasks.forward import tracks
from tests.fake_recordings import FakeRecording, FakeShard, dataset

PAGE = Path(__file__).parents[2] / "docs/reference/look-ahead.md"
MS = 1_000_000
PERIOD_MS = 20
SECONDS = 5.0  # the duration of a simulated trial
TARGETS = ("slip", "dropped")
CUTS_MS = st.integers(600, int(SECONDS * 1000))  # the level at rest is measured in the first 200 ms


def cut(recording: Any, until_ns: int) -> Any:
    """Return a recording that ends at a time."""
    tables = {
        name: table.filter(pa.array(table["t_ns"].to_numpy() <= until_ns)) for name, table in recording.tables.items()
    }
    if isinstance(recording, FakeShard):
        return FakeShard(recording.name, tables[""], recording.attributes)
    return FakeRecording(tables, recording.name, recording.attributes)


def run_stage(name: str, recording: Any, *files: Any, **params: Any) -> Any:
    stage = load(name)
    output = stage(stage.params(**params), recording, *files)
    if isinstance(output, RecordingOutput):
        return FakeShard(recording.name, output.streams[""], {**recording.attributes, **output.attributes})
    return FakeShard(recording.name, output, recording.attributes)


@cache
def record(index: int) -> FakeRecording:
    simulate = load("simulate.forward")
    output = simulate(simulate.params(duration_s=SECONDS, seed=3, grip_loss_probability=1.0, grip_loss=0.5), index)
    return FakeRecording(output.streams, f"trial-{index}", output.attributes)


def segmented(recording: FakeRecording, **params: Any) -> Any:
    synced = run_stage("synchronize", recording, rate_hz=1000 / PERIOD_MS, gap_ms=50.0)
    return run_stage("segment.contacts", synced, **params)


@cache
def codec(name: str) -> Mapping[str, bytes]:
    """Return the files of a codec that is fitted on another recording than those that are cut."""
    stage = load(f"compress.{name.partition(' ')[0]}")
    assert stage.fit is not None
    recordings = [dataset(*(segmented(record(index)) for index in (0, 4)))]
    with tempfile.TemporaryDirectory() as folder:
        workspace = [] if name.startswith("pca") else [Path(folder)]
        return dict(stage.fit(codec_params(name), *recordings, *workspace).files)


def codec_params(name: str) -> Any:
    kind, _, representation = name.partition(" ")
    options = {"epochs": 1, "frames": 3} if kind == "autoencoder" else {}
    return load(f"compress.{kind}").params(components=4, representation=representation, **options)


def rows_before(part: pa.Table, uncut: pa.Table, *left_out: str) -> None:
    """Check that rows of a recording that was cut are those of the uncut one, with the metadata of their columns."""
    assert part.num_rows
    part, uncut = (
        table.drop_columns([name for name in left_out if name in table.column_names]) for table in (part, uncut)
    )
    assert part.schema.equals(uncut.schema, check_metadata=True)
    assert part.to_pydict() == uncut.slice(0, part.num_rows).to_pydict()


def test_the_page_has_the_claim_of_each_stage_that_makes_rows() -> None:
    claims = PAGE.read_text().split("## Each stage")[1].split("\n## ")[0]
    assert not {
        name
        for name in stages()
        if name.startswith(("synchronize", "segment", "compress")) and f"`{name.replace('.', ' ')}" not in claims
    }


@pytest.mark.parametrize("tare", ["median", "first", "axis_mean"])
@settings(deadline=None, max_examples=10)
@given(index=st.integers(1, 3), until_ms=CUTS_MS)
def test_contacts_leave_columns_and_levels_at_rest_as_a_cut_recording_has_them(
    tare: str, index: int, until_ms: int
) -> None:
    recording = record(index)
    until_ns = int(recording.tables["xela1"]["t_ns"][0].as_py()) + until_ms * MS
    part, uncut = (segmented(source, tare=tare) for source in (cut(recording, until_ns), recording))
    rows_before(part.content, uncut.content, "contact")


@settings(deadline=None, max_examples=200)
@given(
    runs=st.lists(st.tuples(st.sampled_from([0.0, 90.0, 150.0]), st.integers(1, 40)), min_size=1, max_size=20),
    until=st.integers(1, 400),
    pad_s=st.sampled_from([0.0, 0.1, 0.5]),
    merge_s=st.sampled_from([0.0, 0.1, 0.5]),
    min_s=st.sampled_from([0.0, 0.1, 0.3]),
)
def test_marks_of_contacts_look_ahead_by_no_more_than_the_page_states(
    runs: list[tuple[float, int]], until: int, pad_s: float, merge_s: float, min_s: float
) -> None:
    """Check that the longest time is that to the next merged or padded contact, until it has lasted long enough."""
    loads = np.concatenate([np.full(rows, load) for load, rows in runs])
    marks = []
    for rows in (loads, loads[:until]):
        t_ns = np.arange(len(rows)) * PERIOD_MS * MS
        marks.append(np.zeros(len(rows), bool))
        for start, stop in contact_intervals(rows, t_ns, 120.0, 80.0, min_s, merge_s, pad_s):
            marks[-1][start:stop] = True
    before = max(0, len(marks[1]) - int((max(pad_s, merge_s) + min_s + merge_s) * 1000 / PERIOD_MS) - 1)
    assert marks[0][:before].tolist() == marks[1][:before].tolist()


@settings(deadline=None, max_examples=15)
@given(index=st.integers(1, 3), rows=st.integers(20, int(SECONDS * 1000 / PERIOD_MS)))
def test_slips_so_far_are_those_of_a_recording_that_is_cut(index: int, rows: int) -> None:
    uncut = segmented(record(index))
    part = FakeShard(uncut.name, uncut.content.slice(0, rows), uncut.attributes)
    marked = [run_stage("segment.slips", shard).content for shard in (part, uncut)]
    assert marked[1]["slip_online"].to_numpy().any()
    rows_before(*marked, *TARGETS)


@pytest.mark.parametrize("name", ["pca levels", "pca increments", "autoencoder levels", "autoencoder increments"])
@settings(deadline=None, max_examples=8)
@given(index=st.integers(1, 3), rows=st.integers(2, 200))
def test_latents_and_what_a_forecaster_reads_are_those_of_a_recording_that_is_cut(
    name: str, index: int, rows: int
) -> None:
    """Compare latents to five digits: products of matrices of other shapes round differently in the last digits."""
    uncut = segmented(record(index))
    part = FakeShard(uncut.name, uncut.content.slice(0, rows), uncut.attributes)
    files = codec(name)
    stage = load(f"compress.{name.partition(' ')[0]}")
    compressed: list[Any] = [
        FakeShard(shard.name, stage(codec_params(name), shard, files), shard.attributes) for shard in (part, uncut)
    ]
    short, full = (tracks.track(shard, codecs.load(files)) for shard in compressed)
    scale = np.abs(full.latent).max()
    np.testing.assert_allclose(short.latent, full.latent[:rows], rtol=1e-5, atol=1e-5 * scale)
    for field in ("arm", "finger", "usable", "groups"):
        assert np.array_equal(getattr(short, field), getattr(full, field)[:rows]), field


@settings(deadline=None, max_examples=10)
@given(index=st.integers(0, 4), fraction=st.floats(0.0, 1.0))
def test_a_slide_is_that_of_a_recording_that_goes_on_once_the_arm_has_stopped(index: int, fraction: float) -> None:
    simulate, slides = load("simulate.material"), load("segment.slides")
    output = simulate(simulate.params(trials=5, materials=2, arm_every=1), index)
    recording = FakeRecording(output.streams, f"trial-{index}", output.attributes)
    uncut = slides(slides.params(), recording)
    if "profile" not in uncut.streams:
        return
    t_ns, phase = (uncut.streams["profile"][name].to_numpy() for name in ("t_ns", "phase"))
    stopped_ns = int(t_ns[phase == 0][-1]) + 200 * MS  # an end is found by the steady motion of 200 ms
    until_ns = stopped_ns + int(fraction * max(0, int(t_ns[-1]) - stopped_ns))
    part = slides(slides.params(), cut(recording, until_ns))
    assert part.streams["slide"].equals(uncut.streams["slide"])


@pytest.fixture(scope="module")
def grasped() -> tuple[FakeRecording, RecordingOutput]:
    """Return a recorded grasp, and what is cut out of it."""
    simulate, grasps = load("simulate.touch"), load("segment.grasps")
    output = simulate(simulate.params(trials=1, objects=1, raw=True), 0)
    recording = FakeRecording(output.streams, "grasp", output.attributes)
    return recording, grasps(grasps.params(), recording)


def test_the_cloud_of_a_grasp_is_that_of_a_plan_without_fingers(grasped: tuple[FakeRecording, RecordingOutput]) -> None:
    recording, with_fingers = grasped
    grasps = load("segment.grasps")
    planned = FakeRecording({name: table for name, table in recording.tables.items() if name in ("scene", "grasp")})
    output = grasps(grasps.params(), planned)
    assert all(output.streams[name].equals(with_fingers.streams[name]) for name in ("cloud", "grasp"))


@settings(deadline=None, max_examples=20)
@given(fraction=st.floats(0.0, 1.0))
def test_a_reading_of_the_fingers_is_that_of_a_recording_that_goes_on(
    fraction: float, grasped: tuple[FakeRecording, RecordingOutput]
) -> None:
    recording, uncut = grasped
    grasps = load("segment.grasps")
    stream, reading = recording.tables["biotac_sp"], uncut.streams["reading"]
    read_ns = int(reading["t_ns"][0].as_py()) + 210 * MS  # the median is of 200 ms
    until_ns = read_ns + int(fraction * (int(stream["t_ns"][-1].as_py()) - read_ns))
    fingers = stream.filter(pa.array(stream["t_ns"].to_numpy() <= until_ns))
    tables = {"grasp": recording.tables["grasp"], "cloud": uncut.streams["cloud"], "biotac_sp": fingers}
    part = grasps(grasps.params(), FakeRecording(tables))
    assert part.streams["reading"].equals(reading) and part.attributes == uncut.attributes
