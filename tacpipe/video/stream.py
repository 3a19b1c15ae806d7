"""Describe streams of frames: one row per frame with its encoded packet; the packet column's metadata name the codec.

Rows are in presentation order. `DTS` gives the decoding order, which differs if a codec has B-frames. Rows whose
`KEY_FRAME` is true can be decoded without earlier rows. pyarrow is imported when fields are built.
"""

from __future__ import annotations

import base64
import binascii
import contextlib
import heapq
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.channels.schema import DAMAGED, device_fields, time_field
from tacpipe.errors import TacpipeError
from tacpipe.printable import excerpt, listed, plain
from tacpipe.signals.runs import runs

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import Bools, Int64s
    from tacpipe.io.columns import Columns

PACKET, PTS, DTS, KEY_FRAME = "packet", "pts", "dts", "key_frame"
BATCH_ROWS = 64  # number of encoded frames in memory at once
MAX_SIDE_PX = 1 << 14  # maximum width and height of a frame
MAX_PIXELS = 1 << 24  # maximum size of a frame, whose image then has 50 MB; 4096 x 4096 pixels
MAX_REORDER = 1 << 10  # maximum plausible number of frames between decoding and presentation
_CODEC, _WIDTH, _HEIGHT, _PIXELS = "codec", "width_px", "height_px", "pixel_format"
_TIME_BASE, _RATE, _EXTRADATA, _REORDER = "time_base_s", "nominal_rate_hz", "extradata", "reorder_frames"


@dataclass(frozen=True)
class VideoFormat:
    """The codec of a stream of frames, and everything else that a decoder or a file needs besides the packets."""

    codec: str  # FFmpeg's name, such as mjpeg, mpeg4, h264, hevc, av1, png
    width_px: int
    height_px: int
    pixel_format: str  # FFmpeg's name, such as yuv420p
    time_base: Fraction  # seconds per unit of pts and dts
    nominal_rate_hz: Fraction | None = None  # frames per second according to the source; None without a common rate
    extradata: bytes = b""  # codec headers that are not part of a packet
    reorder_frames: int = 0  # maximum number of rows by which a frame is decoded before it is presented

    def __post_init__(self) -> None:
        """Check the values. Raises `TacpipeError` for implausible ones."""
        sides_fit = 0 < self.width_px <= MAX_SIDE_PX and 0 < self.height_px <= MAX_SIDE_PX
        sides_fit = sides_fit and self.width_px * self.height_px <= MAX_PIXELS
        if not sides_fit or self.time_base <= 0 or not 0 <= self.reorder_frames <= MAX_REORDER or not self.codec:
            raise TacpipeError(
                f"A video of {self.width_px} x {self.height_px} pixels (codec {self.codec or 'unknown'}, time base "
                f"{self.time_base} s, {self.reorder_frames} frames out of order) cannot be read; frames have 1 to "
                f"{MAX_SIDE_PX} pixels a side, and at most {MAX_PIXELS:,} in all."
            )

    def describe(self) -> str:
        """Return codec, size and rate as text, such as ``mpeg4, 320 x 240 pixels, 25 frames/s``."""
        rate = "" if self.nominal_rate_hz is None else f", {float(self.nominal_rate_hz):.6g} frames/s"
        return f"{plain(self.codec)}, {self.width_px} x {self.height_px} pixels{rate}"

    def to_metadata(self) -> dict[str, str]:
        """Return the metadata of the packet column, from which `from_metadata` restores the format."""
        rate = {} if self.nominal_rate_hz is None else {_RATE: str(self.nominal_rate_hz)}
        headers = {_EXTRADATA: base64.b64encode(self.extradata).decode()} if self.extradata else {}
        return {
            "quantity": "image",
            _CODEC: self.codec,
            _WIDTH: str(self.width_px),
            _HEIGHT: str(self.height_px),
            _PIXELS: self.pixel_format,
            _TIME_BASE: str(self.time_base),
            **rate,
            _REORDER: str(self.reorder_frames),
            **headers,
        }

    @classmethod
    def from_metadata(cls, metadata: Mapping[bytes, bytes]) -> VideoFormat:
        """Return the format in the metadata of a packet column. Raises `TacpipeError` if there is none."""
        texts = {key.decode(errors="replace"): value.decode(errors="replace") for key, value in metadata.items()}
        try:
            _expect_video(texts[_CODEC], texts[_PIXELS])
            return cls(
                texts[_CODEC],
                int(texts[_WIDTH]),
                int(texts[_HEIGHT]),
                texts[_PIXELS],
                Fraction(texts[_TIME_BASE]),
                Fraction(texts[_RATE]) if _RATE in texts else None,
                base64.b64decode(texts.get(_EXTRADATA, ""), validate=True),
                int(texts[_REORDER]),
            )
        except (KeyError, ValueError, ZeroDivisionError, binascii.Error) as error:
            raise TacpipeError(
                f"The column {PACKET} does not state its video format ({excerpt(error)}). Ingest the recording again."
            ) from error

    def fields(self) -> list[pa.Field]:
        """Return the fields ``packet``, ``pts``, ``dts`` and ``key_frame``."""
        import pyarrow as pa

        ticks = {"unit": "1", "quantity": "time"}
        return [
            pa.field(PACKET, pa.binary(), metadata=self.to_metadata()),
            pa.field(PTS, pa.int64(), metadata=ticks),
            pa.field(DTS, pa.int64(), metadata=ticks),
            pa.field(KEY_FRAME, pa.bool_(), metadata={"unit": "1", "quantity": "mask"}),
        ]

    def schema(self, stamp_origin: str | None = None, *, counted: bool = True) -> pa.Schema:
        """Return the schema of a stream: ``t_ns``, ``seq`` if frames are ``counted``, and `fields`.

        ``stamp_origin`` is the origin of timestamps that do not come from a clock.
        """
        import pyarrow as pa

        counter = device_fields(clock=False, counters=["seq"]) if counted else []
        return pa.schema([time_field(stamp_origin), *counter, *self.fields()])


