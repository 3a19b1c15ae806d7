"""Show frames of cameras in which a model's prediction is right, and frames in which it is wrong."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tacpipe.comparison.runs import RecordingOutcome
from tacpipe.datasets.dataset import Dataset, Recording
from tacpipe.report.blocks import Fold, ImageRow, Picture, fold, notes
from tacpipe.video.encoding import encode_images, jpeg_format
from tacpipe.video.frames import read_frames
from tacpipe.video.stream import read_format

SHOWN = 4  # number of right and of wrong predictions with frames


def holds_cameras(dataset: Dataset) -> bool:
    """Return whether a dataset has recordings with streams of frames."""
    return any(_cameras(recording) for recording in dataset.recordings.values())


def frame_folds(outcomes: Sequence[RecordingOutcome], datasets: Sequence[Dataset]) -> list[Fold]:
    """Return a list with the fold of frames of right and of wrong predictions; empty if no outcome's recording has a camera.

    A frame is in the middle of its recording, or of the recording's part in another of ``datasets``, such as a slide.
    """
    recordings: dict[str, Recording] = {}
    parts: dict[str, Recording] = {}
    for dataset in datasets:
        for name, recording in dataset.recordings.items():
            (recordings if _cameras(recording) else parts)[name] = recording
    outcomes_with_frames = [outcome for outcome in outcomes if outcome.recording in recordings]
    blocks = []
    for title, is_right in (("Right", True), ("Wrong", False)):
        chosen = _evenly_spaced([outcome for outcome in outcomes_with_frames if outcome.is_right == is_right])
        pictures = [
            picture
            for outcome in chosen
            for picture in _pictures(outcome, recordings[outcome.recording], parts.get(outcome.recording))
        ]
        blocks += [ImageRow(title, pictures)] if pictures else []
    if not blocks:
        return []
    right_count = sum(outcome.is_right for outcome in outcomes_with_frames)
    note = notes(
        f"Frames in the middle of what the model read, of at most {SHOWN} right and {SHOWN} wrong predictions."
    )
    return fold(
        "Frames of right and wrong predictions",
        *blocks,
        note,
        about=f"{right_count} of {len(outcomes_with_frames)} are right",
    )


def _cameras(recording: Recording) -> list[str]:
    return [name for name in recording.streams if read_format(recording.columns(name)) is not None]


def _evenly_spaced(outcomes: Sequence[RecordingOutcome]) -> list[RecordingOutcome]:
    """Return at most `SHOWN` outcomes, evenly spaced by recording."""
    ordered = sorted(outcomes, key=lambda outcome: outcome.recording)
    if len(ordered) <= SHOWN:
        return ordered
    return [ordered[row] for row in np.linspace(0, len(ordered) - 1, SHOWN).round().astype(int).tolist()]


def _pictures(outcome: RecordingOutcome, recording: Recording, part: Recording | None) -> list[Picture]:
    """Return a picture of each camera of a recording, at the middle of its ``part`` if there is one.

    Cameras without frames, and frames that cannot be decoded, are omitted.
    """
    pictures = []
    for stream in _cameras(recording):
        columns = recording.columns(stream)
        t_ns = columns.column("t_ns").to_numpy()
        if not len(t_ns):
            continue
        at_ns = (int(t_ns[0]) + int(t_ns[-1])) // 2 if part is None else _middle_ns(part, (t_ns[0] + t_ns[-1]) // 2)
        row = min(int(np.searchsorted(t_ns, at_ns)), len(t_ns) - 1)
        image = read_frames(columns, [row]).get(row)
        if image is None:
            continue
        video_format = jpeg_format(image.shape[1], image.shape[0], None, "yuvj420p")
        (content,) = encode_images(video_format, [image])
        text = outcome.expected if outcome.is_right else f"{outcome.predicted}, and it is {outcome.expected}"
        below = f"{outcome.recording}, {stream}, {(t_ns[row] - t_ns[0]) / 1e9:.2f} s"
        pictures.append(Picture(content, text, below))
    return pictures


def _middle_ns(part: Recording, otherwise_ns: int) -> int:
    """Return the middle of the times of a recording's first stream that has times; ``otherwise_ns`` if none has."""
    for stream in part.streams:
        columns = part.columns(stream)
        if "t_ns" in columns.column_names and columns.num_rows:
            t_ns = columns.column("t_ns").to_numpy()
            return (int(t_ns[0]) + int(t_ns[-1])) // 2
    return int(otherwise_ns)
