"""Read a recording for a forecaster: latents, arm motion and raw channels by row, and the windows."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Int64s, Times
from tacpipe.channels import arm as poses
from tacpipe.channels import streams
from tacpipe.channels.arm import Pose
from tacpipe.channels.schema import field_metadata, is_truth
from tacpipe.channels.streams import missing_channel_error
from tacpipe.codecs import codec as codecs
from tacpipe.codecs import tactile
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import columns
from tacpipe.io.columns import Columns
from tacpipe.io.spill import MappedArrays
from tacpipe.plugins.rows import IN_GAP, MEASURED, NO_CONTACT, RowCounts, count_rows
from tacpipe.signals import kinematics
from tacpipe.signals.kinematics import make_continuous
from tacpipe.signals.runs import rows_in_windows, run_starts, window_starts

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording

BLOCK_ROWS = 1 << 14  # rows per block
IN_MEMORY = 1 << 27  # maximum bytes of recording rows in memory, above which they are stored on disk
_EXACT_BITS = 16  # bits of an integer that float32 represents exactly


class Levels:
    """Levels above rest (time, channel), an array whose rows are computed when they are indexed.

    An hour at 50 Hz takes half the memory of a float64 array. Indexing returns the values of
    ``(stored.astype(float64) - rest).astype(dtype)``.
    """

    def __init__(self, stored: AnyFloats, rest_counts: AnyFloats, dtype: type[np.floating[Any]] = np.float64) -> None:
        self.stored = stored  # (time, channel), in the recording's precision
        self.rest_counts = rest_counts  # (channel,)
        self.dtype = dtype

    def __len__(self) -> int:
        return len(self.stored)

    @property
    def shape(self) -> tuple[int, ...]:
        """Numbers of rows and channels."""
        return self.stored.shape

    def __getitem__(self, at: Any) -> AnyFloats:
        """Return the levels at an index of rows, or at a pair of indices of rows and of channels."""
        rest_counts = self.rest_counts[at[1]] if isinstance(at, tuple) else self.rest_counts
        levels: AnyFloats = np.subtract(self.stored[at], rest_counts, dtype=np.float64)
        return levels.astype(self.dtype, copy=False)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> AnyFloats:
        return self[:].astype(dtype or self.dtype, copy=False)

    def astype(self, dtype: type[np.floating[Any]]) -> Levels:
        """Return the same levels in another precision."""
        return Levels(self.stored, self.rest_counts, dtype)

    def rows_between(self, first: int, last: int) -> Levels:
        """Return the levels of the rows from ``first`` to ``last``, exclusive."""
        return Levels(self.stored[first:last], self.rest_counts, self.dtype)

    def finite(self, storage: MappedArrays) -> Bools:
        """Return which rows (time,) contain only finite levels; ``storage`` may contain the rows."""
        finite = np.ones(len(self), dtype=bool)
        for first in range(0, len(self), BLOCK_ROWS):
            block = slice(first, first + BLOCK_ROWS)
            finite[block] = np.isfinite(self.stored[block] - self.rest_counts).all(axis=1)
            storage.release()
        return finite


def above_rest(columns: Columns, channels: Sequence[str], storage: MappedArrays) -> Levels:
    """Return the channels' levels above rest, kept in ``storage``. Raises `TacpipeError` if a channel has no rest level."""
    rest_counts = tactile.rest_counts(columns.schema, channels)
    narrow = all(_fits_float32(columns.schema.field(name).type) for name in channels)
    stored = storage.empty((columns.num_rows, len(channels)), np.float32 if narrow else np.float64)
    for rows, batch in _batches(columns, channels):
        for index, name in enumerate(channels):
            stored[rows, index] = batch.column(name).to_numpy()
        storage.read(stored[rows].nbytes)
    return Levels(stored, rest_counts)


def _batches(columns: Columns, names: Sequence[str]) -> Iterator[tuple[slice, pa.Table]]:
    """Yield the range of rows of each batch, and its table with these columns."""
    first = 0
    for batch in columns.batches(names):
        yield slice(first, first + batch.num_rows), batch
        first += batch.num_rows


def _fits_float32(kind: pa.DataType) -> bool:
    """Return whether float32 represents every value of a column's type."""
    import pyarrow as pa

    small = pa.types.is_integer(kind) and kind.bit_width <= _EXACT_BITS
    return bool(small or pa.types.is_float32(kind) or pa.types.is_float16(kind))


