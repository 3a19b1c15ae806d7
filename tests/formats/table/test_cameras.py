"""Video files and folders of images become streams of frames of a lab's own recordings."""

from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

import tacpipe
from tacpipe.arrays import Bytes
from tacpipe.datasets.dataset import Recording
from tacpipe.formats.table import guess
from tacpipe.video import decoding, stream
from tests.conftest import Lab
from tests.video import videos

LAYOUT = """
[streams.gel]
files = "{trial}/gel.%s"
%s
[streams.skin]
files = "{trial}/skin.csv"
time = { column = "t" }
columns = [{ match = "f", quantity = "force", unit = "N" }]
"""
IMAGES = '[streams.gel]\nfiles = "{trial}/frames"\nformat = "images"\ntime = %s\n'
STEP_NS = 40_000_000


def write_trials(folder: Path, ending: str = "mp4", encoder: str = "libx264") -> None:
    for trial in ("a", "b"):
        place = folder / trial
        place.mkdir(parents=True)
        videos.write(place / f"gel.{ending}", encoder, 12)
        (place / "skin.csv").write_text("t,f\n" + "".join(f"{row / 100},{row}\n" for row in range(50)))


def write_images(folder: Path, encoder: str, ending: str, names: list[str]) -> list[bytes]:
    """Write one encoded image per name, and return the files."""
    folder.mkdir(parents=True)
    output = []
    for name, image in zip(names, videos.images(len(names)), strict=True):
        with av.open(str(folder / f"{name}.{ending}"), "w", format="image2") as container:
            track: Any = container.add_stream(encoder, rate=25)
            track.width, track.height = videos.WIDTH, videos.HEIGHT
            track.pix_fmt = videos.PIXELS.get(encoder, "yuv420p")
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            container.mux([*track.encode(frame), *track.encode(None)])
        output.append((folder / f"{name}.{ending}").read_bytes())
    return output


def frames_of(recording: Recording) -> list[Bytes]:
    columns = recording.columns("gel")
    video_format = stream.read_format(columns)
    assert video_format is not None
    return list(videos.sound_images(video_format, decoding.read_batches(columns)).values())


def ingest(lab: Lab, layout: str) -> list[Recording]:
    (lab.folder / "layout.toml").write_text(layout)
    ran = lab.call("ingest table lab --layout layout.toml -o data/lab")
    assert ran.code == 0, ran.err
    return list(tacpipe.open(lab.folder / "data/lab"))


@pytest.mark.parametrize(("ending", "encoder"), [("mp4", "libx264"), ("avi", "mjpeg")])
def test_a_video_is_a_stream_next_to_a_table(lab: Lab, ending: str, encoder: str) -> None:
    write_trials(lab.folder / "lab", ending, encoder)
    recordings = ingest(lab, LAYOUT % (ending, ""))
    assert [recording.name for recording in recordings] == ["a", "b"]
    expected = videos.decoded(lab.folder / "lab/b" / f"gel.{ending}")
    images = frames_of(recordings[1])
    assert len(images) == len(expected) == 12
    assert all(np.array_equal(image, original) for image, original in zip(images, expected, strict=True))
    assert recordings[0].columns("gel").column("t_ns").to_pylist() == [row * STEP_NS for row in range(12)]
    assert recordings[0].columns("skin").num_rows == 50


