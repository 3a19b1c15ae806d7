"""Read frames of a video in order, at random and for windows, next to PyAV on the same file."""

from __future__ import annotations

import random
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import timing

import tacpipe
from tacpipe.video.frames import read_frames

FRAMES, HEIGHT_PX, WIDTH_PX, RATE_HZ = 1500, 240, 320, 25
AT_RANDOM = 200
VIDEOS = {"mjpeg": "avi", "mpeg4": "mp4"}  # ending of the file by encoder
AIM = 1.25  # times PyAV's CPU seconds: 80 % of its speed


def measure(folder: Path, rounds: int) -> list[timing.Line]:
    """Return the CPU seconds of frames beside PyAV's, for each codec."""
    lines = []
    for encoder, ending in VIDEOS.items():
        place = folder / encoder
        path = place / "lab" / "a" / f"gel.{ending}"
        path.parent.mkdir(parents=True)
        (place / ".tacpipe").mkdir()
        _write(path, encoder)
        (place / "layout.toml").write_text(f'[streams.gel]\nfiles = "{{trial}}/gel.{ending}"\n')
        timing.run("tacpipe ingest table lab --layout layout.toml -o r --quiet", place)
        lines += _of_video(encoder, path, tacpipe.open(place / "r"), max(5, rounds // 2))
    return lines


def _of_video(encoder: str, path: Path, dataset: Any, rounds: int) -> list[timing.Line]:
    recording, rows = dataset["a"], sorted(random.Random(0).sample(range(FRAMES), AT_RANDOM))
    windows = dataset.windows(5, 1, stream="gel", images=["gel"], size=112)
    shuffled = random.Random(1).sample(range(len(windows)), AT_RANDOM // 4)
    ours: dict[str, Callable[[], object]] = {
        "in order": lambda: read_frames(recording.columns("gel"), range(FRAMES)),
        "at random": lambda: read_frames(recording.columns("gel"), rows),
        "of shuffled windows": lambda: [windows[index]["images"]["gel"] for index in shuffled],
    }
    theirs: dict[str, Callable[[], object]] = {
        "in order": lambda: _decode(path),
        "at random": lambda: _seek(path, rows),
        "of shuffled windows": lambda: [_seek(path, [index], 5, 112) for index in shuffled],
    }
    lines = []
    for name, call in ours.items():
        times = timing.interleaved({"tacpipe": call, "PyAV": theirs[name]}, rounds)
        lines.append(timing.at_most(f"frames {name}, {encoder}", times, "tacpipe", "PyAV", AIM))
    return lines


def _write(path: Path, encoder: str) -> None:
    """Write a video of a bright square that moves over noise."""
    import av

    rng = np.random.default_rng(0)
    noise = rng.integers(0, 60, (HEIGHT_PX, WIDTH_PX, 3), np.uint8)
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(encoder, rate=Fraction(RATE_HZ), options={"g": "12"})
        stream.height, stream.width = HEIGHT_PX, WIDTH_PX
        stream.pix_fmt = "yuvj420p" if encoder == "mjpeg" else "yuv420p"
        for number in range(FRAMES):
            image = noise.copy()
            left = number % (WIDTH_PX - 80)
            image[80:160, left : left + 80] += 150
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))


def _decode(path: Path) -> list[Any]:
    import av

    with av.open(str(path)) as container:
        container.streams.video[0].thread_type = "NONE"
        return [frame.to_ndarray(format="rgb24", threads=1) for frame in container.decode(video=0)]


def _seek(path: Path, rows: list[int], count: int = 1, size: int | None = None) -> list[Any]:
    """Return ``count`` images from each row on, found by seeking to its time."""
    import av

    images = []
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "NONE"
        assert stream.time_base is not None
        for row in rows:
            target = round(row / RATE_HZ / stream.time_base)
            container.seek(target, stream=stream)
            found = 0
            for frame in container.decode(stream):
                if frame.pts is not None and frame.pts >= target:
                    images.append(frame.to_ndarray(format="rgb24", height=size, width=size, threads=1))
                    found += 1
                    if found == count:
                        break
    return images
