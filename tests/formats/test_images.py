"""Images in HDF5, Zarr and NPZ files, LeRobot datasets and bags become streams of frames that decode to the same images."""

from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import pyarrow as pa
import pytest
import zarr

import tacpipe
from tacpipe.arrays import AnyArray, Bytes
from tacpipe.errors import TacpipeError
from tacpipe.video import decoding, images
from tacpipe.video.encoding import MICROSECOND
from tacpipe.video.stream import PACKET, VideoFormat, read_format
from tests.conftest import Lab
from tests.formats.bags import writers
from tests.video import videos

COUNT = 10
START_NS = 1_700_000_000 * 10**9
STEP_NS = 40_000_000
IMAGES = videos.images(COUNT)  # (frame, row, column, rgb)
LAYOUT = '[streams.cam]\nfiles = "{trial}.npz"\narray = "rgb"\ntime = %s\n'


def encoded(codec: str, pixels: str) -> list[bytes]:
    """Return each image encoded by FFmpeg."""
    packets = []
    for image in IMAGES:
        context: Any = av.CodecContext.create(codec, "w")
        context.width, context.height, context.pix_fmt = videos.WIDTH, videos.HEIGHT, pixels
        context.time_base = MICROSECOND
        frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format=pixels, threads=1)
        packets.append(b"".join(bytes(packet) for packet in [*context.encode(frame), *context.encode(None)]))
    return packets


def frames(dataset: str, stream: str) -> tuple[VideoFormat, list[Bytes]]:
    """Return format and decoded images (row, column, rgb) of a stream of the only recording."""
    (recording,) = tacpipe.open(dataset)
    columns = recording.columns(stream)
    video_format = read_format(columns)
    assert video_format is not None
    return video_format, list(videos.sound_images(video_format, decoding.read_batches(columns)).values())


def column(dataset: str, stream: str, name: str) -> list[Any]:
    (recording,) = tacpipe.open(dataset)
    values: list[Any] = recording.columns(stream).column(name).to_pylist()
    return values


@pytest.mark.parametrize("kind", ["hdf5", "zarr"])
@pytest.mark.parametrize("colours", ["last", "first", "none", "alpha"])
def test_decoded_arrays_are_frames(lab: Lab, kind: str, colours: str) -> None:
    grey = IMAGES[..., 1]
    alpha = np.concatenate([IMAGES, np.full((*IMAGES.shape[:3], 1), 255, np.uint8)], axis=3)
    arrays = {"last": IMAGES, "first": np.moveaxis(IMAGES, 3, 1), "none": grey, "alpha": alpha}
    Path("in").mkdir()
    t_ns = START_NS + STEP_NS * np.arange(COUNT)
    if kind == "hdf5":
        with h5py.File("in/a.h5", "w") as file:
            file.create_dataset("wrist/rgb_image", data=arrays[colours], compression="gzip")
            file["wrist/t_ns"] = t_ns
    else:
        root: Any = zarr.open_group("in/a.zarr", mode="w", zarr_format=2)
        root.create_array("wrist/rgb_image", data=arrays[colours])
        root.create_array("wrist/t_ns", data=t_ns)
    lab.run(f"ingest {kind} in -o rec")
    video_format, decoded = frames("rec", "rgb_image")
    assert (video_format.codec, video_format.width_px, video_format.height_px) == (
        "rawvideo",
        videos.WIDTH,
        videos.HEIGHT,
    )
    assert np.array_equal(decoded, IMAGES if colours != "none" else np.repeat(grey[..., None], 3, axis=3))
    assert column("rec", "rgb_image", "t_ns") == t_ns.tolist()
    assert column("rec", "rgb_image", "pts") == (40_000 * np.arange(COUNT)).tolist()


def test_depth_images_keep_all_of_their_bits(lab: Lab) -> None:
    depth = np.arange(COUNT * 48 * 64, dtype=np.uint16).reshape(COUNT, 48, 64)
    Path("in").mkdir()
    with h5py.File("in/a.h5", "w") as file:
        file["depth"] = depth
        file["depth"].attrs["rate_hz"] = 30
    lab.run("ingest hdf5 in -o rec")
    assert b"".join(column("rec", "depth", PACKET)) == depth.tobytes()
    video_format, decoded = frames("rec", "depth")
    assert (video_format.pixel_format, str(video_format.nominal_rate_hz), len(decoded)) == ("gray16le", "30", COUNT)


def test_images_of_floats_are_left_out_with_the_reason(lab: Lab) -> None:
    Path("in").mkdir()
    with h5py.File("in/a.h5", "w") as file:
        file["cam"], file["force"] = np.zeros((COUNT, 48, 64, 3), np.float32), np.arange(COUNT)
        file.attrs["rate_hz"] = 30
    ran = lab.call("ingest hdf5 in -o rec")
    assert "cam is left out: holds decoded pictures (48 x 64 x 3) of float32" in ran.err


@pytest.mark.parametrize("time", ['{ column = "t", unit = "s" }', "{ rate_hz = 25 }", '{ file = "{trial}.csv" }'])
def test_an_array_of_an_npz_file_is_frames(lab: Lab, time: str) -> None:
    Path("in").mkdir()
    np.savez("in/a.npz", rgb=IMAGES, t=np.arange(COUNT) / 25, force=np.arange(COUNT))
    Path("in/a.csv").write_text("t_s\n" + "".join(f"{row / 25}\n" for row in range(COUNT)))
    Path("l.toml").write_text(LAYOUT % time)
    lab.run("ingest table in --layout l.toml -o rec")
    _, decoded = frames("rec", "cam")
    assert np.array_equal(decoded, IMAGES)
    assert column("rec", "cam", "t_ns") == [row * STEP_NS for row in range(COUNT)]


