"""LeRobot datasets as pyarrow and json read them; LeRobot's own loader reads them in `tests.exports.test_other_tools`."""

import json
import os
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import zarr

import tacpipe
from tacpipe.arrays import Bytes
from tacpipe.video.decoding import padded_packet
from tacpipe.video.stream import read_format
from tests.conftest import Lab
from tests.exports import recordings
from tests.exports.test_mcap import read
from tests.fake_recordings import write_dataset
from tests.stages.test_extract import frames_of
from tests.video import videos

EXPORT = "export lerobot rec -o lr --rate-hz 100 --actions arm --task 'press the {object}'"


def info() -> Any:
    with open("lr/meta/info.json") as file:
        return json.load(file)


def test_frames_hold_what_synchronize_gives_under_lerobot_s_names(rig: Lab) -> None:
    rig.run(EXPORT)
    rig.run("synchronize rec -o sync --rate-hz 100")
    provided = tacpipe.open("sync")
    frames = pq.read_table("lr/data/chunk-000/file-000.parquet")
    features = info()["features"]
    start = 0
    for episode, entry in enumerate(provided):
        table = entry.table()
        mine = frames.slice(start, table.num_rows)
        assert set(mine["episode_index"].to_pylist()) == {episode}
        assert mine["index"].to_pylist() == list(range(start, start + table.num_rows))
        np.testing.assert_allclose(mine["timestamp"].to_numpy(), np.arange(table.num_rows) / 100, atol=1e-6)
        np.testing.assert_array_equal(mine["tacpipe.t_ns"].to_numpy(), table["t_ns"].to_numpy())
        for feature, stream in (("observation.state", "arm"), ("observation.tactile.skin", "skin")):
            values = np.array(mine[feature].to_pylist(), np.float32)
            for position, name in enumerate(features[feature]["names"]):
                expected = table[f"{stream}_{name}"].to_numpy()
                with np.errstate(over="ignore"):
                    np.testing.assert_array_equal(values[:, position], expected.astype(np.float32))
        state, action = (np.array(mine[name].to_pylist()) for name in ("observation.state", "action"))
        np.testing.assert_array_equal(action[:-1], state[1:])
        np.testing.assert_array_equal(mine["tacpipe.gap.skin"].to_numpy(), table["skin_gap"].to_numpy())
        start += table.num_rows
    assert (info()["total_frames"], info()["total_episodes"], info()["fps"]) == (start, 2, 100)


