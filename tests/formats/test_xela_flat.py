"""The flat object set: made-up trials with each of its faults, and the published ones where they are at hand."""

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tacpipe.errors import TacpipeError
from tacpipe.formats.published import Params
from tacpipe.formats.xela_flat import discover, xela_flat
from tacpipe.signals.kinematics import PANDA, rotates_with_hand
from tests.conftest import sample_data
from tests.formats import xela_files
from tests.formats.builders import edit, read_single
from tests.signals.test_kinematics import elementary

SAMPLE = sample_data()
Trial = Callable[..., Path]
read = partial(read_single, xela_flat, discover)


def drop_rows(path: Path, count: int) -> None:
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-count]))


def test_every_stream_keeps_its_rows_and_its_layout(flat_trial: Trial) -> None:
    recording = read(flat_trial())
    assert {name: table.shape for name, table in recording.streams.items()} == {
        "xela1": (6, 49),
        "xela2": (6, 49),
        "robot": (5, 23),
        "marker1": (6, 8),
        "marker2": (6, 8),
    }
    raw = np.random.default_rng(2).integers(0, 65_536, (6, 48))
    streams = recording.streams["xela2"]
    np.testing.assert_array_equal(np.column_stack([column.to_numpy() for column in streams.columns[1:]]), raw)
    assert streams.schema.field("taxel16_z").metadata == {
        b"unit": b"count",
        b"quantity": b"tactile",
        b"taxel": b"16",
        b"axis": b"z",
    }


def test_stamps_are_made_from_the_mean_rate_and_say_so(flat_trial: Trial) -> None:
    streams = read(flat_trial()).streams
    assert streams["xela1"].schema.field("t_ns").metadata[b"made"] == b"from mean rate"
    start_ns = int(np.datetime64("2021-11-24T15:19:09.142171", "ns").astype(np.int64))
    assert streams["xela1"].column("t_ns").to_pylist() == [start_ns + k * 25_000_000 for k in range(6)]
    assert streams["robot"].column("t_ns").to_pylist() == streams["xela1"].column("t_ns").to_pylist()[:5]


def test_what_is_known_of_a_trial_becomes_attributes(flat_trial: Trial) -> None:
    assert read(flat_trial(), Params(authors_role="test")).attributes == {
        "sensor": "xela-uskin",
        "object": "7",
        "object_class": "box",
        "seen": True,
        "dropped": False,
        "covering": "xela_2fingers_noglove",
        "rate_hz": 40.0,
        "trial": "data_sample_2021-11-24-15-19-34",
        "marker1_unseen_ratio": 0.0,
        "marker2_unseen_ratio": round(1 / 6, 4),
        "published": "xela-flat",
        "authors_role": "test",
    }


def test_a_marker_that_was_not_seen_is_nan_and_not_ten(flat_trial: Trial) -> None:
    marker = read(flat_trial()).streams["marker2"]
    values = ~np.isnan(np.column_stack([column.to_numpy() for column in marker.columns[1:]]))
    assert values.all(axis=1).tolist() == [True, True, False, True, True, True]
    assert not values[2].any()


def test_trials_are_found_at_any_depth_with_unique_names(flat_trial: Trial, tmp_path: Path) -> None:
    flat_trial(place=tmp_path / "train")
    flat_trial(place=tmp_path / "test")
    flat_trial("data_sample_new one", place=tmp_path)
    assert list(discover(Params(), tmp_path)) == ["new-one", "test-2021-11-24-15-19-34", "train-2021-11-24-15-19-34"]


def test_a_trial_folder_may_itself_be_the_source(flat_trial: Trial) -> None:
    assert list(discover(Params(), flat_trial())) == ["2021-11-24-15-19-34"]


def test_a_source_without_trials_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TacpipeError, match="holds no trial"):
        discover(Params(), tmp_path)
    with pytest.raises(TacpipeError, match="is not a folder"):
        discover(Params(), tmp_path / "absent")


def test_a_trial_that_lacks_a_file_is_found_and_named_when_read(flat_trial: Trial, tmp_path: Path) -> None:
    folder = flat_trial()
    (folder / "marker.csv").unlink()
    (tmp_path / "data_sample_empty").mkdir()
    sources = discover(Params(), tmp_path)
    with pytest.raises(TacpipeError, match=r"2021-11-24-15-19-34 lacks marker\.csv"):
        xela_flat(Params(), sources["2021-11-24-15-19-34"])
    with pytest.raises(TacpipeError, match=r"xela_sensor1\.csv"):
        xela_flat(Params(), sources["empty"])


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("meta_data.csv", "40.0", "", "column frequency_hz is missing or empty; it must be a positive number"),
        ("meta_data.csv", "40.0", "-3", "column frequency_hz holds '-3'"),
        ("meta_data.csv", "2021-11-24 15:19:09.142171", "noon", "column start_time holds 'noon'"),
        ("meta_data.csv", "box,1,0", "box,yes,0", "column seen holds 'yes'; it must be 0 or 1"),
        ("meta_data.csv", "7,box", "7,box,box", "line 2 has 9 cells under a header of 8"),
        ("xela_sensor1.csv", "txl16_z", "txl17_z", "lacks the column txl16_z"),
        ("xela_sensor2.csv", ".0\n", ".5\n", "line 2, column txl16_z holds"),
        ("marker.csv", "marker1_position_x", "x", "lacks the column marker1_position_x"),
    ],
)
def test_a_fault_is_named_with_its_file(flat_trial: Trial, file: str, old: str, new: str, message: str) -> None:
    folder = flat_trial()
    edit(folder / file, old, new)
    with pytest.raises(TacpipeError) as caught:
        read(folder)
    assert str(folder / file) in str(caught.value)
    assert message in str(caught.value)


