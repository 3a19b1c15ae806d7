"""Read trials of two GelSight Mini on a Franka hand that lifts and shakes objects: Incipient-Slip-Detection (BSD-2).

Published as amitparag/Incipient-Slip-Detection. A trial is a folder ``OBJECT/exp_num_N`` with one video per sensor,
``camera_0.avi`` and ``camera_2.avi`` (MPEG-4, 25 frames per second, no clock), and an empty file ``slip.txt`` if the
object slipped. The time of the slip is not published. In most trials, the object left the fingers about a second
before the end, in others much earlier (`tacpipe segment losses`). The length of a trial reveals the label: compare
windows at equal times since the start.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.formats.published import by_object, published_attribute, require
from tacpipe.plugins.stage import Attribute, Discovery, Files, RecordingOutput, stage
from tacpipe.plugins.video_checks import VideoChecks, check_videos

if TYPE_CHECKING:
    import pyarrow as pa

VIDEOS = {"camera_0.avi": "gel0", "camera_2.avi": "gel2"}  # stream of each video
SLIP = "slip.txt"
NAMES = (*VIDEOS, SLIP)


@dataclass(frozen=True)
class Params(VideoChecks):
    """How trials are read."""


def discover(params: Params, source: Path) -> dict[str, dict[str, Path]]:
    """Return the files of each trial below ``source`` by recording name, ``lemon-3`` for ``lemon/exp_num_3/``.

    Files have their relative paths as names, ``lemon/exp_num_3/camera_0.avi``, so that the object is part of a key.
    Raises `TacpipeError` if ``source`` is not a folder or contains no trial, `UsageError` if two trials have the same
    name.
    """
    return by_object(source, NAMES, "trial", example="lemon", described=tuple(VIDEOS), prefix="exp_num_")


@stage(version=2, source=Discovery(discover))
def gelsight_slip(params: Params, files: Files) -> RecordingOutput:
    """Read published videos of two GelSight Mini, with slip.

    Each recording has the streams gel0 and gel2, with one row per frame, and the labels object and slip. A trial with a
    slip does not state when the object slipped: `segment losses` finds it. The length of a recording reveals the label.
    """
    from tacpipe.video.files import read_stream, scan

    trial_files = {Path(name).name: path for name, path in files.items()}
    require(trial_files, tuple(VIDEOS))
    streams: dict[str, pa.Table | pa.RecordBatchReader] = {}
    notes: list[str] = []
    with check_videos(params):
        for name, stream in VIDEOS.items():
            path = trial_files[name]
            frames = scan(path)
            streams[stream] = read_stream(path, frames, frames.times_ns(), frames.stamp_origin(), notes)
    label = next(iter(files)).split("/", 1)[0]
    attributes: dict[str, Attribute] = {"sensor": "gelsight-mini", "object": label, "slip": SLIP in trial_files}
    return RecordingOutput(streams, {**attributes, **published_attribute("gelsight-slip")}, notes, rows={})