POSE = poses.DEFAULT_POSE.columns
VELOCITY = tuple(f"robot_velocity_{axis}_m_s" for axis in "xyz")
TURNING = tuple(f"robot_turning_{axis}_rad_s" for axis in "xyz")
ARM = POSE + VELOCITY + TURNING
TURNED = slice(3, 7)  # quaternion columns of ``ARM``
POSED = len(POSE)  # number of pose columns of ``ARM``, which velocities follow
FINGER = "robot_finger_m"
JOINTS = 7
BY_POSES = "differences of poses"  # source of a plan's velocities, as written in models


@dataclass(frozen=True)
class Track:
    """Rows of one recording; tactile channels are in counts above rest, latents in the codec's unit."""

    name: str
    t_ns: Times  # (time,)
    contact: Int64s  # (time,), negative without contact
    groups: Int64s  # (time,), equal for consecutive rows without a gap
    usable: Bools  # (time,)
    latent: AnyFloats | Levels  # (time, latent), float32
    arm: AnyFloats  # (time, 13): `ARM`
    finger: AnyFloats  # (time,), m; 0 if it is not recorded
    tactile: AnyFloats | Levels  # (time, channel), float64
    timeline: str = "uniform"  # grid: uniform, logged or fresh
    object: str | None = None  # grasped object, if it is labelled
    # (time, 6), velocities of a plan with these poses; None: the velocities in ``arm``
    plan_velocity: AnyFloats | None = None
    measured: Bools | None = None  # (time,): True if the next row had arrived with a row; None: nowhere
    storage: MappedArrays = field(default_factory=lambda: MappedArrays(sys.maxsize))  # contains the rows

    def starts(self, context: int, horizon: int, stride: int = 1) -> Int64s:
        """Return the first row of each window of ``context + horizon`` rows (window,).

        A window whose first target had already arrived with its last input row is no forecast, and left out.
        """
        starts = window_starts(self.groups, self.usable, context, horizon, stride)
        return starts if self.measured is None else starts[~self.measured[starts + context - 1]]

    def rows_between(self, first: int, last: int) -> Track:
        """Return the rows from ``first`` to ``last``, exclusive."""

        def slice_rows(values: AnyFloats | Levels) -> AnyFloats | Levels:
            return values.rows_between(first, last) if isinstance(values, Levels) else values[first:last]

        selected = {
            name: getattr(self, name)[first:last] for name in ("t_ns", "contact", "groups", "usable", "arm", "finger")
        }
        for name in ("plan_velocity", "measured"):
            if getattr(self, name) is not None:
                selected[name] = getattr(self, name)[first:last]
        return replace(self, latent=slice_rows(self.latent), tactile=slice_rows(self.tactile), **selected)

    def planned_arm(self, rows: Int64s) -> AnyFloats:
        """Return the arm at ``rows`` (…) as a plan contains it, (…, 13), with velocities from `plan_velocity`."""
        arm = self.arm[rows]
        if self.plan_velocity is not None:
            arm[..., POSED:] = self.plan_velocity[rows]
        return arm

    def count_rows(self, starts: Int64s, length: int, *, only_contact: bool = False) -> None:
        """Count the rows in windows of ``length`` rows from ``starts`` (window,) as used."""
        inside = rows_in_windows(starts, length, len(self.t_ns))
        reasons = [(IN_GAP, ~self.usable), (NO_CONTACT, (self.contact < 0) & only_contact)]
        if self.measured is not None:
            reasons.append((MEASURED, self.measured))
        count_rows(self.name, "", RowCounts.from_masks(inside, reasons))

    def contact_starts(self, context: int, horizon: int, stride: int) -> Int64s:
        """Return the first row of each window within a single contact (window,)."""
        same = np.concatenate([[0], np.cumsum(np.diff(self.contact) != 0)])[: len(self.contact)]
        groups = self.groups * (int(same.max(initial=0)) + 1) + same
        return window_starts(groups, self.usable & (self.contact >= 0), context, horizon, stride)


def variances(track: Track) -> AnyFloats:
    """Return the variance of each tactile channel over the usable rows (channel,), in squared counts."""
    usable = np.flatnonzero(track.usable)
    blocks = [usable[first : first + BLOCK_ROWS] for first in range(0, len(usable), BLOCK_ROWS)]

    def levels() -> Iterator[AnyFloats]:
        for block in blocks:
            yield np.asarray(track.tactile[block])
            track.storage.release()

    mean = sum(block.sum(axis=0) for block in levels()) / len(usable)
    variance: AnyFloats = sum(((block - mean) ** 2).sum(axis=0) for block in levels()) / len(usable)
    return variance