def damage_field() -> pa.Field:
    """Return the field ``damaged``, a mask of the frames that the decoder reports as damaged when they are ingested."""
    import pyarrow as pa

    return pa.field(DAMAGED, pa.bool_(), metadata={"unit": "1", "quantity": "mask"})


def describe_damage(damaged: Bools) -> str:
    """Return text that counts and names the damaged frames (frame,), numbered from 0.

    >>> describe_damage(np.array([False, True, True, True, False, True]))
    '4 of 6 frames are damaged (1 to 3, 5)'
    """
    starts, stops = runs(damaged)
    frames = [
        f"{start}" if stop == start + 1 else f"{start} to {stop - 1}"
        for start, stop in zip(starts.tolist(), stops.tolist(), strict=True)
    ]
    return f"{damaged.sum():,} of {len(damaged):,} frames are damaged ({listed(frames)})"


def _expect_video(codec: str, pixel_format: str) -> None:
    """Raise `ValueError` if FFmpeg knows the codec as one of other data than video, or does not know the pixel format."""
    try:
        import av
    except ImportError:  # decoding reports it
        return
    with contextlib.suppress(av.codec.codec.UnknownCodecError):  # decoding reports that there is no decoder
        if (kind := av.Codec(codec, "r").type) != "video":
            raise ValueError(f"{plain(codec)} is a codec of {kind}")
    if pixel_format:
        av.VideoFormat(pixel_format)


def read_format(source: pa.Table | pa.Schema | Columns) -> VideoFormat | None:
    """Return the format of a stream of frames, or None for other streams.

    Raises the errors of `VideoFormat.from_metadata`.
    """
    schema: pa.Schema = getattr(source, "schema", source)
    if not {PACKET, DTS, KEY_FRAME} <= set(schema.names):
        return None
    metadata = schema.field(PACKET).metadata or {}
    return VideoFormat.from_metadata(metadata) if _CODEC.encode() in metadata else None


def reorder_frames(dts: Int64s) -> int:
    """Return the maximum number of rows by which a frame is decoded before it is presented.

    >>> reorder_frames(np.array([0, 2, 3, 1, 4]))  # presented I B B P P, decoded I P B B P
    2
    """
    if not len(dts):
        return 0
    decode_index = np.argsort(np.argsort(dts, kind="stable"), kind="stable")
    return int((np.arange(len(dts)) - decode_index).max())


