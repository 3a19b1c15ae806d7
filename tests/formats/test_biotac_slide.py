"""BioTac slides: made-up ones with each fault of the files, and the published ones where they are at hand."""

from decimal import Decimal
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.formats.biotac_slide import biotac_slide, discover
from tacpipe.formats.published import Params
from tests.conftest import sample_data
from tests.formats.builders import edit, read_single
from tests.formats.slide_files import SECOND, write_biotac

SAMPLE = sample_data()
read = partial(read_single, biotac_slide, discover)


def values(table: pa.Table) -> np.ndarray:
    return np.column_stack([column.to_numpy() for column in table.columns[1:]])


def test_all_seven_streams_are_read_each_with_its_own_stamps(tmp_path: Path) -> None:
    write_biotac(tmp_path)
    streams = read(tmp_path).streams
    assert {name: table.shape for name, table in streams.items()} == {
        "biotac": (6, 45),
        "pose": (6, 8),
        "twist": (6, 7),
        "wrench": (6, 7),
        "joint_position": (6, 8),
        "joint_torque": (6, 8),
        "joint_velocity": (6, 8),
    }
    begins = {name: table.column("t_ns")[0].as_py() - SECOND * 10**9 for name, table in streams.items()}
    assert sorted(begins.values()) == [0, 0, 1, 2, 3, 4, 5]


def test_the_comma_at_the_end_of_rows_shifts_no_column(tmp_path: Path) -> None:
    write_biotac(tmp_path)
    table = read(tmp_path).streams["biotac"]
    np.testing.assert_array_equal(values(table), np.arange(6 * 44).reshape(6, 44))
    assert {field.type for field in table.schema if field.name != "t_ns"} == {pa.uint16()}
    assert table.column_names[:5] == ["t_ns", "tdc", "tac", "pdc", "pac01"]
    assert table.column_names[-1] == "electrode19"
    assert table.schema.field("electrode19").metadata == {
        b"unit": b"count",
        b"quantity": b"tactile",
        b"electrode": b"19",
    }


def test_stamps_keep_their_last_nanosecond(tmp_path: Path) -> None:
    write_biotac(tmp_path)
    streams = read(tmp_path).streams["biotac"].column("t_ns").to_pylist()
    assert streams == [SECOND * 10**9 + 10_000_001 * row for row in range(6)]
    assert [round(float(nanoseconds)) for nanoseconds in streams] != streams  # float64 could not hold them


def test_what_has_no_angular_velocity_has_nan_and_no_other_value_is_touched(tmp_path: Path) -> None:
    write_biotac(tmp_path)
    twist = values(read(tmp_path).streams["twist"])
    assert np.isnan(twist[:, 3:]).all()
    np.testing.assert_array_equal(twist[:, :3], np.arange(36).reshape(6, 6)[:, :3] / 8)


def test_the_space_in_a_header_is_no_part_of_the_name(tmp_path: Path) -> None:
    write_biotac(tmp_path)
    assert " ow" in (tmp_path / "mat3_7_cp.csv").read_text()
    assert read(tmp_path).streams["pose"].column("orientation_w").to_pylist()[:2] == [0.75, 1.625]


def test_a_spike_stays_as_it_was_recorded(tmp_path: Path) -> None:
    edit(write_biotac(tmp_path), ",43,\n", ",3425,\n")
    assert read(tmp_path).streams["biotac"].column("electrode19").to_pylist()[:2] == [3425, 87]


def test_material_trial_and_session_follow_from_the_names_of_the_files(tmp_path: Path) -> None:
    write_biotac(tmp_path / "mat12", 12, 5, arm=False)
    assert list(discover(Params(), tmp_path)) == ["biotac-m12-t005"]
    assert read(tmp_path, Params(authors_role="test")).attributes == {
        "sensor": "biotac",
        "material": 12,
        "trial": 5,
        "session": "biotac-m12",
        "published": "biotac-slide",
        "rate_hz": 100.0,
        "authors_role": "test",
    }


def test_slides_of_another_time_are_a_labs_own_and_of_no_known_session(tmp_path: Path) -> None:
    write_biotac(tmp_path / "mat12", 12, 5, arm=False)
    (file,) = (tmp_path / "mat12").glob("*_bio.csv")
    head, *rows = file.read_text().splitlines()
    later = [f"{float(row.split(',')[0]) + 1e8:.6f},{row.partition(',')[2]}" for row in rows]
    file.write_text("\n".join([head, *later, ""]))
    assert {"session", "published"} & set(read(tmp_path, Params()).attributes) == set()


