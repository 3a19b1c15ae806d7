"""Test that exported videos decode to the recorded frames, and that packets are restored bit for bit."""

import json
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import pytest
import zarr

import tacpipe
from tacpipe.arrays import Bytes
from tacpipe.video.decoding import padded_packet
from tacpipe.video.stream import read_format
from tests.conftest import Lab
from tests.exports.test_mcap import read
from tests.fake_recordings import write_dataset
from tests.stages.test_extract import frames_of
from tests.video import videos

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


LEROBOT = "export lerobot rec -o lr --rate-hz 25 --master gel"
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
    lab.run(f"export zarr rec -o zarr --rate-hz {rate_hz} --master gel --images")
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
