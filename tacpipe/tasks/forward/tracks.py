"""One recording as a forecaster reads it: latents, motion of the arm and raw channels side by side, and its windows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Int64s, Times
from tacpipe.channels import arm as poses
from tacpipe.channels import streams
from tacpipe.channels.arm import Pose
from tacpipe.channels.streams import absent
from tacpipe.codecs import codec as codecs
from tacpipe.codecs import tactile
from tacpipe.codecs.codec import breaks
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import columns
from tacpipe.signals import kinematics
from tacpipe.signals.kinematics import continuous
from tacpipe.signals.runs import window_starts

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording
    from tacpipe.io.columns import Columns
    from tacpipe.io.spill import MappedArrays

BLOCK_ROWS = 1 << 14  # looked at at once
_EXACT_BITS = 16  # bits of an integer that float32 holds exactly


class Levels:
    """Levels above rest (time, channel), of which rows are computed when they are indexed, as of an array.

    An hour at 50 Hz is half as large as an array of float64. What is returned has the values of
    ``(stored.astype(float64) - rest).astype(dtype)``.
    """

    def __init__(self, stored: AnyFloats, rest_counts: AnyFloats, dtype: type[np.floating[Any]] = np.float64) -> None:
        self.stored = stored  # (time, channel), in the precision in which the recording has it
        self.rest_counts = rest_counts  # (channel,)
        self.dtype = dtype

    def __len__(self) -> int:
        return len(self.stored)

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and channels."""
        return self.stored.shape

    def __getitem__(self, at: Any) -> AnyFloats:
        """Return the levels at an index of rows, or of rows and channels."""
        rest_counts = self.rest_counts[at[1]] if isinstance(at, tuple) else self.rest_counts
        levels: AnyFloats = np.subtract(self.stored[at], rest_counts, dtype=np.float64)
        return levels.astype(self.dtype, copy=False)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> AnyFloats:
        return self[:].astype(dtype or self.dtype, copy=False)

    def of_type(self, dtype: type[np.floating[Any]]) -> Levels:
        """Return the same levels in another precision."""
        return Levels(self.stored, self.rest_counts, dtype)

    def between(self, first: int, last: int) -> Levels:
        """Return the levels of the rows from ``first`` to before ``last``."""
        return Levels(self.stored[first:last], self.rest_counts, self.dtype)

    def put_aside(self, mapped: MappedArrays) -> Levels:
        """Return the same levels, whose rows lie in ``mapped``."""
        return Levels(mapped.kept(self.stored), self.rest_counts, self.dtype)

    def finite(self) -> Bools:
        """Return for each row (time,) whether all its levels are finite."""
        finite = np.ones(len(self), dtype=bool)
        for first in range(0, len(self), BLOCK_ROWS):
            block = slice(first, first + BLOCK_ROWS)
            finite[block] = np.isfinite(self.stored[block] - self.rest_counts).all(axis=1)
        return finite


def above_rest(table: pa.Table | Columns, channels: Sequence[str]) -> Levels:
    """Return the levels of the channels above rest. Raises `TacpipeError` if one has no rest level."""
    rest_counts = tactile.rest_counts(table.schema, channels)
    narrow = all(_is_narrow(table.schema.field(name).type) for name in channels)
    stored = np.empty((table.num_rows, len(channels)), np.float32 if narrow else np.float64)
    for index, name in enumerate(channels):
        stored[:, index] = table.column(name).to_numpy()
    return Levels(stored, rest_counts)


def _is_narrow(kind: pa.DataType) -> bool:
    """Return whether float32 holds every value of a column's type."""
    import pyarrow as pa

    small = pa.types.is_integer(kind) and kind.bit_width <= _EXACT_BITS
    return bool(small or pa.types.is_float32(kind) or pa.types.is_float16(kind))


# a label, of `segment slips` or of a person; that of a stream of labels, as a published set has it; the simulator's truth
COLUMNS = ("slip", "slip_slip", "gt_slip")


def slips_of(table: pa.Table | Columns) -> Bools | None:
    """Return where the object slips (time,), by label or the simulator's truth, or None if nothing states that."""
    for name in COLUMNS:
        if name in table.column_names:
            return np.asarray(table.column(name).to_numpy()) > 0
    return None


