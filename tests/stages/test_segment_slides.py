"""Test slides cut from constructed recordings, synchronized or not, and from published ones where they are at hand."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.channels import schema
from tacpipe.errors import TacpipeError
from tacpipe.plugins.registry import load
from tacpipe.plugins.stage import RecordingOutput
from tests.conftest import sample_data
from tests.stages.slide_fakes import START_NS, drawn, finger, pressed, replaced

SAMPLE = sample_data()
slides = load("segment.slides")
synchronize = load("synchronize")
Recording = Callable[..., Any]


def cut(recording: Any, **params: Any) -> RecordingOutput:
    output = slides(slides.params(**params), recording)
    assert isinstance(output, RecordingOutput)
    return output


def rows_of(output: RecordingOutput) -> tuple[int, int]:
    """Return the first row and the row after the last, by their stamps."""
    t_ns = output.streams["slide"].column("t_ns").to_numpy()
    return int(t_ns[0] - START_NS) // 10_000_000, int(t_ns[-1] - START_NS) // 10_000_000 + 1


def skin(frames: int = 75) -> pa.Table:
    values = np.random.default_rng(0).uniform(0, 190, (60, frames))
    return schema.stream(np.arange(frames) * 20_000_000, list(values), schema.roboskin_fields(), "from nominal rate")


def test_the_middle_of_a_slide_is_kept_with_all_columns_of_the_finger(shard: Recording) -> None:
    readings = finger(pressed(800))
    output = cut(shard({"biotac": readings}))
    assert rows_of(output) == (200, 600)
    assert output.streams["slide"].equals(readings.slice(200, 400).combine_chunks())
    assert output.streams["slide"].schema.equals(readings.schema, check_metadata=True)
    assert output.attributes == {
        "pressure_mean_count": 25.0,
        "slide_frames": 400,
        "spikes": 0,
        "outside_protocol": False,
    }


@pytest.mark.parametrize("reached", [0, 1, 57, 300])
def test_a_slide_starts_in_the_row_that_reaches_the_trigger_and_goes_on_though_the_pressure_falls(
    shard: Recording, reached: int
) -> None:
    recording = shard({"biotac": finger(pressed(800, reached))})
    assert rows_of(cut(recording, crop="none")) == (reached, 800)
    assert rows_of(cut(recording, frames=100)) == (reached + (800 - reached - 100) // 2, (800 + reached + 100) // 2)
    assert rows_of(cut(recording, crop="offset", frames=350)) == (reached + 101, reached + 451)


def test_an_arm_bounds_the_slide_and_gives_its_profile(shard: Recording) -> None:
    streams = {"biotac": finger(pressed(800, 30)), **drawn(800, slice(60, 740))}
    output = cut(shard(streams), crop="none")
    first, stop = rows_of(output)
    assert abs(first - 60) <= 1
    assert abs(stop - 740) <= 1
    profile = output.streams["profile"]
    assert profile.column_names == ["t_ns", "pressure_count", "speed_raw_m_s", "speed_m_s", "force_n", "phase"]
    assert profile.column("t_ns").equals(streams["biotac"].column("t_ns"))
    assert profile.column("phase").to_pylist() == [-1] * first + [0] * (stop - first) + [1] * (800 - stop)
    np.testing.assert_allclose(profile.column("speed_m_s").to_numpy()[first + 2 : stop - 2], 0.025, rtol=1e-6)
    np.testing.assert_allclose(profile.column("force_n").to_numpy(), 2.0)
    assert output.attributes["speed_m_s"] == 0.025
    assert output.attributes["force_n"] == 2.0
    assert output.attributes["outside_protocol"] is False


def test_a_speed_that_a_lost_cycle_multiplied_is_filtered_and_stays_in_the_raw_one(shard: Recording) -> None:
    arm = drawn(800, slice(60, 740))
    arm["joint_velocity"] = replaced(arm["joint_velocity"], "joint1_velocity_rad_s", 30, 1.0)  # row 20, at rest
    profile = cut(shard({"biotac": finger(pressed()), **arm}), crop="none").streams["profile"]
    assert profile.column("speed_raw_m_s").to_numpy()[:40].max() > 0.1
    assert not profile.column("speed_m_s").to_numpy()[:40].any()
    assert profile.column("phase").to_pylist()[:40] == [-1] * 40


def test_the_velocity_of_the_controller_counts_where_the_joints_are_missing_or_another_arms(shard: Recording) -> None:
    arm = drawn(800, slice(0, 800), 0.025)
    slow = drawn(800, slice(0, 800), 0.02)["twist"]
    streams = {"biotac": finger(pressed()), **arm, "twist": slow}
    without_joints = {name: table for name, table in streams.items() if not name.startswith("joint")}
    angles = arm["joint_position"]
    other_joints = {
        **streams,
        "joint_position": angles.set_column(2, angles.schema.field(2), pa.array(np.linspace(0, 1, 1200))),
    }
    assert cut(shard(streams)).attributes["speed_m_s"] == 0.025
    assert cut(shard(without_joints)).attributes["speed_m_s"] == 0.02
    assert cut(shard(other_joints)).attributes["speed_m_s"] == 0.02
    assert cut(shard(without_joints)).attributes["outside_protocol_why"] == "its speed is 20.0 mm/s and not 25.0"


def test_an_arm_that_never_moves_leaves_the_slide_to_its_end_and_outside_the_protocol(shard: Recording) -> None:
    output = cut(shard({"biotac": finger(pressed()), **drawn(800, slice(0, 0))}), crop="none")
    assert rows_of(output) == (0, 800)
    assert output.attributes["outside_protocol_why"] == "its speed is 0.0 mm/s and not 25.0"


def test_an_arm_without_a_wrench_has_no_force(shard: Recording) -> None:
    arm = {name: table for name, table in drawn(800, slice(0, 800)).items() if name != "wrench"}
    output = cut(shard({"biotac": finger(pressed()), **arm}))
    assert "force_n" not in output.attributes
    assert np.isnan(output.streams["profile"].column("force_n").to_numpy()).all()


@pytest.mark.parametrize("grid", [{"master": "biotac"}, {"rate_hz": 100.0}])
def test_a_synchronized_recording_gives_the_same_slide(shard: Recording, grid: dict[str, Any]) -> None:
    streams = {"biotac": finger(pressed(800, 30)), **drawn(800, slice(60, 740))}
    truth = pa.table({"t_ns": streams["biotac"].column("t_ns"), "gt_force_n": pa.array(np.ones(800))})
    synced = synchronize(synchronize.params(values="interpolate", **grid), shard({**streams, "truth": truth})).streams[
        ""
    ]
    raw, from_synced = cut(shard({**streams, "truth": truth})), cut(shard({"": synced}))
    assert from_synced.streams["slide"].column_names == raw.streams["slide"].column_names
    assert rows_of(from_synced) == rows_of(raw)
    for name in raw.streams["slide"].column_names:
        ours, theirs = (
            from_synced.streams["slide"].column(name).to_numpy(),
            raw.streams["slide"].column(name).to_numpy(),
        )
        np.testing.assert_array_equal(ours, theirs)
    assert from_synced.attributes == raw.attributes
    assert set(from_synced.streams) == {"slide", "profile"}


def test_single_wrong_readings_are_mended_and_counted_where_they_are_kept(shard: Recording) -> None:
    readings = finger(pressed())
    for row, name in ((5, "electrode07"), (400, "electrode07"), (400, "electrode19"), (400, "tdc")):
        readings = replaced(readings, name, row, 3425)
    output = cut(shard({"biotac": readings}))
    assert output.attributes["spikes"] == 2
    table = output.streams["slide"]
    assert table.column("tdc")[200].as_py() == 3425  # no touch, so it is left alone
    assert table.column("electrode19")[200].as_py() < 60
    assert table.column("electrode19").type == pa.uint16()
    changed = [
        name for name in table.column_names if not table.column(name).equals(readings.slice(200, 400).column(name))
    ]
    assert changed == ["electrode07", "electrode19"]
    unrepaired = cut(shard({"biotac": readings}), spike_frames=1)
    assert unrepaired.attributes["spikes"] == 0
    assert unrepaired.streams["slide"].equals(readings.slice(200, 400).combine_chunks())
    assert cut(shard({"biotac": readings}), crop="none").attributes["spikes"] == 3


def test_a_skin_without_pressure_stays_whole(shard: Recording) -> None:
    output = cut(shard({"roboskin": skin()}))
    assert output.streams["slide"].equals(skin())
    assert set(output.streams) == {"slide"}
    assert output.attributes == {"slide_frames": 75, "spikes": 0, "outside_protocol": False}


def test_a_slide_that_left_the_protocol_is_kept_and_says_why(shard: Recording) -> None:
    output = cut(shard({"biotac": finger(np.full(500, 160))}))
    assert output.attributes["outside_protocol"] is True
    assert output.attributes["outside_protocol_why"] == (
        "it lasts 4.99 s and not 5.5 or more; its mean pressure is 160.0 counts and not 2 to 150"
    )


def test_recordings_without_a_slide_are_refused_with_a_sentence(shard: Recording) -> None:
    with pytest.raises(TacpipeError, match="Recording trial: The pressure never reaches 40 counts; its maximum is 39"):
        cut(shard({"biotac": finger(np.full(800, 39))}))
    with pytest.raises(TacpipeError, match=r"Recording trial: The slide has 399 rows from row 0 .* 400 are needed"):
        cut(shard({"biotac": finger(pressed(399))}))
    with pytest.raises(TacpipeError, match="crop is 'start'; it must be middle, offset or none"):
        cut(shard({"biotac": finger(pressed())}), crop="start")
    with pytest.raises(TacpipeError, match="quantity tactile"):
        cut(shard(drawn(800, slice(0, 800))))
    with pytest.raises(TacpipeError, match="has 2 streams with tactile channels: biotac, roboskin"):
        cut(shard({"biotac": finger(pressed()), "roboskin": skin()}))


@pytest.fixture(scope="module")
def published() -> dict[str, Any]:
    """The published BioTac slides: recording name to what ingest gives."""
    ingest = load("ingest.biotac-slide")
    assert ingest.source is not None
    files_by_name = ingest.source.discover(ingest.params(), SAMPLE / "biotac_slide_20_50")
    return {name: ingest(ingest.params(), files) for name, files in files_by_name.items()}


@pytest.mark.long
@pytest.mark.data
@pytest.mark.skipif(not (SAMPLE / "biotac_slide_20_50").is_dir(), reason="the published recordings are not here")
def test_in_published_slides_nothing_but_glitches_is_mended(published: dict[str, Any], shard: Recording) -> None:
    repaired: dict[str, int] = {}
    for name, recording in published.items():
        readings = recording.streams["biotac"]
        output = cut(shard(recording.streams, name=name), crop="none", moving_fraction=0.0)
        table = output.streams["slide"]
        assert table.num_rows == readings.num_rows  # each begins at its trigger
        for column in table.column_names:
            before, after = readings.column(column).to_numpy(), table.column(column).to_numpy()
            changed = before != after
            assert (before[changed] > 2500).all()
            assert (after[changed] <= 255).all()
            repaired[name] = repaired.get(name, 0) + int(changed.sum())
        assert output.attributes["spikes"] == repaired[name]
        electrodes = [table.column(f"electrode{number:02d}").to_numpy() for number in range(1, 20)]
        assert max(column.max() for column in electrodes) <= 255
    assert {name: count for name, count in repaired.items() if count} == {
        "biotac-m02-t007": 8,
        "biotac-m02-t009": 4,
        "biotac-m05-t050": 8,
        "biotac-m09-t003": 4,
    }


@pytest.mark.data
@pytest.mark.skipif(not (SAMPLE / "biotac_slide_20_50").is_dir(), reason="the published recordings are not here")
def test_published_slides_keep_400_frames_within_the_protocol(published: dict[str, Any], shard: Recording) -> None:
    with_arm = 0
    for name, recording in published.items():
        output = cut(shard(recording.streams, name=name))
        assert output.streams["slide"].num_rows == 400
        assert output.attributes["outside_protocol"] is False
        if "profile" not in output.streams:
            continue
        with_arm += 1
        pose = recording.streams["pose"]
        path_m = np.column_stack([pose.column(f"position_{axis}_m").to_numpy() for axis in "xyz"])
        t_ns = pose.column("t_ns").to_numpy()
        mean_m_s = np.linalg.norm(path_m[-1] - path_m[0]) / ((t_ns[-1] - t_ns[0]) / 1e9)
        assert output.attributes["speed_m_s"] == pytest.approx(mean_m_s, rel=0.03)
    assert with_arm == 40
