"""Recognize images by their bytes, and make streams of frames from columns of images.

Images of a column are encoded (JPEG, PNG), or raw rows of pixels. Either way they become packets unchanged.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, ArrayType, Int64s
from tacpipe.errors import TacpipeError
from tacpipe.printable import plain
from tacpipe.video.encoding import MICROSECOND
from tacpipe.video.stream import BATCH_ROWS, DTS, KEY_FRAME, MAX_SIDE_PX, PACKET, PTS, VideoFormat

START, END = b"\xff\xd8", b"\xff\xd9"  # first and last bytes of a JPEG image
END_BYTES = 4096  # maximum number of bytes with which a camera pads an image
# pixel formats by the ratio of luma to chroma samples, (horizontal, vertical)
PIXEL_FORMATS = {(1, 1): "yuvj444p", (2, 1): "yuvj422p", (2, 2): "yuvj420p", (1, 2): "yuvj440p"}


class ImageShape(NamedTuple):
    """Size and pixel format in the header of a JPEG image."""

    width_px: int
    height_px: int
    pixel_format: str  # FFmpeg's name of the pixel format


def read_shape(image: bytes) -> ImageShape | None:
    """Return the size and the pixel format of a JPEG image, or None for bytes that are not a complete JPEG image."""
    if image[:2] != START or image.rfind(END, max(2, len(image) - END_BYTES)) < 0:
        return None
    offset = 2
    while offset + 4 <= len(image) and image[offset] == 0xFF:
        marker, size = image[offset + 1], int.from_bytes(image[offset + 2 : offset + 4])
        if 0xC0 <= marker <= 0xC2:
            return _shape_of_frame(image[offset + 4 : offset + 2 + size])
        offset += 2 + size
    return None


def _shape_of_frame(segment: bytes) -> ImageShape | None:
    """Return the shape in a start-of-frame segment: bits, height, width, components, and the sampling of each.

    None if the segment is incomplete or its pixel format is unknown.
    """
    if len(segment) < 6 or segment[0] != 8 or len(segment) < 6 + 3 * segment[5]:
        return None
    height, width, components = int.from_bytes(segment[1:3]), int.from_bytes(segment[3:5]), segment[5]
    pixel_format = "gray" if components == 1 else ""
    if components == 3:
        (luma_x, luma_y), (chroma_x, chroma_y) = (divmod(segment[offset], 16) for offset in (7, 10))
        ratio = (luma_x // max(chroma_x, 1), luma_y // max(chroma_y, 1))
        pixel_format = PIXEL_FORMATS.get(ratio, "")
    return ImageShape(width, height, pixel_format) if pixel_format and width and height else None


PICTURE = "data"  # name of a column of images, the same as in image messages
PNG = b"\x89PNG\r\n\x1a\n"
PNG_FORMATS = {
    (1, 0): "monob",
    (8, 0): "gray",
    (8, 2): "rgb24",
    (8, 3): "pal8",
    (8, 4): "ya8",
    (8, 6): "rgba",
    (16, 0): "gray16be",
    (16, 2): "rgb48be",
    (16, 4): "ya16be",
    (16, 6): "rgba64be",
}  # pixel format by bits and colour type
RAW = "rawvideo"  # FFmpeg's codec of pixels that are not encoded
RAW_FORMATS = {
    **{"rgb8": ("rgb24", 3), "bgr8": ("bgr24", 3), "8UC3": ("bgr24", 3), "rgba8": ("rgba", 4), "bgra8": ("bgra", 4)},
    **{"mono8": ("gray", 1), "8UC1": ("gray", 1), "mono16": ("gray16", 2), "16UC1": ("gray16", 2)},
    **{"rgb16": ("rgb48", 6), "bgr16": ("bgr48", 6), "uyvy": ("uyvy422", 2), "yuv422": ("uyvy422", 2)},
    **{"yuyv": ("yuyv422", 2), "yuv422_yuy2": ("yuyv422", 2), "bayer_rggb8": ("bayer_rggb8", 1)},
    **{"bayer_bggr8": ("bayer_bggr8", 1), "bayer_gbrg8": ("bayer_gbrg8", 1), "bayer_grbg8": ("bayer_grbg8", 1)},
}  # pixel format and bytes per pixel by the encoding of a ROS image
_TWO_BYTES = ("gray16", "rgb48", "bgr48")
COLOURS = (1, 3, 4)  # number of colours of a decoded image
ENCODINGS = {(1, "u1"): "mono8", (3, "u1"): "rgb8", (4, "u1"): "rgba8", (1, "u2"): "mono16"}  # by colours and type


def raw_format(encoding: str, width_px: int, height_px: int, *, big_endian: bool = False) -> VideoFormat | None:
    """Return the format of raw images with an encoding of ROS, or None if they cannot be decoded.

    >>> raw_format("mono16", 64, 48).pixel_format
    'gray16le'
    """
    if encoding not in RAW_FORMATS or not (0 < width_px <= MAX_SIDE_PX and 0 < height_px <= MAX_SIDE_PX):
        return None
    pixel_format = RAW_FORMATS[encoding][0]
    if pixel_format in _TWO_BYTES:
        pixel_format += "be" if big_endian else "le"
    return VideoFormat(RAW, width_px, height_px, pixel_format, MICROSECOND)


def array_format(shape: tuple[int, ...], kind: ArrayType) -> VideoFormat | None:
    """Return the format of decoded images (frame, row, column), or None if they cannot be stored as raw images.

    With colours, these are the last axis or the one after the frame.

    >>> array_format((9, 3, 48, 64), np.dtype("uint8")).describe()
    'rawvideo, 64 x 48 pixels'
    """
    if len(shape) not in (3, 4):
        return None
    height, width, colours = shape[1:] if len(shape) == 4 else (*shape[1:], 1)
    if colours not in COLOURS:
        colours, height, width = height, width, colours  # (frame, colour, row, column), as in PyTorch
    encoding = ENCODINGS.get((colours, f"{kind.kind}{kind.itemsize}"), "")
    return raw_format(encoding, width, height, big_endian=kind.byteorder == ">")


def raw_images(images: AnyArray) -> list[bytes]:
    """Return the pixels of each decoded image, row by row with its colours together, as `array_format` describes them."""
    if images.ndim == 4 and images.shape[-1] not in COLOURS:
        images = np.moveaxis(images, 1, -1)
    return [np.ascontiguousarray(image).tobytes() for image in images]


_STARTS = {b"\xff\xd8\xff": "jpeg", b"\x89PNG": "png", b"RIFF": "webp"}  # image formats by their first bytes


def picture_encoding(content: bytes) -> str:
    r"""Return the encoding of a picture by its first bytes, or an empty string if it is none of JPEG, PNG and WebP.

    >>> picture_encoding(b"\xff\xd8\xff\xe0"), picture_encoding(b"abc")
    ('jpeg', '')
    """
    return next((name for start, name in _STARTS.items() if content.startswith(start)), "")


def image_format(image: bytes) -> VideoFormat | None:
    """Return the format of an encoded image, or None for bytes that are not a JPEG or PNG image."""
    shape = read_shape(image)
    if shape is not None:
        return VideoFormat("mjpeg", *shape, MICROSECOND)
    if not image.startswith(PNG) or len(image) < 26:
        return None
    width_px, height_px = int.from_bytes(image[16:20]), int.from_bytes(image[20:24])
    pixel_format = PNG_FORMATS.get((image[24], image[25]), "")
    if not pixel_format or not (0 < width_px <= MAX_SIDE_PX and 0 < height_px <= MAX_SIDE_PX):
        return None
    return VideoFormat("png", width_px, height_px, pixel_format, MICROSECOND)


def frames_from_images(
    rows: pa.Table | pa.RecordBatchReader, place: str, rate_hz: float | None = None
) -> pa.Table | pa.RecordBatchReader:
    """Return a stream whose column of images is replaced by packets, if its first image can be decoded.

    ``rows`` have ``t_ns``. The column is binary with the quantity image. If its metadata state a video format, each
    value has the raw pixels of an image. Other columns and rows stay. ``place`` names the stream in errors. Raises
    `TacpipeError`, also while rows are read, for an image of another kind or size than the first.
    """
    name = _image_column(rows.schema)
    if name is None:
        return rows
    batches = iter(rows.to_batches(BATCH_ROWS)) if isinstance(rows, pa.Table) else iter(rows)
    first_batches = list(itertools.islice(batches, 1))
    video_format = _column_format(rows.schema.field(name), first_batches, name)
    if video_format is None:
        if isinstance(rows, pa.Table):
            return rows
        return pa.RecordBatchReader.from_batches(rows.schema, itertools.chain(first_batches, batches))
    rate = None if rate_hz is None else Fraction(rate_hz).limit_denominator(1001)
    video_format = replace(video_format, nominal_rate_hz=rate)
    column_index = rows.schema.get_field_index(name)
    fields = list(rows.schema)
    schema = pa.schema([*fields[:column_index], *video_format.fields(), *fields[column_index + 1 :]])
    reader = pa.RecordBatchReader.from_batches(
        schema, _packet_batches(itertools.chain(first_batches, batches), name, video_format, schema, place)
    )
    return reader.read_all() if isinstance(rows, pa.Table) else reader


def _image_column(schema: pa.Schema) -> str | None:
    """Return the name of a stream's only column of images; None if there is not exactly one, or the stream has packets."""
    names = [
        field.name
        for field in schema
        if pa.types.is_binary(field.type) and (field.metadata or {}).get(b"quantity") == b"image"
    ]
    is_free = not {PACKET, PTS, DTS, KEY_FRAME} & set(schema.names)
    return names[0] if len(names) == 1 and is_free else None