def no_window(beginning: str, recordings: Dataset, context: int, horizon: int) -> TacpipeError:
    """Return the error for recordings without a window, with gaps that may be the cause.

    ``beginning`` is the start of the message, such as ``The training recordings contain``.
    """
    gaps = streams.describe_gaps(*(recording.columns() for recording in recordings.recordings.values()))
    advice = gaps or ["Give more or longer recordings, or shorten context and horizon."]
    return TacpipeError(f"{beginning} no window of {context} and {horizon} rows without a gap. {' '.join(advice)}")


def codec_of(schema: pa.Schema, files: Mapping[str, bytes], name: str = "") -> codecs.Codec:
    """Return the codec in a dataset's files, or the identity codec if there is none.

    ``name`` is the name of the recording with this ``schema``. Raises `TacpipeError` if schema and files do not match.
    """
    latents = tactile.columns(schema, "latent")
    if codecs.DESCRIPTION in files:
        codec = codecs.load(files)
        if latents != codec.latents:
            raise TacpipeError(
                f"The table has {len(latents)} latent columns where its codec makes {len(codec.latents)}. "
                "Run `tacpipe compress` on it again."
            )
        return codec
    if latents:
        raise TacpipeError(
            f"The table has {len(latents)} latent columns but its dataset no {codecs.DESCRIPTION}. "
            "Give the output of `tacpipe compress` as it is."
        )
    channels = tactile.columns(schema, "tactile")
    if not channels:
        raise missing_channel_error(name, "tactile", schema)
    return codecs.Raw(channels, tuple(tactile.layout(schema, channels)))


def inputs(table: pa.Table | Columns, names: Sequence[str]) -> AnyFloats:
    """Return the named columns as float64, shape (time, column).

    Raises `TacpipeError` if a column is absent or belongs to the simulator's ground truth.
    """
    _check_inputs(table.schema, names)
    return tactile.matrix(table, names)


def _check_inputs(schema: pa.Schema, names: Sequence[str]) -> None:
    """Raise `TacpipeError` if a column is absent or belongs to the simulator's ground truth."""
    for name in names:
        if name in schema.names and is_truth(schema.field(name)):
            raise TacpipeError(f"{name} is ground truth; a model that reads it has learned nothing.")
        if name not in schema.names:
            raise TacpipeError(
                f"There is no column {name}. Give recordings of the same streams and columns as the model's, that went "
                "through `tacpipe synchronize` and `tacpipe segment contacts`, and for a model of latents through "
                "`tacpipe compress`."
            )


def select_pose(shard: Recording, actions: str, arm: str = "") -> Pose:
    """Return the arm columns that a model reads as motion, or an empty pose if there is no arm and none is needed.

    ``actions`` and ``arm`` are the params with these names. Raises `TacpipeError` with the recording's name if a plan
    is needed and there is no arm, and the errors of `tacpipe.channels.arm.pose`.
    """
    schema = shard.columns().schema
    try:
        pose = poses.pose(schema, arm, needed=actions != "none")
    except UsageError as error:
        raise UsageError(f"{shard.name}: {error}") from error
    except TacpipeError as error:
        raise TacpipeError(f"{shard.name}: {error}") from error
    if not pose.position and actions != "none":
        raise poses.missing_arm_error(shard.name, schema)
    return pose


def track(
    shard: Recording, codec: codecs.Codec, pose: Pose = poses.DEFAULT_POSE, storage: MappedArrays | None = None
) -> Track:
    """Return a recording's track, with its stored latents, or its channels if ``codec`` is raw.

    ``storage`` contains the rows, by default up to `IN_MEMORY` in memory and others on disk. ``pose`` contains the names
    of the arm's columns. Without a position the arm does not move, and without a quaternion it does not turn. Rows
    with a value that is not finite or in a gap of any stream are unusable. Raises `TacpipeError` with the recording's
    name if a column is absent or its channels are not the codec's.
    """
    table, storage = shard.columns(), storage or MappedArrays(IN_MEMORY)
    try:
        is_fitted = not isinstance(codec, codecs.Raw)
        codecs.check_channels(codec.channels, tactile.columns(table.schema, "tactile"), is_fitted=is_fitted)
        counts_above_rest = above_rest(table, codec.channels, storage)
        finite = counts_above_rest.finite(storage)
        if codec.kind == "raw":
            latent: AnyFloats | Levels = counts_above_rest.astype(np.float32)
        else:
            latent = _stored_latents(table, codec.latents, finite, storage)
        _check_inputs(table.schema, pose.columns)
        t_ns, contact = (whole_numbers(table, name) for name in ("t_ns", "contact"))
        arm, plan_velocity = _motion(table, pose, storage)
        finger = _finger_width(table)
        gaps = streams.unusable_rows(table)
        measured = None
        if streams.ARRIVAL in table.column_names:
            measured = np.append(np.diff(whole_numbers(table, streams.ARRIVAL)) == 0, False)
    except TacpipeError as error:
        raise TacpipeError(f"{shard.name}: {error}") from error
    del table
    columns.release()
    finite &= np.isfinite(arm).all(axis=1)
    timeline = str(shard.attributes.get("grid", "uniform"))
    labelled_object = shard.attributes.get("object")
    return Track(
        shard.name,
        storage.keep(t_ns),
        storage.keep(contact),
        storage.keep(np.cumsum(run_starts(t_ns, streams.max_step(shard.attributes)))),
        finite & np.isfinite(finger) & ~gaps,
        latent,
        arm,
        storage.keep(finger.astype(np.float32)),
        counts_above_rest,
        timeline,
        None if labelled_object is None else str(labelled_object),
        plan_velocity,
        measured if measured is not None and measured.any() else None,
        storage,
    )


