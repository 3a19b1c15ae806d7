"""Compute tactile channels from the frames of cameras.

The cameras look at gels. Rows do not look ahead, and memory use does not depend on the length of a recording.

Example: tacpipe extract markers data/recordings -o data/markers
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import numpy as np

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins import registry
from tacpipe.plugins.constraints import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, Seed, Unit
from tacpipe.plugins.file_params import pin_file
from tacpipe.plugins.params import added
from tacpipe.plugins.rows import RowCounts, count_rows
from tacpipe.plugins.stage import Fitted, RecordingOutput, Result, Workspace, stage
from tacpipe.plugins.stream_selection import StreamSelection

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import AnyFloats, Bytes
    from tacpipe.codecs.frame_autoencoder import Encode
    from tacpipe.datasets.dataset import Dataset, Recording
    from tacpipe.io.columns import Columns
    from tacpipe.video.channels import FrameChannels
    from tacpipe.video.stream import VideoFormat

T = TypeVar("T")
ENCODED_FRAMES = 32  # frames per batch of the encoder
HELD_OUT = 0.15  # fraction of the training recordings used for early stopping
MIN_RATIO = 0.5  # minimum fraction of the markers that are found in a reliable frame
MAX_UNRELIABLE = 0.1  # maximum fraction of other frames without a note
MAX_CELLS = 10_000  # maximum number of grid cells, each with three columns


@dataclass(frozen=True)
class Params(StreamSelection):
    """The grid, and the frames that show the untouched gel."""

    rows: PositiveInt = 6  # rows of the grid
    columns: PositiveInt = 8  # columns of the grid
    # number of first frames whose mean is the untouched gel; 0: brightness itself, for recordings of single images
    reference_frames: NonNegativeInt = 5

    def check(self) -> None:
        """Raise `UsageError` for a grid with more cells than a table should have columns."""
        if self.rows * self.columns > MAX_CELLS:
            raise UsageError(
                f"A grid of {self.rows} x {self.columns} cells has more than {MAX_CELLS:,}. Choose fewer rows or columns."
            )


@stage(version=2)
def difference(params: Params, recording: Recording) -> RecordingOutput:
    """Measure how the brightness of a gel changes on a grid.

    Each stream of frames becomes a stream of tactile channels with one row per frame: the mean of each cell and colour,
    in grey levels from 0 to 255, minus that of the untouched gel. The first frames of a recording show the untouched
    gel, so start a recording before contact. Until ``--reference-frames`` frames exist, the frames so far are used, so
    no row looks ahead. Streams without frames stay unchanged.

    Example: tacpipe extract difference data/gels -o data/difference
    """
    from tacpipe.video.channels import DifferenceChannels

    def compute(subject: str, columns: Columns, video_format: VideoFormat) -> pa.RecordBatchReader:
        if params.rows > video_format.height_px or params.columns > video_format.width_px:
            raise TacpipeError(
                f"{subject}: frames have {video_format.width_px} x {video_format.height_px} pixels, and the grid "
                f"{params.columns} x {params.rows} cells. Choose fewer with --columns and --rows."
            )
        channels = DifferenceChannels(params.rows, params.columns, params.reference_frames, subject)
        return _stream_of_values(columns, channels.fields(), _channel_values(columns, video_format, channels))

    return _replace_frames(recording, compute)


@dataclass(frozen=True)
class MarkerParams(StreamSelection):
    """The grid of markers, and their spacing on the gel."""

    rows: PositiveInt = 4  # rows of the grid; of a larger grid, those nearest to the centre of the image
    columns: PositiveInt = 6  # columns of the grid
    # distance between neighbouring markers on the gel, for displacements in millimetres; 0: pixels
    pitch_mm: Annotated[NonNegativeFloat, Unit("mm")] = 0.0
    # number of first frames that show the untouched gel; the first with all markers is used, else the one with the most
    reference_frames: PositiveInt = 5
    polarity: Literal["auto", "dark", "light"] = "auto"  # brightness of the markers; auto: the one with more markers

    def check(self) -> None:
        """Raise `UsageError` for a grid with more markers than a table should have columns."""
        if self.rows * self.columns > MAX_CELLS:
            raise UsageError(
                f"A grid of {self.rows} x {self.columns} markers has more than {MAX_CELLS:,}. Choose fewer rows or columns."
            )


@stage(version=3)
def markers(params: MarkerParams, recording: Recording) -> RecordingOutput:
    """Track the markers of a gel as tactile channels.

    Each stream of frames becomes a stream with one row per frame: the displacement of each marker along x and y since
    the first frames, and the fraction of markers that are found. The first frames show the untouched gel, so start a
    recording before contact. A marker that is hidden, or that contradicts the order of the grid, is null. No row looks
    ahead. If all markers move by more than half the distance to their neighbours between two frames, they may be
    mistaken for these. Streams without frames stay unchanged.

    Example: tacpipe extract markers data/gels -o data/markers
    """
    from tacpipe.video.channels import MarkerChannels

    def compute(subject: str, columns: Columns, video_format: VideoFormat) -> pa.RecordBatchReader:
        channels = MarkerChannels(
            params.rows, params.columns, params.pitch_mm, params.reference_frames, params.polarity, subject
        )
        return _stream_of_values(columns, channels.fields(), _channel_values(columns, video_format, channels))

    return _replace_frames(recording, compute)


@dataclass(frozen=True)
class DepthParams(StreamSelection):
    """The map of the gel, the grid, and the frames that show the untouched gel."""

    map: str = ""  # required: result of `tacpipe extract gel-map`
    map_sha256: str = ""  # sha256 of the map in it; computed if omitted
    rows: PositiveInt = 12  # rows of the grid
    columns: PositiveInt = 16  # columns of the grid
    # number of first frames whose mean is the untouched gel; 0: that of the map, for recordings of single images
    reference_frames: NonNegativeInt = 5
    # minimum depth of a contact; deeper contacts begin where the rims of the balls were, as a fraction of their depth
    contact_mm: Annotated[PositiveFloat, Unit("mm")] = 0.1

    def __post_init__(self) -> None:
        """Compute the digest of the map, which is part of the key. Raises the errors of `pin_file`."""
        from tacpipe.video.gel_map import map_path

        digest = pin_file("map", self.map and str(map_path(self.map)), self.map_sha256)
        object.__setattr__(self, "map_sha256", digest)


@stage(version=1)
def depth(params: DepthParams, recording: Recording) -> RecordingOutput:
    """Measure the depth of a gel from its colours.

    Each stream of frames becomes a stream of tactile channels with one row per frame: the depth in millimetres on a
    grid, the area and the volume of the contact, the deepest point from the top left corner of the image, and the
    fraction of the contact where the map is a guess, because no press was as steep or at that place. The map comes from
    `tacpipe extract gel-map`. Depth is relative to the flatter half of the image. The first frames of a recording show
    the untouched gel, so start a recording before contact. No row looks ahead. Streams without frames stay unchanged.

    Example: tacpipe extract depth data/gels --map data/gel -o data/depth
    """
    from tacpipe.video.depth import DepthChannels

    def compute(subject: str, columns: Columns, video_format: VideoFormat) -> pa.RecordBatchReader:
        channels = DepthChannels.from_params(params, subject)
        return _stream_of_values(columns, channels.fields(), _channel_values(columns, video_format, channels))

    return _replace_frames(recording, compute)


@dataclass(frozen=True)
class FrameAutoencoderParams(StreamSelection):
    """Features of the autoencoder, and its training."""

    components: PositiveInt = 16  # number of features
    images: PositiveInt = 4000  # number of training images, evenly spaced over the frames of the training recordings
    epochs: PositiveInt = 20  # maximum number of passes over the training images
    batch: PositiveInt = 64  # images per step of the optimiser
    learning_rate: PositiveFloat = 1e-3  # learning rate of Adam
    patience: PositiveInt = 5  # epochs without a lower error on held-out training recordings before training stops
    seed: Seed = 0  # random seed of initial weights and of the order of images
    # number of first frames whose mean, the untouched gel, is subtracted from each image; 0: images as they are
    reference_frames: NonNegativeInt = added(0)


@stage(version=2)
def fit_autoencoder(params: FrameAutoencoderParams, train: Dataset, workspace: Workspace) -> Result:
    """Return the weights of an encoder trained on images of the training recordings.

    Raises `TacpipeError` if there are fewer than two, or no frames.
    """
    from tacpipe.codecs import frame_autoencoder
    from tacpipe.training.loop import Schedule

    recordings = [params.narrow(recording) for recording in train.recordings.values()]
    if len(recordings) < 2:
        raise TacpipeError(
            f"An autoencoder is stopped by recordings that it does not learn, so it needs at least 2 training recordings "
            f"and there are {len(recordings)}. Make a split with more."
        )
    images = _training_images(recordings, params.images, params.reference_frames)
    schedule = Schedule(
        epochs=params.epochs,
        batch=params.batch,
        learning_rate=params.learning_rate,
        patience=params.patience,
        gradient_clip=frame_autoencoder.GRADIENT_CLIP,
        seed=params.seed,
    )
    parts = frame_autoencoder.select_images(images, HELD_OUT)
    weights = frame_autoencoder.fit(*parts, schedule, workspace, params.components)
    return Result(files={frame_autoencoder.WEIGHTS: weights})


@stage(version=2)
def autoencoder(
    params: FrameAutoencoderParams, recording: Recording, codec: Annotated[Fitted, fit_autoencoder]
) -> RecordingOutput:
    """Encode frames with a small convolutional autoencoder.

    Each stream of frames becomes a stream of features with a row per frame. The network is trained on frames of the
    training recordings, of which 15 % are held out for early stopping. Streams without frames stay unchanged.

    Example: tacpipe extract autoencoder data/gels --split data/split -o data/features
    """
    from tacpipe.codecs import frame_autoencoder

    encode = frame_autoencoder.read_encoder(codec[frame_autoencoder.WEIGHTS])
    return _encode_frames(recording, encode, params.reference_frames)


@dataclass(frozen=True)
class EncoderParams(StreamSelection):
    """The encoder and its weights."""

    encoder: str = "autoencoder"  # name of an encoder; plug-ins can add more
    weights: str = ""  # file with the encoder's weights
    weights_sha256: str = ""  # sha256 of that file; computed if omitted
    # number of first frames whose mean, the untouched gel, is subtracted from each image; 0: images as they are
    reference_frames: NonNegativeInt = added(0)

    def __post_init__(self) -> None:
        """Compute the digest of the weights, which is part of the key. Raises the errors of `pin_file`."""
        digest = pin_file("weights", self.weights, self.weights_sha256)
        object.__setattr__(self, "weights_sha256", digest)


@stage(version=2)
def encoder(params: EncoderParams, recording: Recording) -> RecordingOutput:
    """Encode frames with an image encoder from a weights file.

    Each stream of frames becomes a stream of features with a row per frame. The digest of the weights is part of the
    key. Streams without frames stay unchanged.

    Example: tacpipe extract encoder data/gels --weights data/features/encoder.safetensors -o data/codes
    """
    if not params.weights:
        raise UsageError("weights names no file. Give the file with the weights of the encoder.")
    encode = registry.load_encoder(params.encoder)(Path(params.weights))
    return _encode_frames(recording, encode, params.reference_frames)


def _encode_frames(recording: Recording, encode: Encode, reference_frames: int) -> RecordingOutput:
    """Return a recording with its frames replaced by their features."""

    def compute(place: str, columns: Columns, video_format: VideoFormat) -> pa.RecordBatchReader:
        return _feature_stream(columns, _images(columns, video_format, reference_frames, place), encode)

    return _replace_frames(recording, compute)


def _images(
    columns: Columns, video_format: VideoFormat, reference_frames: int, place: str
) -> Iterator[tuple[int, Bytes | None]]:
    """Yield row number and image of each frame; with ``reference_frames``, minus the untouched gel, around 128.

    The untouched gel is the mean of the first frames up to the row, so no row looks ahead. Differences beyond 127 grey
    levels are cut off. ``place`` names the stream in errors.
    """
    from tacpipe.video.channels import UntouchedGel
    from tacpipe.video.decoding import decode_frames, read_batches

    frames = decode_frames(video_format, read_batches(columns))
    if not reference_frames:
        yield from frames
        return
    untouched = UntouchedGel(reference_frames, place)
    for row, image in frames:
        if image is None:
            untouched.skip()
            yield row, None
        else:
            difference = np.rint(image - untouched.update(image.astype(np.float32)))
            yield row, np.clip(difference + 128, 0, 255).astype(np.uint8)


def _replace_frames(
    recording: Recording, compute: Callable[[str, Columns, VideoFormat], pa.RecordBatchReader]
) -> RecordingOutput:
    """Return a recording with its streams of frames replaced by the streams that ``compute`` returns.

    Rows of damaged frames are null, counted and noted. The first argument of ``compute`` names recording and stream for
    errors. Raises `TacpipeError` if no stream has frames.
    """
    from tacpipe.video.stream import read_format

    streams: dict[str, pa.Table | pa.RecordBatchReader] = {}
    rows: dict[str, RowCounts] = {}
    notes: list[str] = []
    has_frames = False
    for name in recording.streams:
        columns = recording.columns(name)
        video_format = read_format(columns)
        if video_format is None:
            streams[name], rows[name] = _copy_stream(columns), RowCounts.all_used(columns.num_rows)
        else:
            has_frames = True
            values = compute(f"Recording {recording.name}, stream {name}", columns, video_format)
            streams[name] = _count_frames(values, columns, name, rows, notes)
    if not has_frames:
        raise TacpipeError(
            f"Recording {recording.name} has no stream of frames; its streams are {', '.join(recording.streams)}. Give the "
            f"recording of a camera, as `tacpipe ingest` or `tacpipe acquire` wrote it."
        )
    return RecordingOutput(streams, notes=notes, rows=rows)


def _count_frames(
    values: pa.RecordBatchReader, columns: Columns, stream: str, rows: dict[str, RowCounts], notes: list[str]
) -> pa.RecordBatchReader:
    """Return the values computed from frames. When they are read, the frames are counted in ``rows`` and ``notes``.

    The values of a damaged frame are null.
    """
    import pyarrow as pa

    from tacpipe.video.channels import DETECTED_RATIO
    from tacpipe.video.stream import describe_damage

    def batches() -> Iterator[pa.RecordBatch]:
        damaged = [np.zeros(0, bool)]  # (frame,) by batch
        unreliable = 0
        for batch in values:
            damaged.append(batch.column(batch.num_columns - 1).is_null().to_numpy(zero_copy_only=False))
            if DETECTED_RATIO in batch.schema.names:
                ratio = batch.column(DETECTED_RATIO).to_numpy(zero_copy_only=False)
                unreliable += int(np.count_nonzero(ratio < MIN_RATIO))
            yield batch
        is_damaged = np.concatenate(damaged)
        without_image = columns.num_rows - len(is_damaged)
        unused = {"damaged": int(is_damaged.sum()), "without an image": without_image}
        rows[stream] = RowCounts(columns.num_rows, columns.num_rows - sum(unused.values()), unused)
        if is_damaged.any():
            notes.append(f"Stream {stream}: {describe_damage(is_damaged)}. Their rows are null.")
        if unreliable > MAX_UNRELIABLE * len(is_damaged):
            notes.append(
                f"Stream {stream}: fewer than half of the markers are found in {unreliable:,} of {len(is_damaged):,} frames."
            )

    return pa.RecordBatchReader.from_batches(values.schema, batches())


def _copy_stream(columns: Columns) -> pa.RecordBatchReader:
    """Return an unchanged stream as batches."""
    import pyarrow as pa

    batches = (batch for rows in columns.batches() for batch in rows.to_batches())
    return pa.RecordBatchReader.from_batches(columns.schema, batches)


def _stream_of_values(
    columns: Columns, fields: list[pa.Field], values: Iterator[tuple[int, AnyFloats | None]]
) -> pa.RecordBatchReader:
    """Return a lazy stream with the clocks of ``columns`` and ``values``, an iterator of row index and values (field,).

    Rows whose values are None are null.
    """
    import pyarrow as pa

    from tacpipe.video.channels import CLOCKS
    from tacpipe.video.stream import BATCH_ROWS

    clock_names = [name for name in CLOCKS if name in columns.column_names]
    clocks = columns.read(clock_names)
    schema = pa.schema([*clocks.schema, *fields])

    def batches() -> Iterator[pa.RecordBatch]:
        for block in _blocks(values, BATCH_ROWS):
            times = clocks.take([row for row, _ in block]).combine_chunks()
            channels = np.full((len(block), len(fields)), np.nan, np.float32)  # (time, field)
            for position, (_, row_values) in enumerate(block):
                if row_values is not None:
                    channels[position] = row_values
            arrays = [pa.array(channel, from_pandas=True) for channel in channels.T]  # NaN is null
            clock_arrays = [times.column(name).chunk(0) for name in clock_names]
            yield pa.RecordBatch.from_arrays([*clock_arrays, *arrays], schema=schema)

    return pa.RecordBatchReader.from_batches(schema, batches())


def _channel_values(
    columns: Columns, video_format: VideoFormat, channels: FrameChannels
) -> Iterator[tuple[int, AnyFloats | None]]:
    """Yield the row index and the channels (field,) of each frame, None for a damaged one."""
    from tacpipe.video.decoding import decode_frames, read_batches

    for row, image in decode_frames(video_format, read_batches(columns), grey=channels.grey):
        if image is None:
            channels.skip()
            yield row, None
        else:
            yield row, channels.values(image)


def _blocks(values: Iterator[tuple[int, T]], rows: int) -> Iterator[list[tuple[int, T]]]:
    """Yield ``values`` in lists of at most ``rows``."""
    while block := list(itertools.islice(values, rows)):
        yield block


def _training_images(recordings: Sequence[Recording], count: int, reference_frames: int) -> list[Bytes]:
    """Return about ``count`` downscaled images from all streams of frames, by recording (image, row, column, rgb).

    They are those of `_images`. Raises `TacpipeError` if there are no frames.
    """
    from tacpipe.codecs.frame_autoencoder import reduce_image
    from tacpipe.video.stream import read_format

    streams: list[list[tuple[str, Columns, VideoFormat]]] = []  # by recording
    for recording in recordings:
        columns_by_stream = {stream: recording.columns(stream) for stream in recording.streams}
        formats = [(stream, columns, read_format(columns)) for stream, columns in columns_by_stream.items()]
        streams.append([(stream, columns, video_format) for stream, columns, video_format in formats if video_format])
    total = sum(columns.num_rows for frame_streams in streams for _, columns, _ in frame_streams)
    if not total:
        raise TacpipeError("The training recordings have no frames. Give the recordings of a camera.")
    step = max(1, total // count)
    images = []
    for recording, frame_streams in zip(recordings, streams, strict=True):
        reduced: list[Bytes] = []
        for stream, columns, video_format in frame_streams:
            place, before = f"Recording {recording.name}, stream {stream}", len(reduced)
            frames = _images(columns, video_format, reference_frames, place)
            reduced += [reduce_image(image) for row, image in frames if row % step == 0 and image is not None]
            counts = RowCounts.some_used(columns.num_rows, len(reduced) - before, "not sampled or damaged")
            count_rows(recording.name, stream, counts)
        if frame_streams:
            images.append(np.array(reduced, np.uint8))
    return images


def _feature_stream(
    columns: Columns, images_by_row: Iterator[tuple[int, Bytes | None]], encode: Encode
) -> pa.RecordBatchReader:
    """Return a stream of the features of frames, with their clocks. The first batch determines the number of features.

    ``images_by_row`` has row number and image of each frame, or None for a damaged one. Raises `TacpipeError`, here or
    while the stream is read, if the encoder returns an array of the wrong shape.
    """

    def features() -> Iterator[tuple[int, AnyFloats | None]]:
        for block in _blocks(images_by_row, ENCODED_FRAMES):
            images = [image for _, image in block if image is not None]
            if not images:
                yield from ((row, None) for row, _ in block)
                continue
            # all batches have the same size, because the rounding of a matrix product depends on its number of rows
            images += images[-1:] * (ENCODED_FRAMES - len(images))
            encoded = encode(np.stack(images))
            if encoded.shape[:-1] != (ENCODED_FRAMES,):
                raise TacpipeError(
                    f"The encoder returned an array of the shape {encoded.shape} for {ENCODED_FRAMES} frames. It must "
                    f"return one row of features per frame."
                )
            codes = iter(encoded)
            yield from ((row, None if image is None else next(codes)) for row, image in block)

    values = features()
    head = list(_until_sound(values))
    width = next((len(row_values) for _, row_values in reversed(head) if row_values is not None), 0)
    if head and not width:
        raise TacpipeError("None of its frames can be decoded. Leave the recording out with --skip-bad.")
    return _stream_of_values(columns, _feature_fields(width), itertools.chain(head, values))


def _until_sound(values: Iterator[tuple[int, T | None]]) -> Iterator[tuple[int, T | None]]:
    """Yield values up to and including the first that is not None."""
    for row, row_values in values:
        yield row, row_values
        if row_values is not None:
            return


def _feature_fields(count: int) -> list[pa.Field]:
    """Return the fields ``feature01``, ``feature02``, …, float32."""
    import pyarrow as pa

    digits = max(2, len(str(count)))
    return [
        pa.field(
            f"feature{number:0{digits}d}",
            pa.float32(),
            metadata={"unit": "1", "quantity": "tactile", "taxel": str(number)},
        )
        for number in range(1, count + 1)
    ]
