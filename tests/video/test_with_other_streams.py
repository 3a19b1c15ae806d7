"""Recordings that also hold a stream of frames: what shows them, and stages and exports that do not read frames."""

from pathlib import Path

import cv2
import numpy as np
import pytest

import tacpipe
from tacpipe.viewer import contents
from tests.conftest import Lab
from tests.formats import video_files
from tests.video import videos

LAYOUT = """
[streams.skin]
files = "{trial}/skin.csv"
time = { column = "t", origin = "start" }
columns = [{ match = "taxel{taxel}_{axis}", quantity = "tactile", unit = "count", type = "uint16" }]
[streams.robot]
files = "{trial}/robot.csv"
time = { column = "t", origin = "start" }
columns = [{ match = "force", quantity = "force", unit = "N" }]
"""
VIDEO = '[streams.gel]\nfiles = "{trial}/gel.mp4"\n'
TRIALS = ("a", "b", "c", "d")


def write_lab(folder: Path) -> None:
    rng = np.random.default_rng(0)
    names = [f"taxel{taxel:02d}_{axis}" for taxel in range(1, 5) for axis in "xyz"]
    for trial in TRIALS:
        place = folder / trial
        place.mkdir(parents=True)
        videos.write(place / "gel.mp4", "libx264", 75, absent=(5, 6))
        touch = np.zeros(300)
        touch[100:200] = 3000
        rows = 20_000 + touch[:, None] + rng.integers(0, 9, (300, len(names)))
        lines = [f"{row / 100},{','.join(str(int(value)) for value in rows[row])}" for row in range(300)]
        (place / "skin.csv").write_text("\n".join([",".join(["t", *names]), *lines]) + "\n")
        forces = "".join(f"{row / 50},{row % 7}\n" for row in range(150))
        (place / "robot.csv").write_text(f"t,force\n{forces}")


@pytest.fixture
def mixed(lab: Lab) -> Lab:
    """A lab whose recordings in data/r have a skin, a robot and a camera; those in data/bare lack the camera."""
    write_lab(lab.folder / "lab")
    for name, layout in (("r", LAYOUT + VIDEO), ("bare", LAYOUT)):
        (lab.folder / f"{name}.toml").write_text(layout)
        lab.run(f"ingest table lab --layout {name}.toml -o data/{name}")
    return lab


def test_stages_give_the_same_with_and_without_a_camera(mixed: Lab) -> None:
    for name in ("r", "bare"):
        mixed.run(f"synchronize data/{name} -o data/{name}s")
        mixed.run(f"segment contacts data/{name}s -o data/{name}c")
        mixed.run(f"split data/{name}c -o data/{name}p")
        mixed.run(f"compress pca data/{name}c --split data/{name}p -o data/{name}z --components 2")
    for suffix in ("s", "c", "z"):
        with_camera, bare = (tacpipe.open(mixed.folder / f"data/{name}{suffix}") for name in ("r", "bare"))
        assert [entry.table() for entry in with_camera] == [entry.table() for entry in bare]


@pytest.mark.parametrize("export", ["csv", "mcap", "hdf5", "card", "lerobot --rate-hz 25", "zarr --rate-hz 25"])
def test_exports_write_recordings_that_also_hold_frames(mixed: Lab, export: str) -> None:
    ran = mixed.call(f"export {export} data/r -o out")
    assert ran.code == 0, ran.err


def test_packets_come_back_from_mcap_to_the_bit(mixed: Lab) -> None:
    mixed.run("export mcap data/r -o out")
    mixed.run("ingest mcap out -o back")
    original, back = (tacpipe.open(mixed.folder / name)["a"].table("gel") for name in ("data/r", "back"))
    assert back.equals(original)


def test_show_states_the_format_of_a_video_and_its_missing_frames(mixed: Lab) -> None:
    figures = mixed.run_json("show data/r a")["streams"]["gel"]
    assert (figures["codec"], figures["width_px"], figures["height_px"]) == ("h264", videos.WIDTH, videos.HEIGHT)
    assert (figures["nominal_rate_hz"], figures["missing_frames"]) == (25.0, 2)
    assert "gel: h264, 64 x 48 pixels, yuv420p, 25 frames/s, 2 missing frames" in mixed.run("show data/r a").out


def test_the_viewer_has_an_image_for_each_frame_of_a_video(mixed: Lab) -> None:
    recording = tacpipe.open(mixed.folder / "data/r")["a"]
    (frames,) = contents.collect(recording).frames
    expected = videos.decoded(mixed.folder / "lab/a/gel.mp4")
    assert frames.media_type == "image/jpeg"
    assert frames.t_ns.tolist() == recording.table("gel")["t_ns"].to_pylist()
    assert len(frames.content) == len(expected) == 73
    for content, image in zip(frames.content, expected, strict=True):
        bgr = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        assert bgr is not None
        assert np.abs(bgr[..., ::-1].astype(int) - image).mean() < 3


def test_a_picture_has_frames_in_the_middle_of_equal_stretches(mixed: Lab) -> None:
    recording = tacpipe.open(mixed.folder / "data/r")["a"]
    (strip,) = contents.for_picture(recording).strips
    expected = videos.decoded(mixed.folder / "lab/a/gel.mp4")
    t_ns = recording.table("gel")["t_ns"].to_pylist()
    assert len(strip.images) == contents.STRIP_FRAMES
    for place, (stamp_ns, image) in enumerate(zip(strip.t_ns.tolist(), strip.images, strict=True)):
        assert np.array_equal(image, expected[t_ns.index(stamp_ns)])
        assert abs(stamp_ns / t_ns[-1] - (place + 0.5) / 8) < 0.05
    mixed.run("show data/r a --plot a.png")
    assert (mixed.folder / "a.png").read_bytes().startswith(b"\x89PNG")


def test_a_picture_of_cameras_alone_is_drawn(lab: Lab) -> None:
    video_files.write_gelsight(lab.folder / "gels")
    lab.run("ingest gelsight-slip gels -o data/gels")
    lab.run("show data/gels lemon-1 --plot a.png")
    assert (lab.folder / "a.png").stat().st_size > 5000
