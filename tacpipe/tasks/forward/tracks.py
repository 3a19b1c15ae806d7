"""Read a recording for a forecaster: latents, arm motion and raw channels by row, and the windows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Int64s, Times
from tacpipe.channels import arm as poses
from tacpipe.channels import streams
from tacpipe.channels.arm import Pose
from tacpipe.channels.schema import field_metadata
from tacpipe.channels.streams import missing_channel_error
from tacpipe.codecs import codec as codecs
from tacpipe.codecs import tactile
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import columns
from tacpipe.signals import kinematics
from tacpipe.signals.kinematics import make_continuous
from tacpipe.signals.runs import run_starts, window_starts

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording
    from tacpipe.io.columns import Columns
    from tacpipe.io.spill import MappedArrays

BLOCK_ROWS = 1 << 14  # rows per block
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

    def put_aside(self, mapped: MappedArrays) -> Levels:
        """Return the same levels with their rows stored in ``mapped``."""
        return Levels(mapped.keep(self.stored), self.rest_counts, self.dtype)

    def finite(self) -> Bools:
        """Return which rows (time,) contain only finite levels."""
        finite = np.ones(len(self), dtype=bool)
        for first in range(0, len(self), BLOCK_ROWS):
            block = slice(first, first + BLOCK_ROWS)
            finite[block] = np.isfinite(self.stored[block] - self.rest_counts).all(axis=1)
        return finite


def above_rest(table: pa.Table | Columns, channels: Sequence[str]) -> Levels:
    """Return the channels' levels above rest. Raises `TacpipeError` if a channel has no rest level."""
    rest_counts = tactile.rest_counts(table.schema, channels)
    narrow = all(_fits_float32(table.schema.field(name).type) for name in channels)
    stored = np.empty((table.num_rows, len(channels)), np.float32 if narrow else np.float64)
    for index, name in enumerate(channels):
        stored[:, index] = table.column(name).to_numpy()
    return Levels(stored, rest_counts)


def _fits_float32(kind: pa.DataType) -> bool:
    """Return whether float32 represents every value of a column's type."""
    import pyarrow as pa

    small = pa.types.is_integer(kind) and kind.bit_width <= _EXACT_BITS
    return bool(small or pa.types.is_float32(kind) or pa.types.is_float16(kind))


# label from `segment slips` or a person; label stream of a published dataset; ground truth of the simulator
COLUMNS = ("slip", "slip_slip", "gt_slip")


def slips_of(table: pa.Table | Columns) -> Bools | None:
    """Return when the object slips (time,), from a label or the simulator's ground truth; None if there is neither."""
    for name in COLUMNS:
        if name in table.column_names:
            return np.asarray(table.column(name).to_numpy()) > 0
    return None