def in_decode_order(
    video_format: VideoFormat, batches: Iterable[pa.Table]
) -> Iterator[tuple[int, dict[str, int | bool | bytes]]]:
    """Yield row number and columns of each frame in decoding order, given batches of rows in presentation order.

    At most ``reorder_frames`` frames are buffered.
    """
    buffered: list[tuple[int, int, dict[str, int | bool | bytes]]] = []  # dts, row, columns
    row = 0
    for batch in batches:
        names = [name for name in (PACKET, PTS, DTS, KEY_FRAME, DAMAGED) if name in batch.column_names]
        for columns in batch.select(names).to_pylist():
            heapq.heappush(buffered, (columns[DTS], row, columns))
            row += 1
            if len(buffered) > video_format.reorder_frames:
                _, index, frame = heapq.heappop(buffered)
                yield index, frame
    while buffered:
        _, index, frame = heapq.heappop(buffered)
        yield index, frame


def cut_rows(dts: Int64s, key_frame: Bools, start: int, stop: int) -> tuple[int, int]:
    """Return the smallest range of rows that contains rows ``start`` to ``stop`` (exclusive) and can be decoded by itself.

    It starts at a key frame, and no frame in it needs one that is presented later. Raises `TacpipeError` if no key
    frame precedes ``start``, or the rows are not in the stream.
    """
    ((first, last),) = _ranges(dts, key_frame, np.array([start]), np.array([stop]))
    return int(first), int(last)


def decodable_ranges(dts: Int64s, key_frame: Bools, rows: Int64s) -> Int64s:
    """Return start and stop (exclusive) of the ranges to decode for increasing ``rows``, as (range, 2).

    Each row is in the range that `cut_rows` returns for it; ranges that touch are joined. Raises the errors of `cut_rows`.
    """
    if not len(rows):
        return np.zeros((0, 2), np.int64)
    starts, stops = _ranges(dts, key_frame, rows, rows + 1).T
    firsts = np.flatnonzero(np.append(True, starts[1:] > np.maximum.accumulate(stops)[:-1]))
    return np.column_stack([starts[firsts], np.maximum.reduceat(stops, firsts)])


def group_bounds(dts: Int64s, key_frame: Bools) -> Int64s:
    """Return the first row of each group of pictures that can be decoded by itself, and the number of rows (group + 1,).

    Rows before the first key frame belong to no group.
    """
    keys = np.flatnonzero(key_frame)
    bounds = keys[np.isin(keys, _cuts(dts)) | (keys == keys[:1])]
    return np.append(bounds, len(dts))


def _ranges(dts: Int64s, key_frame: Bools, starts: Int64s, stops: Int64s) -> Int64s:
    """Return the range of `cut_rows` for each pair of ``starts`` and ``stops``, as (pair, 2)."""
    is_outside = (starts < 0) | (starts >= stops) | (stops > len(dts))
    if is_outside.any():
        at = int(np.argmax(is_outside))
        raise TacpipeError(f"The rows {starts[at]} to {stops[at]} are not in a stream of {len(dts)} frames.")
    keys = np.flatnonzero(key_frame)
    before = np.searchsorted(keys, starts, side="right")  # number of key frames up to each start
    if not before.all():
        raise TacpipeError(
            f"Frame {starts[np.argmin(before)]} cannot be decoded: no key frame precedes it. Record or export the video "
            f"from a key frame on."
        )
    cuts = _cuts(dts)
    return np.column_stack([keys[before - 1], cuts[np.searchsorted(cuts, stops)]])


def _cuts(dts: Int64s) -> Int64s:
    """Return the rows before which a stream can be cut, and the number of rows: no later one is decoded before it."""
    latest = np.maximum.accumulate(dts)  # (row,)
    earliest = np.minimum.accumulate(dts[::-1])[::-1]  # (row,), earliest decoding time of this row and all later ones
    return 1 + np.flatnonzero(np.append(latest[:-1] < earliest[1:], True))
