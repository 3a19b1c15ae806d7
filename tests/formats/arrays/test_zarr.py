"""Zarr stores, as zarr writes them: folders and zip files, format 2 and 3."""

import json
import shutil
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from zarr import open_group

import tacpipe
from tacpipe.errors import TacpipeError
from tacpipe.formats.arrays import container
from tacpipe.formats.table.contained import LayoutCommand, Params
from tacpipe.plugins import registry
from tacpipe.plugins.stage import RecordingOutput
from tests.conftest import Lab
from tests.conftest import tacpipe as in_a_process
from tests.formats.arrays import files

LAYOUT = '[streams.hand]\nsource = "data"\ntime = { rate_hz = 60 }'
ZARR = LayoutCommand("zarr")
zarr = registry.load("ingest.zarr")
INGEST = "ingest zarr stores --layout layout.toml -o data/rec"


def layout_params(text: str = LAYOUT, *, fill: bool = False) -> Params:
    params: Params = zarr.params(json.dumps(tomllib.loads(text)), fill_missing_chunks=fill)
    return params


def read(folder: Path, params: Params | None = None) -> dict[str, RecordingOutput]:
    params = params or layout_params()
    sources = ZARR.discover(params, folder)
    return {name: zarr(params, value.files, value.values) for name, value in sources.items()}


@pytest.mark.parametrize("zarr_format", [2, 3])
@pytest.mark.parametrize("name", ["replay.zarr", "replay.zarr.zip"])
@pytest.mark.filterwarnings("ignore:Duplicate name:UserWarning")  # zarr's own writer of zip files warns
def test_each_episode_of_a_replay_buffer_is_a_recording(tmp_path: Path, name: str, zarr_format: int) -> None:
    arrays = files.replay(tmp_path / name, zarr_format=zarr_format)
    result = read(tmp_path)
    assert list(result) == [f"replay-episode_00000{number}" for number in range(3)]
    for (start, stop), entry in zip([(0, 30), (30, 45), (45, 80)], result.values(), strict=True):
        table = entry.streams["hand"]
        assert table.column("robot0_eef_pos_z").to_pylist() == arrays["data/robot0_eef_pos"][start:stop, 2].tolist()
        assert (
            table.column("robot0_gripper_width").to_pylist()
            == arrays["data/robot0_gripper_width"][start:stop, 0].tolist()
        )
        assert table.column("t_ns").to_pylist()[:3] == [0, 16666667, 33333333]
    assert table.schema.field("robot0_gripper_width").metadata == {b"quantity": b"finger_width", b"unit": b"m"}


def test_a_rate_names_and_labels_that_the_store_states_count(tmp_path: Path) -> None:
    group = files.store(tmp_path / "a.zarr")
    group.create_array("data/tactile", data=np.arange(24, dtype=np.uint16).reshape(6, 4))
    group.create_array("data/short", data=np.zeros(3))
    group.create_array("meta/episode_ends", data=np.array([2, 6]))
    group.create_array("meta/score", data=np.array([0.5, 0.25]))
    group["meta"].attrs.update(rate_hz=10, recordings=["cup", "box"], labels={"box": {"material": "cork"}})
    result = read(tmp_path, layout_params(""))
    assert result["box"].streams["data"].column("t_ns").to_pylist() == [row * 10**8 for row in range(4)]
    assert result["box"].streams["data"].column("tactile_3").to_pylist() == [11, 15, 19, 23]
    assert result["box"].attributes["material"] == "cork" and result["box"].attributes["score"] == 0.25
    assert "material" not in result["cup"].attributes
    assert "data/short" in str(result["box"].attributes["skipped"])


def test_a_store_without_episodes_is_one_recording(tmp_path: Path) -> None:
    group = files.store(tmp_path / "run.zarr", 3)
    group.create_array("skin/t_ns", data=files.START_NS + np.arange(5) * 10**7)
    group.create_array("skin/force", data=files.values(5, 3))
    (result,) = read(tmp_path, layout_params("")).values()
    assert result.streams["skin"].column_names == ["t_ns", "force_x", "force_y", "force_z"]


def test_a_lost_chunk_is_not_read_as_zeros(tmp_path: Path) -> None:
    files.replay(tmp_path / "replay.zarr")
    (tmp_path / "replay.zarr" / "data" / "robot0_eef_pos" / "3.0").unlink()
    sources = ZARR.discover(layout_params(), tmp_path)
    first, last = sources["replay-episode_000000"], sources["replay-episode_000002"]
    assert zarr(layout_params(), first.files, first.values).streams["hand"].num_rows == 30
    with pytest.raises(TacpipeError, match=r"replay\.zarr lacks data/robot0_eef_pos/3\.0.*--fill-missing-chunks"):
        zarr(layout_params(), last.files, last.values)
    filled = (
        zarr(layout_params(fill=True), last.files, last.values).streams["hand"].column("robot0_eef_pos_x").to_pylist()
    )
    assert filled[15:] == [0.0] * 20 and 0.0 not in filled[:15]


