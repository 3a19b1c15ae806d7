"""Find the inputs of a forecaster in the streams of a rig, and create streams of planned motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyFloats, Floats, Indices, Times
from tacpipe.channels import arm as poses
from tacpipe.channels.schema import field_metadata, time_field
from tacpipe.channels.streams import EVENTS, count_axes
from tacpipe.codecs import tactile
from tacpipe.errors import TacpipeError
from tacpipe.printable import listed
from tacpipe.sensors import plan
from tacpipe.signals.contact import rest_level, tare_level
from tacpipe.synchronization import streams
from tacpipe.synchronization.streams import may_be_signal
from tacpipe.tasks.forward import headline, tracks
from tacpipe.tasks.forward.forecaster import Forecaster

if TYPE_CHECKING:
    import pyarrow as pa

Place = tuple[str, Indices]  # a stream, and columns of its samples


def plan_schema() -> pa.Schema:
    """Return the schema of the stream of plans: arrival, time at which the hand is to be at the pose, and the pose.

    Rows with the same arrival are one plan.
    """
    import pyarrow as pa

    return pa.schema([time_field(), *plan.Plan().fields()])


def plan_table(arrived_ns: int, t_ns: Times, poses: AnyFloats) -> pa.Table:
    """Return a plan as rows of `plan_schema`, from ``poses`` (point, 3 or 7) at ascending times ``t_ns`` (point,).

    Without quaternions the orientation is NaN: the hand keeps its orientation. Raises `TacpipeError` for other shapes,
    a position that is not finite, or times that are not ascending.
    """
    import pyarrow as pa

    t_ns, poses = np.asarray(t_ns, np.int64), np.asarray(poses, np.float64)
    if poses.ndim != 2 or poses.shape[1] not in (3, 7) or len(poses) != len(t_ns) or not len(t_ns):
        raise TacpipeError(
            f"A plan has {len(t_ns)} times and poses of shape {poses.shape}; it needs one pose a time, one at least, of 3 "
            f"numbers (position in m) or of 7 (and a quaternion x, y, z, w)."
        )
    if (np.diff(t_ns) <= 0).any() or not np.isfinite(poses).all():
        raise TacpipeError("The times of a plan must ascend, and all its numbers be finite.")
    rows = np.full((len(poses), plan.NUMBERS), np.nan)
    rows[:, : poses.shape[1]] = poses
    arrays = [pa.array(np.full(len(t_ns), arrived_ns, np.int64)), pa.array(t_ns), *map(pa.array, rows.T)]
    return pa.Table.from_arrays(arrays, schema=plan_schema())


@dataclass(frozen=True)
class InputLayout:
    """Where the inputs of a forecaster are in the samples of a rig's streams."""

    master: str
    columns: Mapping[str, list[str]]  # stream -> columns that are read
    schemas: Mapping[str, pa.Schema]
    tactile_of: Mapping[str, tuple[Indices, Indices]]  # stream -> its columns and their channels
    axes: Mapping[str, int]  # stream -> axes of its taxels
    kinds: Mapping[str, np.dtype[Any]]  # stream -> type in which rest levels are computed
    position: Place | None
    orientation: Place | None
    joints: tuple[Place, Place] | None  # angles and speeds
    finger: Place | None
    position_m: Floats  # (3,), size of each coordinate's unit in metres
    finger_scale_m: float

    @classmethod
    def for_forecaster(
        cls, forecaster: Forecaster, synchronize: Any, layouts: Mapping[str, pa.Schema], master: str = ""
    ) -> InputLayout:
        """Return the layout of the model's inputs in streams with the schemas ``layouts``.

        ``synchronize`` are the params of the stage in the model's chain. Raises `TacpipeError` if a stream or a channel is
        missing or differs from the model's.
        """
        import pyarrow as pa

        signals = {name: layouts[name] for name in sorted(layouts) if name != EVENTS and may_be_signal(layouts[name])}
        origin: dict[str, tuple[str, str]] = {}  # stream and column of each grid column
        for stream, schema in signals.items():
            for name in streams.channel_names(schema):
                origin[streams.grid_name(stream, name)] = (stream, name)
        grid = pa.schema(
            [
                streams.grid_field(stream, signals[stream].field(name), "hold").with_name(grid_column)
                for grid_column, (stream, name) in origin.items()
            ]
        )
        _check(forecaster, signals, grid)
        leader = streams.master("of this rig", synchronize.master or master, signals)
        columns: dict[str, list[str]] = {leader: []}

        def place_columns(names: Sequence[str]) -> Place | None:
            """Add columns of one stream to ``columns``; return the stream and their indices, or None without names."""
            if not names:
                return None
            stream = origin[names[0]][0]
            stream_columns = columns.setdefault(stream, [])
            for grid_column in names:
                if origin[grid_column][1] not in stream_columns:
                    stream_columns.append(origin[grid_column][1])
            return stream, np.array([stream_columns.index(origin[grid_column][1]) for grid_column in names], np.intp)

        by_stream: dict[str, list[int]] = {}
        for index, name in enumerate(forecaster.codec.channels):
            by_stream.setdefault(origin[name][0], []).append(index)
        tactile_of: dict[str, tuple[Indices, Indices]] = {}
        axes: dict[str, int] = {}
        kinds: dict[str, np.dtype[Any]] = {}
        for stream, indices in by_stream.items():
            names = [forecaster.codec.channels[index] for index in indices]
            place = place_columns(names)
            assert place is not None
            tactile_of[stream] = (place[1], np.array(indices, np.intp))
            axes[stream] = count_axes(grid, names)
            kind = np.result_type(*(grid.field(name).type.to_pandas_dtype() for name in names))
            kinds[stream] = kind if kind.kind == "f" else np.dtype(np.float64)
        pose = forecaster.pose
        position, orientation = place_columns(pose.position), place_columns(pose.orientation)
        angles, speeds = tracks.joints(grid, pose)
        has_joints = len(angles) == len(speeds) == tracks.JOINTS
        opening = tracks.opening(grid)
        joints = (place_columns(angles), place_columns(speeds)) if has_joints else (None, None)
        finger = place_columns([opening] if opening else [])
        return cls(
            leader,
            columns,
            signals,
            tactile_of,
            axes,
            kinds,
            position,
            orientation,
            None if joints[0] is None or joints[1] is None else (joints[0], joints[1]),
            finger,
            np.array([poses.metres_per_unit(grid.field(name)) for name in pose.position]),
            poses.metres_per_unit(grid.field(opening)) if opening else 1.0,
        )

    def tactile(self, values: Mapping[str, Floats]) -> Floats:
        """Return the tactile channels (channel,) of a row, given as ``values`` (column,) by stream."""
        row = np.empty(sum(len(channels) for _, channels in self.tactile_of.values()))
        for stream, (columns, channels) in self.tactile_of.items():
            row[channels] = values[stream][columns]
        return row

    def levels(self, rest_levels: Sequence[float]) -> dict[str, Floats]:
        """Return levels of channels (channel,) by stream as columns (column,), NaN for other columns."""
        by_stream = {name: np.full(len(names), np.nan) for name, names in self.columns.items()}
        for stream, (columns, channels) in self.tactile_of.items():
            by_stream[stream][columns] = np.asarray(rest_levels)[channels]
        return by_stream

    def arm_state(self, values: Mapping[str, Floats]) -> tuple[Floats, Floats, Floats | None, Floats | None]:
        """Return position (3,) in m, quaternion (4,), and joint angles and speeds (7,) or None, from rows by stream."""
        position, quaternion = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
        if self.position is not None:
            stream, columns = self.position
            position = values[stream][columns] * self.position_m
        if self.orientation is not None:
            stream, columns = self.orientation
            quaternion = values[stream][columns]
        if self.joints is None:
            return position, quaternion, None, None
        angles, speeds = (values[stream][columns] for stream, columns in self.joints)
        return position, quaternion, angles, speeds

    def finger_m(self, values: Mapping[str, Floats]) -> float:
        """Return the width between the fingers in m of a row, or 0 if it is not recorded."""
        if self.finger is None:
            return 0.0
        stream, columns = self.finger
        return float(np.float32(values[stream][columns[0]] * self.finger_scale_m))

    def rest_levels(self, contacts: Any, rows: Sequence[Floats]) -> Floats:
        """Return each channel's rest level (channel,) from rows at rest, by the params of `segment contacts`."""
        stacked = np.stack(rows)  # (row, channel)
        levels = np.empty(stacked.shape[1])
        t_ns = np.zeros(len(rows), np.int64)  # equal timestamps, so that the rest level uses all rows
        for stream, (_, channels) in self.tactile_of.items():
            values = stacked[:, channels].astype(self.kinds[stream])
            levels[channels] = tare_level(contacts.tare, values, rest_level(values, t_ns, 0.0), self.axes[stream])
        return levels


