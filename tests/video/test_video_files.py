"""Video files become streams of frames, packet for packet, and streams become files again."""

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.arrays import Bytes
from tacpipe.errors import TacpipeError
from tacpipe.io.columns import Columns
from tacpipe.io.parquet import to_parquet
from tacpipe.video import decoding, files, frames, stream
from tests.video import videos
from tests.video.videos import Kind

KINDS = (
    Kind("avi", "mpeg4"),
    Kind("avi", "mjpeg"),
    Kind("mjpeg", "mjpeg"),
    Kind("mkv", "libx264"),
    Kind("mp4", "libx264"),
    Kind("mp4", "libx265"),
    Kind("avi", "libx264"),
)
REORDERED = Kind("mkv", "libx265")  # groups of pictures are open: frames before a key frame need it


def columns_of(path: Path) -> Columns:
    """The stream of a file as it is stored and read."""
    frames = files.scan(path)
    return Columns(to_parquet(files.read_stream(path, frames, frames.times_ns(), frames.stamp_origin(), []).read_all()))


@pytest.fixture(scope="module")
def open_groups(tmp_path_factory: pytest.TempPathFactory) -> tuple[Columns, list[Bytes]]:
    """A stream whose key frames are needed by frames before them, and its images."""
    path = videos.write(tmp_path_factory.mktemp("video") / "open.mkv", REORDERED.encoder, 40)
    return columns_of(path), videos.decoded(path)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: f"{kind.encoder}.{kind.ending}")
def test_frames_of_a_stored_stream_equal_those_of_the_file(kind: Kind, tmp_path: Path) -> None:
    path = videos.write(tmp_path / f"a.{kind.ending}", kind.encoder)
    expected = videos.decoded(path)

    columns = columns_of(path)
    video_format = stream.read_format(columns)
    assert video_format is not None
    images = videos.sound_images(video_format, decoding.read_batches(columns))

    assert list(images) == list(range(30))
    assert all(np.array_equal(images[row], image) for row, image in enumerate(expected))
    in_file_order = sorted(zip(columns.column("dts").to_pylist(), columns.column("packet").to_pylist(), strict=True))
    assert [packet for _, packet in in_file_order] == videos.packets(path)
    assert columns.column("t_ns").to_pylist() == [frame * 40_000_000 for frame in range(30)]
    assert columns.column("seq").to_pylist() == list(range(30))
    assert video_format.nominal_rate_hz == 25
    assert (video_format.reorder_frames > 0) == (kind.encoder in ("libx264", "libx265", "mpeg4"))


@pytest.mark.parametrize("kind", KINDS[:6], ids=lambda kind: f"{kind.encoder}.{kind.ending}")
@pytest.mark.parametrize("ending", ["mkv", "mp4"])
def test_a_file_written_from_a_stream_has_its_packets_and_frames(kind: Kind, ending: str, tmp_path: Path) -> None:
    path = videos.write(tmp_path / f"a.{kind.ending}", kind.encoder)
    columns = columns_of(path)
    video_format = stream.read_format(columns)
    assert video_format is not None

    files.write_file(tmp_path / f"out.{ending}", video_format, decoding.read_batches(columns))

    assert videos.packets(tmp_path / f"out.{ending}") == videos.packets(path)
    pairs = zip(videos.decoded(tmp_path / f"out.{ending}"), videos.decoded(path), strict=True)
    assert all(np.array_equal(image, original) for image, original in pairs)
    assert files.scan(tmp_path / f"out.{ending}").times_ns().tolist() == columns.column("t_ns").to_pylist()


@pytest.mark.parametrize("ending", ["avi", "mp4", "mkv"])
def test_missing_frames_leave_a_gap_in_the_counter(ending: str, tmp_path: Path) -> None:
    path = videos.write(tmp_path / f"a.{ending}", "mjpeg", absent=(5, 6, 20))
    frames = files.scan(path)
    counter = frames.counter()
    assert counter is not None
    assert counter.tolist() == [frame for frame in range(30) if frame not in (5, 6, 20)]


def test_frames_at_irregular_times_have_no_counter(tmp_path: Path) -> None:
    path = videos.write(tmp_path / "a.mkv", "mjpeg", 9, irregular=True)
    frames = files.scan(path)
    assert frames.counter() is None
    assert "seq" not in columns_of(path).column_names
    assert frames.times_ns().tolist() == [40_000_000 * frame * frame for frame in range(9)]