POSE = poses.DEFAULT_POSE.columns
VELOCITY = tuple(f"robot_velocity_{axis}_m_s" for axis in "xyz")
TURNING = tuple(f"robot_turning_{axis}_rad_s" for axis in "xyz")
ARM = POSE + VELOCITY + TURNING
TURNED = slice(3, 7)  # quaternion columns of ``ARM``
POSED = len(POSE)  # number of pose columns of ``ARM``, which velocities follow
FINGER = "robot_finger_m"
JOINTS = 7
BY_POSES = "differences of poses"  # source of a plan's velocities, as written in models
TRUTH = "gt_"  # prefix of the simulator's ground truth, which no model may read


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
    slips: Bools | None = None  # (time,), rows in which the object slips, if known; only for evaluation
    # (time, 6), velocities of a plan with these poses; None: the velocities in ``arm``
    plan_velocity: AnyFloats | None = None

    def starts(self, context: int, horizon: int, stride: int = 1) -> Int64s:
        """Return the first row of each window of ``context + horizon`` rows (window,)."""
        return window_starts(self.groups, self.usable, context, horizon, stride)

    def rows_between(self, first: int, last: int) -> Track:
        """Return the rows from ``first`` to ``last``, exclusive."""

        def part_of(values: AnyFloats | Levels) -> AnyFloats | Levels:
            return values.rows_between(first, last) if isinstance(values, Levels) else values[first:last]

        selected = {
            name: getattr(self, name)[first:last] for name in ("t_ns", "contact", "groups", "usable", "arm", "finger")
        }
        for name in ("slips", "plan_velocity"):
            if getattr(self, name) is not None:
                selected[name] = getattr(self, name)[first:last]
        return replace(self, latent=part_of(self.latent), tactile=part_of(self.tactile), **selected)

    def put_aside(self, mapped: MappedArrays) -> Track:
        """Return the same track with its rows stored in ``mapped``."""
        tactile = self.tactile.put_aside(mapped) if isinstance(self.tactile, Levels) else mapped.keep(self.tactile)
        latent: AnyFloats | Levels
        if not isinstance(self.latent, Levels):
            latent = mapped.keep(self.latent)
        elif isinstance(self.tactile, Levels) and self.latent.stored is self.tactile.stored:
            assert isinstance(tactile, Levels)
            latent = tactile.astype(self.latent.dtype)
        else:
            latent = self.latent.put_aside(mapped)
        names = ("t_ns", "contact", "groups", "usable", "arm", "finger", "plan_velocity")
        arrays: dict[str, Any] = {
            name: mapped.keep(getattr(self, name)) for name in names if getattr(self, name) is not None
        }
        return replace(self, tactile=tactile, latent=latent, **arrays)

    def planned_arm(self, rows: Int64s) -> AnyFloats:
        """Return the arm at ``rows`` (…) as a plan contains it, (…, 13), with velocities from `plan_velocity`."""
        arm = self.arm[rows]
        if self.plan_velocity is not None:
            arm[..., POSED:] = self.plan_velocity[rows]
        return arm

    def contact_starts(self, context: int, horizon: int, stride: int) -> Int64s:
        """Return the first row of each window within a single contact (window,)."""
        same = np.concatenate([[0], np.cumsum(np.diff(self.contact) != 0)])[: len(self.contact)]
        groups = self.groups * (int(same.max(initial=0)) + 1) + same
        return window_starts(groups, self.usable & (self.contact >= 0), context, horizon, stride)


def no_window(beginning: str, recordings: Dataset, context: int, horizon: int) -> TacpipeError:
    """Return the error for recordings without a window, with gaps that may be the cause.

    ``beginning`` is the start of the message, such as ``The training recordings contain``.
    """
    gaps = streams.describe_gaps(*(recording.columns() for recording in recordings.recordings.values()))
    advice = gaps or ["Give more or longer recordings, or shorten context and horizon."]
    return TacpipeError(f"{beginning} no window of {context} and {horizon} rows without a gap. {' '.join(advice)}")


def codec_of(table: pa.Table, files: Mapping[str, bytes], name: str = "") -> codecs.Codec:
    """Return the codec in a dataset's files, or the identity codec if there is none.

    ``name`` is the name of the recording with this ``table``. Raises `TacpipeError` if table and files do not match.
    """
    latents = tactile.columns(table.schema, "latent")
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
    channels = tactile.columns(table.schema, "tactile")
    if not channels:
        raise missing_channel_error(name, "tactile", table.schema)
    return codecs.Raw(channels, tuple(tactile.layout(table.schema, channels)))


def inputs(table: pa.Table | Columns, names: Sequence[str]) -> AnyFloats:
    """Return the named columns as float64, shape (time, column).

    Raises `TacpipeError` if a column is absent or belongs to the simulator's ground truth.
    """
    for name in names:
        if name.startswith(TRUTH):
            raise TacpipeError(f"{name} is the simulator's ground truth; a model that reads it has learned nothing.")
        if name not in table.column_names:
            raise TacpipeError(
                f"There is no column {name}. Give recordings of the same streams and columns as the model's, that went "
                "through `tacpipe synchronize` and `tacpipe segment contacts`, and for a model of latents through "
                "`tacpipe compress`."
            )
    return tactile.matrix(table, names)


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