POSE = poses.NAMED.columns
VELOCITY = tuple(f"robot_velocity_{axis}_m_s" for axis in "xyz")
TURNING = tuple(f"robot_turning_{axis}_rad_s" for axis in "xyz")
ARM = POSE + VELOCITY + TURNING
TURNED = slice(3, 7)  # columns of ``ARM`` with the quaternion
POSED = len(POSE)  # columns of ``ARM`` that are the pose; velocities follow
FINGER = "robot_finger_m"
JOINTS = 7
BY_POSES = "differences of poses"  # source of a plan's velocities, as models state it
TRUTH = "gt_"  # how the simulator's ground truth begins, which no model may see


@dataclass(frozen=True)
class Track:
    """The rows of one recording; tactile channels in counts above rest, latents in the codec's unit."""

    name: str
    t_ns: Times  # (time,)
    contact: Int64s  # (time,), below 0 where nothing is touched
    groups: Int64s  # (time,), equal where rows follow one another without a gap
    usable: Bools  # (time,)
    latent: AnyFloats | Levels  # (time, latent), float32
    arm: AnyFloats  # (time, 13): `ARM`
    finger: AnyFloats  # (time,), m, or 0 if it is not recorded
    tactile: AnyFloats | Levels  # (time, channel), float64
    timeline: str = "uniform"  # the grid: uniform, logged or fresh
    object: str | None = None  # the grasped object, where a label names it
    slips: Bools | None = None  # (time,), where it slips, if that is known; for evaluation alone
    # (time, 6), velocities that a plan of these poses has, or None if they are those of ``arm``
    plan_velocity: AnyFloats | None = None

    def starts(self, context: int, horizon: int, stride: int = 1) -> Int64s:
        """Return the first rows of all windows of ``context + horizon`` rows (window,)."""
        return window_starts(self.groups, self.usable, context, horizon, stride)

    def between(self, first: int, last: int) -> Track:
        """Return the rows from ``first`` to before ``last``."""

        def part_of(values: AnyFloats | Levels) -> AnyFloats | Levels:
            return values.between(first, last) if isinstance(values, Levels) else values[first:last]

        cut = {
            name: getattr(self, name)[first:last] for name in ("t_ns", "contact", "groups", "usable", "arm", "finger")
        }
        for name in ("slips", "plan_velocity"):
            if getattr(self, name) is not None:
                cut[name] = getattr(self, name)[first:last]
        return replace(self, latent=part_of(self.latent), tactile=part_of(self.tactile), **cut)

    def put_aside(self, mapped: MappedArrays) -> Track:
        """Return the same track, whose rows lie in ``mapped``."""
        tactile = self.tactile.put_aside(mapped) if isinstance(self.tactile, Levels) else mapped.kept(self.tactile)
        latent: AnyFloats | Levels
        if not isinstance(self.latent, Levels):
            latent = mapped.kept(self.latent)
        elif isinstance(self.tactile, Levels) and self.latent.stored is self.tactile.stored:
            assert isinstance(tactile, Levels)
            latent = tactile.of_type(self.latent.dtype)
        else:
            latent = self.latent.put_aside(mapped)
        names = ("t_ns", "contact", "groups", "usable", "arm", "finger", "plan_velocity")
        arrays: dict[str, Any] = {
            name: mapped.kept(getattr(self, name)) for name in names if getattr(self, name) is not None
        }
        return replace(self, tactile=tactile, latent=latent, **arrays)

    def planned(self, rows: Int64s) -> AnyFloats:
        """Return the arm as a plan of its poses has it at ``rows`` (…), (…, 13): velocities are `plan_velocity`."""
        arm = self.arm[rows]
        if self.plan_velocity is not None:
            arm[..., POSED:] = self.plan_velocity[rows]
        return arm

    def contact_starts(self, context: int, horizon: int, stride: int) -> Int64s:
        """Return the first rows of the windows that lie within one contact (window,)."""
        same = np.concatenate([[0], np.cumsum(np.diff(self.contact) != 0)])[: len(self.contact)]
        groups = self.groups * (int(same.max(initial=0)) + 1) + same
        return window_starts(groups, self.usable & (self.contact >= 0), context, horizon, stride)