def _check(forecaster: Forecaster, signals: Mapping[str, pa.Schema], grid: pa.Schema) -> None:
    """Raise `TacpipeError` if the streams differ from those of the model's recordings."""
    codec, pose = forecaster.codec, forecaster.pose
    for name in (*codec.channels, *pose.columns):
        if name not in grid.names:
            stream = next((stream_name for stream_name in signals if name.startswith(f"{stream_name}_")), None)
            reason = f"its stream {stream} has no such channel" if stream else f"it records {listed(signals)}"
            raise TacpipeError(f"The model reads {name}, and this rig does not record it: {reason}.")
    owners = {field_metadata(grid.field(name)).get("stream", "") for name in codec.channels}
    tactile_columns = [
        name
        for name in tactile.columns(grid, "tactile")
        if field_metadata(grid.field(name)).get("stream", "") in owners
    ]
    if sorted(tactile_columns) != sorted(codec.channels):
        extra = next((name for name in tactile_columns if name not in codec.channels), None)
        differs = f"{extra} is one that it was not trained on" if extra else "some are not declared tactile"
        raise TacpipeError(
            f"The tactile channels of this rig are {len(tactile_columns)} and those of the model {len(codec.channels)}: "
            f"{differs}. "
            f"Take the rig that the model was trained on, or train one on recordings of this rig."
        )
    for name, trained_place, has in zip(
        codec.channels, codec.layout, tactile.layout(grid, codec.channels), strict=True
    ):
        if dict(trained_place) != has:
            raise TacpipeError(
                f"Channel {name} of this rig is at {has}, and of the model's recordings at {dict(trained_place)}."
            )
    unit = headline.unit_of_channels(grid, codec.channels)
    trained = str(forecaster.config["inputs"].get("unit", headline.COUNT))
    if unit != trained:
        raise TacpipeError(f"The tactile channels of this rig are in {unit}, and those of the model in {trained}.")
