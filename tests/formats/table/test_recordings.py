from pathlib import Path

import pytest

from tacpipe.errors import UsageError
from tacpipe.formats.table import recordings
from tests.formats.table import labs

SKIN = 'columns = [{ match = "x" }]\ntime = { column = "time" }'


def write_files(folder: Path, *paths: str) -> Path:
    """Write files of a row each."""
    for path in paths:
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text("time,x,trial\n0,1,a\n1,2,b\n")
    return folder


def two(skin: str, arm: str, more_toml: str = "", arm_toml: str = "") -> str:
    return f'[streams.skin]\nfiles = "{skin}"\n{SKIN}\n[streams.arm]\nfiles = "{arm}"\n{SKIN}\n{arm_toml}\n{more_toml}'


def find_sources(text: str, folder: Path) -> dict[str, dict[str, str]]:
    from tacpipe.formats.table import layout

    return {
        source.name: {stream: path.relative_to(folder).as_posix() for stream, path in source.files.items()}
        for source in recordings.find_recordings(layout.parse_layout(text), folder)
    }


def test_files_with_the_same_placeholders_are_one_recording(tmp_path: Path) -> None:
    write_files(tmp_path, "s1/t1/skin.csv", "s1/t1/arm.csv", "s1/t2/skin.csv", "s1/t2/arm.csv", "s1/notes.txt")
    assert find_sources(two("{subject}/{trial}/skin.csv", "{subject}/{trial}/arm.csv"), tmp_path) == {
        f"s1-t{trial}": {"skin": f"s1/t{trial}/skin.csv", "arm": f"s1/t{trial}/arm.csv"} for trial in (1, 2)
    }


def test_a_layout_names_recordings(tmp_path: Path) -> None:
    write_files(tmp_path, "skin_07.csv", "arm_07.csv")
    text = two("skin_{trial}.csv", "arm_{trial}.csv", '[recordings]\nname = "cup-{trial}"')
    assert list(find_sources(text, tmp_path)) == ["cup-07"]


def test_one_file_holds_many_recordings(tmp_path: Path) -> None:
    write_files(tmp_path, "all.csv")
    layout = labs.skin_layout('recording = "trial"', '{ match = "x" }', "all.csv")
    assert [(source.name, source.episode) for source in recordings.find_recordings(layout, tmp_path)] == [
        ("a", "a"),
        ("b", "b"),
    ]


WRONG = {  # files; the layout; what the sentence must name
    "nothing matches": (
        ("a.csv",),
        two("skin_{trial}.csv", "arm_{trial}.csv"),
        ("skin_{trial}.csv", "1 files", "a.csv"),
    ),
    "a stream is missing": (
        ("skin_1.csv", "arm_1.csv", "skin_2.csv"),
        two("skin_{trial}.csv", "arm_{trial}.csv"),
        ("skin_2.csv", "arm", "optional"),
    ),
    "two files of a stream": (
        ("a/skin_1.csv", "b/skin_1.csv", "arm_1.csv"),
        two("*/skin_{trial}.csv", "arm_{trial}.csv"),
        ("a/skin_1.csv", "b/skin_1.csv", "placeholder"),
    ),
    "names that differ in case": (
        ("skin_a.csv", "arm_a.csv", "skin_A.csv", "arm_A.csv"),
        two("skin_{trial}.csv", "arm_{trial}.csv"),
        ("differ only in case",),
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_files_that_do_not_fit_the_layout_are_refused(tmp_path: Path, case: str) -> None:
    paths, text, parts = WRONG[case]
    with pytest.raises(UsageError) as error:
        find_sources(text, write_files(tmp_path, *paths))
    assert all(part in str(error.value) for part in parts), str(error.value)


def test_a_recording_without_an_optional_stream_is_read(tmp_path: Path) -> None:
    write_files(tmp_path, "skin_1.csv", "arm_1.csv", "skin_2.csv")
    text = two("skin_{trial}.csv", "arm_{trial}.csv", arm_toml="optional = true")
    assert [sorted(files) for files in find_sources(text, tmp_path).values()] == [["arm", "skin"], ["skin"]]
