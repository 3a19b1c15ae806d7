"""LeRobot datasets, version 2.1 and 3.0."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import tacpipe
from tacpipe.channels import schema
from tacpipe.errors import TacpipeError
from tacpipe.formats.table.contained import LayoutCommand
from tacpipe.io.parquet import to_parquet
from tacpipe.plugins import registry
from tacpipe.plugins.stage import RecordingOutput
from tacpipe.video import stream
from tests.conftest import Lab
from tests.formats.builders import about, layout_params
from tests.formats.lerobot import files
from tests.video import videos

LEROBOT = LayoutCommand("lerobot")
lerobot = registry.load("ingest.lerobot")
EPISODE = "pick-episode_00000{}"


def read(folder: Path, layout: str = "") -> dict[str, RecordingOutput]:
    params = lerobot.params(layout_params(layout).layout if layout else "")
    return {
        name: lerobot(params, value.files, value.values) for name, value in LEROBOT.discover(params, folder).items()
    }


@pytest.mark.parametrize("write", [files.write_v2, files.write_v3])
def test_both_versions_give_the_same_recordings(tmp_path: Path, write: Callable[[Path], None]) -> None:
    write(tmp_path / "pick")
    result = read(tmp_path)
    assert list(result) == [EPISODE.format(episode) for episode in range(3)]
    for episode, entry in enumerate(result.values()):
        assert set(entry.streams) == {"state", "action", "pad", "next"}
        table = entry.streams["state"]
        assert table.column_names == ["t_ns", *files.NAMES]
        assert table.column("joint3_rad").to_pylist() == files.state(episode)[:, 2].tolist()
        assert table.column("t_ns").to_pylist() == [round(row * 10**9 / files.FPS) for row in range(table.num_rows)]
        assert about(table, "t_ns")["made"] == "frame_index / fps"
        assert entry.streams["pad"].column("pad_3").to_pylist()[:2] == [3, 7]
        assert entry.streams["next"].column("done").to_pylist()[-1] is True
        assert entry.attributes["task"] == files.TASKS[episode % 2]
        assert entry.attributes["robot_type"] == "so100"


@pytest.mark.parametrize(
    ("write", "path"),
    [
        (files.write_v2, "videos/chunk-000/observation.images.top/episode_000001.mp4"),
        (files.write_v3, "videos/observation.images.top/chunk-000/file-004.mp4"),
    ],
)
def test_a_video_that_does_not_exist_is_named_with_its_path(
    tmp_path: Path, write: Callable[[Path], None], path: str
) -> None:
    write(tmp_path / "pick")
    result = read(tmp_path)[EPISODE.format(1)]
    assert result.attributes["video.observation.images.top"] == path
    assert path in " ".join(result.notes)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_frames_of_an_episode_are_those_of_its_part_of_the_video(tmp_path: Path, version: str) -> None:
    root, lengths = tmp_path / "pick", files.LENGTHS
    starts = [0, 0, 0] if version == "v2.1" else [0, lengths[0], lengths[0] + lengths[1]]
    (files.write_v2 if version == "v2.1" else files.write_v3)(root)
    folder = (
        root
        / "videos"
        / ("chunk-000/observation.images.top" if version == "v2.1" else "observation.images.top/chunk-000")
    )
    folder.mkdir(parents=True)
    if version == "v2.1":
        paths = [folder / f"episode_{episode:06d}.mp4" for episode in range(3)]
        for path, length in zip(paths, lengths, strict=True):
            videos.write(path, "libx264", length)
    else:
        paths = [videos.write(folder / "file-004.mp4", "mjpeg", sum(lengths))] * 3
    for episode, (path, start) in enumerate(zip(paths, starts, strict=True)):
        result = read(tmp_path)[EPISODE.format(episode)]
        table = result.streams["top"].read_all()
        assert sorted(table["packet"].to_pylist()) == sorted(videos.packets(path)[start : start + lengths[episode]])
        video_format = stream.read_format(table)
        assert video_format is not None
        images = videos.sound_images(video_format, [table])
        expected = videos.decoded(path)[start : start + lengths[episode]]
        assert all(np.array_equal(images[row], image) for row, image in enumerate(expected))
        assert table["t_ns"].to_pylist() == result.streams["state"]["t_ns"].to_pylist()


def test_an_episode_that_cannot_be_cut_out_and_a_video_that_is_too_short_are_one_sentence(tmp_path: Path) -> None:
    files.write_v3(tmp_path / "pick")
    folder = tmp_path / "pick/videos/observation.images.top/chunk-000"
    folder.mkdir(parents=True)
    videos.write(folder / "file-004.mp4", "mpeg4", sum(files.LENGTHS))
    with pytest.raises(TacpipeError, match="cannot be cut out at key frames"):
        read(tmp_path)
    videos.write(folder / "file-004.mp4", "mjpeg", files.LENGTHS[0] + 3)
    with pytest.raises(TacpipeError, match="has 15 frames"):
        read(tmp_path)


def test_quantities_and_units_follow_the_names(tmp_path: Path) -> None:
    files.write_v3(tmp_path / "pick")
    result = read(tmp_path)[EPISODE.format(0)]
    assert about(result.streams["state"], "joint6_rad") == {"quantity": "joint_position", "unit": "rad"}
    assert about(result.streams["state"], "gripper") == {}
    assert about(result.streams["pad"], "pad_0") == {"quantity": "tactile", "unit": "count"}


def test_stamps_that_the_rate_does_not_give_are_read_as_they_are(tmp_path: Path) -> None:
    files.write_v2(tmp_path / "pick", episodes=1)
    pq.write_table(files.frames(0, late_s=0.5), tmp_path / "pick" / "data" / "chunk-000" / "episode_000000.parquet")
    (result,) = read(tmp_path).values()
    table = result.streams["state"]
    stamp = files.frames(0, late_s=0.5).column("timestamp")[-1].as_py()
    assert table.column("t_ns").to_pylist()[-1] == round(stamp * 1e9)
    assert "float32" in about(table, "t_ns")["made"]


def test_a_rate_that_is_not_that_of_the_timestamps_is_a_note_with_both(tmp_path: Path) -> None:
    files.write_v2(tmp_path / "pick")
    path = tmp_path / "pick" / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"fps": files.FPS / 2}))
    notes = {note for result in read(tmp_path).values() for note in result.notes if "fps" in note}
    assert len(notes) == 1  # a command prints it once for all episodes
    assert f"{files.FPS / 2:g} fps" in min(notes) and f"{files.FPS} Hz" in min(notes)


@pytest.mark.parametrize(
    ("key", "entry", "part"),
    [
        (
            "observation.state",
            [0.0, None, *[0.0] * (len(files.NAMES) - 2)],
            "frame 2, value 1, of observation.state is null",
        ),
        ("observation.state", None, "frame 2 of observation.state is null"),
        ("observation.state", [1.0], "frame 2 of observation.state .* has 1 values, and meta/info.json states"),
        ("next.reward", None, "frame 2 of next.reward is null"),
        ("timestamp", None, "frame 2 of timestamp is null"),
        ("frame_index", None, "frame 2 of frame_index is null"),
        ("episode_index", None, "episode_index of 1 rows is null"),
    ],
)
def test_a_null_is_named_with_its_frame_and_value(tmp_path: Path, key: str, entry: Any, part: str) -> None:
    files.write_v2(tmp_path / "pick", episodes=1)
    path = tmp_path / "pick" / "data" / "chunk-000" / "episode_000000.parquet"
    table = pq.read_table(path)
    values = table.column(key).to_pylist()
    values[2] = entry
    kind = table.schema.field(key).type
    kind = pa.list_(kind.value_type) if pa.types.is_fixed_size_list(kind) else kind
    pq.write_table(table.set_column(table.column_names.index(key), key, pa.array(values, kind)), path)
    with pytest.raises(TacpipeError, match=part):
        read(tmp_path)


def test_frames_of_hours_keep_the_rate_although_float32_seconds_do_not(tmp_path: Path) -> None:
    files.write_v2(tmp_path / "pick", episodes=1)
    path = tmp_path / "pick" / "data" / "chunk-000" / "episode_000000.parquet"
    table, frame = files.frames(0), pa.array(range(400_000, 400_012))
    seconds = pa.compute.divide(pa.compute.cast(frame, pa.float64()), float(files.FPS)).cast(pa.float32(), safe=False)
    table = table.set_column(table.column_names.index("frame_index"), "frame_index", frame)
    pq.write_table(table.set_column(table.column_names.index("timestamp"), "timestamp", seconds), path)
    (result,) = read(tmp_path).values()
    assert result.streams["state"].column("t_ns").to_pylist()[1] == round(400_001 * 10**9 / files.FPS)


def test_images_in_the_frames_are_kept_as_they_were_encoded(tmp_path: Path) -> None:
    files.write_v2(
        tmp_path / "pick",
        episodes=1,
        features={**files.FEATURES, "observation.images.top": {"dtype": "image", "shape": [3, 4, 4]}},
    )
    pictures = [b"\x89PNG%d" % row for row in range(files.LENGTHS[0])]
    structs = pa.array([{"bytes": value, "path": f"{row}.png"} for row, value in enumerate(pictures)])
    table = files.frames(0).append_column("observation.images.top", structs)
    pq.write_table(table, tmp_path / "pick" / "data" / "chunk-000" / "episode_000000.parquet")
    (result,) = read(tmp_path).values()
    assert result.streams["top"].column("data").to_pylist() == pictures


def test_a_layout_renames_and_adds_what_the_dataset_does_not_state(tmp_path: Path) -> None:
    files.write_v3(tmp_path / "pick")
    text = '[recordings]\nname = "{recording}"\n[streams.robot]\nsource = "action"\ncolumns = [\n'
    text += '{ match = "action_{n}", name = "joint{n}_target_rad", quantity = "target_joint_position", unit = "rad" }]'
    result = read(tmp_path, text)
    assert set(result) == {"episode_000000", "episode_000001", "episode_000002"}
    table = result["episode_000002"].streams["robot"]
    assert about(table, "joint6_target_rad")["quantity"] == "target_joint_position"


def _originals(root: Path) -> dict[str, pa.Table]:
    """Add what tacpipe's own export adds: names, attributes and the streams that the frames were made of."""
    rows = pq.read_table(root / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    names = pa.array(["cup", "box", "can"])
    attributes = pa.array(
        [json.dumps({"material": name, "trial": at}) for at, name in enumerate(["cork", None, "foam"])]
    )
    rows = rows.append_column("tacpipe/recording", names).append_column("tacpipe/attributes", attributes)
    pq.write_table(rows, root / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    angles, _ = schema.joint_fields()
    fields = [*schema.uskin_fields(), *angles, pa.field("mode", pa.string()), pa.field("on", pa.bool_())]
    rng = np.random.default_rng(3)
    columns = [
        *rng.integers(0, 60000, (48, 200)),
        *rng.normal(size=(7, 200)),
        np.array(["a"] * 200),
        np.arange(200) % 2,
    ]
    columns[50][7] = np.nan
    t_ns = 1_700_000_000_000_000_000 + np.cumsum(rng.integers(0, 9_000_000, 200))
    arrays = [pa.array(t_ns), *(pa.array(value).cast(field.type) for value, field in zip(columns, fields, strict=True))]
    table = pa.table(arrays, pa.schema([schema.time_field("from mean rate"), *fields]))
    for name in names.to_pylist():
        (root / "tacpipe" / name).mkdir(parents=True)
        (root / "tacpipe" / name / "xela1.parquet").write_bytes(to_parquet(table))
    return {"xela1": table}


def test_a_dataset_that_was_exported_gives_the_recordings_back_to_the_bit(tmp_path: Path) -> None:
    files.write_v3(tmp_path / "pick")
    streams = _originals(tmp_path / "pick")
    result = read(tmp_path)
    assert set(result) == {"cup", "box", "can"}
    assert result["box"].attributes == {"material": None, "trial": 1}
    assert to_parquet(result["cup"].streams["xela1"]) == to_parquet(streams["xela1"])


@pytest.mark.parametrize(
    ("damage", "parts"),
    [
        (lambda root: _cut(root / "data/chunk-000/episode_000001.parquet"), ("episode_000001.parquet",)),
        (
            lambda root: (root / "data/chunk-000/episode_000001.parquet").unlink(),
            ("episode_000001.parquet", "not there"),
        ),
        (lambda root: _shorten(root / "data/chunk-000/episode_000001.parquet"), ("episode_000001.parquet", "6", "7")),
    ],
)
def test_a_damaged_file_costs_its_own_episode(
    tmp_path: Path, damage: Callable[[Path], object], parts: tuple[str, ...]
) -> None:
    files.write_v2(tmp_path / "pick")
    damage(tmp_path / "pick")
    sources = LEROBOT.discover(lerobot.params(), tmp_path)
    assert len(sources) == 3
    for name, entry in sources.items():
        if name != EPISODE.format(1):
            assert lerobot(lerobot.params(), entry.files, entry.values).streams
            continue
        with pytest.raises(TacpipeError) as raised:
            lerobot(lerobot.params(), entry.files, entry.values)
        assert all(part in str(raised.value) for part in parts)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def _shorten(path: Path) -> None:
    pq.write_table(pq.read_table(path).slice(0, 6), path)


@pytest.mark.parametrize(
    ("info", "parts"),
    [
        ({"codebase_version": "v1.6"}, ("codebase_version", "v1.6", "v2.1")),
        ({"fps": 0}, ("fps", "0")),
        ({"chunks_size": 0.5}, ("chunks_size", "0.5")),
        ({"chunks_size": "abc"}, ("chunks_size", "abc")),
        ({"features": {"action": [7]}}, ("action", "shape")),
        ({"features": {"action": {"dtype": "float32", "shape": [-1]}}}, ("action", "[-1]")),
        ({"features": {"action": {"dtype": "float32", "shape": [2**62, 2**62]}}}, ("action", "2,147,483,647")),
        ({"data_path": "data/{episode}"}, ("data_path", "episode_index")),
    ],
)
def test_a_wrong_description_is_one_sentence_with_its_entry(
    tmp_path: Path, info: dict[str, Any], parts: tuple[str, ...]
) -> None:
    files.write_v2(tmp_path / "pick", episodes=1)
    path = tmp_path / "pick" / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | info))
    with pytest.raises(TacpipeError, match=r"meta/info\.json") as raised:
        read(tmp_path)
    assert all(part in str(raised.value) for part in parts)


