"""Decode the frames of a stream to arrays one after another with PyAV (FFmpeg).

A frame is damaged if its decoder reports it, with an error, a mark at the frame or a message of the level error, or if
its packet contains zeros that its codec does not write, as a lost block of a disk leaves them. So are the packet before
it, because a lost block can begin there, and the frames after it up to the next key frame, because they are changes of
it. FFmpeg gives an invented image for most of them; here they have none.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import Bools, Bytes, Floats
from tacpipe.channels.schema import DAMAGED
from tacpipe.errors import TacpipeError
from tacpipe.plugins import extras
from tacpipe.printable import plain
from tacpipe.video.encoding import RGB, JpegEncoder
from tacpipe.video.stream import (
    BATCH_ROWS,
    DTS,
    KEY_FRAME,
    MAX_PIXELS,
    PACKET,
    PTS,
    VideoFormat,
    in_decode_order,
)

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.io.columns import Columns

NEEDED_BY = "Reading video"  # start of the error about a missing extra
MAX_DELAY = 16  # maximum number of frames that a decoder delays
# FFmpeg's own AV1 decoder needs a graphics card, and its own VP9 decoder does not report damage
DECODERS = {"av1": "libdav1d", "vp9": "libvpx-vp9"}
# codecs that never write `ZEROS` in a row: start codes must not appear in their data, or it is coded arithmetically
WITHOUT_ZEROS = ("av1", "h264", "hevc", "mpeg4", "vp8", "vp9")
ZEROS = bytes(64)
# markers of JPEG images (ITU-T T.81, annex B), of which none appears in the data of a scan
START_OF_IMAGE, START_OF_SCAN, END_OF_IMAGE = b"\xff\xd8", b"\xff\xda", b"\xff\xd9"
STRICT = ("hevc",)  # codecs whose decoder reports most damage only if an error ends the decoding of a frame
GREY = "gray"  # FFmpeg's name of the grey pixel format


def decode_frames(
    video_format: VideoFormat, batches: Iterable[pa.Table], *, grey: bool = False
) -> Iterator[tuple[int, Bytes | None]]:
    """Yield row number and image of each frame, uint8 (height, width, rgb), or (height, width) for ``grey``.

    ``batches`` are rows of a stream in presentation order that start at a key frame; rows are counted from the first of
    them. Frames are yielded in row order. The image of a damaged frame is None. A row without an image, such as an empty
    packet, is skipped. Few frames are in memory at once. Raises `TacpipeError` if a frame has another size, and
    `MissingModuleError` if PyAV is not installed.
    """
    pixels = GREY_PIXELS if grey else COLOUR_PIXELS
    for row, frame in raw_frames(video_format, batches):
        yield row, None if frame is None else pixels.of(frame)


@dataclass(frozen=True)
class Pixels:
    """The part of a frame that becomes an image, and the image's format and size. The default is the frame in colour."""

    format: str = RGB  # FFmpeg's name
    # left, top, width and height of the part in pixels; None for the complete frame
    roi: tuple[int, int, int, int] | None = None
    size: tuple[int, int] | None = None  # height and width of the image in pixels; None for those of the part

    def of(self, frame: Any) -> Bytes:
        """Return the image of PyAV's frame, uint8 (height, width, rgb), or (height, width) for grey."""
        if self.roi is not None:
            import av

            left, top, width, height = self.roi
            part = frame.to_ndarray(format=self.format, threads=1)[top : top + height, left : left + width]
            if self.size is None:
                return np.ascontiguousarray(part)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(part), format=self.format)
        height_px, width_px = self.size or (None, None)
        image: Bytes = frame.to_ndarray(format=self.format, height=height_px, width=width_px, threads=1)
        return image


COLOUR_PIXELS, GREY_PIXELS = Pixels(), Pixels(GREY)


def damaged_frames(video_format: VideoFormat, batches: Iterable[pa.Table], suspect: Bools) -> Bools:
    """Return whether each frame is damaged (frame,). ``suspect`` are frames that are damaged for another reason (frame,).

    The other arguments and the errors are those of `decode_frames`.
    """
    damaged = np.zeros(len(suspect), bool)
    for row, frame in raw_frames(video_format, batches, suspect):
        damaged[row] = frame is None
    return damaged


def cell_means(image: Bytes | Floats, rows: int, columns: int) -> Floats:
    """Return the mean of each cell and colour (row, column, colour) of an image (height, width, colour).

    Cells differ by a pixel if the height or width is not divisible.

    >>> cell_means(np.arange(12, dtype=np.uint8).reshape(2, 6, 1), 1, 2).tolist()
    [[[4.0], [7.0]]]
    """
    height, width, _ = image.shape
    tops = np.arange(rows) * height // rows
    lefts = np.arange(columns) * width // columns
    kinds = (
        (np.uint32, np.int64) if image.dtype == np.uint8 else (np.float64, np.float64)
    )  # sums of rows are below 2^32
    row_sums = np.add.reduceat(image, tops, axis=0, dtype=kinds[0])  # (row, width, colour)
    sums = np.add.reduceat(row_sums, lefts, axis=1, dtype=kinds[1])
    areas = np.outer(np.diff([*tops, height]), np.diff([*lefts, width]))  # (row, column)
    means: Floats = sums / areas[:, :, None]
    return means


