"""Write small videos with PyAV, and read them by PyAV alone, as what tacpipe reads is compared with."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import av
import numpy as np
import pyarrow as pa

from tacpipe.arrays import Bytes
from tacpipe.video import decoding
from tacpipe.video.stream import VideoFormat

HEIGHT, WIDTH, RATE_HZ = 48, 64, 25
PIXELS = {"mjpeg": "yuvj420p", "png": "rgb24", "ffv1": "bgr0"}
OPTIONS = {
    "libx264": {"g": "12", "bf": "3", "b_strategy": "0", "x264-params": "log-level=none"},
    "libx265": {"x265-params": "keyint=12:bframes=4:open-gop=1:scenecut=0:log-level=none"},
    "mpeg4": {"g": "12", "bf": "2"},
    "mjpeg": {"huffman": "default"},
}


@dataclass(frozen=True)
class Kind:
    """A video file: its ending, and the encoder that writes it."""

    ending: str
    encoder: str


def images(count: int, height: int = HEIGHT, width: int = WIDTH) -> Bytes:
    """Images (frame, row, column, rgb) of a bright square that moves over a gradient; no two are equal."""
    frames = np.zeros((count, height, width, 3), np.uint8)
    frames[..., 0] = np.arange(width) * 255 // width
    frames[..., 1] = (np.arange(count) * 5 % 200)[:, None, None]
    for index in range(count):
        left = 2 + index * 3 % (width - 20)
        frames[index, 10:26, left : left + 16] = 255
    return frames


def write(
    path: Path, encoder: str, count: int = 30, *, absent: Collection[int] = (), irregular: bool = False, size: int = 1
) -> Path:
    """Write a video of `images`, without the frames ``absent``, at 25 frames per second or at ``irregular`` times."""
    frames = images(count, HEIGHT * size, WIDTH * size)
    return write_images(path, encoder, frames, absent=absent, irregular=irregular)


def write_images(
    path: Path, encoder: str, frames: Bytes, *, absent: Collection[int] = (), irregular: bool = False
) -> Path:
    """Write a video of images (frame, row, column, rgb), as `write`."""
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(encoder, rate=RATE_HZ, options=OPTIONS.get(encoder, {}))
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = PIXELS.get(encoder, "yuv420p")
        for index, image in enumerate(frames):
            if index in absent:
                continue
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.time_base = Fraction(1, RATE_HZ)
            frame.pts = index * index if irregular else index
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def decoded(path: Path) -> list[Bytes]:
    """The images (row, column, rgb) of a file as PyAV decodes them."""
    with av.open(str(path)) as container:
        return [cast(Any, frame).to_ndarray(format="rgb24", threads=1) for frame in container.decode(video=0)]


def sound_images(video_format: VideoFormat, batches: Iterable[pa.Table]) -> dict[int, Bytes]:
    """The images of a stream by row; none may be damaged."""
    images = dict(decoding.decode_frames(video_format, batches))
    sound = {row: image for row, image in images.items() if image is not None}
    assert len(sound) == len(images)
    return sound


def packets(path: Path) -> list[bytes]:
    """The packets of a file in its order."""
    with av.open(str(path)) as container:
        return [bytes(packet) for packet in container.demux(container.streams.video[0]) if packet.size]
