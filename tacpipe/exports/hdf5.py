"""Write recordings as HDF5 files: one group per stream at its own rate, or one file of demonstrations for robomimic.

By default one file per recording: one group per stream, one dataset per column in its own type, unit and quantity as
attributes, labels as attributes of the file. ``--structure robomimic`` writes one file ``demos.hdf5`` from synchronized
recordings, or any with ``--rate-hz``: ``data/demo_0/obs/STREAM_QUANTITY``, with ``--actions`` ``actions``, and with
``--split`` the lists ``mask/train`` and ``mask/valid``.

Example: tacpipe export hdf5 data/recordings -o exports/hdf5
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict

import numpy as np

from tacpipe.arrays import AnyArray
from tacpipe.errors import UsageError
from tacpipe.exports import contents, files
from tacpipe.exports.contents import TIME, ColumnName, Loss, stream_label
from tacpipe.exports.files import Files, Scratch, copy_to_sink
from tacpipe.plugins.constraints import Rate
from tacpipe.plugins.params import added
from tacpipe.plugins.stage import ALL, Attribute, RecordingName, RecordingOutput, Result, Roles, stage
from tacpipe.printable import listed
from tacpipe.video.decoding import decode_frames, read_batches
from tacpipe.video.stream import PACKET, read_format

if TYPE_CHECKING:
    import h5py
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording
    from tacpipe.exports.frames import FrameArray
    from tacpipe.io.columns import Columns

    Parts = Dataset

DEMOS = "demos.hdf5"
MASKS = {"train": "train", "val": "valid", "test": "test"}  # role -> robomimic's name for it
EXTRA = "tacpipe"  # group of a demonstration with data that policies must not read
VERSION = ("v110", "v110")  # HDF5 of 2016, which stores many small columns in half the space of older versions
IMAGES, DERIVED = (
    "images",
    "derived_from",
)  # dataset of decoded frames, and its attribute with the column they come from
CHUNK_ROWS = 1 << 16
LEVEL = 4  # gzip level; higher levels take twice the time for 1 %
_STREAMS = f"""
One HDF5 file a recording: the group `STREAM` has a dataset a column; `{TIME}` is the time in nanoseconds of UTC.
Attributes of a dataset are its unit and quantity, attributes of the file the labels:

```python
import h5py

with h5py.File("EXPORT/RECORDING.h5") as file:
    values, unit = file["STREAM/COLUMN"][:], file["STREAM/COLUMN"].attrs["unit"]
```

