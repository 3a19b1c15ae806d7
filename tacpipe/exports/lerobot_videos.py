"""Write the frames of cameras as video features of a LeRobot dataset: one MP4 file per episode and camera.

A video has one frame per row of the dataset, the nearest in time. Packets are copied if the stream has the codec of the
dataset and its frames match the rows one to one; otherwise the frames are encoded.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict

import numpy as np

from tacpipe.arrays import Bytes, Floats, Int64s
from tacpipe.channels.schema import DAMAGED
from tacpipe.exports.contents import TIME, Loss
from tacpipe.plugins import extras
from tacpipe.signals import resampling
from tacpipe.video.decoding import decode_frames, read_batches
from tacpipe.video.files import add_stream
from tacpipe.video.frames import read_frames
from tacpipe.video.stream import (
    BATCH_ROWS,
    DTS,
    KEY_FRAME,
    PACKET,
    VideoFormat,
    cut_rows,
    in_decode_order,
    read_format,
)

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Recording
    from tacpipe.io.columns import Columns

Codec = Literal["h264", "av1"]
PREFIX = "observation.images."
TICKS = 90_000  # units of presentation times per second; rounding is far below LeRobot's tolerance of 0.1 ms
ENCODERS: Mapping[str, tuple[str, dict[str, str]]] = {  # FFmpeg's encoder and options; g as in LeRobot
    "h264": ("libx264", {"crf": "18", "g": "2", "bf": "0", "preset": "veryfast"}),
    "av1": ("libsvtav1", {"crf": "30", "g": "2", "preset": "8"}),
}
PIXELS = "yuv420p"
SAMPLED = 10  # maximum number of frames per episode for the statistics
COLOUR_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


class VideoFeatureJson(TypedDict):
    """A video feature in LeRobot's format."""

    dtype: str
    shape: list[int]
    names: list[str]
    info: dict[str, str | int | float | bool]


@dataclass(frozen=True)
class VideoFeature:
    """A stream of frames that all recordings have with the same size."""

    stream: str
    width_px: int
    height_px: int

    @property
    def name(self) -> str:
        """The name of the feature."""
        return PREFIX + self.stream

    def feature(self, codec: Codec, fps: float) -> VideoFeatureJson:
        """Return the description in info.json."""
        return {
            "dtype": "video",
            "shape": [self.height_px, self.width_px, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": self.height_px,
                "video.width": self.width_px,
                "video.codec": codec,
                "video.pix_fmt": PIXELS,
                "video.is_depth_map": False,
                "video.fps": int(fps) if fps.is_integer() else fps,
                "video.channels": 3,
                "has_audio": False,
            },
        }


def find_cameras(originals: Dataset) -> tuple[list[VideoFeature], list[tuple[str, Loss]]]:
    """Return the cameras of a dataset, and a loss for each stream of frames that cannot be a feature of all episodes."""
    sizes: dict[str, dict[str, tuple[int, int]]] = {}  # size by recording, by stream
    for recording in originals:
        for stream in recording.streams:
            columns = recording.columns(stream)
            video_format = read_format(columns)
            if video_format is not None and columns.num_rows:
                sizes.setdefault(stream, {})[recording.name] = (video_format.width_px, video_format.height_px)
    cameras: list[VideoFeature] = []
    losses: list[tuple[str, Loss]] = []
    for stream, by_recording in sizes.items():
        if len(by_recording) < len(originals):
            reason = "a video must exist in all recordings, and not all have this one"
        elif len(set(by_recording.values())) > 1:
            reason = "a video has one size in all recordings, and this one has several"
        else:
            cameras.append(VideoFeature(stream, *next(iter(by_recording.values()))))
            continue
        losses += [(recording, Loss(reason, stream)) for recording in by_recording]
    return cameras, losses


def nearest_rows(columns: Columns, synchronized: Columns) -> Int64s:
    """Return the row of the nearest frame of a stream for each row of the ``synchronized`` recording."""
    rows: Int64s = resampling.nearest_rows(columns.column(TIME).to_numpy(), synchronized.column(TIME).to_numpy())
    return rows


