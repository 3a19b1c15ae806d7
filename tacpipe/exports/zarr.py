"""Write recordings as a Zarr replay buffer, as UMI and diffusion policy read it.

Recordings must be synchronized, or have ``--rate-hz``, and are concatenated: ``data/STREAM_QUANTITY`` has the shape
(frame, channel), and ``meta/episode_ends`` the exclusive end of each recording. The format is Zarr 2.

Example: tacpipe export zarr data/recordings -o exports/zarr --rate-hz 50 --actions robot
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from tacpipe.arrays import AnyArray, ArrayType
from tacpipe.exports import contents
from tacpipe.exports.contents import Loss
from tacpipe.exports.files import README_NAME, Content, Files, Scratch, loss_notes, readme_text
from tacpipe.exports.lerobot_videos import find_cameras, images_of_rows, nearest_rows
from tacpipe.plugins.constraints import Rate
from tacpipe.plugins.params import added
from tacpipe.plugins.stage import RecordingOutput, Result, stage

if TYPE_CHECKING:
    from zarr.abc.buffer import Buffer

    from tacpipe.datasets.dataset import Dataset, Recording

    Parts = Dataset

STORE = "replay.zarr"  # folder of the store
ENDS = "meta/episode_ends"
CHUNK_BYTES = 1 << 20  # size of a chunk before compression
_OPENING = f"""
A Zarr store (format 2), `{STORE}`, as UMI's and diffusion policy's `ReplayBuffer` reads it:

```python
import zarr

store = zarr.open("EXPORT/{STORE}", mode="r")
touch, ends = store["data/STREAM_tactile"], store["{ENDS}"]
```

With `--images`, `data/STREAM_rgb` has the frame of a camera nearest to each row (frame, row, column, rgb).