def jpeg_images(video_format: VideoFormat, batches: Iterable[pa.Table]) -> Iterator[tuple[int, bytes]]:
    """Yield row number and JPEG of each sound frame, re-encoded with some loss for viewers."""
    encoder = JpegEncoder(video_format.width_px, video_format.height_px, "yuvj420p")
    for row, frame in raw_frames(video_format, batches):
        if frame is not None:
            yield row, encoder.encode(frame)


def decoded_columns(columns: Columns) -> list[str]:
    """Return the names of the columns of a stream of frames that decoding reads."""
    return [name for name in (PACKET, PTS, DTS, KEY_FRAME, DAMAGED) if name in columns.column_names]


def read_batches(columns: Columns, start: int = 0, stop: int | None = None) -> Iterator[pa.Table]:
    """Yield the rows ``start`` to ``stop`` (exclusive; None for the end) of a stream of frames in small batches.

    They are the batches that `decode_frames` reads.
    """
    first = 0
    end = columns.num_rows if stop is None else stop
    for batch in columns.batches(decoded_columns(columns), BATCH_ROWS):
        rows = batch.slice(max(0, start - first), max(0, end - max(first, start)))
        if rows.num_rows:
            yield rows
        first += batch.num_rows
        if first >= end:
            return


def raw_frames(
    video_format: VideoFormat, batches: Iterable[pa.Table], suspect: Bools | None = None
) -> Iterator[tuple[int, Any]]:
    """Yield row number and decoded frame of PyAV, or None if it is damaged, as those that are ``suspect`` (frame,).

    Raises the errors of `decode_frames`, and if the first is no key frame.
    """
    decoder, frames = FrameDecoder(video_format), _FramesInOrder(video_format)
    for row, columns in in_decode_order(video_format, batches):
        content, is_key_frame = columns[PACKET], bool(columns[KEY_FRAME])
        if not frames.started and not is_key_frame:
            raise TacpipeError(
                f"Frame {row} cannot be decoded: it is the first to be decoded, and no key frame. Start at a key frame."
            )
        frames.started = True
        if not isinstance(content, bytes) or not content:
            continue
        packet = padded_packet(content)
        packet.pts = packet.dts = row
        packet.is_keyframe = is_key_frame  # FFmpeg would add other PNG images to the previous one
        decoded, is_damaged = decoder.decode(packet)
        is_damaged |= has_lost_block(video_format.codec, content) or (suspect is not None and bool(suspect[row]))
        frames.add(row, is_key_frame=is_key_frame, is_damaged=is_damaged, is_marked=bool(columns.get(DAMAGED)))
        for frame in decoded:
            yield from frames.take(frame)
    if frames.started:
        for frame in decoder.decode(None)[0]:
            yield from frames.take(frame)
    yield from frames.take_rest()