def _stored_latents(table: Columns, names: Sequence[str], finite: Bools, storage: MappedArrays) -> AnyFloats:
    """Return the latents (time, latent), float32, in ``storage``; ``finite`` (time,) becomes False for other values.

    Raises the errors of `inputs`.
    """
    _check_inputs(table.schema, names)
    stored = storage.empty((table.num_rows, len(names)), np.float32)
    for rows, batch in _batches(table, names):
        values = inputs(batch, names)
        finite[rows] &= np.isfinite(values).all(axis=1)
        stored[rows] = values
        storage.read(stored[rows].nbytes)
    return stored


def _motion(table: Columns, pose: Pose, storage: MappedArrays) -> tuple[AnyFloats, AnyFloats | None]:
    """Return the arm (time, 13) and, if its velocities come from joints, those of a plan with its poses (time, 6).

    Quaternions have unit length and continuous signs; those that cannot be normalised become NaN.
    """
    angles, speeds = _joints_that_carry_hand(table, pose)
    count = table.num_rows
    arm = storage.empty((count, len(ARM)), np.float32)
    plan_velocity = storage.empty((count, len(ARM) - POSED), np.float32) if angles else None
    signs = kinematics.SignContinuation()
    before = slice(0, 0)  # range with the row before a batch
    t_ns, placed = np.zeros(0, np.int64), np.zeros((0, POSED))
    for rows, batch in _batches(table, ["t_ns", *pose.position, *pose.orientation, *angles, *speeds]):
        orientation = np.tile([0.0, 0.0, 0.0, 1.0], (batch.num_rows, 1))
        if pose.orientation:
            with np.errstate(divide="ignore", invalid="ignore"):
                stored = signs.apply(
                    np.arange(rows.start, rows.stop), inputs(batch, pose.orientation).astype(np.float64, copy=False)
                )
                orientation = make_continuous(stored)
        t_ns = np.concatenate([t_ns[before], whole_numbers(batch, "t_ns")])
        placed = np.concatenate([placed[before], np.hstack([_position(batch, pose), orientation])])
        by_poses = kinematics.difference_velocity(t_ns, placed[:, :3], placed[:, 3:])
        before = slice(-1, None)
        by_poses, batch_poses = by_poses[-batch.num_rows :], placed[-batch.num_rows :]
        velocity = by_poses
        if plan_velocity is not None:
            plan_velocity[rows] = by_poses
            velocity = kinematics.hand_velocity(
                kinematics.PANDA, inputs(batch, angles), inputs(batch, speeds), batch_poses[:, :3]
            )
        arm[rows] = np.hstack([batch_poses, velocity])
        storage.read(2 * arm[rows].nbytes)
    return arm, plan_velocity


def _position(table: pa.Table | Columns, pose: Pose) -> AnyFloats:
    """Return the arm's position (time, 3) in m, or the origin without an arm.

    Raises `TacpipeError` if a column is absent.
    """
    if not pose.position:
        return np.zeros((table.num_rows, 3))
    position = inputs(table, pose.position)
    scale = np.array([poses.metres_per_unit(table.schema.field(name)) for name in pose.position])
    return position if (scale == 1.0).all() else position * scale


def _finger_width(table: pa.Table | Columns) -> AnyFloats:
    """Return the width between the fingers (time,) in m, or 0 if no width or more than one is recorded."""
    column = opening(table.schema)
    if not column:
        return np.zeros(table.num_rows)
    scale = poses.metres_per_unit(table.schema.field(column))
    width = inputs(table, [column])[:, 0]
    return width if scale == 1.0 else width * scale