@pytest.mark.filterwarnings("ignore:Duplicate name:UserWarning")
@pytest.mark.parametrize("part", [0.5, 0.0])
def test_a_zip_file_that_was_cut_is_one_sentence(tmp_path: Path, part: float) -> None:
    path = tmp_path / "replay.zarr.zip"
    files.replay(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * part)])
    with pytest.raises(TacpipeError, match=r"replay\.zarr\.zip is not a whole zip file"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("name", "content", "parts"),
    [
        ("data/robot0_eef_pos/0.0", b"\x02\x01", ("data/robot0_eef_pos", "rows 1 to 30")),
        ("data/robot0_eef_pos/.zarray", b"{", ("data/robot0_eef_pos/.zarray",)),
        ("meta/episode_ends/.zarray", b'{"shape": [3], "dtype": "<i8"}', ("meta/episode_ends", "chunks")),
        ("meta/episode_ends/.zarray", b'{"shape": [3, 1], "chunks": [3, 1], "dtype": "<i8"}', ("meta/episode_ends",)),
    ],
)
def test_damage_is_one_sentence_with_its_place(
    tmp_path: Path, name: str, content: bytes, parts: tuple[str, ...]
) -> None:
    files.replay(tmp_path / "replay.zarr")
    (tmp_path / "replay.zarr" / name).write_bytes(content)
    with pytest.raises(TacpipeError, match=r"replay\.zarr") as raised:
        read(tmp_path)
    assert all(part in str(raised.value) for part in parts)


def test_ends_that_do_not_rise_are_refused(tmp_path: Path) -> None:
    files.replay(tmp_path / "replay.zarr", ends=(30, 20, 80))
    with pytest.raises(TacpipeError, match=r"meta/episode_ends .*row 2 .*20.*30"):
        read(tmp_path)


def test_an_array_of_an_unknown_codec_keeps_no_other_from_being_read(tmp_path: Path) -> None:
    files.replay(tmp_path / "replay.zarr")
    place = tmp_path / "replay.zarr" / "data" / "camera0_rgb"
    place.mkdir()
    about: dict[str, Any] = {"zarr_format": 2, "shape": [80, 224, 224, 3], "chunks": [1, 224, 224, 3], "dtype": "|u1"}
    about |= {"compressor": {"id": "imagecodecs_jpegxl"}, "fill_value": 0, "order": "C", "filters": None}
    (place / ".zarray").write_text(json.dumps(about))
    assert read(tmp_path)["replay-episode_000001"].streams["hand"].num_rows == 15


@pytest.fixture
def stores(lab: Lab) -> Lab:
    """A project with a replay buffer of three episodes, in chunks of 20 rows."""
    (lab.folder / "stores").mkdir()
    files.replay(lab.folder / "stores" / "replay.zarr")
    (lab.folder / "layout.toml").write_text(LAYOUT)
    return lab


def counts(lab: Lab, options: str = "") -> tuple[int, int]:
    """Return how many recordings were read, and how many were in the store."""
    content = json.loads(lab.run(f"{INGEST} --json {options}").out)
    return content["ran"], content["reused"]


def test_a_changed_chunk_costs_the_recordings_that_lie_in_it(stores: Lab) -> None:
    assert counts(stores) == (3, 0)
    assert counts(stores) == (0, 3)
    shutil.rmtree(stores.folder / "stores")
    arrays = files.replay(stores.folder / "stores" / "replay.zarr")
    place = stores.folder / "stores" / "replay.zarr"
    changed = arrays["data/robot0_eef_pos"].copy()
    changed[79] = 1.0  # the chunk of rows 60 to 79 belongs only to the last recording
    files.store(place.parent / "other.zarr").create_array("x", data=changed, chunks=(20, 3))
    shutil.move(place.parent / "other.zarr" / "x" / "3.0", place / "data" / "robot0_eef_pos" / "3.0")
    shutil.rmtree(place.parent / "other.zarr")
    assert counts(stores, "--replace") == (1, 2)
    assert (
        tacpipe.open("data/rec")["replay-episode_000002"].table("hand").column("robot0_eef_pos_x").to_pylist()[-1]
        == 1.0
    )


@pytest.mark.parametrize(("ends", "cost"), [((30, 45, 80), (1, 3)), ((30, 45, 70), (2, 2))])
def test_an_episode_that_is_added_costs_itself_and_the_one_in_its_first_chunk(
    stores: Lab, ends: tuple[int, ...], cost: tuple[int, int]
) -> None:
    shutil.rmtree(stores.folder / "stores" / "replay.zarr")
    files.replay(stores.folder / "stores" / "replay.zarr", ends=ends)
    counts(stores)
    group: Any = open_group(str(stores.folder / "stores" / "replay.zarr"), mode="a")
    for name in ("data/robot0_eef_pos", "data/robot0_gripper_width"):
        array = group[name]
        array.append(np.ones((20, array.shape[1]), np.float32))
    group["meta/episode_ends"].append(np.array([ends[-1] + 20]))
    assert counts(stores, "--replace") == cost


@pytest.mark.long
def test_workers_leave_nothing_behind_that_python_complains_about(stores: Lab) -> None:
    process = in_a_process(stores.folder, f"{INGEST} --jobs 2")
    assert process.returncode == 0 and "Warning" not in process.stderr, process.stderr


def test_a_missing_chunk_ends_with_one_and_the_others_are_read_with_skip_bad(stores: Lab) -> None:
    (stores.folder / "stores" / "replay.zarr" / "data" / "robot0_eef_pos" / "0.0").unlink()
    refused = stores.call(INGEST)
    assert refused.code == 1 and "data/robot0_eef_pos/0.0" in refused.err and "replay-episode_000000" in refused.err
    assert counts(stores, "--skip-bad") == (0, 2)


def test_an_episode_of_many_blocks_has_the_rows_of_one_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files.replay(tmp_path / "replay.zarr")
    expected = {name: value.streams["hand"] for name, value in read(tmp_path).items()}
    monkeypatch.setattr(container, "BLOCK_BYTES", 200)
    for name, entry in read(tmp_path).items():
        streams = entry.streams["hand"]
        assert isinstance(streams, pa.RecordBatchReader)
        assert streams.read_all().equals(expected[name], check_metadata=True)