def _column_format(field: pa.Field, first_batches: list[pa.RecordBatch], name: str) -> VideoFormat | None:
    """Return the format in the metadata of a column of images, or that of the first image; None if it is not known.

    Raises the errors of `VideoFormat.from_metadata`.
    """
    if b"codec" in field.metadata:
        return VideoFormat.from_metadata(field.metadata)
    images = (image.as_py() for batch in first_batches for image in batch.column(name))
    return next((image_format(image) for image in images if image), None)


def _packet_batches(
    batches: Iterator[pa.RecordBatch], name: str, video_format: VideoFormat, schema: pa.Schema, place: str
) -> Iterator[pa.RecordBatch]:
    """Yield batches with ``packet``, ``pts`` (microseconds since the first row, distinct), ``dts`` and ``key_frame``.

    Raises `TacpipeError` as `_expect_alike` does.
    """
    first_ns, last_pts, row = None, -1, 0
    for batch in batches:
        if not batch.num_rows:
            continue
        images = batch.column(name)
        _expect_alike(images, video_format, row, place)
        t_ns: Int64s = batch.column("t_ns").to_numpy()
        first_ns = int(t_ns[0]) if first_ns is None else first_ns
        index = np.arange(batch.num_rows)
        pts = np.maximum(np.maximum.accumulate((t_ns - first_ns) // 1000 - index), last_pts + 1) + index
        last_pts, row = int(pts[-1]), row + batch.num_rows
        ticks = pa.array(pts)
        columns = dict(zip(batch.schema.names, batch.columns, strict=True))
        columns |= {PACKET: images, PTS: ticks, DTS: ticks, KEY_FRAME: pa.array(np.ones(len(pts), bool))}
        yield pa.RecordBatch.from_arrays([columns[field.name] for field in schema], schema=schema)


def _expect_alike(images: pa.Array, video_format: VideoFormat, first_row: int, place: str) -> None:
    """Raise `TacpipeError` for an image of another kind or size. Raw images have the length that their reader checked."""
    if video_format.codec == RAW:
        return
    expected = (video_format.codec, video_format.width_px, video_format.height_px)
    for row, image in enumerate(images, first_row):
        actual_format = image_format(image.as_py()) if image.is_valid else None
        if actual_format is None:  # an incomplete image is stored unchanged, and decoding it raises an error
            continue
        if (actual_format.codec, actual_format.width_px, actual_format.height_px) != expected:
            raise TacpipeError(
                f"{place}: image {row + 1} is {actual_format.describe()}, and the first is {plain(expected[0])}, "
                f"{expected[1]} x {expected[2]} pixels. The images of a stream have one kind and size: leave the stream "
                f"out with --without, or divide it."
            )