def test_the_guessed_layout_of_an_npz_file_reads_its_images_and_columns(lab: Lab) -> None:
    Path("in").mkdir()
    np.savez("in/a.npz", rgb=IMAGES, t_s=np.arange(COUNT) / 25, force=np.arange(COUNT))
    text = lab.call("ingest table in --guess").out
    assert 'array = "rgb"  # rawvideo, 64 x 48 pixels' in text
    text = text.replace('quantity = "?"', 'quantity = "force"').replace('unit = "?"', 'unit = "N"')
    Path("l.toml").write_text(text.replace('"?"', '"gel"'))
    lab.run("ingest table in --layout l.toml -o rec")
    assert np.array_equal(frames("rec", "rgb")[1], IMAGES)
    assert column("rec", "a", "force") == list(range(COUNT))


@pytest.mark.parametrize(("array", "problem"), [("force", "Images must be uint8"), ("cam", "has no array cam")])
def test_a_layout_that_names_another_array_is_refused(lab: Lab, array: str, problem: str) -> None:
    Path("in").mkdir()
    np.savez("in/a.npz", rgb=IMAGES, force=np.arange(COUNT))
    Path("l.toml").write_text((LAYOUT % "{ rate_hz = 25 }").replace('"rgb"', f'"{array}"'))
    assert problem in lab.call("ingest table in --layout l.toml -o rec").err


def write_bag(name: str, ros1: bool, message: Any) -> None:
    """Write a bag whose messages ``message`` returns for each row and types."""
    types = writers.store(ros1=ros1)
    sent = [("/cam", name, START_NS + row * STEP_NS, message(row, types)) for row in range(COUNT)]
    writers.ros1(Path("in/a.bag"), sent) if ros1 else writers.ros2(Path("in/a"), sent, "mcap")


@pytest.mark.parametrize("ros1", [True, False])
@pytest.mark.parametrize(("codec", "pixels"), [("mjpeg", "yuvj420p"), ("png", "rgb24")])
def test_compressed_images_of_a_bag_are_frames_with_the_bytes_of_the_messages(
    lab: Lab, ros1: bool, codec: str, pixels: str
) -> None:
    packets, name = encoded(codec, pixels), "sensor_msgs/msg/CompressedImage"
    Path("in").mkdir()

    def message(row: int, types: Any) -> Any:
        header = writers.header(types, START_NS + row * STEP_NS, "cam")
        return writers.build(types, name, header=header, format=codec, data=np.frombuffer(packets[row], np.uint8))

    write_bag(name, ros1, message)
    lab.run("ingest rosbag in -o rec")
    video_format, decoded = frames("rec", "cam")
    assert (video_format.codec, video_format.pixel_format) == (codec, pixels)
    assert column("rec", "cam", PACKET) == packets
    assert column("rec", "cam", "t_ns") == [START_NS + row * STEP_NS for row in range(COUNT)]
    assert np.abs(np.array(decoded, int) - IMAGES).mean() < 6


RAW: dict[str, AnyArray] = {
    "rgb8": IMAGES,
    "bgr8": IMAGES[..., ::-1],
    "mono8": IMAGES[..., :1],
    "mono16": IMAGES[..., :1].astype("<u2") * 257,
}


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("encoding", RAW)
def test_raw_images_of_a_bag_are_frames(lab: Lab, encoding: str, padding: int) -> None:
    name = "sensor_msgs/msg/Image"
    Path("in").mkdir()

    def message(row: int, types: Any) -> Any:
        header = writers.header(types, START_NS + row * STEP_NS, "cam")
        rows = [line.tobytes() + bytes(padding) for line in RAW[encoding][row]]
        data = np.frombuffer(b"".join(rows), np.uint8)
        shape = {"height": videos.HEIGHT, "width": videos.WIDTH, "step": len(rows[0]), "is_bigendian": 0}
        return writers.build(types, name, header=header, encoding=encoding, data=data, **shape)

    write_bag(name, False, message)
    lab.run("ingest mcap in/a -o rec")
    _, decoded = frames("rec", "cam")
    grey = np.repeat(IMAGES[..., :1], 3, axis=3)
    expected = IMAGES if encoding in ("rgb8", "bgr8") else grey
    difference = np.abs(np.array(decoded, int) - expected).max()
    assert difference <= (encoding == "mono16")  # FFmpeg rounds 16 bits to 8
    assert column("rec", "cam", PACKET) == [image.tobytes() for image in RAW[encoding]]


def test_images_of_another_size_than_the_first_are_refused_with_their_row() -> None:
    small = encoded("png", "rgb24")
    context: Any = av.CodecContext.create("png", "w")
    context.width, context.height, context.pix_fmt, context.time_base = 32, 32, "rgb24", MICROSECOND
    large = b"".join(map(bytes, context.encode(av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8)))))
    table = pa.table(
        [pa.array([0, 1, 2]), pa.array([small[0], b"", large])],
        pa.schema([("t_ns", pa.int64()), pa.field("data", pa.binary(), metadata={"quantity": "image"})]),
    )
    with pytest.raises(TacpipeError, match="cam: image 3 is png, 32 x 32 pixels, and the first is png, 64 x 48"):
        images.frames_from_images(table, "cam")


def test_markers_and_differences_are_extracted_from_images_of_any_source(lab: Lab) -> None:
    Path("in").mkdir()
    with h5py.File("in/a.h5", "w") as file:
        file["cam"] = IMAGES
        file.attrs["rate_hz"] = 25
    lab.run("ingest hdf5 in -o rec")
    lab.run("extract difference rec -o diff --rows 2 --columns 2")
    assert len(column("diff", "cam", "taxel0101_red")) == COUNT