def opening(schema: pa.Schema) -> str:
    """Return the column of the width between the fingers, or an empty string if there is none or more than one."""
    columns = (FINGER,) if FINGER in schema.names else tactile.columns(schema, poses.WIDTH)
    return columns[0] if len(columns) == 1 else ""


def _joints_that_carry_hand(table: Columns, pose: Pose) -> tuple[Sequence[str], Sequence[str]]:
    """Return the columns of joint angles and speeds that move the hand, or empty tuples if the arm's model is unknown."""
    names, speeds = joints(table.schema, pose)
    if not len(names) == len(speeds) == JOINTS:
        return (), ()
    tool_m = [
        kinematics.tool_positions(kinematics.PANDA, inputs(batch, names), _position(batch, pose))
        for batch in table.batches([*pose.position, *names])
    ]
    return (names, speeds) if kinematics.is_fixed(np.concatenate([np.zeros((0, 3)), *tool_m])) else ((), ())


def joints(schema: pa.Schema, pose: Pose) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the columns of the arm's joint angles and joint speeds, or empty tuples if it has none."""
    if pose == poses.DEFAULT_POSE:
        numbers = range(1, JOINTS + 1)
        names = (
            tuple(f"robot_joint{number}_rad" for number in numbers),
            tuple(f"robot_joint{number}_velocity_rad_s" for number in numbers),
        )
        return names if set(names[0] + names[1]) <= set(schema.names) else ((), ())
    if not pose.position:
        return (), ()
    stream = field_metadata(schema.field(pose.position[0])).get("stream")

    def columns_of_arm(quantity: str) -> tuple[str, ...]:
        names = tactile.columns(schema, quantity)
        return tuple(name for name in names if field_metadata(schema.field(name)).get("stream") == stream)

    return columns_of_arm("joint_position"), columns_of_arm("joint_velocity")


def whole_numbers(table: pa.Table | Columns, name: str) -> Int64s:
    """Return an integer column (time,). Raises `TacpipeError` if it is absent."""
    if name not in table.column_names:
        raise TacpipeError(f"There is no column {name}. Run `tacpipe segment contacts` on the synchronized recordings.")
    return np.asarray(table.column(name).to_numpy(), dtype=np.int64)


def align_quaternions(arm: AnyFloats, reference: AnyFloats) -> AnyFloats:
    """Return the arm's rows (time, 13) with the common sign of quaternions that is nearest to ``reference`` (4,).

    A quaternion and its negative are the same rotation. The sign is continuous within a recording, but arbitrary
    between recordings, and a model would interpret it as a different pose.
    """
    return negate_quaternions(arm) if is_opposite(arm, reference) else arm


def is_opposite(arm: AnyFloats, reference: AnyFloats) -> bool:
    """Return whether the first finite quaternion in the arm's rows (time, 13) is nearer to minus ``reference``."""
    finite = arm[np.isfinite(arm).all(axis=1), TURNED]
    return bool(len(finite) and finite[0] @ reference < 0)


def negate_quaternions(arm: AnyFloats) -> AnyFloats:
    """Return the arm's rows (time, 13) with negated quaternions."""
    return np.hstack([arm[:, : TURNED.start], -arm[:, TURNED], arm[:, TURNED.stop :]])


def rate_hz(tracks: Sequence[Track]) -> float:
    """Return the median rate of the tracks' grids in Hz, or 0 if no track has two rows.

    A step on logged or fresh timelines is a row of any duration, so rates may differ there. Raises `TacpipeError` if
    the tracks' timelines differ, or if rates on a uniform timeline differ by more than 1 %.
    """
    if len({track.timeline for track in tracks}) > 1:
        names_by_timeline = {track.timeline: track.name for track in tracks}
        grids = ", ".join(f"{name} is {timeline}" for timeline, name in sorted(names_by_timeline.items()))
        raise TacpipeError(f"The recordings are not of one grid: {grids}. Synchronize all with one --grid.")
    rates = {track.name: 1e9 / float(np.median(np.diff(track.t_ns))) for track in tracks if len(track.t_ns) > 1}
    if not rates:
        return 0.0
    slow, fast = min(rates, key=lambda name: rates[name]), max(rates, key=lambda name: rates[name])
    if rates[fast] > 1.01 * rates[slow] and tracks[0].timeline == "uniform":
        raise TacpipeError(
            f"{slow} runs at {rates[slow]:.2f} Hz and {fast} at {rates[fast]:.2f} Hz, so a step is not the same time. "
            "Synchronize all recordings with one --rate-hz."
        )
    return round(float(np.median(list(rates.values()))), 3)
