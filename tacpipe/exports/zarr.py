"""Write recordings as a Zarr replay buffer, as UMI and diffusion policy read it.

Synchronized recordings, or any with ``--rate-hz``, one after another: ``data/STREAM_QUANTITY`` has the shape
(frame, channel), ``meta/episode_ends`` the frame behind the last of each recording. Zarr's format 2.

Example: tacpipe export zarr data/recordings -o exports/zarr --rate-hz 50 --actions robot
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tacpipe.exports import contents
from tacpipe.exports.files import README_NAME, Content, Files, loss_notes, readme_text
from tacpipe.plugins.constraints import Rate
from tacpipe.plugins.stage import RecordingOutput, Result, stage

if TYPE_CHECKING:
    from tacpipe.arrays import AnyArray
    from tacpipe.datasets.dataset import Dataset, Recording

    Parts = Dataset

STORE = "replay.zarr"  # the folder of the store
ENDS = "meta/episode_ends"
CHUNK_BYTES = 1 << 20  # size of a chunk before compression
_OPENING = f"""
A Zarr store (format 2), `{STORE}`, as UMI's and diffusion policy's `ReplayBuffer` reads it:

```python
import zarr

store = zarr.open("EXPORT/{STORE}", mode="r")
touch, ends = store["data/STREAM_tactile"], store["{ENDS}"]
```

The attribute `columns` of an array names its channels, `units` their units. The attributes of the group `meta` hold the
rate, the name of each recording and its labels.
"""


@dataclass(frozen=True)
class Params:
    """The contents of the arrays."""

    rate_hz: Rate | None = None  # synchronize to this rate first; without it the recordings must be synchronized
    master: str = ""  # stream whose samples start and end the frames; without it the first tactile one
    actions: str = ""  # stream of the actions: its targets, else its state one frame later
    common: bool = False  # leave out columns that not all recordings have


def first(params: Params) -> Mapping[str, Mapping[str, Any]]:
    """Return the stage that recordings go through first, where a rate is given."""
    from tacpipe.exports import frames

    return frames.synchronize_stage(params.rate_hz, params.master)


@stage(version=2, reads=("grid", "grid_rate_hz"))
def part(params: Params, recording: Recording) -> RecordingOutput:
    """Return what one recording holds."""
    from tacpipe.exports import arrays

    return RecordingOutput(arrays.describe(recording))


@stage(version=2, part=part, first=first)
def zarr(params: Params, recordings: Dataset, parts: Parts, originals: Dataset) -> Result:
    """Write recordings as a Zarr replay buffer, as UMI does.

    Synchronized recordings, or any with ``--rate-hz``, one after another, with meta/episode_ends.

    Example: tacpipe export zarr data/recordings -o exports/zarr --rate-hz 50 --actions robot
    """
    import numpy as np

    from tacpipe.exports import arrays, frames

    all_recordings = list(recordings)
    rate_hz = frames.common_rate_hz(all_recordings)
    columns, described = frames.frame_columns(contents.contents_from_parts(parts), common=params.common)
    described = frames.add_frame_losses(described, recordings, originals)
    episodes = [
        arrays.from_table(frames.synchronized_table(recording).select(columns), params.actions)
        for recording in all_recordings
    ]
    files: dict[str, Content] = {}
    for episode_arrays in zip(*episodes, strict=True):
        first_array = episode_arrays[0]
        attributes = {"columns": list(first_array.columns), "units": list(first_array.units)}
        values = np.concatenate([array.values for array in episode_arrays])
        files |= _array(f"data/{first_array.name}", values, attributes)
    files |= _array(ENDS, np.cumsum([len(episode[0].values) for episode in episodes], dtype=np.int64), {})
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


def _array(path: str, values: AnyArray, attributes: Mapping[str, Any]) -> dict[str, Content]:
    """Return the files of an array: chunks of rows, compressed as zarr's own, and its metadata."""
    import zarr
    from zarr.storage import MemoryStore

    row_bytes = max(1, values[:1].nbytes)
    rows = max(1, min(len(values), CHUNK_BYTES // row_bytes))
    store: dict[str, Any] = {}
    array = zarr.create_array(
        MemoryStore(store),
        shape=values.shape,
        dtype=values.dtype,
        chunks=(rows, *values.shape[1:]),
        zarr_format=2,
        attributes=dict(attributes),
        config={"write_empty_chunks": True},
    )
    array[:] = values
    return {f"{path}/{name}": content.to_bytes() for name, content in store.items()}


def _json(value: Any) -> bytes:
    return json.dumps(value, indent=4).encode() + b"\n"


_GROUP = _json({"zarr_format": 2})