def counts(lab: Lab, options: str = "") -> tuple[int, int]:
    content = json.loads(lab.run(f"ingest lerobot sets -o data/rec --json {options}").out)
    return content["ran"], content["reused"]


def test_an_episode_that_is_added_costs_itself_alone(lab: Lab) -> None:
    files.write_v2(lab.folder / "sets" / "pick", episodes=2)
    assert counts(lab) == (2, 0)
    files.write_v2(lab.folder / "sets" / "pick", episodes=3)
    assert counts(lab) == (1, 2)
    assert [entry.attributes["task"] for entry in tacpipe.open("data/rec")] == [
        files.TASKS[0],
        files.TASKS[1],
        files.TASKS[0],
    ]


def test_a_changed_file_of_version_3_costs_the_episodes_in_it(lab: Lab) -> None:
    files.write_v3(lab.folder / "sets" / "pick")
    assert counts(lab) == (3, 0)
    path = lab.folder / "sets" / "pick" / "data" / "chunk-000" / "file-001.parquet"
    pq.write_table(pq.read_table(path), path, compression="zstd")
    before = tacpipe.open("data/rec").digest
    assert counts(lab, "--replace") == (1, 2)
    assert tacpipe.open("data/rec").digest == before  # the same values: nothing after it is computed again


def test_a_damaged_episode_is_left_out_with_skip_bad(lab: Lab) -> None:
    files.write_v2(lab.folder / "sets" / "pick")
    _cut(lab.folder / "sets" / "pick" / "data" / "chunk-000" / "episode_000001.parquet")
    refused = lab.call("ingest lerobot sets -o data/rec")
    assert refused.code == 1 and EPISODE.format(1) in refused.err
    assert counts(lab, "--skip-bad") == (0, 2)


def test_names_that_are_nested_deep_are_names(tmp_path: Path) -> None:
    files.write_v2(tmp_path / "pick", episodes=1)
    path = tmp_path / "pick" / "meta" / "info.json"
    info = json.loads(path.read_text())
    info["features"]["action"]["names"] = json.loads("[" * 800 + json.dumps([f"a{n}" for n in range(7)]) + "]" * 800)
    path.write_text(json.dumps(info))
    (source,) = LEROBOT.discover(lerobot.params(), tmp_path).values()
    assert "a6" in lerobot(lerobot.params(), source.files, source.values).streams["action"].schema.names
