"""Read which length a video file states, so that a file that was cut off is not taken for a shorter recording.

The outermost structures of the three kinds of files state their sizes: RIFF chunks of AVI (Microsoft, "AVI RIFF File
Reference"), EBML elements of Matroska (RFC 8794), and boxes of MP4 (ISO/IEC 14496-12). A file that is still written, or
was written without seeking, states none.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from tacpipe.io import regular

HEAD_BYTES = 16  # maximum size of the header of a structure
AVI_HEAD_BYTES = 52  # up to the number of frames in the main header of an AVI file


def missing_bytes(path: Path, demuxer: str) -> int:
    """Return by how many bytes a video file is shorter than its structures state; 0 for other kinds of files.

    ``demuxer`` is FFmpeg's name of the kind.
    """
    read_size = _SIZES.get(demuxer)
    if read_size is None:
        return 0
    with regular.opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        at = 0
        while 0 <= at < size:
            at = _end(file, at, read_size)
    return max(0, at - size)


def avi_frames(path: Path) -> int:
    """Return the number of frames in the main header of an AVI file (``dwTotalFrames``), 0 if it has none."""
    with regular.opened(path) as file:
        head = file.read(AVI_HEAD_BYTES)
    is_header = head[:4] == b"RIFF" and head[12:16] == b"LIST" and head[20:28] == b"hdrlavih"
    return int.from_bytes(head[48:52], "little") if is_header else 0


def _end(file: BinaryIO, at: int, read_size: Callable[[bytes], int]) -> int:
    """Return where the structure at ``at`` ends, or -1 if it states no size."""
    file.seek(at)
    size = read_size(file.read(HEAD_BYTES))
    return at + size if size > 0 else -1


def _riff_size(head: bytes) -> int:
    """Return the size of a RIFF chunk, header included, or 0 if it states none."""
    body_bytes = int.from_bytes(head[4:8], "little")
    return 8 + body_bytes + body_bytes % 2 if head[:4] == b"RIFF" and body_bytes else 0


def _ebml_size(head: bytes) -> int:
    """Return the size of an EBML element, header included, or 0 if it states none."""
    id_bytes = 9 - head[0].bit_length()
    if not 1 <= id_bytes <= 4 or len(head) <= id_bytes or not head[id_bytes]:
        return 0
    size_bytes = 9 - head[id_bytes].bit_length()
    body_bytes = int.from_bytes(head[id_bytes : id_bytes + size_bytes]) & ((1 << 7 * size_bytes) - 1)
    is_unknown = body_bytes == (1 << 7 * size_bytes) - 1
    return 0 if is_unknown else id_bytes + size_bytes + body_bytes


def _box_size(head: bytes) -> int:
    """Return the size of an MP4 box, header included, or 0 if it reaches to the end of the file."""
    if len(head) < 8:
        return HEAD_BYTES  # a header was begun
    size = int.from_bytes(head[:4])
    return int.from_bytes(head[8:16]) if size == 1 else size


_SIZES: dict[str, Callable[[bytes], int]] = {"avi": _riff_size, "matroska": _ebml_size, "mp4": _box_size}
