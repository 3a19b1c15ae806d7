"""The slip control set: made-up trials with each of its faults, and the published ones where they are at hand."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from scipy.spatial.transform import Rotation

from tacpipe.errors import TacpipeError
from tacpipe.formats.published import Params
from tacpipe.formats.xela_psc import discover, xela_psc
from tests.conftest import sample_data
from tests.formats.builders import read_single

SAMPLE = sample_data()
Trial = Callable[..., Path]
read = partial(read_single, xela_psc, discover)


def set_cell(path: Path, row: int, column: str, cell: str) -> None:
    lines = [line.split(",") for line in path.read_text().splitlines()]
    lines[row - 1][lines[0].index(column)] = cell
    path.write_text("\n".join(map(",".join, lines)) + "\n")


def test_the_column_major_transform_becomes_position_and_quaternion(psc_trial: Trial) -> None:
    robot = read(psc_trial()).streams["robot"]
    np.testing.assert_allclose(robot.column("position_y_m").to_numpy(), np.arange(6) * 0.3 + 0.1)
    values = np.column_stack([robot.column(f"orientation_{part}").to_numpy() for part in "xyzw"])
    expected = Rotation.random(6, rng=np.random.default_rng(0))
    assert (Rotation.from_quat(values) * expected.inv()).magnitude().max() < 1e-7
    assert ((values[1:] * values[:-1]).sum(axis=1) >= 0).all()


def test_all_streams_have_the_seconds_of_the_robot_as_stamps(psc_trial: Trial) -> None:
    streams = read(psc_trial()).streams
    start_ns = int(np.datetime64("2022-02-21T09:58:40.837657", "ns").astype(np.int64))
    expected = [start_ns + ms * 1_000_000 for ms in (0, 10, 10, 30, 45, 60)]
    assert set(streams) == {"xela1", "xela2", "robot", "marker", "slip"}
    for table in streams.values():
        assert table.column("t_ns").to_pylist() == expected
        assert b"made" not in table.schema.field("t_ns").metadata


def test_labels_are_bytes_and_what_was_commanded_is_kept(psc_trial: Trial) -> None:
    recording = read(psc_trial())
    slip = recording.streams["slip"]
    assert slip.schema.field("slip").type == pa.int8()
    assert slip.schema.field("slip").metadata[b"quantity"] == b"label"
    assert slip.column("slip").to_pylist() == [0, 0, 1, 1, 0, 0]
    commanded = recording.streams["robot"].column("commanded_velocity_y_m_s").to_pylist()
    assert commanded == [0.0, 0.02, 0.02, 0.06, 0.09, 0.12]
    assert recording.attributes["slipped"] is True
    assert recording.attributes["failed"] is True
    assert recording.attributes["rate_hz"] == pytest.approx(5 / 0.06, abs=1e-5)


def test_time_that_runs_backwards_is_named_with_its_row(psc_trial: Trial) -> None:
    folder = psc_trial()
    set_cell(folder / "robot_state.csv", 5, "time", "0.005")
    with pytest.raises(TacpipeError, match=r"robot_state\.csv, line 5.*0\.01 s.*0\.005 s"):
        read(folder)


@pytest.mark.parametrize(("column", "cell"), [("ee_T_11", "3.0"), ("ee_T_30", "0.5"), ("ee_T_33", "0.0")])
def test_what_is_no_rigid_transform_is_named_with_its_row(psc_trial: Trial, column: str, cell: str) -> None:
    folder = psc_trial()
    set_cell(folder / "robot_state.csv", 4, column, cell)
    with pytest.raises(TacpipeError, match=r"robot_state\.csv, line 4: ee_T"):
        read(folder)


def test_a_label_that_is_neither_0_nor_1_is_named(psc_trial: Trial) -> None:
    folder = psc_trial()
    set_cell(folder / "slip_label.csv", 3, "fail", "2")
    with pytest.raises(TacpipeError, match=r"slip_label\.csv, line 3.*2"):
        read(folder)


def test_a_missing_label_file_is_named(psc_trial: Trial) -> None:
    folder = psc_trial()
    (folder / "slip_label.csv").unlink()
    with pytest.raises(TacpipeError, match=r"lacks slip_label\.csv"):
        read(folder)


@pytest.mark.data
@pytest.mark.skipif(not (SAMPLE / "xela_slip_psc").is_dir(), reason="the published recordings are not here")
def test_the_published_trials_are_read_as_they_were_counted() -> None:
    sources = discover(Params(), SAMPLE / "xela_slip_psc")
    recordings = [xela_psc(Params(), files) for files in sources.values()]
    assert sum(recording.streams["xela1"].num_rows for recording in recordings) == 674
    assert [recording.attributes["slipped"] for recording in recordings] == [False, True]