def test_the_task_is_the_recording_s_label_and_every_label_is_with_its_episode(rig: Lab) -> None:
    rig.run(EXPORT)
    tasks = pd.read_parquet("lr/meta/tasks.parquet")
    assert tasks["task_index"].to_dict() == {"press the box": 0, "press the cup": 1}
    episodes = pq.read_table("lr/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [episode["tasks"] for episode in episodes] == [["press the box"], ["press the cup"]]
    assert [episode["tacpipe/recording"] for episode in episodes] == ["trial-00", "trial-01"]
    assert [json.loads(episode["tacpipe/attributes"]) for episode in episodes] == [
        recordings.trial(0)[1],
        recordings.trial(1)[1],
    ]
    err = rig.call("export lerobot rec -o lr --rate-hz 100 --task 'press the {colour}'").err
    assert "colour" in err


@pytest.mark.long
def test_statistics_are_those_of_the_frames(rig: Lab) -> None:
    rig.run(EXPORT)
    frames = pq.read_table("lr/data/chunk-000/file-000.parquet")
    with open("lr/meta/stats.json") as file:
        stats = json.load(file)
    values = np.array(frames["observation.tactile.skin"].to_pylist(), float)
    result = stats["observation.tactile.skin"]
    for name in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(result[name], getattr(values, name)(axis=0), rtol=1e-9)
    assert result["count"] == [len(values)]
    assert result["q01"] < result["q10"] < result["q50"] < result["q90"] < result["q99"]
    numbers = {name for name, value in info()["features"].items() if value["dtype"] != "string"}
    assert set(stats) == numbers


def test_the_recorded_shards_lie_beside_the_frames_byte_for_byte(rig: Lab) -> None:
    rig.run(EXPORT)
    for path in (rig.folder / "rec").glob("*/*.parquet"):
        assert (rig.folder / "lr/tacpipe" / path.parent.name / path.name).read_bytes() == path.read_bytes()
    rig.run("export lerobot rec -o bare --rate-hz 100 --no-originals")
    assert not (rig.folder / "bare/tacpipe").exists()


@pytest.mark.long
def test_only_measured_channels_are_observations_and_touch_joins_the_state_if_asked(rig: Lab) -> None:
    rig.run(EXPORT)
    names = [name for name in info()["features"] if name.startswith("observation.")]
    assert sorted(names) == ["observation.odd", "observation.state", "observation.tactile.skin"]
    rig.run(EXPORT + " --tactile-in-state")
    state = info()["features"]["observation.state"]
    assert state["shape"] == [13 + 6]
    assert state["names"][-1] == "skin_taxel02_z"


def test_what_is_lost_is_listed(rig: Lab) -> None:
    err = rig.run(EXPORT).err
    lost = [line for line in err.splitlines() if "not carried" in line]
    assert any("float32" in line and "arm" in line for line in lost)
    assert any("rate" in line for line in lost)
    readme = (rig.folder / "lr/README.md").read_text()
    assert all(line.partition("not carried: ")[2] in readme for line in lost)


@pytest.mark.parametrize("options", ["", "--rate-hz 100 --actions leg", "--rate-hz 100 --state leg"])
def test_what_cannot_be_made_is_refused(rig: Lab, options: str) -> None:
    ran = rig.call(f"export lerobot rec -o lr {options}")
    assert ran.code != 0
    assert "--rate-hz" in ran.err if not options else "leg" in ran.err
    assert not (rig.folder / "lr").exists()


def test_an_episode_of_more_frames_than_memory_takes_at_once_has_the_same_frames(
    rig: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.run(EXPORT)
    expected = pq.read_table("lr/data/chunk-000/file-000.parquet")
    monkeypatch.setattr("tacpipe.exports.lerobot.GROUP_FRAMES", 7)
    rig.run(EXPORT.replace("-o lr", "-o pieces") + " --rerun")
    path = "pieces/data/chunk-000/file-000.parquet"
    assert pq.read_table(path).equals(expected)
    assert pq.ParquetFile(path).num_row_groups > 2


COUNT = 40
PLAYED = {"libx264": ("h264", "mp4"), "libx265": ("h265", "mkv")}


def write(lab: Lab, encoder: str, ending: str, monkeypatch: pytest.MonkeyPatch, *, b_frames: int) -> Path:
    """Write a dataset with a video; return the video."""
    parameters = {
        "libx264": {"g": "12", "bf": str(b_frames), "x264-params": "log-level=none"},
        "libx265": {"x265-params": f"keyint=12:bframes={b_frames}:scenecut=0:log-level=none"},
        "mpeg4": {"g": "12", "bf": str(b_frames)},
    }
    monkeypatch.setattr(videos, "OPTIONS", parameters)
    path = videos.write(lab.folder / f"gel.{ending}", encoder, COUNT)
    write_dataset(lab.folder / "rec", {"a": ({"gel": frames_of(path)}, {})})
    return path


def decoded(codec: str, packets: list[bytes]) -> list[Bytes]:
    """Return the images of packets that a fresh decoder gets without anything else."""
    context: Any = av.CodecContext.create(codec, "r")
    frames = [frame for packet in packets for frame in context.decode(padded_packet(packet))]
    return [frame.to_ndarray(format="rgb24", threads=1) for frame in [*frames, *context.decode(None)]]


@pytest.mark.parametrize("encoder", PLAYED)
def test_a_video_that_foxglove_plays_is_compressed_video_with_all_that_a_decoder_needs(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, encoder: str
) -> None:
    name, ending = PLAYED[encoder]
    path = write(lab, encoder, ending, monkeypatch, b_frames=0)
    lab.run("export mcap rec -o mcap")
    topics = read(lab.folder / "mcap/a.mcap")
    messages = [message for _, message in topics["/gel/video"]]
    assert "/gel/image" not in topics
    assert {message.format for message in messages} == {name}
    assert len(messages) == COUNT
    images = decoded({"h265": "hevc"}.get(name, name), [bytes(message.data) for message in messages])
    assert np.array_equal(images, videos.decoded(path))
    from_second_key_frame = decoded(
        {"h265": "hevc"}.get(name, name), [bytes(message.data) for message in messages[12:]]
    )
    assert np.array_equal(from_second_key_frame, videos.decoded(path)[12:])


@pytest.mark.parametrize(("encoder", "ending", "b_frames"), [("mpeg4", "avi", 0), ("libx264", "mp4", 3)])
def test_any_other_video_is_decoded_and_encoded_as_images(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, encoder: str, ending: str, b_frames: int
) -> None:
    path = write(lab, encoder, ending, monkeypatch, b_frames=b_frames)
    lab.run("export mcap rec -o mcap")
    messages = read(lab.folder / "mcap/a.mcap")["/gel/image"]
    t_ns = tacpipe.open("rec")["a"].table("gel").column("t_ns").to_pylist()
    assert [stamp for stamp, _ in messages] == t_ns
    for (_, message), original in zip(messages, videos.decoded(path), strict=True):
        (image,) = decoded("mjpeg", [bytes(message.data)])
        assert np.abs(image.astype(int) - original).mean() < 6


@pytest.mark.parametrize(
    ("encoder", "ending", "b_frames"), [("mpeg4", "avi", 2), ("libx264", "mp4", 3), ("mjpeg", "avi", 0)]
)
@pytest.mark.parametrize("kind", ["mcap", "hdf5"])
def test_packets_come_back_bit_for_bit_with_their_format(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, kind: str, encoder: str, ending: str, b_frames: int
) -> None:
    write(lab, encoder, ending, monkeypatch, b_frames=b_frames)
    lab.run(f"export {kind} rec -o out")
    lab.run(f"ingest {kind} out -o back")
    original, back = (tacpipe.open(name)["a"].table("gel") for name in ("rec", "back"))
    assert read_format(back) == read_format(original)
    for name in ("t_ns", "packet", "pts", "dts", "key_frame"):
        assert back.column(name).to_pylist() == original.column(name).to_pylist()


def test_h5py_reads_decoded_frames(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(lab, "mpeg4", "avi", monkeypatch, b_frames=2)
    lab.run("export hdf5 rec -o h5 --images")
    with h5py.File("h5/a.h5") as file:
        assert np.array_equal(file["gel/images"][:], videos.decoded(path))
    refused = lab.call("export hdf5 rec -o demos --images --structure robomimic")
    assert refused.code == 2
    assert "images belongs to --structure streams" in refused.err


LEROBOT = "export lerobot rec -o lr --rate-hz 25"
VIDEO = "lr/videos/observation.images.gel/chunk-000/file-000.mp4"


@pytest.mark.parametrize("b_frames", [0, 3])
def test_packets_of_h264_are_copied_to_a_lerobot_dataset_and_come_back(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, b_frames: int
) -> None:
    path = write(lab, "libx264", "mp4", monkeypatch, b_frames=b_frames)
    ran = lab.run(f"{LEROBOT} --no-originals")
    assert "encoded" not in ran.err
    assert videos.packets(lab.folder / VIDEO) == videos.packets(path)
    lab.run("ingest lerobot lr -o back")
    original, back = (tacpipe.open(name)["a"].table("gel") for name in ("rec", "back"))
    assert back.column("packet").to_pylist() == original.column("packet").to_pylist()
    assert np.array_equal(videos.decoded(lab.folder / VIDEO), videos.decoded(path))


@pytest.mark.parametrize(("codec", "option"), [("h264", ""), ("av1", " --video-codec av1")])
def test_other_frames_are_encoded_for_lerobot_and_the_loss_is_stated(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, codec: str, option: str
) -> None:
    path = write(lab, "mpeg4", "avi", monkeypatch, b_frames=2)
    ran = lab.run(f"{LEROBOT} --no-originals{option}")
    assert f"stream gel: its packets: frames are encoded as {codec.upper()}, with some loss" in ran.err
    with av.open(str(lab.folder / VIDEO)) as container:
        assert container.streams.video[0].codec_context.codec.canonical_name == codec
        stamps = [frame.time for frame in container.decode(video=0)]
    assert stamps == pytest.approx([number / 25 for number in range(COUNT)], abs=1e-4)
    images = np.array(videos.decoded(lab.folder / VIDEO), int)
    assert np.abs(images - videos.decoded(path)).mean() < 6
    info = json.loads((lab.folder / "lr/meta/info.json").read_text())
    assert info["features"]["observation.images.gel"]["info"]["video.codec"] == codec
    colours = json.loads((lab.folder / "lr/meta/stats.json").read_text())["observation.images.gel"]["mean"]
    assert np.ravel(colours) == pytest.approx(np.mean(videos.decoded(path), axis=(0, 1, 2)) / 255, abs=0.03)


def test_with_the_shards_in_a_lerobot_dataset_packets_come_back_bit_for_bit(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(lab, "mpeg4", "avi", monkeypatch, b_frames=2)
    lab.run(LEROBOT)
    lab.run("ingest lerobot lr -o back")
    original, back = (tacpipe.open(name)["a"].table("gel") for name in ("rec", "back"))
    assert back.equals(original) and read_format(back) == read_format(original)


def test_a_row_of_a_lerobot_dataset_has_the_nearest_frame(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(lab, "libx264", "mp4", monkeypatch, b_frames=0)
    lab.run(f"{LEROBOT.replace('25', '10')} --no-originals")
    images = np.array(videos.decoded(lab.folder / VIDEO), int)
    rows = [round(number * 2.5 - 1e-9) for number in range(len(images))]
    assert len(images) == 16
    assert np.abs(images - np.array(videos.decoded(path), int)[rows]).mean() < 4


def test_decoded_frames_in_an_hdf5_file_are_no_second_stream(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    write(lab, "mpeg4", "avi", monkeypatch, b_frames=0)
    lab.run("export hdf5 rec -o h5 --images")
    lab.run("ingest hdf5 h5 -o back")
    original, back = (tacpipe.open(name)["a"] for name in ("rec", "back"))
    assert back.streams == original.streams
    assert back.table("gel").column("packet").to_pylist() == original.table("gel").column("packet").to_pylist()


@pytest.mark.parametrize("rate_hz", [25, 10])
def test_zarr_arrays_have_the_nearest_frame_of_each_row(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, rate_hz: int
) -> None:
    path = write(lab, "mpeg4", "avi", monkeypatch, b_frames=2)
    lab.run(f"export zarr rec -o zarr --rate-hz {rate_hz} --images")
    store: Any = zarr.open("zarr/replay.zarr", mode="r")
    images = store["data/gel_rgb"][:]
    rows = [round(number * 25 / rate_hz - 1e-9) for number in range(len(images))]
    assert len(images) == COUNT * rate_hz // 25
    assert np.array_equal(images, np.array(videos.decoded(path))[rows])
    if rate_hz == 25:
        lab.run("ingest zarr zarr/replay.zarr -o back")
        (back,) = tacpipe.open("back")
        table = back.table("gel_rgb")
        assert table.column("packet").to_pylist() == [image.tobytes() for image in images]


def test_cameras_with_different_codec_headers_are_exported_together(lab: Lab) -> None:
    videos.write(lab.folder / "a.avi", "mpeg4", COUNT)
    videos.write(lab.folder / "b.avi", "mjpeg", COUNT)
    write_dataset(lab.folder / "rec", {name: ({"gel": frames_of(lab.folder / f"{name}.avi")}, {}) for name in "ab"})
    lab.run(f"{LEROBOT} --no-originals")
    assert len(list(Path("lr/videos").rglob("*.mp4"))) == 2


@pytest.mark.skipif(os.geteuid() != 0, reason="only as root does the encoder change the scheduling")
def test_encoding_av1_does_not_move_this_process_before_others(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    write(lab, "mpeg4", "avi", monkeypatch, b_frames=0)
    before = os.sched_getscheduler(0)
    lab.run(f"{LEROBOT} --no-originals --video-codec av1")
    assert os.sched_getscheduler(0) == before
