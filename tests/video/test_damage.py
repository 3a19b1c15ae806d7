"""Damaged and cut videos: each frame is that of the sound file, or it has no image and is counted."""

import io
import re
import zlib
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

import tacpipe
from tacpipe.arrays import Bytes
from tacpipe.channels.schema import DAMAGED
from tacpipe.errors import TacpipeError
from tacpipe.plugins.video_checks import VideoChecks, check_videos
from tacpipe.traces.spans import label_spans
from tacpipe.video import decoding, files, lengths
from tests.conftest import Lab
from tests.formats import video_files
from tests.video import videos
from tests.video.videos import Kind

KINDS = (
    Kind("avi", "mpeg4"),
    Kind("avi", "mjpeg"),
    Kind("mkv", "libx264"),
    Kind("mp4", "libx265"),
    Kind("webm", "libvpx-vp9"),
    Kind("mkv", "ffv1"),
)
COUNT = 40


SECTOR_BYTES = 512


def damage(path: Path, packet_index: int, fill: bytes = b"\xa5") -> None:
    """Put other bytes into the middle of a packet of a file."""
    content, packet = bytearray(path.read_bytes()), videos.packets(path)[packet_index]
    at = content.index(packet) + len(packet) // 3
    content[at : at + len(packet) // 2] = (fill * len(packet))[: len(packet) // 2]
    path.write_bytes(content)


def noisy_images(count: int = COUNT) -> Bytes:
    """Images whose packets are longer than a sector, (frame, row, column, rgb)."""
    noise = np.random.default_rng(0).integers(0, 60, (count, 24, 32, 3), np.uint8)
    return videos.images(count, 96, 128) // 2 + np.kron(noise, np.ones((1, 4, 4, 1), np.uint8))


# of lost blocks of other bytes, decoders of H.264 and H.265 do not notice each seventh to fifth
@pytest.mark.parametrize(
    ("kind", "fill"),
    [
        *((kind, b"\0") for kind in KINDS),
        *((kind, b"\xa5") for kind in KINDS if kind.encoder not in ("libx264", "libx265")),
    ],
    ids=lambda value: value.encoder if isinstance(value, Kind) else value.hex(),
)
def test_a_lost_sector_is_refused_or_each_frame_equals_that_of_the_sound_file_or_has_no_image(
    kind: Kind, fill: bytes, tmp_path: Path
) -> None:
    path = videos.write_images(tmp_path / f"a.{kind.ending}", kind.encoder, noisy_images())
    content, expected = path.read_bytes(), videos.decoded(path)
    starts = (
        np.linspace(4 * SECTOR_BYTES, len(content) - 4 * SECTOR_BYTES, 8).astype(int) // SECTOR_BYTES * SECTOR_BYTES
    )
    marked_count = 0
    for start in starts.tolist():
        path.write_bytes(content[:start] + fill * SECTOR_BYTES + content[start + SECTOR_BYTES :])
        notes: list[str] = []
        try:
            frames = files.scan(path)
            table = files.read_stream(path, frames, frames.times_ns(), None, notes).read_all()
        except TacpipeError:
            continue
        images = dict(decoding.decode_frames(frames.video_format, [table.slice(0, 20), table.slice(20)]))
        without_image = [row for row, image in images.items() if image is None]
        numbers = np.rint(frames.times_ns() / 40_000_000).astype(int)  # a damaged header of a packet can cost the frame
        for row, image in images.items():
            assert image is None or np.array_equal(image, expected[numbers[row]]), (start, row)
        if without_image:
            marked_count += 1
            assert np.flatnonzero(table[DAMAGED]).tolist() == without_image
            assert f"{len(without_image)} of {len(frames)} frames are damaged" in notes[0]
    assert marked_count


@pytest.mark.parametrize("shift", [-8, 8])
def test_jpeg_images_that_lack_their_start_or_end_are_damaged(shift: int, tmp_path: Path) -> None:
    path = videos.write(tmp_path / "a.mp4", "mjpeg")
    content = bytearray(path.read_bytes())
    at = content.index(b"stco") + 12
    content[at : at + 4] = (int.from_bytes(content[at : at + 4]) + shift).to_bytes(4)
    path.write_bytes(content)
    frames = files.scan(path)
    with pytest.raises(TacpipeError, match="none of the 30 frames can be decoded as mjpeg"):
        files.read_stream(path, frames, frames.times_ns(), None, [])


def test_frames_in_elements_that_matroska_does_not_know_are_noted(tmp_path: Path) -> None:
    path, notes = videos.write(tmp_path / "a.mkv", "mjpeg"), list[str]()
    content = path.read_bytes()
    packet = videos.packets(path)[20]
    header = content.rindex(b"\xa3", 0, content.index(packet))
    path.write_bytes(content[:header] + b"\xa2" + content[header + 1 :])
    frames = files.scan(path)
    files.read_stream(path, frames, frames.times_ns(), None, notes)
    assert len(frames) == 29
    assert re.search(r"a\.mkv is damaged: [\d,]+ bytes are not Matroska, and frames in them are missing", notes[0])


def test_damage_ends_at_the_next_key_frame(tmp_path: Path) -> None:
    path = videos.write(tmp_path / "a.avi", "mpeg4", COUNT)
    damage(path, 15)
    frames = files.scan(path)
    table = files.read_stream(path, frames, frames.times_ns(), None, []).read_all()
    damaged = np.flatnonzero(table[DAMAGED])
    keys = np.flatnonzero(frames.key_frame)
    assert keys.tolist()[:3] == [0, 12, 24]
    assert damaged[0] > 12 and damaged[-1] == 23
    assert [(span.lane, span.stop_ns) for span in label_spans(table)][-1] == (DAMAGED, 24 * 40_000_000)


def test_without_verification_frames_are_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = videos.write(tmp_path / "a.mp4", "mpeg4")
    monkeypatch.setattr(files, "damaged_frames", lambda *_: pytest.fail("frames were decoded"))
    frames = files.scan(path)
    with check_videos(VideoChecks(verify_video=False)):
        files.read_stream(path, frames, frames.times_ns(), None, [])


def test_a_codec_without_checks_is_noted(tmp_path: Path) -> None:
    path, notes = videos.write(tmp_path / "a.webm", "libvpx"), list[str]()
    frames = files.scan(path)
    files.read_stream(path, frames, frames.times_ns(), None, notes)
    assert "vp8, whose frames carry no check" in notes[0]


@pytest.mark.parametrize("kind", [*KINDS, Kind("mp4", "libx264")], ids=lambda kind: f"{kind.encoder}.{kind.ending}")
def test_a_file_that_is_cut_is_refused_or_accepted_with_a_note(kind: Kind, tmp_path: Path) -> None:
    path = videos.write_images(tmp_path / f"a.{kind.ending}", kind.encoder, noisy_images())
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    with pytest.raises(TacpipeError, match=r"is cut after frame \d+ of 40, and [\d,]+ bytes|cannot be read as a video"):
        files.scan(path)
    if kind.ending == "mp4":  # its tables were at the end
        return
    notes: list[str] = []
    with check_videos(VideoChecks(accept_cut=True)):
        frames = files.scan(path)
        files.read_stream(path, frames, frames.times_ns(), None, notes)
    assert 0 < len(frames) < COUNT and len(frames) + frames.cut_frames == COUNT
    assert f"is cut after frame {len(frames)} of 40" in notes[0]


def test_an_mp4_file_whose_tables_come_first_is_refused_if_it_is_cut(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for image in videos.images(COUNT):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    with pytest.raises(TacpipeError, match=r"is cut after frame \d+ of 40"):
        files.scan(path)


@pytest.mark.parametrize("ending", ["avi", "mkv", "mp4", "webm"])
def test_a_whole_file_lacks_no_bytes_and_a_cut_one_those_that_were_cut(ending: str, tmp_path: Path) -> None:
    path = videos.write(tmp_path / f"a.{ending}", "libvpx-vp9" if ending == "webm" else "mpeg4")
    demuxer = files.DEMUXERS[path.suffix]
    assert lengths.missing_bytes(path, demuxer) == 0
    path.write_bytes(path.read_bytes()[:-5])
    assert lengths.missing_bytes(path, demuxer) == 5


def test_a_file_that_was_written_without_seeking_states_no_length(tmp_path: Path) -> None:
    sink = io.BytesIO()
    sink.seekable = lambda: False  # type: ignore[method-assign]
    with av.open(sink, "w", format="matroska", options={"live": "1"}) as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for image in videos.images(5):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
    path = tmp_path / "a.mkv"
    path.write_bytes(sink.getvalue())
    assert lengths.missing_bytes(path, "matroska") == 0
    assert len(files.scan(path)) == 5


def test_rows_of_damaged_frames_are_null_and_counted_in_every_stage(lab: Lab) -> None:
    trial = video_files.write_gelsight(lab.folder / "source")
    lab.run("ingest gelsight-slip source -o sound")
    lab.run("extract difference --reference-frames 2 sound -o expected")
    damage(trial / "camera_0.avi", 5)
    ran = lab.run("ingest gelsight-slip source -o rec")
    assert "camera_0.avi: 8 of 13 frames are damaged" in ran.err
    ran = lab.run("extract difference --reference-frames 2 rec -o gel")
    assert "Stream gel0: 8 of 13 frames are damaged" in ran.err
    assert "8 damaged (gel0 8)" in ran.err
    expected, table = (tacpipe.open(name)["lemon-1"].table("gel0") for name in ("expected", "gel"))
    is_null = np.array(table["taxel0101_red"].is_null())
    assert is_null.sum() == 8 and len(table) == len(expected) == 13
    assert table.filter(~is_null).equals(expected.filter(~is_null))
    assert "8 damaged frames" in lab.run("show rec lemon-1").out


def test_a_cut_trial_is_left_out_with_skip_bad(lab: Lab) -> None:
    for number in (1, 2):
        trial = video_files.write_gelsight(lab.folder / "source", trial=number)
    path = trial / "camera_2.avi"
    content = path.read_bytes()
    path.write_bytes(content[: content.index(videos.packets(path)[9])])
    assert "is cut after frame" in lab.call("ingest gelsight-slip source -o rec").err
    lab.run("ingest gelsight-slip source -o rec --skip-bad")
    assert list(lab.manifest("rec").recordings) == ["lemon-1"]
    lab.run("ingest gelsight-slip source -o all --accept-cut")
    assert len(lab.manifest("all").recordings) == 2


def test_the_size_of_an_image_is_checked_before_it_is_decoded(tmp_path: Path) -> None:
    image = videos.images(1)[0]
    with av.open(str(tmp_path / "0.png"), "w", format="image2") as container:
        stream = container.add_stream("png")
        stream.height, stream.width, stream.pix_fmt = image.shape[0], image.shape[1], "rgb24"
        container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
    content = (tmp_path / "0.png").read_bytes()
    header = b"IHDR" + (16_380).to_bytes(4) + (16_000).to_bytes(4) + content[24:29]
    (tmp_path / "0.png").write_bytes(content[:12] + header + zlib.crc32(header).to_bytes(4) + content[33:])
    with pytest.raises(TacpipeError, match="more than 16,777,216 pixels"):
        files.scan_images([tmp_path / "0.png"])


def test_a_video_with_a_gap_of_months_takes_no_memory_for_it(lab: Lab) -> None:
    (lab.folder / "source").mkdir()
    with av.open(str(lab.folder / "source" / "a.mkv"), "w") as container:
        stream = container.add_stream("mjpeg", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
        for number, image in enumerate(videos.images(30)):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.time_base, frame.pts = Fraction(1, 25), number if number < 15 else number + 270_000_000
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    (lab.folder / "l.toml").write_text(
        '[streams.gel]\nfiles = "{trial}.mkv"\nformat = "video"\ntime = { rate_hz = 25 }\n'
    )
    lab.run("ingest table source --layout l.toml -o rec")
    assert tacpipe.open("rec")["a"].table("gel")["t_ns"][-1].as_py() == round(270_000_029 * 1e9 / 25)
    lab.run("extract difference rec -o gel")
    for command in ("synchronize gel --rate-hz 25 -o grid", "export lerobot gel --rate-hz 25 -o lr"):
        assert "the grid would have 270,000,031 rows" in lab.call(command).err
