"""Find the inputs of a forecaster in the streams of a rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import Floats, Indices
from tacpipe.channels import arm as poses
from tacpipe.channels.schema import field_metadata
from tacpipe.channels.streams import EVENTS, count_axes
from tacpipe.codecs import tactile
from tacpipe.errors import TacpipeError
from tacpipe.printable import listed
from tacpipe.signals.contact import rest_level, tare_level
from tacpipe.synchronization import streams
from tacpipe.synchronization.streams import may_be_signal
from tacpipe.tasks.forward import headline, tracks
from tacpipe.tasks.forward.forecaster import Forecaster

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True)
class InputLayout:
    """Where the inputs of a forecaster are in the samples of a rig's streams."""

    master: str
    columns: Mapping[str, list[str]]  # stream -> columns that are read; others may be added after them
    schemas: Mapping[str, pa.Schema]
    widths: Mapping[str, int]  # stream -> number of columns of the inputs, which follow one another in a row
    tactile: Indices  # (channel,), places in a row, as all that follow; empty for what is not recorded
    position: Indices
    orientation: Indices
    angles: Indices
    speeds: Indices
    finger: Indices
    rest_parts: Sequence[tuple[Indices, int, np.dtype[Any]]]  # channels of a stream, axes of its taxels, type of levels
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
        channels, pose = forecaster.codec.channels, forecaster.pose
        angles, speeds = tracks.joints(grid, pose)
        if not len(angles) == len(speeds) == tracks.JOINTS:
            angles, speeds = (), ()
        opening = tracks.opening(grid)
        inputs = (channels, pose.position, pose.orientation, angles, speeds, (opening,) if opening else ())
        columns: dict[str, list[str]] = {leader: []}
        for stream, column in (origin[name] for names in inputs for name in names):
            if column not in columns.setdefault(stream, []):
                columns[stream].append(column)
        widths = {stream: len(names) for stream, names in columns.items()}
        starts = dict(zip(widths, np.cumsum([0, *widths.values()]), strict=False))
        tactile_places, position, orientation, angle_places, speed_places, finger = (
            np.array(
                [starts[origin[name][0]] + columns[origin[name][0]].index(origin[name][1]) for name in names], np.intp
            )
            for names in inputs
        )
        rest_parts = []
        for stream in dict.fromkeys(origin[name][0] for name in channels):
            own = np.array([index for index, name in enumerate(channels) if origin[name][0] == stream], np.intp)
            names = [channels[index] for index in own]
            kind = np.result_type(*(grid.field(name).type.to_pandas_dtype() for name in names))
            rest_parts.append((own, count_axes(grid, names), kind if kind.kind == "f" else np.dtype(np.float64)))
        return cls(
            leader,
            columns,
            signals,
            widths,
            tactile_places,
            position,
            orientation,
            angle_places,
            speed_places,
            finger,
            rest_parts,
            np.array([poses.metres_per_unit(grid.field(name)) for name in pose.position]),
            poses.metres_per_unit(grid.field(opening)) if opening else 1.0,
        )

    def row(self, values: Mapping[str, Floats]) -> Floats:
        """Return the columns of all inputs of a row, given as ``values`` (column,) by stream."""
        return np.concatenate([values[stream][:width] for stream, width in self.widths.items()])

    def levels(self, rest_levels: Sequence[float]) -> dict[str, Floats]:
        """Return levels of channels (channel,) by stream as columns (column,), NaN for other columns."""
        row = np.full(sum(self.widths.values()), np.nan)
        row[self.tactile] = rest_levels
        parts = np.split(row, np.cumsum([*self.widths.values()])[:-1])
        return {
            stream: np.pad(part, (0, len(names) - len(part)), constant_values=np.nan)
            for part, (stream, names) in zip(parts, self.columns.items(), strict=True)
        }

    def arm_state(self, row: Floats) -> tuple[Floats, Floats, Floats | None, Floats | None]:
        """Return position (3,) in m, quaternion (4,), and joint angles and speeds (7,) or None, of a `row`."""
        position = row[self.position] * self.position_m if len(self.position) else np.zeros(3)
        quaternion = row[self.orientation] if len(self.orientation) else np.array([0.0, 0.0, 0.0, 1.0])
        has_joints = len(self.angles) > 0
        return position, quaternion, row[self.angles] if has_joints else None, row[self.speeds] if has_joints else None

    def finger_m(self, row: Floats) -> float:
        """Return the width between the fingers in m of a `row`, or 0 if it is not recorded."""
        return float(np.float32(row[self.finger[0]] * self.finger_scale_m)) if len(self.finger) else 0.0

    def rest_levels(self, contacts: Any, rows: Sequence[Floats]) -> Floats:
        """Return each channel's rest level (channel,) from rows at rest, by the params of `segment contacts`."""
        stacked = np.stack(rows)  # (row, channel)
        levels = np.empty(stacked.shape[1])
        t_ns = np.zeros(len(rows), np.int64)  # equal timestamps, so that the rest level uses all rows
        for channels, axes, kind in self.rest_parts:
            values = stacked[:, channels].astype(kind)
            levels[channels] = tare_level(contacts.tare, values, rest_level(values, t_ns, 0.0), axes)
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