def test_a_quaternion_that_is_no_rotation_is_named_with_its_row(flat_trial: Trial) -> None:
    folder = flat_trial()
    lines = (folder / "robot_state.csv").read_text().splitlines()
    lines[3] = ",".join([*lines[3].split(",")[:-4], "1", "1", "1", "1"])
    (folder / "robot_state.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(TacpipeError, match=r"robot_state\.csv, line 4: ee_state_orientation.*2"):
        read(folder)


@pytest.mark.parametrize("order", ["wxyz", "xyzw"])
def test_the_hand_is_turned_as_the_joints_of_the_arm_turn_it_in_either_order_of_its_columns(
    flat_trial: Trial, order: str
) -> None:
    folder = flat_trial()
    names, *lines = (folder / "robot_state.csv").read_text().splitlines()
    rows = np.array([line.split(",") for line in lines], dtype=np.float64)
    rows[:, :7] = np.linspace(-1, 1, 7) + np.linspace(0, 0.5, len(rows))[:, None]
    turned = Rotation.from_matrix([elementary(angles)[-1][:3, :3] for angles in rows[:, :7]])
    rows[:, -4:] = turned.as_quat(scalar_first=order == "wxyz")
    xela_files.write(folder / "robot_state.csv", names.split(","), rows)
    robot = read(folder).streams["robot"]
    quaternions = np.column_stack([robot[f"orientation_{part}"].to_numpy() for part in "xyzw"])
    assert (Rotation.from_quat(quaternions) * turned.inv()).magnitude().max() < 1e-6


def test_files_of_one_trial_may_differ_by_one_row_at_most(flat_trial: Trial) -> None:
    folder = flat_trial()
    drop_rows(folder / "robot_state.csv", 1)
    with pytest.raises(TacpipeError, match=r"robot_state\.csv.*4 rows.*xela_sensor1\.csv 6"):
        read(folder)
    shutil.copy(folder / "xela_sensor1.csv", folder / "xela_sensor2.csv")
    drop_rows(folder / "xela_sensor2.csv", 1)
    with pytest.raises(TacpipeError, match=r"xela_sensor2\.csv.*5 rows"):
        read(folder)


def test_more_robot_rows_than_tactile_ones_are_refused(flat_trial: Trial) -> None:
    folder = flat_trial()
    for sensor in (1, 2):
        drop_rows(folder / f"xela_sensor{sensor}.csv", 2)
    with pytest.raises(TacpipeError, match=r"robot_state\.csv.*5 rows.*xela_sensor1\.csv 4"):
        read(folder)


@pytest.mark.data
@pytest.mark.skipif(not (SAMPLE / "xela_flat_pick_move").is_dir(), reason="the published recordings are not here")
def test_the_published_trials_are_read_as_they_were_counted() -> None:
    sources = discover(Params(), SAMPLE / "xela_flat_pick_move")
    recordings = [xela_flat(Params(), files) for files in sources.values()]
    assert len(recordings) == 52
    assert {recording.attributes["object"] for recording in recordings} == {
        "4",
        "5",
        "7",
        "10",
        "12",
        "13",
        "14",
        "16",
        "17",
    }
    for recording in recordings:
        rows = {name: table.num_rows for name, table in recording.streams.items()}
        assert rows["xela1"] == rows["xela2"]
        assert {rows["robot"], rows["marker1"]} <= {rows["xela1"], rows["xela1"] - 1}
        rate_hz = recording.attributes["rate_hz"]
        assert isinstance(rate_hz, float) and 31.9 < rate_hz < 46.1
        robot = recording.streams["robot"]
        angles, quaternions = (
            np.column_stack([robot[name].to_numpy() for name in robot.column_names if name.endswith(ending)])
            for ending in (tuple(f"joint{n}_rad" for n in range(1, 8)), tuple(f"orientation_{part}" for part in "xyzw"))
        )
        assert rotates_with_hand(PANDA, angles, quaternions)


def test_selected_streams_are_those_of_the_whole_recording(flat_trial: Trial) -> None:
    folder = flat_trial()
    full, tactile = read(folder), read(folder, Params(streams="xela*"))
    assert sorted(tactile.streams) == ["xela1", "xela2"] and tactile.attributes == full.attributes
    assert all(tactile.streams[name].equals(full.streams[name]) for name in tactile.streams)
