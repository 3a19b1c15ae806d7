"""Write frames of cameras as messages that viewers show: compressed video of codecs that Foxglove plays, or JPEG."""

from __future__ import annotations

from collections.abc import Iterator

import pyarrow as pa

from tacpipe.exports import ros
from tacpipe.exports.contents import TIME
from tacpipe.exports.ros import Topic
from tacpipe.io.columns import Columns
from tacpipe.video.decoding import jpeg_images, read_batches
from tacpipe.video.stream import KEY_FRAME, PACKET, VideoFormat, in_decode_order

PLAYED = {"h264": "h264", "hevc": "h265", "vp9": "vp9", "av1": "av1"}  # codecs that Foxglove plays, with its names
VIDEO, IMAGE = "foxglove_msgs/CompressedVideo", "sensor_msgs/CompressedImage"
START_CODE = b"\x00\x00\x00\x01"


class Pictures:
    """The frames of a stream, requested block by block in the order of rows."""

    def __init__(self, columns: Columns, video_format: VideoFormat) -> None:
        self._columns, self._format = columns, video_format
        self.is_video = video_format.codec in PLAYED and not video_format.reorder_frames  # Foxglove plays no B-frames
        self._frames: Iterator[tuple[int, bytes]] | None = None
        self._next: tuple[int, bytes] | None = None
        self._stop = 0  # row after the last block

    def topic(self, stream: str, table: pa.Table) -> Topic:
        """Return the topic of the next block of rows; rows without a frame have no message."""
        first, self._stop = self._stop, self._stop + table.num_rows
        block = list(self._frames_before(self._stop)) if table.num_rows else []
        t_ns = table.column(TIME).to_numpy()[[row - first for row, _ in block]]
        content = ros.Texts([data for _, data in block])
        if self.is_video:
            return ros.derived_topic(stream, "video", VIDEO, t_ns, [content, ros.text_part(PLAYED[self._format.codec])])
        return ros.derived_topic(stream, "image", IMAGE, t_ns, [ros.text_part("jpeg"), content])

    def _frames_before(self, stop: int) -> Iterator[tuple[int, bytes]]:
        """Yield row and content of the following frames before the row ``stop``."""
        if self._frames is None:
            batches = read_batches(self._columns)
            self._frames = self._packets(batches) if self.is_video else jpeg_images(self._format, batches)
        while (frame := self._next or next(self._frames, None)) is not None:
            self._next = None
            if frame[0] >= stop:
                self._next = frame
                return
            yield frame

    def _packets(self, batches: Iterator[pa.Table]) -> Iterator[tuple[int, bytes]]:
        """Yield row and content of each frame's packet, with parameter sets before key frames."""
        headers, size_bytes = parameter_sets(self._format)
        for row, columns in in_decode_order(self._format, batches):
            packet = columns[PACKET]
            if isinstance(packet, bytes) and packet:
                content = with_start_codes(packet, size_bytes) if size_bytes else packet
                yield row, headers + content if columns[KEY_FRAME] else content


def parameter_sets(video_format: VideoFormat) -> tuple[bytes, int]:
    """Return the parameter sets that a decoder needs before a key frame, and the width in bytes of a unit's size.

    In files, H.264 and H.265 units are preceded by their size (ISO/IEC 14496-15), but Foxglove expects start codes. The
    width is 0 for packets with start codes and for other codecs.
    """
    extradata = video_format.extradata
    if video_format.codec not in ("h264", "hevc"):
        return b"", 0
    if extradata[:1] != b"\x01":  # the packets already have start codes
        return extradata, 0
    units: list[bytes] = []
    if video_format.codec == "h264":
        offset, size_bytes = 5, (extradata[4] & 3) + 1
        for mask in (0x1F, 0xFF):  # sequence parameter sets, picture parameter sets
            count, offset = extradata[offset] & mask, offset + 1
            offset = _read_units(extradata, offset, count, units)
    else:
        offset, size_bytes = 23, (extradata[21] & 3) + 1
        for _ in range(extradata[22]):
            offset = _read_units(extradata, offset + 3, int.from_bytes(extradata[offset + 1 : offset + 3]), units)
    return b"".join(START_CODE + unit for unit in units), size_bytes


def with_start_codes(packet: bytes, size_bytes: int) -> bytes:
    """Return a packet whose units have start codes in place of their sizes."""
    units, offset = [], 0
    while offset + size_bytes <= len(packet):
        stop = offset + size_bytes + int.from_bytes(packet[offset : offset + size_bytes])
        units.append(START_CODE + packet[offset + size_bytes : stop])
        offset = stop
    return b"".join(units)


def _read_units(extradata: bytes, offset: int, count: int, units: list[bytes]) -> int:
    """Append ``count`` units, each preceded by its size in two bytes, to ``units``; return the offset after them."""
    stop = offset
    for _ in range(count):
        start = stop + 2
        stop = start + int.from_bytes(extradata[stop:start])
        units.append(extradata[start:stop])
    return stop
