"""Video files and folders of images become streams of frames of a lab's own recordings."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

import tacpipe
from tacpipe.arrays import Bytes
from tacpipe.datasets.dataset import Recording
from tacpipe.errors import TacpipeError
from tacpipe.formats.table import guess
from tacpipe.video import decoding, files, stream
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


@pytest.mark.parametrize(("encoder", "ending"), [("png", "png"), ("mjpeg", "jpg"), ("libwebp", "webp")])
def test_an_image_that_is_cut_off_is_named_when_it_is_ingested(lab: Lab, encoder: str, ending: str) -> None:
    for trial in "ab":
        folder = lab.folder / "images" / trial / "frames"
        folder.mkdir(parents=True)
        for number, image in enumerate(videos.images(3, 480, 640)):
            with av.open(str(folder / f"{number}.{ending}"), "w", format="image2") as container:
                track: Any = container.add_stream(encoder, rate=25)
                track.width, track.height = 640, 480
                track.pix_fmt = {"libwebp": "yuv420p"}.get(encoder) or videos.PIXELS[encoder]
                frame = av.VideoFrame.from_ndarray(image, format="rgb24")
                container.mux([*track.encode(frame), *track.encode(None)])
    path = lab.folder / f"images/a/frames/1.{ending}"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    (lab.folder / "layout.toml").write_text(IMAGES % "{ rate_hz = 25 }")
    ran = lab.run("ingest table images --layout layout.toml -o data/images --skip-bad")
    assert f"left out a: a/frames/1.{ending} is cut off" in ran.err
    path.write_bytes(b"")
    assert f"1.{ending} is empty" in lab.run("ingest table images --layout layout.toml -o data/i --skip-bad").err
    path.write_bytes(b"GIF89a" + bytes(100))
    assert (
        f"1.{ending} is no .{ending} image" in lab.run("ingest table images --layout layout.toml -o i --skip-bad").err
    )


def test_the_kinds_of_images_that_are_read_are_named_where_a_folder_holds_others(lab: Lab) -> None:
    folder = lab.folder / "images/a/frames"
    folder.mkdir(parents=True)
    (folder / "1.bmp").write_bytes(b"BM" + bytes(60))
    (lab.folder / "layout.toml").write_text(IMAGES % "{ rate_hz = 25 }")
    refused = lab.call("ingest table images --layout layout.toml -o data/images")
    assert refused.code == 2 and "a/frames/1.bmp" in refused.err
    assert "images are files of .jpeg, .jpg, .png, .webp" in refused.err


def test_an_empty_video_and_one_of_another_ending_are_left_out_with_skip_bad(lab: Lab) -> None:
    write_trials(lab.folder / "lab")
    (lab.folder / "lab/b/gel.mp4").write_bytes(b"")
    (lab.folder / "layout.toml").write_text(LAYOUT % ("mp4", ""))
    ran = lab.run("ingest table lab --layout layout.toml -o data/lab --skip-bad")
    assert "left out b: b/gel.mp4 is empty" in ran.err
    (lab.folder / "lab/b/gel.mp4").rename(lab.folder / "lab/b/gel.gif")
    (lab.folder / "lab/a/gel.mp4").rename(lab.folder / "lab/a/gel.gif")
    (lab.folder / "layout.toml").write_text(LAYOUT % ("gif", 'format = "video"'))
    refused = lab.call("ingest table lab --layout layout.toml -o data/gif")
    assert refused.code == 1 and "gel.gif cannot be read as a video: its name must end in .avi" in refused.err


def test_a_video_whose_times_do_not_fit_costs_its_own_recording(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    write_trials(lab.folder / "lab")
    scan = files.scan

    def scan_with_long_times(path: Path) -> files.VideoScan:
        frames = scan(path)
        return replace(frames, pts=frames.pts << 40) if path.parent.name == "b" else frames

    monkeypatch.setattr(files, "scan", scan_with_long_times)
    (lab.folder / "layout.toml").write_text(LAYOUT % ("mp4", ""))
    ran = lab.run("ingest table lab --layout layout.toml -o data/lab --skip-bad")
    assert "left out b: b/gel.mp4, b/skin.csv cannot be read: OverflowError" in ran.err
    assert "This is a defect of tacpipe" in ran.err


@pytest.mark.parametrize("values", [{"codec": "aac"}, {"pixel_format": "nonsense"}])
def test_metadata_that_are_not_of_video_are_one_sentence(lab: Lab, values: dict[str, str]) -> None:
    write_trials(lab.folder / "lab")
    (lab.folder / "layout.toml").write_text(LAYOUT % ("mp4", ""))
    lab.run("ingest table lab --layout layout.toml -o data/lab")
    recording = next(iter(tacpipe.open(lab.folder / "data/lab").recordings.values()))
    metadata = {**(recording.columns("gel").schema.field("packet").metadata or {})}
    metadata |= {key.encode(): value.encode() for key, value in values.items()}
    with pytest.raises(TacpipeError, match="does not state its video format") as refused:
        stream.VideoFormat.from_metadata(metadata)
    assert next(iter(values.values())) in str(refused.value)
