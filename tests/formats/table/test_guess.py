import time
from pathlib import Path, PurePath

import numpy as np
import pandas as pd
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tacpipe.errors import UsageError
from tacpipe.formats.table import column_names, file_sample, guess, labels, layout, pattern, recordings
from tests.formats.table import labs


def answered(text: str, **answers: str) -> layout.Layout:
    """Return a guessed layout in which what it could not know is replaced, in order."""
    for expected, answer in answers.items():
        text = text.replace(f'{expected} = "?"', f'{expected} = "{answer}"')
    return layout.parse_layout(text)


def test_a_guess_with_its_questions_answered_reads_what_pandas_wrote(tmp_path: Path) -> None:
    frames = labs.write(tmp_path, sep=";", decimal=",")
    text = guess.guess_layout(tmp_path)
    result = answered(text, unit="N", sensor="mine")
    assert result.streams[0].separator == ";" and result.streams[0].decimal == ","
    for entry, frame in zip(recordings.find_recordings(result, tmp_path), frames, strict=True):
        table = labs.read_stream_table(entry.files["skin"], result.streams[0])
        assert np.array_equal(table.column("fx").to_numpy(), frame["fx"].to_numpy())
        assert table.column("taxel3").to_pylist() == frame["taxel3"].tolist()
        assert abs(table.column("t_ns")[0].as_py() - labs.START_S * 10**9) == 0


def test_what_a_file_cannot_say_is_refused_until_somebody_writes_it(tmp_path: Path) -> None:
    labs.write(tmp_path, 1)
    with pytest.raises(UsageError, match="unit is"):
        layout.parse_layout(guess.guess_layout(tmp_path))


@pytest.mark.parametrize(
    ("stamps", "unit"),
    [
        (1.7e9 + np.arange(5) / 100, "s"),
        (1.7e12 + np.arange(5) * 10, "ms"),
        (1.7e15 + np.arange(5) * 10_000, "us"),
        (1_700_000_000_000_000_000 + np.arange(5) * 10_000_000, "ns"),
        (["2024-05-01T12:00:00.1", "2024-05-01T12:00:00.2"], "iso8601"),
    ],
)
def test_the_unit_of_stamps_is_found_by_their_size(tmp_path: Path, stamps: object, unit: str) -> None:
    pd.DataFrame({"stamp": stamps}).assign(taxel1=1).to_csv(tmp_path / "skin_1.csv", index=False)
    assert f'column = "stamp", unit = "{unit}" }}' in guess.guess_layout(tmp_path)


def test_stamps_that_count_from_a_start_have_a_unit_only_if_their_name_says_it(tmp_path: Path) -> None:
    pd.DataFrame({"time_ms": [0, 10, 20], "taxel1": 1}).to_csv(tmp_path / "skin_1.csv", index=False)
    assert 'unit = "ms", origin = "start"' in guess.guess_layout(tmp_path)
    pd.DataFrame({"time": [0, 10, 20], "taxel1": 1}).to_csv(tmp_path / "skin_1.csv", index=False)
    assert 'unit = "?", origin = "start"' in guess.guess_layout(tmp_path)


def test_tables_and_files_of_labels_are_found(tmp_path: Path) -> None:
    labs.write(tmp_path, 2)
    pd.DataFrame({"trial": [0, 1], "material": ["cork", "felt"]}).to_csv(tmp_path / "labels.csv", index=False)
    for trial in range(2):
        (tmp_path / f"trial_{trial}" / "meta.yaml").write_text("object: cup\n")
    result = answered(guess.guess_layout(tmp_path), unit="N", sensor="mine")
    sources = labels.find_labels(result, tmp_path, recordings.find_recordings(result, tmp_path))
    assert sources["trial_1"] == {"sensor": "mine", "trial": 1, "material": "felt", "object": "cup"}


def test_two_sensors_of_a_trial_are_two_streams(tmp_path: Path) -> None:
    for trial in range(3):
        for sensor in (1, 2):
            (tmp_path / f"t{trial}").mkdir(exist_ok=True)
            labs.frame().to_csv(tmp_path / f"t{trial}" / f"skin{sensor}.csv", index=False)
    result = answered(guess.guess_layout(tmp_path), unit="N", sensor="mine")
    assert [(stream.name, stream.files) for stream in result.streams] == [
        ("skin1", "t{trial}/skin1.csv"),
        ("skin2", "t{trial}/skin2.csv"),
    ]


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("header", [True, False])
def test_how_a_file_is_written_is_found_from_its_lines(separator: str, header: bool) -> None:
    rows = [[f"{row / 100:.2f}", str(row), "1.5"] for row in range(5)]
    lines = [separator.join(row) for row in ([["t", "a", "b"]] if header else []) + rows]
    result = file_sample.detect_dialect(lines)
    assert (result.separator, result.header, len(result.rows)) == (separator, header, 5)