def images_of_rows(columns: Columns, rows: Int64s) -> Iterator[Bytes]:
    """Yield the image of each of the ascending ``rows``; a row without a sound image has the last one, or a black one."""
    video_format = VideoFormat.from_metadata(columns.schema.field(PACKET).metadata)
    start, _ = cut_rows(*_clocks(columns), int(rows[0]), int(rows[0]) + 1)
    frames = decode_frames(video_format, read_batches(columns, start))
    latest: Bytes = np.zeros((video_format.height_px, video_format.width_px, 3), np.uint8)
    following = next(frames, None)
    for row in rows.tolist():
        while following is not None and start + following[0] <= row:
            latest = latest if following[1] is None else following[1]
            following = next(frames, None)
        yield latest


def _clocks(columns: Columns) -> tuple[Int64s, Any]:
    clocks = columns.read([DTS, KEY_FRAME])
    return clocks.column(DTS).to_numpy(), clocks.column(KEY_FRAME).to_numpy(zero_copy_only=False)


@dataclass(frozen=True)
class EpisodeVideo:
    """The video of a camera in one episode: the stream's row for each frame of the dataset."""

    columns: Columns
    video_format: VideoFormat
    rows: Int64s  # (frame,)
    codec: Codec
    fps: float

    @classmethod
    def from_recordings(
        cls, camera: VideoFeature, original: Recording, synchronized: Columns, codec: Codec, fps: float
    ) -> EpisodeVideo:
        """Return the video with the nearest frame to each row of the ``synchronized`` recording."""
        columns = original.columns(camera.stream)
        video_format = VideoFormat.from_metadata(columns.schema.field(PACKET).metadata)
        return cls(columns, video_format, nearest_rows(columns, synchronized), codec, fps)

    @cached_property
    def is_copied(self) -> bool:
        """Whether packets are copied: the codec is that of the dataset, and each row has the next frame."""
        if self.video_format.codec != self.codec or not len(self.rows) or (np.diff(self.rows) != 1).any():
            return False
        start, stop = int(self.rows[0]), int(self.rows[-1]) + 1
        dts, key_frame = _clocks(self.columns)
        if not key_frame[start] or cut_rows(dts, key_frame, start, stop) != (start, stop):
            return False
        packets = (batch.column(PACKET) for batch in self.columns.batches([PACKET], BATCH_ROWS))
        return all(packet for column in packets for packet in column.to_pylist())

    def losses(self, stream: str, ending: str) -> Iterator[Loss]:
        """Yield the losses of the stream in the video; ``ending`` completes each reason."""
        if DAMAGED in self.columns.column_names and not self.is_copied:
            damaged = int(np.count_nonzero(self.columns.column(DAMAGED).to_numpy(zero_copy_only=False)[self.rows]))
            if damaged:
                yield Loss(f"{damaged:,} damaged frames: each has the image of the sound one before it{ending}", stream)
        if not self.is_copied:
            yield Loss(f"its packets: frames are encoded as {self.codec.upper()}, with some loss{ending}", stream)
        if len(np.unique(self.rows)) < self.columns.num_rows or (np.diff(self.rows) == 0).any():
            yield Loss(f"frames between the rows: a video has the nearest frame to each row{ending}", stream)

    def write(self, sink: Any) -> None:
        """Write the MP4 file."""
        with extras.explain_missing("Writing video"):
            import av
        os.environ.setdefault("SVT_LOG", "1")  # the AV1 encoder would print its settings
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "video.mp4")
            with av.open(str(path), "w") as container:
                self._copy(container) if self.is_copied else self._encode(container)
            with path.open("rb") as file:
                shutil.copyfileobj(file, sink, 1 << 20)

    def _copy(self, container: Any) -> None:
        """Copy the packets of the rows to a video file, with presentation times of the dataset's rate."""
        import av

        start, stop = int(self.rows[0]), int(self.rows[-1]) + 1
        stream = add_stream(container, self.video_format)
        stream.time_base = Fraction(1, TICKS)
        delay = self.video_format.reorder_frames
        batches = read_batches(self.columns, start, stop)
        for position, (row, columns) in enumerate(in_decode_order(self.video_format, batches)):
            content = columns[PACKET]
            assert isinstance(content, bytes)
            packet = av.Packet(content)
            packet.time_base, packet.duration = Fraction(1, TICKS), self._tick(row + 1) - self._tick(row)
            packet.pts, packet.dts = self._tick(row), self._tick(position - delay)
            packet.is_keyframe = bool(columns[KEY_FRAME])
            packet.stream = stream
            container.mux_one(packet)

    def _encode(self, container: Any) -> None:
        """Encode the images of the rows to a video file."""
        import av

        encoder, options = ENCODERS[self.codec]
        stream: Any = container.add_stream(encoder, rate=Fraction(self.fps).limit_denominator(1001), options=options)
        stream.width, stream.height = self.video_format.width_px, self.video_format.height_px
        stream.pix_fmt = PIXELS
        stream.codec_context.time_base = Fraction(1, TICKS)
        stream.codec_context.thread_count = 1  # the bytes do not depend on the number of cores
        for number, image in enumerate(images_of_rows(self.columns, self.rows)):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = self._tick(number), Fraction(1, TICKS)
            with _unchanged_priority():
                container.mux(stream.encode(frame))
        container.mux(stream.encode(None))

    def _tick(self, number: int) -> int:
        """Return the time of a frame of the dataset, rounded to `TICKS`."""
        return round(number * TICKS / self.fps)

    def statistics(self) -> dict[str, list[Any]]:
        """Return the statistics of the colours, 0 to 1, of evenly spaced frames, each as (colour, 1, 1)."""
        sampled_rows = np.unique(np.linspace(0, len(self.rows) - 1, SAMPLED).round().astype(int))
        black: Bytes = np.zeros((1, 1, 3), np.uint8)  # if no sampled frame is sound
        images = list(read_frames(self.columns, self.rows[sampled_rows].tolist()).values()) or [black]
        pixels: Floats = np.concatenate([np.zeros((0, 3)), *(image.reshape(-1, 3) for image in images)]) / 255
        values = {
            **{"min": pixels.min(0), "max": pixels.max(0), "mean": pixels.mean(0), "std": pixels.std(0)},
            **dict(zip(COLOUR_QUANTILES, np.quantile(pixels, list(COLOUR_QUANTILES.values()), axis=0), strict=True)),
        }
        return {**{key: value.reshape(3, 1, 1).tolist() for key, value in values.items()}, "count": [len(images)]}