def test_stamps_of_frames_come_from_a_rate_or_a_file(lab: Lab) -> None:
    write_trials(lab.folder / "lab")
    timed = LAYOUT % ("mp4", 'time = { rate_hz = 50, start = "2024-05-01T12:00:00" }')
    start_ns = int(np.datetime64("2024-05-01T12:00:00", "ns").astype(np.int64))
    (recording, _) = ingest(lab, timed)
    expected = [start_ns + row * STEP_NS // 2 for row in range(12)]
    assert recording.columns("gel").column("t_ns").to_pylist() == expected
    stamps = [1_700_000_000_000 + 40 * row + row % 3 for row in range(12)]
    for trial in "ab":
        text = "ms\n" + "".join(f"{stamp}\n" for stamp in stamps)
        (lab.folder / "lab" / trial / "gel_times.csv").write_text(text)
    entry = 'time = { file = "{trial}/gel_times.csv", unit = "ms" }'
    (lab.folder / "layout.toml").write_text(LAYOUT % ("mp4", entry))
    assert lab.call("ingest table lab --layout layout.toml -o data/stamped").code == 0
    recording = next(iter(tacpipe.open(lab.folder / "data/stamped")))
    assert recording.columns("gel").column("t_ns").to_pylist() == [stamp * 10**6 for stamp in stamps]
    (lab.folder / "lab/b/gel_times.csv").write_text("ms\n1\n2\n")
    refused = lab.call("ingest table lab --layout layout.toml -o data/unequal")
    assert refused.code == 1
    assert "has 12 frames" in refused.err and "2 stamps" in refused.err


@pytest.mark.parametrize(("encoder", "ending"), [("mjpeg", "jpg"), ("png", "png"), ("libwebp", "webp")])
def test_a_folder_of_images_is_a_stream_of_its_files(lab: Lab, encoder: str, ending: str) -> None:
    names = [f"frame_{row}" for row in (8, 9, 10, 11)]
    contents = write_images(lab.folder / "lab/a/frames", encoder, ending, names)
    (recording,) = ingest(lab, IMAGES % "{ rate_hz = 25 }")
    assert recording.columns("gel").column("packet").to_pylist() == contents
    assert recording.columns("gel").column("t_ns").to_pylist() == [row * STEP_NS for row in range(4)]
    images = frames_of(recording)
    if encoder == "png":
        assert np.array_equal(np.array(images), videos.images(4))
    assert len(images) == 4


def test_names_of_images_state_their_stamps_and_a_guess_says_so(lab: Lab) -> None:
    stamps = ["1744849152.016136162", "1744849151.5", "1744849152.25"]
    contents = write_images(lab.folder / "lab/a/frames", "png", "png", stamps)
    text = guess.guess_layout(lab.folder / "lab")
    assert 'format = "images"' in text
    assert 'time = { column = "name", unit = "s" }' in text
    (recording,) = ingest(
        lab, text.replace('sensor = "?"', 'sensor = "gel"').replace("[streams.frames]", "[streams.gel]")
    )
    columns = recording.columns("gel")
    assert columns.column("t_ns").to_pylist() == [1744849151500000000, 1744849152016136162, 1744849152250000000]
    assert columns.column("packet").to_pylist() == [contents[1], contents[0], contents[2]]


def test_a_guess_for_videos_reads_them(lab: Lab) -> None:
    write_trials(lab.folder / "lab")
    text = guess.guess_layout(lab.folder / "lab")
    assert "h264, 64 x 48 pixels, 25 frames/s" in text
    answered = (
        text.replace('sensor = "?"', 'sensor = "gel"')
        .replace('quantity = "?"', 'quantity = "force"')
        .replace('"?"', '"N"')
    )
    recordings = ingest(lab, answered)
    assert [set(recording.streams) for recording in recordings] == [{"gel", "skin"}] * 2
    preview = lab.call("ingest table lab --layout layout.toml --dry-run")
    assert preview.code == 0
    assert "gel: 12 rows" in preview.out


def test_a_guess_leaves_out_empty_files_next_to_videos(lab: Lab) -> None:
    write_trials(lab.folder / "lab")
    for trial in "ab":
        (lab.folder / "lab" / trial / "slip.txt").touch()
    text = guess.guess_layout(lab.folder / "lab")
    assert "[streams.slip]" not in text
    assert [line for line in text.splitlines() if "slip.txt" in line and "it has no row" in line]


def test_damaged_videos_and_images_of_two_sizes_are_one_sentence(lab: Lab) -> None:
    write_trials(lab.folder / "lab")
    path = lab.folder / "lab/b/gel.mp4"
    path.write_bytes(path.read_bytes()[:500])
    (lab.folder / "layout.toml").write_text(LAYOUT % ("mp4", ""))
    refused = lab.call("ingest table lab --layout layout.toml -o data/lab --skip-bad")
    assert refused.code == 0 and "gel.mp4 cannot be read as a video" in refused.err
    assert list(tacpipe.open(lab.folder / "data/lab").recordings) == ["a"]
    folder = lab.folder / "images/a/frames"
    write_images(folder, "png", "png", ["1", "2"])
    (folder / "3.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(40))
    (lab.folder / "layout.toml").write_text(IMAGES % "{ rate_hz = 25 }")
    refused = lab.call("ingest table images --layout layout.toml -o data/images")
    assert refused.code == 1 and "3.png" in refused.err


@pytest.mark.parametrize(
    ("layout", "sentence"),
    [
        (LAYOUT % ("mp4", 'columns = [{ match = "a" }]'), "columns is for tables"),
        (LAYOUT % ("mp4", 'time = { column = "t" }'), "a stream of video takes file or rate_hz"),
        ('[streams.gel]\nfiles = "{trial}/frames"\nformat = "images"\n', "time must be given"),
    ],
)
def test_an_entry_that_a_camera_does_not_take_is_refused(lab: Lab, layout: str, sentence: str) -> None:
    write_trials(lab.folder / "lab")
    (lab.folder / "layout.toml").write_text(layout)
    refused = lab.call("ingest table lab --layout layout.toml -o data/lab")
    assert refused.code == 2
    assert sentence in refused.err