def test_whole_numbers_that_are_written_as_decimal_ones_are_floats(tmp_path: Path) -> None:
    (tmp_path / "skin_1.csv").write_text("time,force_x_n,taxel1\n1700000000,3.0,3\n1700000001,4.0,4\n")
    printed = guess.guess_layout(tmp_path)
    assert 'match = "force_x_n", quantity = "force", unit = "N", type = "float64"' in printed
    assert 'unit = "count", type = "uint16"' in printed


def test_a_folder_without_tables_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.md").write_text("nothing")
    with pytest.raises(UsageError, match=r"\.csv"):
        guess.guess_layout(tmp_path)


def columns_of(folder: Path, frame: pd.DataFrame) -> dict[str, str]:
    """Return the rules that are guessed for the columns of a table, by what they match."""
    frame.to_csv(folder / "skin_1.csv", index=False)
    lines = [line.strip() for line in guess.guess_layout(folder).splitlines()]
    return {line.split('"')[1]: line for line in lines if line.startswith("{ match")}


def test_numbered_columns_that_are_or_may_be_taxels_state_which(tmp_path: Path) -> None:
    counts = {f"{name}{n}": [n, 3, 4] for name in ("pad", "t") for n in range(3)}
    joints = {f"q{n}": [0.5, 0.25, n / 8] for n in range(3)}
    result = columns_of(tmp_path, pd.DataFrame({"time": [1.7e9, 1.7e9 + 1, 1.7e9 + 2], **counts, **joints}))
    assert 'quantity = "tactile"' in result["pad{taxel}"] and 'quantity = "?"' in result["t{taxel}"]
    assert 'quantity = "joint_position"' in result["q{number}"]


def test_axes_of_taxels_are_one_rule_and_lengths_called_x_y_z_are_a_position(tmp_path: Path) -> None:
    cells = {f"taxel {n} {axis} [counts]": [1, 2] for n in (1, 2) for axis in "xyz"}
    place = {f"{axis} [mm]": [0.5, 0.25] for axis in "xyz"}
    result = columns_of(tmp_path, pd.DataFrame({"time": [1.7e9, 1.7e9 + 1], **cells, **place}))
    assert set(result) == {"taxel {taxel} {axis} [counts]", "x [mm]", "y [mm]", "z [mm]"}
    assert 'name = "taxel_{taxel}_{axis}", quantity = "tactile"' in result["taxel {taxel} {axis} [counts]"]
    assert all('quantity = "position", unit = "mm"' in result[f"{axis} [mm]"] for axis in "xyz")


def test_a_place_beside_a_quaternion_is_a_position_and_one_alone_is_asked_for(tmp_path: Path) -> None:
    place, turned = (dict.fromkeys(names, (0.5, 0.25)) for names in ("xyz", ("qx", "qy", "qz", "qw")))
    time = {"time": [1.7e9, 1.7e9 + 1]}
    position_only = columns_of(tmp_path, pd.DataFrame({**time, **place}))
    with_quaternion = columns_of(tmp_path, pd.DataFrame({**time, **place, **turned}))
    for part in "xyz":
        assert 'quantity = "?"' in position_only[part]
        assert 'quantity = "position", unit = "?"' in with_quaternion[part]


def test_a_guess_lists_quantities_and_units_to_choose_from(tmp_path: Path) -> None:
    labs.write(tmp_path, 1)
    head = guess.guess_layout(tmp_path).partition("[streams")[0]
    assert all(line.startswith("#") for line in head.splitlines() if line)
    for word in ("tactile", "position", "orientation", "count", "kPa", "--requirements", "{taxel}"):
        assert word in head