def test_slides_are_found_at_any_depth_with_the_streams_of_the_arm_that_are_there(tmp_path: Path) -> None:
    write_biotac(tmp_path / "a" / "mat2", 2, 1, arm=False)
    write_biotac(tmp_path / "mat10", 10, 3)
    (tmp_path / "mat10" / "mat10_3_jt.csv").unlink()
    (tmp_path / "mat10" / "mat10_4_cp.csv").write_text("of a slide whose finger is missing")
    (tmp_path / "mat10" / "mat10_3.pt").write_bytes(b"")
    sources = discover(Params(), tmp_path)
    assert {name: len(files) for name, files in sources.items()} == {"biotac-m02-t001": 1, "biotac-m10-t003": 6}
    assert list(sources["biotac-m02-t001"].values()) == [tmp_path / "a" / "mat2" / "mat2_1_bio.csv"]


def test_a_folder_without_slides_and_a_slide_that_is_there_twice_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TacpipeError, match="holds no slide: no file in it is named"):
        discover(Params(), tmp_path)
    with pytest.raises(TacpipeError, match="is not a folder"):
        discover(Params(), write_biotac(tmp_path / "a"))
    write_biotac(tmp_path / "b")
    with pytest.raises(TacpipeError, match="are the same slide"):
        discover(Params(), tmp_path)


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("bio", ",43,\n", ",70000,\n", "line 2, column ele19 holds 70000; it must be a whole number from 0 to 65535"),
        ("bio", ",43,\n", ",-1,\n", "line 2, column ele19 holds -1; it must be a whole number"),
        ("bio", ",43,\n", ",43\n", "line 2 has 45 cells instead of 46; it was cut short"),
        ("bio", ",86,87,\n", ",\n", "line 3 has 44 cells instead of 46; it was cut short"),
        (
            "bio",
            "654.010000001",
            "654.0100000015",
            "line 3, column timestamp holds '1581072654.0100000015', .*seconds",
        ),
        ("bio", "654.010000001", "653.010000001", "line 3: the timestamp is -990 ms after the one before"),
        ("bio", "1581072654.010000001", "-nan", "line 3, column timestamp holds '-nan', .*seconds since 1970"),
        (
            "jp",
            "654.006000003",
            "654.000000003",
            "line 3: the timestamp is 0 ms after the one before; it must be later",
        ),
        ("jp", ",0.125,", ",-nan,", "line 2, column pa2 holds nan; it must be a finite number"),
        ("cv", "-nan", "inf", "line 2, column a holds inf; it must be a finite number or NaN"),
        ("cw", "fz", "gz", "lacks the column fz"),
    ],
)
def test_a_fault_is_told_with_its_file_and_row(tmp_path: Path, name: str, old: str, new: str, message: str) -> None:
    write_biotac(tmp_path)
    edit(tmp_path / f"mat3_7_{name}.csv", old, new)
    with pytest.raises(TacpipeError, match=f"mat3_7_{name}.csv.*{message}"):
        read(tmp_path)


@pytest.mark.data
@pytest.mark.skipif(not (SAMPLE / "biotac_slide_20_50").is_dir(), reason="the published recordings are not here")
def test_the_published_slides_are_read_as_they_are_written() -> None:
    sources = discover(Params(), SAMPLE / "biotac_slide_20_50")
    assert len(sources) == 800
    with_arm = {name: files for name, files in sources.items() if len(files) > 1}
    assert {len(files) for files in with_arm.values()} == {7}
    for files in [*with_arm.values()][:3]:
        streams = biotac_slide(Params(), files).streams
        for path in files.values():
            lines = [line.rstrip(",").split(",") for line in path.read_text().split("\n")[1:] if line]
            (table,) = (stream for stream in streams.values() if _holds(stream, lines[0]))
            assert table.column("t_ns").to_pylist() == [int(Decimal(cells[0]) * 10**9) for cells in lines]
            np.testing.assert_array_equal(values(table), np.array([cells[1:] for cells in lines], dtype=np.float64))
        assert streams["biotac"].num_rows >= 599


def _holds(table: pa.Table, first: list[str]) -> bool:
    return bool(table.column("t_ns")[0].as_py() == int(Decimal(first[0]) * 10**9) and len(first) == table.num_columns)