The attribute `columns` of an array names its channels, `units` their units. The attributes of the group `meta` hold the
rate, the name of each recording and its labels.
"""


@dataclass(frozen=True)
class Params:
    """The contents of the arrays."""

    rate_hz: Rate | None = None  # synchronize to this rate first; without it the recordings must be synchronized
    master: str = ""  # stream whose samples start and end the frames; without it the first tactile one
    actions: str = ""  # stream of the actions: its targets, else its state one frame later
    common: bool = False  # omit columns that not all recordings have
    # decode the frames of cameras into arrays STREAM_rgb (frame, row, column, rgb), the nearest in time to each row
    images: bool = added(False)


def prepare(params: Params) -> Mapping[str, Mapping[str, str | float]]:
    """Return the stage that synchronizes the recordings first, if a rate is given."""
    from tacpipe.exports import frames

    return frames.synchronize_stage(params.rate_hz, params.master)


@stage(version=2, reads=("grid", "grid_rate_hz"))
def part(params: Params, recording: Recording) -> RecordingOutput:
    """Return the description of one recording."""
    from tacpipe.exports import frames

    return RecordingOutput(frames.describe(recording))


@stage(version=2)
def zarr(
    params: Params, recordings: Annotated[Dataset, prepare], parts: Annotated[Parts, part], originals: Dataset
) -> Result:
    """Write recordings as a Zarr replay buffer, as UMI does.

    Synchronized recordings, or any with ``--rate-hz``, one after another, with meta/episode_ends.

    Example: tacpipe export zarr data/recordings -o exports/zarr --rate-hz 50 --actions robot
    """
    from tacpipe.exports import frames

    all_recordings = list(recordings)
    rate_hz = frames.common_rate_hz(all_recordings)
    columns, described = frames.frame_columns(contents.contents_from_parts(parts), common=params.common)
    cameras, losses = find_cameras(originals) if params.images else ([], [])
    described = frames.add_frame_losses(described, recordings, originals, videos=[camera.stream for camera in cameras])
    losses += [
        (recording.name, Loss("packets: an array has the decoded frame nearest to each row", camera.stream))
        for recording in recordings
        for camera in cameras
    ]
    described = replace(described, losses={**described.losses, **contents.loss_sentences(losses)})
    frame_arrays = frames.arrays_of_frames(
        frames.synchronized_columns(all_recordings[0]).select(columns), params.actions
    )
    types: list[list[ArrayType]] = []  # type of each array in each recording
    lengths: list[int] = []
    for recording in all_recordings:
        table = frames.synchronized_columns(recording).select(columns)
        types.append([array.type_in(table) for array in frame_arrays])
        lengths.append(table.num_rows)
    chunks = Scratch()
    writers = []
    for array, array_types in zip(frame_arrays, zip(*types, strict=True), strict=True):
        attributes = {"columns": array.columns, "units": array.units}
        shape = array.shape(sum(lengths))
        writers.append(_ArrayWriter(f"data/{array.name}", shape, np.result_type(*array_types), attributes, chunks))
    image_writers = [
        _ArrayWriter(
            f"data/{camera.stream}_rgb",
            (sum(lengths), camera.height_px, camera.width_px, 3),
            np.dtype(np.uint8),
            {"columns": ["red", "green", "blue"]},
            chunks,
        )
        for camera in cameras
    ]
    for recording in all_recordings:
        table = frames.synchronized_columns(recording).select(columns)
        for camera, writer in zip(cameras, image_writers, strict=True):
            original, grid = originals[recording.name], frames.synchronized_columns(recording)
            frame_columns = original.columns(camera.stream)
            for image in images_of_rows(frame_columns, nearest_rows(frame_columns, grid)):
                writer.append(image[None])
        for array, writer in zip(frame_arrays, writers, strict=True):
            for values in array.blocks(table, writer.kind):
                writer.append(values)
    ends = _ArrayWriter(ENDS, (len(lengths),), np.dtype(np.int64), {}, chunks)
    ends.append(np.cumsum(lengths, dtype=np.int64))
    files: dict[str, Content] = {}
    for writer in (*writers, *image_writers, ends):
        files |= writer.files()
    names = [recording.name for recording in all_recordings]
    files |= {".zgroup": _GROUP, "data/.zgroup": _GROUP, "meta/.zgroup": _GROUP}
    files["meta/.zattrs"] = _json(
        {
            "rate_hz": rate_hz,
            "recordings": names,
            "labels": {recording.name: dict(recording.attributes) for recording in all_recordings},
        }
    )
    files = {f"{STORE}/{name}": content for name, content in files.items()}
    files[README_NAME] = readme_text("Tactile recordings as a Zarr replay buffer", _OPENING, recordings, described)
    return Result(files=Files(files), notes=loss_notes(recordings, described))


class _ArrayWriter:
    """Writes the rows of an array in order as chunks, compressed like zarr's own, to a temporary file."""

    def __init__(
        self,
        path: str,
        shape: tuple[int, ...],
        kind: ArrayType,
        attributes: Mapping[str, Sequence[str]],
        scratch: Scratch,
    ) -> None:
        import zarr
        from zarr.storage import MemoryStore

        self.kind = kind
        self._path, self._scratch = path, scratch
        row_bytes = kind.itemsize * math.prod(shape[1:])
        self._chunk_rows = max(1, min(shape[0], CHUNK_BYTES // row_bytes))
        self._waiting: list[AnyArray] = []
        self._rows = self._first_row = 0  # number of buffered rows, and the index of the first of them
        self._encoded: dict[str, Buffer] = {}  # metadata, and the chunks of the last write
        self._array = zarr.create_array(
            MemoryStore(self._encoded),
            shape=shape,
            dtype=kind,
            chunks=(self._chunk_rows, *shape[1:]),
            zarr_format=2,
            attributes=dict(attributes),
            config={"write_empty_chunks": True},
        )
        self._metadata = {name: content.to_bytes() for name, content in self._encoded.items()}
        self._places: dict[str, tuple[int, int]] = {}  # offset and size of each chunk in the temporary file

    def append(self, values: AnyArray) -> None:
        """Add rows, and write complete chunks."""
        self._waiting.append(values)
        self._rows += len(values)
        complete_rows = self._rows // self._chunk_rows * self._chunk_rows
        if complete_rows:
            rows = np.concatenate(self._waiting)
            self._write(rows[:complete_rows])
            self._waiting, self._rows = [rows[complete_rows:]], len(rows) - complete_rows

    def files(self) -> dict[str, Content]:
        """Write the last rows and return the files of the array by name."""
        if self._rows:
            self._write(np.concatenate(self._waiting))
        self._scratch.check()
        chunks = {name: functools.partial(self._scratch.piece, *span) for name, span in self._places.items()}
        files: dict[str, Content] = {**self._metadata, **chunks}
        return {f"{self._path}/{name}": content for name, content in files.items()}

    def _write(self, values: AnyArray) -> None:
        """Write the next rows to the array, and move its complete chunks to the temporary file."""
        self._array[self._first_row : self._first_row + len(values)] = values
        self._first_row += len(values)
        for name in self._encoded.keys() - self._metadata.keys():
            content = self._encoded.pop(name).to_bytes()
            self._places[name] = (self._scratch.tell(), len(content))
            self._scratch.write(content)
        self._scratch.check()


def _json(value: Any) -> bytes:
    return json.dumps(value, indent=4).encode() + b"\n"


_GROUP = _json({"zarr_format": 2})