def no_window(beginning: str, recordings: Dataset, context: int, horizon: int) -> TacpipeError:
    """Return the error for recordings without a window; where gaps may be the cause, it names them.

    ``beginning`` are its first words, such as ``The training recordings hold``.
    """
    gaps = streams.describe_gaps(*(recording.columns() for recording in recordings.recordings.values()))
    advice = gaps or ["Give more or longer recordings, or shorten context and horizon."]
    return TacpipeError(f"{beginning} no window of {context} and {horizon} rows without a gap. {' '.join(advice)}")


def codec_of(table: pa.Table, files: Mapping[str, bytes], name: str = "") -> codecs.Codec:
    """Return the codec among a dataset's files, or the one that leaves channels as they are where there is none.

    ``name`` is that of the recording whose ``table`` it is. Raises `TacpipeError` if table and files do not belong
    together.
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
        raise absent(name, "tactile", table.schema)
    return codecs.Raw(channels, tuple(tactile.layout(table.schema, channels)))


def inputs(table: pa.Table | Columns, names: Sequence[str]) -> AnyFloats:
    """Return the named columns as float64, shape (time, column).

    Raises `TacpipeError` for a column that is absent, and for the simulator's ground truth.
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


def pose_of(shard: Recording, actions: str, arm: str = "") -> Pose:
    """Return the columns of the arm whose motion a model reads; of no arm where it needs none and there is none.

    ``actions`` and ``arm`` are the params of these names. Raises `TacpipeError`, naming the recording, where there is
    no arm to plan with, and what `tacpipe.channels.arm.pose` raises.
    """
    schema = shard.columns().schema
    try:
        pose = poses.pose(schema, arm, needed=actions != "none")
    except UsageError as error:
        raise UsageError(f"{shard.name}: {error}") from error
    except TacpipeError as error:
        raise TacpipeError(f"{shard.name}: {error}") from error
    if not pose.position and actions != "none":
        raise poses.no_arm(shard.name, schema)
    return pose


def track(shard: Recording, codec: codecs.Codec, pose: Pose = poses.NAMED) -> Track:
    """Return the track of a recording; its latents are those stored, or its channels where ``codec`` is raw.

    ``pose`` names the columns of its arm; without them it rests where it is, and without a quaternion it never turns.
    Rows in a gap of any stream or with a value that is not finite are unusable. Raises `TacpipeError` naming the
    recording where a column is absent or its channels are not the codec's.
    """
    table = shard.columns()
    try:
        codecs.check_channels(codec.channels, tactile.columns(table.schema, "tactile"))
        counts_above_rest = above_rest(table, codec.channels)
        finite = counts_above_rest.finite()
        if codec.kind == "raw":
            latent: AnyFloats | Levels = counts_above_rest.of_type(np.float32)
        else:
            read = inputs(table, codec.latents)
            finite &= np.isfinite(read).all(axis=1)
            latent = read.astype(np.float32)
        placed = np.hstack([_position(table, pose), _orientation(table, pose)])
        t_ns, contact = (whole_numbers(table, name) for name in ("t_ns", "contact"))
        finger = _opening(table)
        gaps, slips = tactile.gaps(table), slips_of(table)
    except TacpipeError as error:
        raise TacpipeError(f"{shard.name}: {error}") from error
    by_joints = _velocity_of_joints(table, pose, placed)
    by_poses = kinematics.differences(t_ns, placed[:, :3], placed[:, 3:])
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
        np.cumsum(breaks(t_ns, streams.apart(shard.attributes))),
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
    """Return where the arm is (time, 3), m; the origin without an arm."""
    if not pose.position:
        return np.zeros((table.num_rows, 3))
    position = inputs(table, pose.position)
    scale = np.array([poses.metres(table.schema.field(name)) for name in pose.position])
    return position if (scale == 1.0).all() else position * scale


