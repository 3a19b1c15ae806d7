"""Decode the frames of a stream to arrays one after another with PyAV (FFmpeg)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import Bytes, Floats
from tacpipe.errors import TacpipeError
from tacpipe.plugins import extras
from tacpipe.printable import plain
from tacpipe.video.encoding import RGB, JpegEncoder
from tacpipe.video.stream import (
    BATCH_ROWS,
    DTS,
    KEY_FRAME,
    PACKET,
    PTS,
    VideoFormat,
    cut_rows,
    in_decode_order,
    read_format,
)

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.io.columns import Columns

NEEDED_BY = "Reading video"  # start of the error about a missing extra
MAX_DELAY = 16  # maximum number of frames that a decoder delays
DECODERS = {"av1": "libdav1d"}  # FFmpeg's own AV1 decoder needs a graphics card
GREY = "gray"  # FFmpeg's name of the grey pixel format


def decode_frames(
    video_format: VideoFormat, batches: Iterable[pa.Table], *, grey: bool = False
) -> Iterator[tuple[int, Bytes]]:
    """Yield row number and image of each frame, uint8 (height, width, rgb), or (height, width) for ``grey``.

    ``batches`` are rows of a stream in presentation order that start at a key frame; rows are counted from the first of
    them. Frames are yielded in row order. A row without an image, such as an empty packet, is skipped. Few frames are
    in memory at once. Raises `TacpipeError` if a frame cannot be decoded or has another size, and `MissingModuleError`
    if PyAV is not installed.
    """
    for row, frame in _decode(video_format, batches):
        image: Bytes = frame.to_ndarray(format=GREY if grey else RGB, threads=1)
        yield row, image


def cell_means(image: Bytes, rows: int, columns: int) -> Floats:
    """Return the mean of each cell and colour (row, column, colour) of an image (height, width, colour).

    Cells differ by a pixel if the height or width is not divisible.

    >>> cell_means(np.arange(12, dtype=np.uint8).reshape(2, 6, 1), 1, 2).tolist()
    [[[4.0], [7.0]]]
    """
    height, width, _ = image.shape
    tops = np.arange(rows) * height // rows
    lefts = np.arange(columns) * width // columns
    row_sums = np.add.reduceat(image, tops, axis=0, dtype=np.uint32)  # (row, width, colour), below 2^32
    sums = np.add.reduceat(row_sums, lefts, axis=1, dtype=np.int64)
    areas = np.outer(np.diff([*tops, height]), np.diff([*lefts, width]))  # (row, column)
    means: Floats = sums / areas[:, :, None]
    return means


def jpeg_images(video_format: VideoFormat, batches: Iterable[pa.Table]) -> Iterator[tuple[int, bytes]]:
    """Yield row number and JPEG of each frame, in the order of `decode_frames`, re-encoded with some loss for viewers."""
    encoder = JpegEncoder(video_format.width_px, video_format.height_px, "yuvj420p")
    for row, frame in _decode(video_format, batches):
        yield row, encoder.encode(frame)


def read_batches(columns: Columns, start: int = 0, stop: int | None = None) -> Iterator[pa.Table]:
    """Yield the rows ``start`` to ``stop`` (exclusive; None for the end) of a stream of frames in small batches.

    They are the batches that `decode_frames` reads.
    """
    first = 0
    end = columns.num_rows if stop is None else stop
    for batch in columns.batches([PACKET, PTS, DTS, KEY_FRAME], BATCH_ROWS):
        rows = batch.slice(max(0, start - first), max(0, end - max(first, start)))
        if rows.num_rows:
            yield rows
        first += batch.num_rows
        if first >= end:
            return


def read_frames(columns: Columns, rows: Sequence[int], *, grey: bool = False) -> dict[int, Bytes]:
    """Return the images of some rows of a stream of frames by row, as `decode_frames` yields them.

    For each row, decoding starts at the preceding key frame. Raises `TacpipeError` if the stream has no frames, or one
    cannot be decoded. Rows without an image are missing.
    """
    video_format = read_format(columns)
    if video_format is None:
        raise TacpipeError("This stream holds no frames. Give the stream of a camera.")
    clocks = columns.read([DTS, KEY_FRAME])
    dts, key_frame = clocks[DTS].to_numpy(), clocks[KEY_FRAME].to_numpy()
    images: dict[int, Bytes] = {}
    pending = sorted(set(rows))
    while pending:
        start, stop = cut_rows(dts, key_frame, pending[0], pending[0] + 1)
        group = [row for row in pending if row < stop]
        for index, frame in _decode(video_format, read_batches(columns, start, stop)):
            if start + index in group:
                images[start + index] = frame.to_ndarray(format=GREY if grey else RGB, threads=1)
        pending = pending[len(group) :]
    return images


def _decode(video_format: VideoFormat, batches: Iterable[pa.Table]) -> Iterator[tuple[int, Any]]:
    """Yield row number and decoded frame of PyAV.

    Raises the errors of `decode_frames`, and if the first is no key frame.
    """
    with extras.explain_missing(NEEDED_BY):
        import av
    context = open_decoder(video_format)
    started = False
    row = 0
    try:
        for row, columns in in_decode_order(video_format, batches):
            if not started and not columns[KEY_FRAME]:
                raise TacpipeError(
                    f"Frame {row} cannot be decoded: it is the first to be decoded, and no key frame. Start at a key frame."
                )
            started = True
            content = columns[PACKET]
            if not isinstance(content, bytes) or not content:
                continue
            packet = padded_packet(content)
            packet.pts = packet.dts = row
            packet.is_keyframe = bool(columns[KEY_FRAME])  # FFmpeg would add other PNG images to the previous one
            for frame in context.decode(packet):
                yield _row_and_frame(video_format, frame)
        for frame in context.decode(None) if started else ():
            yield _row_and_frame(video_format, frame)
    except (av.error.FFmpegError, ValueError) as error:
        reason = plain(str(getattr(error, "strerror", None) or error), 100)
        raise TacpipeError(
            f"Frame {row} cannot be decoded as {plain(video_format.codec)}: {reason}. Check that the video plays in another "
            f"program, and ingest it again."
        ) from error


def open_decoder(video_format: VideoFormat) -> Any:
    """Return a single-threaded PyAV decoder. Raises `TacpipeError` if FFmpeg has none for the codec."""
    with extras.explain_missing(NEEDED_BY):
        import av
    try:
        context: Any = av.CodecContext.create(DECODERS.get(video_format.codec, video_format.codec), "r")
    except ValueError as error:  # UnknownCodecError is a ValueError
        raise TacpipeError(
            f"There is no decoder for the codec {plain(video_format.codec)}. Convert the video to H.264 first."
        ) from error
    context.thread_count = 1  # a stage uses one core per recording
    context.width, context.height = video_format.width_px, video_format.height_px
    if video_format.pixel_format:
        context.pix_fmt = video_format.pixel_format
    if video_format.extradata:
        context.extradata = video_format.extradata
    context.reorder_depth = min(video_format.reorder_frames, MAX_DELAY)
    return context


def padded_packet(data: bytes | memoryview) -> Any:
    """Return a packet of PyAV with a copy of ``data`` and the zero bytes behind it that FFmpeg's decoders may read.

    `av.Packet` of bytes refers to them without such padding, so that the last blocks of a frame depend on whatever
    follows in memory.
    """
    import av

    packet: Any = av.Packet(len(data))
    packet.update(data)
    return packet


def _row_and_frame(video_format: VideoFormat, frame: Any) -> tuple[int, Any]:
    """Return row number and frame. Raises `TacpipeError` if its size is not the stream's."""
    if (frame.width, frame.height) != (video_format.width_px, video_format.height_px):
        raise TacpipeError(
            f"Frame {frame.pts} has {frame.width} x {frame.height} pixels, and the stream {video_format.width_px} x "
            f"{video_format.height_px}. Frames of a stream have one size: divide the video where the size changes."
        )
    return int(frame.pts), frame
