from pathlib import Path

import pytest

from tacpipe.errors import TacpipeError
from tacpipe.formats.table import labels, recordings
from tests.formats.table import labs


def read_labels(folder: Path, more_toml: str) -> dict[str, dict[str, object]]:
    layout = labs.skin_layout(more_toml=more_toml)
    return {
        name: dict(values)
        for name, values in labels.find_labels(layout, folder, recordings.find_recordings(layout, folder)).items()
    }


def test_a_table_labels_each_recording_by_its_row(tmp_path: Path) -> None:
    labs.write(tmp_path, 2)
    (tmp_path / "labels.csv").write_text("trial,material,force\n1,cork,2.5\n0,felt,1\n")
    assert read_labels(tmp_path, '[[labels]]\nfile = "labels.csv"\nkey = "trial"') == {
        "trial_0": {"trial": 0, "material": "felt", "force": 1},
        "trial_1": {"trial": 1, "material": "cork", "force": 2.5},
    }


def test_a_yaml_file_labels_its_recording_over_what_all_share(tmp_path: Path) -> None:
    labs.write(tmp_path, 1)
    (tmp_path / "trial_0" / "meta.yaml").write_text(
        "material: cork\nsensor: {name: mine, serial: 7}\nwhen: 2024-05-01\n"
    )
    remaining = '[[labels]]\nfile = "trial_{trial}/meta.yaml"\n[attributes]\nmaterial = "unknown"\nlab = "ours"'
    assert read_labels(tmp_path, remaining)["trial_0"] == {
        "trial": 0,
        "lab": "ours",
        "material": "cork",
        "sensor.name": "mine",
        "sensor.serial": 7,
        "when": "2024-05-01",
    }


def test_a_table_of_one_row_labels_its_recording(tmp_path: Path) -> None:
    labs.write(tmp_path, 1)
    (tmp_path / "trial_0" / "meta.csv").write_text("object,seen\ncup,true\n")
    remaining = '[[labels]]\nfile = "trial_{trial}/meta.csv"\ncolumns = ["object"]'
    assert read_labels(tmp_path, remaining)["trial_0"] == {"trial": 0, "object": "cup"}


WRONG = {  # the file; what the sentence must name
    "trial,material\n0,cork\n": ("trial_1", "no row"),
    "trial,material\n0,cork\n1,felt\n1,foam\n": ("line 4", "1"),
    "trial,material\n0,cork\n1\n": ("line 3", "1 cells"),
    "name,material\n0,cork\n": ("trial", "name"),
}


@pytest.mark.parametrize("content", WRONG)
def test_a_wrong_table_of_labels_is_one_sentence_with_its_place(tmp_path: Path, content: str) -> None:
    labs.write(tmp_path, 2)
    (tmp_path / "labels.csv").write_text(content)
    with pytest.raises(TacpipeError) as error:
        read_labels(tmp_path, '[[labels]]\nfile = "labels.csv"\nkey = "trial"')
    assert all(part in str(error.value) for part in ("labels.csv", *WRONG[content])), str(error.value)


@pytest.mark.parametrize(
    "text",
    [
        "trial_0: {material: felt}\ntrial_1: {material: cork}\n",
        "trial-0: {material: felt}\ntrial-1: {material: cork}\n",
    ],
    ids=["folders", "joined"],
)
def test_one_yaml_file_labels_all_recordings_by_their_names_or_those_of_their_folders(
    tmp_path: Path, text: str
) -> None:
    labs.write(tmp_path, 2)
    (tmp_path / "labels.yaml").write_text(text)
    output = read_labels(tmp_path, '[[labels]]\nfile = "labels.yaml"')
    assert {name: value["material"] for name, value in output.items()} == {"trial_0": "felt", "trial_1": "cork"}


def test_a_table_may_name_recordings_by_their_folders(tmp_path: Path) -> None:
    labs.write(tmp_path, 2)
    (tmp_path / "labels.csv").write_text("folder,material\ntrial_1,cork\ntrial_0,felt\n")
    output = read_labels(tmp_path, '[[labels]]\nfile = "labels.csv"\nkey = "folder"')
    assert {name: value["material"] for name, value in output.items()} == {"trial_0": "felt", "trial_1": "cork"}


def test_a_yaml_file_of_all_without_a_recordings_entry_is_refused(tmp_path: Path) -> None:
    labs.write(tmp_path, 2)
    (tmp_path / "labels.yaml").write_text("trial_0: {material: felt}\n")
    with pytest.raises(TacpipeError, match=r"labels\.yaml has no row for the recording trial_1"):
        read_labels(tmp_path, '[[labels]]\nfile = "labels.yaml"')
    (tmp_path / "labels.yaml").write_text("material: felt\n")
    with pytest.raises(TacpipeError, match=r"labels\.yaml, material is 'felt'"):
        read_labels(tmp_path, '[[labels]]\nfile = "labels.yaml"')