@contextmanager
def _unchanged_priority() -> Iterator[None]:
    """Keep the scheduling of this process: run as root, SVT-AV1 moves it before all other programs, a recording included."""
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        if os.sched_getscheduler(0) != policy:
            for thread in Path("/proc/self/task").iterdir():
                with suppress(OSError):  # the thread may have ended
                    os.sched_setscheduler(int(thread.name), policy, parameters)


def combine_statistics(episodes: Sequence[Mapping[str, list[Any]]]) -> dict[str, list[Any]]:
    """Return the statistics over all episodes, weighted by their numbers of sampled frames."""
    weights = np.array([values["count"][0] for values in episodes], float).reshape(-1, 1, 1, 1)
    weights /= weights.sum()
    stacked = {key: np.array([values[key] for values in episodes]) for key in episodes[0] if key != "count"}
    mean = (weights * stacked["mean"]).sum(0)
    spread = (weights * (stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2)).sum(0)
    return {
        "min": stacked["min"].min(0).tolist(),
        "max": stacked["max"].max(0).tolist(),
        "mean": mean.tolist(),
        "std": np.sqrt(spread).tolist(),
        "count": [sum(values["count"][0] for values in episodes)],
        **{key: (weights * stacked[key]).sum(0).tolist() for key in COLOUR_QUANTILES},
    }