@given(data=st.data())
def test_every_cut_decodes_to_the_frames_of_the_whole_video(
    data: st.DataObject, open_groups: tuple[Columns, list[Bytes]]
) -> None:
    columns, expected = open_groups
    start = data.draw(st.integers(0, 39))
    stop = data.draw(st.integers(start + 1, 40))
    clocks = columns.read([stream.DTS, stream.KEY_FRAME])
    video_format = stream.read_format(columns)
    assert video_format is not None

    first, last = stream.cut_rows(clocks[stream.DTS].to_numpy(), clocks[stream.KEY_FRAME].to_numpy(), start, stop)

    assert first <= start
    assert last >= stop
    images = videos.sound_images(video_format, decoding.read_batches(columns, first, last))
    assert list(images) == list(range(last - first))
    assert all(np.array_equal(images[row - first], expected[row]) for row in range(first, last))


def test_single_frames_are_read_without_the_rest(open_groups: tuple[Columns, list[Bytes]]) -> None:
    columns, expected = open_groups
    images = frames.read_frames(columns, [39, 0, 17])
    assert sorted(images) == [0, 17, 39]
    assert all(np.array_equal(image, expected[row]) for row, image in images.items())
    grey = frames.read_frames(columns, [3], grey=True)[3]
    assert grey.shape == (videos.HEIGHT, videos.WIDTH)


def test_a_stream_that_begins_between_key_frames_is_refused(open_groups: tuple[Columns, list[Bytes]]) -> None:
    columns, _ = open_groups
    video_format = stream.read_format(columns)
    assert video_format is not None
    with pytest.raises(TacpipeError, match="no key frame"):
        list(decoding.decode_frames(video_format, decoding.read_batches(columns, 3, 9)))


def test_a_file_without_its_tables_is_one_sentence(tmp_path: Path) -> None:
    path = videos.write(tmp_path / "whole.mp4", "libx264")
    content = path.read_bytes()
    for size in (0, 7, 100, len(content) // 2, len(content) - 300):
        part = tmp_path / "part.mp4"
        part.write_bytes(content[:size])
        with pytest.raises(TacpipeError, match=r"part\.mp4"):
            files.scan(part)


def test_a_file_of_another_kind_is_not_opened_as_a_playlist(tmp_path: Path) -> None:
    videos.write(tmp_path / "real.mp4", "mjpeg", 3)
    playlist = tmp_path / "a.mp4"
    playlist.write_text("#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nreal.mp4\n#EXT-X-ENDLIST\n")
    with pytest.raises(TacpipeError, match=r"a\.mp4 cannot be read as a video"):
        files.scan(playlist)


def test_a_codec_that_a_kind_of_file_does_not_hold_is_one_sentence(tmp_path: Path) -> None:
    columns = columns_of(videos.write(tmp_path / "a.mp4", "libx265", 13))
    video_format = stream.read_format(columns)
    assert video_format is not None
    with pytest.raises(TacpipeError, match=r"out\.avi cannot be written"):
        files.write_file(tmp_path / "out.avi", video_format, decoding.read_batches(columns))


def test_metadata_without_a_format_is_one_sentence() -> None:
    with pytest.raises(TacpipeError, match="does not state its video format"):
        stream.VideoFormat.from_metadata({b"codec": b"h264", b"width_px": b"wide"})
    with pytest.raises(TacpipeError, match="no decoder"):
        decoding.open_decoder(stream.VideoFormat("unheard_of", 8, 8, "gray", Fraction(1, 25)))


def test_what_follows_a_packet_in_memory_does_not_change_its_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(videos, "OPTIONS", {"mpeg4": {"g": "12", "bf": "2"}})
    path = videos.write(tmp_path / "gel.avi", "mpeg4", 40)
    stored = [packet + b"\0\x80" + bytes(62) for packet in videos.packets(path)]  # a resync marker of MPEG-4 follows
    packets = [memoryview(content)[:-64] for content in stored]
    context: Any = av.CodecContext.create("mpeg4", "r")
    context.thread_count = 1
    frames = [frame for packet in packets for frame in context.decode(decoding.padded_packet(packet))]
    images = [frame.to_ndarray(format="rgb24", threads=1) for frame in [*frames, *context.decode(None)]]
    assert np.array_equal(images, videos.decoded(path))


def test_a_video_of_an_unknown_codec_is_refused(tmp_path: Path) -> None:
    path = videos.write(tmp_path / "a.avi", "mjpeg", 3)
    path.write_bytes(path.read_bytes().replace(b"MJPG", b"ZZZZ"))
    with pytest.raises(TacpipeError, match=r"a\.avi has a video of a codec that cannot be decoded"):
        files.scan(path)