def _orientation(table: pa.Table | Columns, pose: Pose) -> AnyFloats:
    """Return unit quaternions (time, 4) of continuous sign; those that cannot be normalised become NaN.

    Without a quaternion the arm is not turned.
    """
    if not pose.orientation:
        return np.tile([0.0, 0.0, 0.0, 1.0], (table.num_rows, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        return continuous(inputs(table, pose.orientation).astype(np.float64))


def _opening(table: pa.Table | Columns) -> AnyFloats:
    """Return the width between the fingers (time,), m, or 0 if none is recorded, or several."""
    column = opening(table.schema)
    if not column:
        return np.zeros(table.num_rows)
    scale = poses.metres(table.schema.field(column))
    width = inputs(table, [column])[:, 0]
    return width if scale == 1.0 else width * scale


def opening(schema: pa.Schema) -> str:
    """Return the column of the width between the fingers; the empty text where there is none, or several."""
    columns = (FINGER,) if FINGER in schema.names else tactile.columns(schema, poses.WIDTH)
    return columns[0] if len(columns) == 1 else ""


def _velocity_of_joints(table: pa.Table | Columns, pose: Pose, placed: AnyFloats) -> AnyFloats | None:
    """Return the hand's linear and angular velocity (time, 6) from its joints, or None if they are not a known arm's."""
    names, speeds = joints(table.schema, pose)
    if len(names) == len(speeds) == JOINTS:
        angles = inputs(table, names)
        if kinematics.carries(kinematics.PANDA, angles, placed[:, :3]):
            return kinematics.hand_velocity(kinematics.PANDA, angles, inputs(table, speeds), placed[:, :3])
    return None


def joints(schema: pa.Schema, pose: Pose) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the columns of the angles and speeds of the arm's joints, or empty if it has none."""
    if pose == poses.NAMED:
        numbers = range(1, JOINTS + 1)
        names = tuple(f"robot_joint{n}_rad" for n in numbers), tuple(f"robot_joint{n}_velocity_rad_s" for n in numbers)
        return names if set(names[0] + names[1]) <= set(schema.names) else ((), ())
    if not pose.position:
        return (), ()
    stream = tactile.metadata(schema.field(pose.position[0])).get("stream")
    angles, speeds = (
        tuple(
            name
            for name in tactile.columns(schema, quantity)
            if tactile.metadata(schema.field(name)).get("stream") == stream
        )
        for quantity in ("joint_position", "joint_velocity")
    )
    return angles, speeds


def whole_numbers(table: pa.Table | Columns, name: str) -> Int64s:
    """Return an integer column, shape (time,). Raises `TacpipeError` if it is absent."""
    if name not in table.column_names:
        raise TacpipeError(f"There is no column {name}. Run `tacpipe segment contacts` on the synchronized recordings.")
    return np.asarray(table.column(name).to_numpy(), dtype=np.int64)


def aligned(arm: AnyFloats, reference: AnyFloats) -> AnyFloats:
    """Return the arm's rows (time, 13) with the quaternions' common sign nearest to that of ``reference`` (4,).

    A quaternion and its negative are the same rotation. Within a recording the sign is continuous already; between
    recordings it is a matter of chance, and a model would take it for another pose.
    """
    return negated(arm) if is_opposite(arm, reference) else arm


def is_opposite(arm: AnyFloats, reference: AnyFloats) -> bool:
    """Return whether the first finite one of the arm's rows (time, 13) has a quaternion nearer to minus ``reference``."""
    finite = arm[np.isfinite(arm).all(axis=1), TURNED]
    return bool(len(finite) and finite[0] @ reference < 0)


def negated(arm: AnyFloats) -> AnyFloats:
    """Return the arm's rows (time, 13) with the quaternions' other sign."""
    return np.hstack([arm[:, : TURNED.start], -arm[:, TURNED], arm[:, TURNED.stop :]])


def rate_hz(tracks: Sequence[Track]) -> float:
    """Return the median rate of the tracks' grids in Hz, or 0 if none has two rows.

    On rows as logged or fresh a step is a row, however long it takes; so rates may differ there. Else raises
    `TacpipeError` if they do by more than 1 %, and where the tracks are not of one timeline.
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
