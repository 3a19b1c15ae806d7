"""Count the frames in which markers of gels are mistaken for their neighbours.

A frame is wrong if a cell of the grid has flipped, if the offset between two neighbours has changed by more than
`MAX_STRETCH` pitches, or if a marker is more than half a pitch from its rest although all dots are where they were in the
first frame. Run it with the datasets of `tacpipe extract markers` and of the frames:

python -m benchmarks.marker_order data/markers data/gels
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

import tacpipe
from tacpipe.arrays import Bools, Floats
from tacpipe.datasets.dataset import Recording
from tacpipe.video.decoding import decode_frames, read_batches
from tacpipe.video.markers import detect
from tacpipe.video.stream import read_format
from tacpipe.viewer.markers import track_markers

MAX_STRETCH = 0.85  # pitches
AT_REST = (
    0.12,
    0.9,
)  # maximum distance of a dot from one of the first frame in pitches, and the minimum share of such dots


def is_flipped(cells: Floats) -> Bools:
    """Return whether a corner of a cell has a negative area in each frame. ``cells`` is (time, row, column, xy)."""
    corners = [cells[:, :-1, :-1], cells[:, :-1, 1:], cells[:, 1:, 1:], cells[:, 1:, :-1]]
    flipped = np.zeros(len(cells), bool)
    for number, corner in enumerate(corners):
        after, before = corners[(number + 1) % 4] - corner, corners[number - 1] - corner
        flipped |= (after[..., 0] * before[..., 1] < after[..., 1] * before[..., 0]).any(axis=(1, 2))
    return flipped


def is_at_rest(video: Recording, stream: str, pitch_px: float) -> Bools:
    """Return whether the dots of each frame are those of the first."""
    frames = video.columns(stream)
    video_format = read_format(frames)
    assert video_format is not None
    images = decode_frames(video_format, read_batches(frames), grey=True)
    dots = [np.empty((0, 2)) if image is None else detect(image) for _, image in images]
    limit, share = AT_REST
    distances = [np.linalg.norm(dots[0][:, None] - shown, axis=2) for shown in dots]  # (first, shown) by frame
    return np.array([d.size > 0 and (d.min(axis=1) < limit * pitch_px).mean() > share for d in distances])


def main(markers: str, gels: str) -> None:
    """Print the number of videos and frames with wrong markers, and the share of missing ones."""
    dataset, videos = tacpipe.open(markers), tacpipe.open(gels)
    wrong_videos = wrong = frames = resting = 0
    missing = 0.0
    for name, recording in dataset.recordings.items():
        for stream in recording.streams:
            track = track_markers(stream, recording.table(stream), videos[name], dataset.source.chain)
            if track is None:
                continue
            params: Any = dataset.source.chain[-1]["params"]
            rows, columns = params["rows"], params["columns"]
            rest = track.rest_px.reshape(rows, columns, 2)
            pitch_px = float(np.nanmedian(np.linalg.norm(np.diff(rest, axis=1), axis=-1)))
            cells = track.positions_px.reshape(-1, rows, columns, 2)
            changes = [np.diff(cells, axis=axis) - np.diff(rest, axis=axis - 1) for axis in (1, 2)]
            stretched = [
                (np.linalg.norm(change, axis=-1) > MAX_STRETCH * pitch_px).any(axis=(1, 2)) for change in changes
            ]
            displaced = np.linalg.norm(track.positions_px - track.rest_px, axis=-1) > pitch_px / 2
            at_rest = is_at_rest(videos[name], stream, pitch_px)
            is_wrong = is_flipped(cells) | stretched[0] | stretched[1] | (displaced.any(axis=1) & at_rest)
            if is_wrong.any():
                print(f"{name} {stream}: {is_wrong.sum()} of {len(is_wrong)} frames")
            wrong_videos += bool(is_wrong.any())
            wrong += int(is_wrong.sum())
            frames += len(cells)
            missing += float(np.isnan(track.positions_px).mean(axis=(1, 2)).sum())
            resting += int(at_rest.sum())
    print(
        f"{wrong_videos} videos, {wrong} of {frames} frames are wrong; {resting} at rest; {missing / frames:.2%} missing"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