The group of a camera has its packets as they were recorded; with `--images` the dataset `images` has the decoded frames
(frame, row, column, rgb). tacpipe reads the packets back with `tacpipe ingest hdf5`.
"""
_DEMOS = f"""
One file of demonstrations, `{DEMOS}`, as robomimic reads them: `data/demo_0/obs/STREAM_QUANTITY` has the shape
(frame, channel); the attribute `columns` names its channels, `units` their units. `data/demo_0/tacpipe` has clocks, masks of
gaps and of repeated samples, labels and ground truth, which no policy may read. `data/demo_0` has the recording's name and
labels as attributes. `mask/train`, `mask/valid` and `mask/test` list the demonstrations of each role of the split, where one
was given: robomimic reads them with `hdf5_filter_key`.
"""


@dataclass(frozen=True)
class Params:
    """How the files are structured."""

    structure: Literal["streams", "robomimic"] = "streams"  # one file per recording, or one file of all demonstrations
    # streams: decode the frames of cameras into arrays too (frame, row, column, rgb), next to their packets
    images: bool = added(False)
    rate_hz: Rate | None = None  # robomimic: synchronize to this rate first
    master: str = ""  # robomimic: stream whose samples start and end the frames; without it the first tactile one
    actions: str = ""  # robomimic: stream of the actions: its targets, else its state one frame later
    common: bool = False  # robomimic: omit columns that not all recordings have

    def check(self) -> None:
        """Raise `UsageError` for an option that has no effect on streams."""
        if self.structure == "robomimic" and self.images:
            raise UsageError("images belongs to --structure streams; demonstrations have no frames of cameras.")
        if self.structure == "streams" and (self.rate_hz is not None or self.actions or self.master or self.common):
            raise UsageError(
                "rate_hz, master, actions and common belong to --structure robomimic; streams are written as they are."
            )


def prepare(params: Params) -> Mapping[str, Mapping[str, str | float]]:
    """Return the stage that synchronizes the recordings first, if a rate is given."""
    from tacpipe.exports import frames

    return frames.synchronize_stage(params.rate_hz, params.master)


@stage(version=3, reads=ALL)
def part(params: Params, recording: Recording, name: RecordingName) -> Result:
    """Return the file of one recording, or no file if all recordings are in one."""
    if params.structure == "robomimic":
        from tacpipe.exports import frames

        return Result({"": RecordingOutput(frames.describe(recording))})
    losses: list[Loss] = []
    columns: list[ColumnName] = []
    content = _write_recording(params, recording, losses, columns)
    tables = contents.part(recording, losses, columns)
    return Result({"": RecordingOutput(tables)}, written={f"{name}.h5": copy_to_sink(content)})


@stage(version=3)
def hdf5(
    params: Params,
    recordings: Annotated[Dataset, prepare],
    parts: Annotated[Parts, part],
    originals: Dataset,
    split: Roles | None = None,
) -> Result:
    """Write recordings as HDF5 files.

    One file per recording, with one group per stream at its own rate; or ``--structure robomimic``, one file of
    demonstrations, with the roles of ``--split`` as masks.

    Example: tacpipe export hdf5 data/recordings -o exports/hdf5
    """
    described = contents.contents_from_parts(parts)
    writers: dict[str, Callable[[Any], object]] = {}
    opening, notes = _STREAMS, []
    if params.structure == "robomimic":
        from tacpipe.exports import frames

        roles = {recording: role for (recording, _), role in (split or {}).items()}
        columns, described = frames.frame_columns(described, common=params.common)
        described = frames.add_frame_losses(described, recordings, originals)
        losses: list[tuple[str, Loss]] = []
        content = _write_demos(params, recordings, columns, roles, losses)
        described = replace(described, losses={**described.losses, **contents.loss_sentences(losses)})
        opening, writers[DEMOS] = _DEMOS, copy_to_sink(content)
        missing = [recording.name for recording in recordings if roles and recording.name not in roles]
        notes += (
            [f"{len(missing)} recordings have no role in the split and are in no mask: {listed(missing)}"]
            if missing
            else []
        )
    elif split:
        raise UsageError("split belongs to --structure robomimic; files of single recordings have no masks.")
    text = files.readme_text("Tactile recordings as HDF5", opening, recordings, described)
    notes += files.loss_notes(recordings, described)
    return Result(files=Files({files.README_NAME: text}), notes=notes, written=writers)


def _write_recording(params: Params, recording: Recording, losses: list[Loss], columns: list[ColumnName]) -> Scratch:
    """Return a temporary file with a recording, because HDF5 does not write sequentially.

    Adds losses to ``losses`` and written columns to ``columns``.
    """
    import h5py

    sink = Scratch()
    with h5py.File(sink, "w", track_order=True, libver=VERSION) as file:
        losses += _write_attributes(file, recording.attributes)
        for stream in recording.streams:
            group = file.create_group(stream_label(stream), track_order=True)
            table = recording.columns(stream)
            for field in table.schema:
                losses += _write_column(group, field, table.column(field.name), stream)
            columns += [(stream, name) for name in group]
            if params.images:
                _write_images(group, table)
            sink.check()
    return sink.check()


def _write_images(group: h5py.Group, columns: Columns) -> None:
    """Write the decoded frames of a stream of frames, one chunk per frame; rows without a sound frame are black."""
    video_format = read_format(columns)
    if video_format is None or not columns.num_rows:
        return
    shape = (columns.num_rows, video_format.height_px, video_format.width_px, 3)
    dataset = group.create_dataset(
        IMAGES, shape, "u1", chunks=(1, *shape[1:]), compression="gzip", compression_opts=LEVEL, shuffle=True
    )
    dataset.attrs[DERIVED] = PACKET  # `tacpipe ingest hdf5` reads the packets, and no second stream
    for row, image in decode_frames(video_format, read_batches(columns)):
        if image is not None:
            dataset[row] = image


def _write_attributes(group: h5py.Group, values: Mapping[str, Attribute]) -> Iterator[Loss]:
    """Set the attributes of a recording; yield those that HDF5 cannot represent as losses."""
    for name, value in values.items():
        if value is not None:
            group.attrs[name] = value
    if any(value is None for value in values.values()):
        yield Loss("attributes without a value (null): HDF5 has none, so they are left out")


def _write_column(group: h5py.Group, field: pa.Field, column: pa.ChunkedArray, stream: str) -> Iterator[Loss]:
    """Write a column; yield its losses."""
    import h5py
    import pyarrow as pa

    kind = field.type
    if pa.types.is_string(kind):
        values = np.array([value or "" for value in column.to_pylist()], dtype=object)
        dataset = group.create_dataset(field.name, data=values, dtype=h5py.string_dtype())
    elif pa.types.is_binary(kind):
        values = np.empty(len(column), dtype=object)
        values[:] = [np.frombuffer(value or b"", np.uint8) for value in column.to_pylist()]
        dataset = group.create_dataset(field.name, data=values, dtype=h5py.vlen_dtype(np.uint8))
    elif pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind):
        from tacpipe.exports import ros

        values = ros.column_numbers(column)
        dataset = group.create_dataset(field.name, data=values, **_storage(values))
    else:
        yield Loss(f"HDF5 has no type for {kind}", stream, field.name)
        return
    for key, value in contents.field_metadata(field).items():
        dataset.attrs[key] = value
    if column.null_count:
        yield Loss("missing values are written as NaN, 0 or empty text", stream, field.name)


class Storage(TypedDict, total=False):
    """How h5py stores an array."""

    chunks: tuple[int, ...]
    compression: str
    compression_opts: int
    shuffle: bool


def _storage(values: AnyArray) -> Storage:
    """Return the storage options of an array: compressed chunks, or none for an array without rows."""
    if not len(values):
        return {}
    chunks = (min(len(values), CHUNK_ROWS), *values.shape[1:])
    return {"chunks": chunks, "compression": "gzip", "compression_opts": LEVEL, "shuffle": True}


def _write_array(demo: h5py.Group, array: FrameArray, columns: Columns) -> h5py.Dataset:
    """Write an array of a demonstration chunk by chunk; the file equals that of an array written at once."""
    import h5py

    path, kind, shape = _demo_path(array), array.type_in(columns), array.shape(columns.num_rows)
    group_path, _, name = path.rpartition("/")
    group = demo.require_group(group_path) if group_path else demo
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_obj_track_times(False)  # equal recordings give equal bytes
    if shape[0]:
        layout.set_chunk((min(shape[0], CHUNK_ROWS), *shape[1:]))
        layout.set_shuffle()
        layout.set_deflate(LEVEL)
    space = h5py.h5s.create_simple(shape)
    dataset = h5py.h5d.create(group.id, name.encode(), h5py.h5t.py_create(kind, logical=True), space, dcpl=layout)
    for first_row, values in _chunks(array.blocks(columns, kind)):
        space.select_hyperslab((first_row, *(0 for _ in shape[1:])), values.shape)
        dataset.write(h5py.h5s.create_simple(values.shape), space, values)
    return h5py.Dataset(dataset)


def _chunks(blocks: Iterable[AnyArray]) -> Iterator[tuple[int, AnyArray]]:
    """Yield the rows of blocks in whole chunks, each with the index of its first row, so that it is compressed once."""
    buffered: list[AnyArray] = []
    first_row = count = 0
    for block in blocks:
        buffered.append(block)
        count += len(block)
        while count >= CHUNK_ROWS:
            rows = np.concatenate(buffered)
            yield first_row, rows[:CHUNK_ROWS]
            buffered, count, first_row = [rows[CHUNK_ROWS:]], count - CHUNK_ROWS, first_row + CHUNK_ROWS
    if count:
        yield first_row, np.concatenate(buffered)


def _write_demos(
    params: Params,
    recordings: Dataset,
    columns: Sequence[str],
    roles: Mapping[str, str],
    losses: list[tuple[str, Loss]],
) -> Scratch:
    """Return a temporary file with all demonstrations; adds losses of recordings to ``losses``."""
    import h5py

    from tacpipe.exports import frames

    rate_hz = frames.common_rate_hz(list(recordings))
    masks: dict[str, list[bytes]] = {}
    sink = Scratch()
    with h5py.File(sink, "w", track_order=True, libver=VERSION) as file:
        data = file.create_group("data", track_order=True)
        total = 0
        for number, recording in enumerate(recordings):
            demo = data.create_group(f"demo_{number}", track_order=True)
            table = frames.synchronized_columns(recording).select(columns)
            for array in frames.arrays_of_frames(table, params.actions):
                dataset = _write_array(demo, array, table)
                dataset.attrs["columns"], dataset.attrs["units"] = array.columns, array.units
            losses += [(recording.name, loss) for loss in _write_attributes(demo, recording.attributes)]
            demo.attrs["num_samples"] = table.num_rows
            demo.attrs["recording"] = recording.name
            sink.check()
            total += table.num_rows
            if mask := MASKS.get(roles.get(recording.name, "")):
                masks.setdefault(mask, []).append(f"demo_{number}".encode())
        data.attrs["total"] = total
        data.attrs["env_args"] = json.dumps({"env_name": "tacpipe", "type": 1, "env_kwargs": {"control_freq": rate_hz}})
        for name, demos in sorted(masks.items()):
            file[f"mask/{name}"] = demos
    return sink.check()


def _demo_path(array: FrameArray) -> str:
    """Return the path of an array in its demonstration: robomimic reads actions next to obs, and policies read obs."""
    if array.actions or array.name == TIME:
        return array.name
    return f"obs/{array.name}" if array.observed else f"{EXTRA}/{array.name}"