def track(shard: Recording, codec: codecs.Codec, pose: Pose = poses.DEFAULT_POSE) -> Track:
    """Return a recording's track, with its stored latents, or its channels if ``codec`` is raw.

    ``pose`` contains the names of the arm's columns. Without a position the arm does not move, and without a quaternion
    it does not turn. Rows with a value that is not finite or in a gap of any stream are unusable. Raises `TacpipeError`
    with the recording's name if a column is absent or its channels are not the codec's.
    """
    table = shard.columns()
    try:
        codecs.check_channels(codec.channels, tactile.columns(table.schema, "tactile"))
        counts_above_rest = above_rest(table, codec.channels)
        finite = counts_above_rest.finite()
        if codec.kind == "raw":
            latent: AnyFloats | Levels = counts_above_rest.astype(np.float32)
        else:
            read = inputs(table, codec.latents)
            finite &= np.isfinite(read).all(axis=1)
            latent = read.astype(np.float32)
        placed = np.hstack([_position(table, pose), _orientation(table, pose)])
        t_ns, contact = (whole_numbers(table, name) for name in ("t_ns", "contact"))
        finger = _finger_width(table)
        gaps, slips = tactile.gap_mask(table), slips_of(table)
    except TacpipeError as error:
        raise TacpipeError(f"{shard.name}: {error}") from error
    by_joints = _velocity_of_joints(table, pose, placed)
    by_poses = kinematics.difference_velocity(t_ns, placed[:, :3], placed[:, 3:])
    arm = np.hstack([placed, by_poses if by_joints is None else by_joints]).astype(np.float32)
    plan_velocity = None if by_joints is None else by_poses.astype(np.float32)
    del table, by_joints, by_poses
    columns.release()
    finite &= np.isfinite(arm).all(axis=1)
    timeline = str(shard.attributes.get("grid", "uniform"))
    labelled_object = shard.attributes.get("object")
    return Track(
        shard.name,
        t_ns,
        contact,
        np.cumsum(run_starts(t_ns, streams.max_step(shard.attributes))),
        finite & np.isfinite(finger) & ~gaps,
        latent,
        arm,
        finger.astype(np.float32),
        counts_above_rest,
        timeline,
        None if labelled_object is None else str(labelled_object),
        slips,
        plan_velocity,
    )


def _position(table: pa.Table | Columns, pose: Pose) -> AnyFloats:
    """Return the arm's position (time, 3) in m, or the origin without an arm."""
    if not pose.position:
        return np.zeros((table.num_rows, 3))
    position = inputs(table, pose.position)
    scale = np.array([poses.metres_per_unit(table.schema.field(name)) for name in pose.position])
    return position if (scale == 1.0).all() else position * scale


def _orientation(table: pa.Table | Columns, pose: Pose) -> AnyFloats:
    """Return unit quaternions (time, 4) with continuous signs; those that cannot be normalised become NaN.

    Without a quaternion column, returns the identity.
    """
    if not pose.orientation:
        return np.tile([0.0, 0.0, 0.0, 1.0], (table.num_rows, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        return make_continuous(inputs(table, pose.orientation).astype(np.float64))


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


def _velocity_of_joints(table: pa.Table | Columns, pose: Pose, placed: AnyFloats) -> AnyFloats | None:
    """Return the hand's linear and angular velocity (time, 6) from its joints, or None if the arm's model is unknown."""
    names, speeds = joints(table.schema, pose)
    if len(names) == len(speeds) == JOINTS:
        angles = inputs(table, names)
        if kinematics.carries_hand(kinematics.PANDA, angles, placed[:, :3]):
            return kinematics.hand_velocity(kinematics.PANDA, angles, inputs(table, speeds), placed[:, :3])
    return None


def joints(schema: pa.Schema, pose: Pose) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the columns of the arm's joint angles and joint speeds, or empty tuples if it has none."""
    if pose == poses.DEFAULT_POSE:
        numbers = range(1, JOINTS + 1)
        names = tuple(f"robot_joint{n}_rad" for n in numbers), tuple(f"robot_joint{n}_velocity_rad_s" for n in numbers)
        return names if set(names[0] + names[1]) <= set(schema.names) else ((), ())
    if not pose.position:
        return (), ()
    stream = field_metadata(schema.field(pose.position[0])).get("stream")
    angles, speeds = (
        tuple(
            name
            for name in tactile.columns(schema, quantity)
            if field_metadata(schema.field(name)).get("stream") == stream
        )
        for quantity in ("joint_position", "joint_velocity")
    )
    return angles, speeds


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
