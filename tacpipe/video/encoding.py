"""Encode images as frames of a stream. PyAV (FFmpeg) encodes, and is imported when it is needed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from typing import Any

from tacpipe.arrays import Bytes
from tacpipe.plugins import extras
from tacpipe.video.stream import VideoFormat

ENCODED_BY = "Encoding video"  # start of the error about a missing extra
MICROSECOND = Fraction(1, 10**6)  # unit of the presentation times of images
JPEG_QUALITY = 2  # FFmpeg's quantizer scale, on which 2 is the best quality
RGB = "rgb24"  # FFmpeg's name of the RGB pixel format


def jpeg_format(width_px: int, height_px: int, rate_hz: Fraction | None, pixel_format: str = "yuvj422p") -> VideoFormat:
    """Return the format of a stream of JPEG images with presentation times in microseconds."""
    return VideoFormat("mjpeg", width_px, height_px, pixel_format, MICROSECOND, rate_hz)


def encode_images(video_format: VideoFormat, images: Iterable[Bytes]) -> Iterator[bytes]:
    """Yield the JPEG of each image, uint8 (height, width, rgb), in the format that `jpeg_format` returned.

    Raises `MissingModuleError` if PyAV is not installed.
    """
    with extras.explain_missing(ENCODED_BY):
        import av
    encoder = JpegEncoder(video_format.width_px, video_format.height_px, video_format.pixel_format)
    for image in images:
        yield encoder.encode(av.VideoFrame.from_ndarray(image, format=RGB))


class JpegEncoder:
    """Encodes PyAV frames as JPEG images of one size, on one thread."""

    def __init__(self, width_px: int, height_px: int, pixel_format: str) -> None:
        with extras.explain_missing(ENCODED_BY):
            import av
        encoder: Any = av.CodecContext.create("mjpeg", "w")
        encoder.width, encoder.height, encoder.pix_fmt = width_px, height_px, pixel_format
        encoder.time_base = MICROSECOND
        encoder.thread_count = 1  # a stage uses one core per recording
        encoder.options = {"qmin": str(JPEG_QUALITY), "qmax": str(JPEG_QUALITY)}
        self._encoder, self._count = encoder, 0

    def encode(self, frame: Any) -> bytes:
        """Return the JPEG of a frame of PyAV, converted to the encoder's pixel format."""
        image = frame.reformat(format=self._encoder.pix_fmt, threads=1)
        image.pts, image.time_base = self._count, MICROSECOND
        self._count += 1
        return b"".join(bytes(packet) for packet in self._encoder.encode(image))
