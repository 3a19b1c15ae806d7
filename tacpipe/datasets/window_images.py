"""The images of cameras at the rows of windows, as tensors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch

from tacpipe.arrays import Bools, Bytes, Floats, Int64s
from tacpipe.channels import streams
from tacpipe.errors import UsageError
from tacpipe.io.spill import MappedArrays
from tacpipe.printable import listed, plain
from tacpipe.signals.resampling import newest_rows
from tacpipe.video.decoding import Pixels
from tacpipe.video.frames import FrameReader
from tacpipe.video.stream import read_format

if TYPE_CHECKING:
    from tacpipe.datasets.reading import ReadableDataset, ReadableRecording
    from tacpipe.io.columns import Columns

KEPT_BYTES = 1 << 30  # encoded frames in memory; further ones are in temporary files
UNTOUCHED_FRAMES = 5  # first frames of a recording, whose mean is the untouched gel
MAX_AGE_STEPS = 3.0  # age of the newest frame, in median steps between frames, from which a row has none

Transform = Callable[[torch.Tensor], torch.Tensor]


@dataclass(frozen=True)
class ImageOptions:
    """Which images a window has: those of ``streams`` of ``cameras``, a dataset with recordings of the same names."""

    streams: tuple[str, ...]
    cameras: ReadableDataset
    size: int | tuple[int, int] | None  # height and width in pixels; one number for both; None for those of the camera
    roi: tuple[int, int, int, int] | None  # left, top, width and height of the part in pixels
    difference: bool  # True if the mean of the first `UNTOUCHED_FRAMES` frames is subtracted
    transform: Transform | None  # applied to the images (time, colour, height, width) of a camera

    def __post_init__(self) -> None:
        """Raise `UsageError` for a size or a part without pixels."""
        sides = (self.size, self.size) if isinstance(self.size, int) else self.size
        if sides is not None and min(sides) < 1:
            raise UsageError(f"size is {self.size}; an image has at least 1 pixel along each side.")
        if self.roi is not None and (len(self.roi) != 4 or min(self.roi[:2]) < 0 or min(self.roi[2:]) < 1):
            raise UsageError(f"roi is {self.roi}; it is (left, top, width, height) in pixels of the frame.")

    @property
    def pixels(self) -> Pixels:
        """The part of a frame and the size of its image."""
        return Pixels(roi=self.roi, size=(self.size, self.size) if isinstance(self.size, int) else self.size)


class WindowImages:
    """The images of all recordings of windows. At each row they are the newest frames of the cameras."""

    def __init__(self, options: ImageOptions) -> None:
        self._options, self._storage = options, MappedArrays(KEPT_BYTES)
        self._recordings: list[dict[str, _Camera]] = []

    def add(self, recording: ReadableRecording, t_ns: Int64s) -> Bools:
        """Add the next recording, whose rows have the times ``t_ns`` (row,).

        Returns whether each row (row,) has a sound frame of every camera, at most `MAX_AGE_STEPS` old. With
        ``difference``, rows before the end of the untouched frames have none. Raises `UsageError` if the recording has
        no such stream of frames, or ``roi`` is not within its frames.
        """
        cameras = {}
        for name in self._options.streams:
            columns, place = self._columns(recording, name), f"recording {recording.name}, stream {name}"
            reader = FrameReader(columns, place, self._storage, self._options.pixels)
            cameras[name] = _Camera(reader, streams.times(columns.read(["t_ns"])), t_ns, self._options.difference)
        self._recordings.append(cameras)
        masks: Bools = np.logical_and.reduce([camera.has_image for camera in cameras.values()])
        return masks

    def read(self, recording: int, rows: Int64s) -> dict[str, torch.Tensor]:
        """Return the images of each camera at some rows of a recording, (row, colour, height, width).

        They are uint8, or float32 differences in grey levels; ``transform`` changes them.
        """
        images = {}
        for name, camera in self._recordings[recording].items():
            tensor = torch.from_numpy(camera.read(rows)).permute(0, 3, 1, 2).contiguous()
            images[name] = tensor if self._options.transform is None else self._options.transform(tensor)
        return images

    def _columns(self, recording: ReadableRecording, name: str) -> Columns:
        source = recording if name in recording.streams else self._options.cameras.recordings.get(recording.name)
        video_format = read_format(source.columns(name)) if source and name in source.streams else None
        if source is None or video_format is None:
            cameras = [stream for stream in source.streams if read_format(source.columns(stream))] if source else []
            advice = f"Its cameras are {listed(cameras)}." if cameras else "Give the dataset that has it as cameras=…."
            raise UsageError(f"Recording {recording.name} has no stream of frames {plain(name)}. {advice}")
        left, top, width, height = self._options.roi or (0, 0, 1, 1)
        if left + width > video_format.width_px or top + height > video_format.height_px:
            raise UsageError(
                f"roi is {self._options.roi}, and frames of recording {recording.name}, stream {name}, have "
                f"{video_format.width_px} x {video_format.height_px} pixels. It is (left, top, width, height) within them."
            )
        return source.columns(name)


class _Camera:
    """The frames of one camera in a recording, and the frame of each row."""

    def __init__(self, reader: FrameReader, frame_ns: Int64s, t_ns: Int64s, difference: bool) -> None:
        """Find the newest frame of each row; ``frame_ns`` (frame,) are the times of frames, ``t_ns`` (row,) of rows."""
        self._reader = reader
        self._frames = newest_rows(frame_ns, t_ns)  # (row,), -1 without a frame
        untouched = np.flatnonzero(reader.has_image)[:UNTOUCHED_FRAMES]
        self._untouched_frames = untouched.tolist() if difference else []
        first = (untouched[-1] if len(untouched) == UNTOUCHED_FRAMES else len(frame_ns)) if difference else 0
        is_sound = np.append(reader.has_image, False)[self._frames]  # the last is that of rows without a frame
        age_ns = t_ns - np.append(frame_ns, 0)[self._frames]
        step_ns = np.median(np.diff(frame_ns)) if len(frame_ns) > 1 else np.inf
        self.has_image: Bools = is_sound & (self._frames >= first) & (age_ns <= MAX_AGE_STEPS * step_ns)

    def read(self, rows: Int64s) -> Bytes | Floats:
        """Return the images at some rows, (row, height, width, colour). Raises `TacpipeError` for a damaged frame."""
        images = self._reader.read(self._frames[rows].tolist())
        return images - self._untouched if self._untouched_frames else images

    @cached_property
    def _untouched(self) -> Floats:
        """The mean of the first sound frames (height, width, colour)."""
        mean: Floats = self._reader.read(self._untouched_frames).mean(axis=0, dtype=np.float32)
        return mean
