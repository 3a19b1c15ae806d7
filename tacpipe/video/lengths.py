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


def foreign_bytes(path: Path) -> int:
    """Return the size of the elements in the segment and the clusters of a Matroska file that Matroska does not know.

    FFmpeg skips them without a message, with the frames that they may have held before their name was damaged.
    """
    lost, at = 0, 0
    with regular.opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        while at < size:
            file.seek(at)
            name, head_bytes, body_bytes = _ebml_head(file.read(HEAD_BYTES))
            end = size if body_bytes is None else min(size, at + head_bytes + body_bytes)
            if not name:
                break
            lost += 0 if name in _NESTING or name in _ELEMENTS else end - at
            at = at + head_bytes if name in _NESTING else end
    return lost


_NESTING = ("18538067", "1F43B675")  # segment and cluster
_ELEMENTS = (  # RFC 9559: those of a file, a segment and a cluster, and those that any element may have
    *("1A45DFA3", "114D9B74", "1549A966", "1654AE6B", "1C53BB6B", "1941A469", "1043A770", "1254C367"),
    *("E7", "5854", "A7", "AB", "A3", "A0", "AF", "EC", "BF"),
)


def _ebml_head(head: bytes) -> tuple[str, int, int | None]:
    """Return name in hex, size of header and size of body of an EBML element: None if unknown; no name if it is none."""
    id_bytes = 9 - head[0].bit_length()
    if not 1 <= id_bytes <= 4 or len(head) <= id_bytes or not head[id_bytes]:
        return "", 0, 0
    size_bytes = 9 - head[id_bytes].bit_length()
    body_bytes = int.from_bytes(head[id_bytes : id_bytes + size_bytes]) & ((1 << 7 * size_bytes) - 1)
    is_unknown = body_bytes == (1 << 7 * size_bytes) - 1
    return head[:id_bytes].hex().upper(), id_bytes + size_bytes, None if is_unknown else body_bytes


def _ebml_size(head: bytes) -> int:
    """Return the size of an EBML element, header included, or 0 if it states none."""
    _, head_bytes, body_bytes = _ebml_head(head)
    return 0 if body_bytes is None else head_bytes + body_bytes


def _box_size(head: bytes) -> int:
    """Return the size of an MP4 box, header included, or 0 if it reaches to the end of the file."""
    if len(head) < 8:
        return HEAD_BYTES  # a header was begun
    size = int.from_bytes(head[:4])
    return int.from_bytes(head[8:16]) if size == 1 else size


_SIZES: dict[str, Callable[[bytes], int]] = {"avi": _riff_size, "matroska": _ebml_size, "mp4": _box_size}