@pytest.mark.parametrize(
    ("paths", "later"),
    [
        (["2026-05-01 cork/run 1/skin.csv", "2026-05-02 felt/run 1/skin.csv"], "2026-06-11 tile/run 2/skin.csv"),
        (["2026-05-01/trial_1/skin.csv"], "2026-06-02/trial_12/skin.csv"),
        (["20260501_1430/skin.csv", "20260501_1502/skin.csv"], "20270101_0900/skin.csv"),
        (["object1_trial1.csv", "object1_trial2.csv"], "object12_trial3.csv"),
        (["day1/t1/skin.csv", "day1/t2/skin.csv"], "day2/t1/skin.csv"),
    ],
)
def test_a_guessed_pattern_matches_the_files_of_a_later_day(tmp_path: Path, paths: list[str], later: str) -> None:
    for path in paths:
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        labs.frame().to_csv(tmp_path / path, index=False)
    (stream,) = answered(guess.guess_layout(tmp_path), unit="N", sensor="mine").streams
    assert all(pattern.match(stream.files, path) is not None for path in [*paths, later])
    assert pattern.match(stream.files, later.replace("skin", "arm").replace("trial", "arm")) is None


@given(st.lists(st.from_regex(r"[a-c]{0,2}[0-9]{0,3}[-_ ]?[a-c0-9]{1,3}", fullmatch=True), min_size=1, unique=True))
@example(["0a", "a"])
@example(["ab", "abc"])
def test_a_generalized_pattern_matches_the_paths_that_it_is_from(names: list[str]) -> None:
    paths = [PurePath(name) for name in names]
    text = pattern.generalize(paths)
    assert all(pattern.match(text, name) is not None for name in names)


def test_a_guess_names_every_file_that_it_does_not_read_and_why(tmp_path: Path) -> None:
    labs.write(tmp_path, 2)
    (tmp_path / "trial_0" / "camera.mp4").write_bytes(b"video")
    (tmp_path / "trial_0" / "notes.docx").write_bytes(b"notes")
    (tmp_path / "trial_0" / "bag.mcap").write_bytes(b"bag")
    (tmp_path / "trial_1" / "broken.parquet").write_bytes(b"no table")
    (tmp_path / "rig" / "deep" / "down").mkdir(parents=True)
    (tmp_path / "rig" / "deep" / "down" / "calibration.yaml").write_text("gain: 2\n")
    comments = [
        line for line in guess.guess_layout(tmp_path).splitlines() if line.startswith("#") and "not read" in line
    ]
    for path, reason in (
        ("trial_0/camera.mp4", "cannot be read as a video"),
        ("trial_0/notes.docx", "*.csv"),
        ("trial_0/bag.mcap", "tacpipe ingest mcap"),
        ("trial_1/broken.parquet", "is not a Parquet file"),
        ("rig/deep/down/calibration.yaml", "labels"),
    ):
        assert [line for line in comments if path in line and reason in line], comments
    assert not any("skin.csv" in line for line in comments)


@pytest.mark.parametrize("letter", [*" [(_a)1", "a_", "_pad", "vel_", "a1"])
def test_a_name_of_any_length_is_read_in_linear_time(tmp_path: Path, letter: str) -> None:
    (tmp_path / "1.csv").write_text(f"t,a{letter * 60_000}x\n0,1\n1,2\n")
    with pytest.raises(
        UsageError, match=r"1\.csv: the name of column 2 has [\d,]+ characters|1\.csv is not a table: field larger"
    ):
        guess.guess_layout(tmp_path)
    started = time.process_time()
    for ending in ("x", "{", "-"):
        text = f"a{letter * 60_000}{ending}"
        column_names.without_unit(text)
        column_names.meaning(text, "float64")
        column_names.meanings(text, 3)
        column_names.component(text)
    column_names.numbered_pattern(letter * 1000)
    assert time.process_time() - started < 20


def test_the_unit_in_a_name_is_the_last_text_in_brackets() -> None:
    pairs = {"Fx [N]": ("Fx", "N"), "t (ms)": ("t", "ms"), "a (b) [c": ("", ""), "[N]": ("", "N"), "a [(N)]": ("", "")}
    assert {name: column_names.split_unit(name) for name in pairs} == pairs


@pytest.mark.parametrize("is_archive", [True, False])
def test_an_image_of_floats_is_no_table_of_columns(tmp_path: Path, is_archive: bool) -> None:
    images = np.zeros((50, 240, 320, 3), np.float32)
    if is_archive:
        np.savez(tmp_path / "1.npz", image=images, t=np.arange(50) / 30, force=np.arange(50.0) % 7)
        text = guess.guess_layout(tmp_path)
        assert '{ match = "image*", skip = true }' in text and "time_axis" not in text
        assert 'match = "force"' in text and len(text) < 3000
    else:
        np.save(tmp_path / "1.npy", images)
        with pytest.raises(UsageError, match="240 x 320 x 3 values"):
            guess.guess_layout(tmp_path)