@dataclass
class _FramesInOrder:
    """The rows that a decoder was given, until it is known whether they are damaged.

    A frame can be marked after frames that are changes of it were returned, because these are presented before it. So a
    row waits until all rows that were decoded before it, and the one after it, have been returned.
    """

    video_format: VideoFormat
    started: bool = False
    _key_row: int = 0  # row of the newest key frame
    _is_group_damaged: bool = False  # True if a frame since the newest key frame is damaged
    _is_previous_damaged: bool = False  # the same between the two newest key frames
    _damaged: dict[int, bool] = field(default_factory=dict)  # True for each damaged row that waits, in decoding order
    _frames: dict[int, Any] = field(default_factory=dict)  # frame by waiting row, of those that the decoder returned
    _returned: int = -1  # last row that the decoder returned; earlier ones without a frame get none
    _is_complete: bool = False  # True once the decoder has returned all frames

    def add(self, row: int, *, is_key_frame: bool, is_damaged: bool, is_marked: bool) -> None:
        """Add a row that the decoder was given. ``is_marked``: whether it is in the stream's mask of damaged frames."""
        if is_key_frame:
            self._is_previous_damaged, self._is_group_damaged, self._key_row = self._is_group_damaged, False, row
        if is_damaged and self._damaged:
            self._damaged[next(reversed(self._damaged))] = True
        self._is_group_damaged |= is_damaged
        # frames that are presented before a key frame and decoded after it can be changes of the previous group
        is_change = row < self._key_row and self._is_previous_damaged
        self._damaged[row] = self._is_group_damaged or is_change or is_marked

    def take(self, frame: Any) -> Iterator[tuple[int, Any]]:
        """Add a frame that the decoder returned. Yield the rows that wait no longer.

        Raises `TacpipeError` for a sound frame of another size.
        """
        row = int(frame.pts)
        if row not in self._damaged:  # a damaged stream can return a frame late
            return
        if frame.is_corrupt:
            waiting = list(self._damaged)
            self._damaged |= dict.fromkeys(waiting[max(0, waiting.index(row) - 1) :], True)
            self._is_group_damaged |= row >= self._key_row
            self._is_previous_damaged |= row < self._key_row
        self._frames[row], self._returned = frame, max(self._returned, row)
        yield from self._settle()

    def take_rest(self) -> Iterator[tuple[int, Any]]:
        """Yield the rows that still wait at the end of the stream."""
        self._is_complete = True
        yield from self._settle()

    def _settle(self) -> Iterator[tuple[int, Any]]:
        """Yield the first waiting rows. A sound row without a frame has no image, such as an empty packet."""
        while self._damaged:
            row = min(self._damaged)
            waiting = list(self._damaged)
            rows_to_return = waiting[: waiting.index(row) + 2]
            if not self._is_complete and (row == waiting[-1] or max(rows_to_return) > self._returned):
                return
            frame, is_damaged = self._frames.pop(row, None), self._damaged.pop(row)
            if is_damaged:
                yield row, None
            elif frame is not None:
                self._expect_size(row, frame)
                yield row, frame

    def _expect_size(self, row: int, frame: Any) -> None:
        """Raise `TacpipeError` if a frame does not have the size of the stream."""
        if (frame.width, frame.height) != (self.video_format.width_px, self.video_format.height_px):
            raise TacpipeError(
                f"Frame {row} has {frame.width} x {frame.height} pixels, and the stream {self.video_format.width_px} x "
                f"{self.video_format.height_px}. Frames of a stream have one size: divide the video where the size changes."
            )


class FrameDecoder:
    """Decodes packets one after another, and returns whether FFmpeg reports damage. Raises the errors of `open_decoder`."""

    def __init__(self, video_format: VideoFormat) -> None:
        self._context = open_decoder(video_format)

    def decode(self, packet: Any) -> tuple[list[Any], bool]:
        """Return the decoded frames of PyAV, and whether the packet is damaged. None as packet returns delayed frames."""
        import av

        with error_messages() as messages:
            try:
                frames: list[Any] = self._context.decode(packet)
            except (av.error.FFmpegError, ValueError):
                return [], True
            return frames, bool(messages)


def has_lost_block(codec: str, packet: bytes) -> bool:
    """Return whether a packet is a JPEG image without start or end, or contains zeros that its codec does not write."""
    if codec == "mjpeg" and (
        not packet.startswith(START_OF_IMAGE) or packet.find(END_OF_IMAGE, packet.rfind(START_OF_SCAN)) < 0
    ):
        return True
    if ZEROS not in packet:
        return False
    return codec in WITHOUT_ZEROS or (codec == "mjpeg" and not _codes_flat_blocks_as_zeros(packet))


def _codes_flat_blocks_as_zeros(image: bytes) -> bool:
    """Return whether zeros are flat blocks according to a JPEG image's own tables for brightness.

    The first symbol of a Huffman table has the code of zeros (ITU-T T.81, annex C). It is the end of a block only in
    tables that were made for an image; in those of annex K, which are also meant if there are none, it is not.
    """
    at = image.find(b"\xff\xc4")
    while 0 <= at < len(image) - 4:
        table, end = at + 4, at + 2 + int.from_bytes(image[at + 2 : at + 4])
        while table + 17 < min(end, len(image)):
            if image[table] == 0x10:  # coefficients of brightness
                return image[table + 17] == 0
            table += 17 + sum(image[table + 1 : table + 17])
        at = image.find(b"\xff\xc4", end)
    return False


_listeners_lock = threading.Lock()
_listeners = 0  # number of decoders that receive messages now


@contextmanager
def error_messages() -> Iterator[list[Any]]:
    """Yield a list to which FFmpeg's messages of the level error in this thread are added.

    FFmpeg is silent otherwise, because messages from threads of an encoder could block the process.
    """
    global _listeners
    import av.logging

    with _listeners_lock:
        _listeners += 1
        av.logging.set_skip_repeated(False)
        av.logging.set_level(av.logging.ERROR)
    try:
        with av.logging.Capture(local=True) as messages:
            yield messages
    finally:
        with _listeners_lock:
            _listeners -= 1
            if not _listeners:
                av.logging.set_level(None)


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
    strict = {"err_detect": "explode"} if video_format.codec in STRICT else {}
    context.options = {"max_pixels": str(MAX_PIXELS), **strict}
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
