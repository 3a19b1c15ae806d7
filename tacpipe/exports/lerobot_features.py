"""Features of a LeRobot frame: which columns of a synchronized table are state, action and tactile observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.exports.contents import TIME

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import AnyArray
    from tacpipe.exports.lerobot import Params

ORIGINALS = "tacpipe"
ACTION = "action"


@dataclass(frozen=True)
class Feature:
    """One feature of a frame: its values (time,) or (time, channel), and the channels' names, units and quantities."""

    name: str
    values: AnyArray
    names: Sequence[str]
    columns: Sequence[str]  # of the synchronized table
    units: Sequence[str] = ()
    quantities: Sequence[str] = ()

    @property
    def dtype(self) -> str:
        """The type, as info.json names it."""
        return "string" if self.values.dtype.kind in "OUT" else str(self.values.dtype)

    @property
    def shape(self) -> list[int]:
        """The shape of one frame."""
        return list(self.values.shape[1:]) or [1]


def features(params: Params, table: pa.Table) -> list[Feature]:
    """Return the features of a synchronized table, in a fixed order."""
    import numpy as np

    from tacpipe.exports import frames

    channels = frames.channels(table)
    state = frames.state_of(channels, [name.strip() for name in params.state.split(",") if name.strip()])
    taxels = [channel for channel in channels if channel.signal and channel.quantity == frames.TACTILE]
    state = [channel for channel in state if channel not in taxels]

    def vector(name: str, members: Sequence[frames.Channel], values: AnyArray | None = None) -> Feature:
        values = frames.matrix(table, members, np.dtype(np.float32)) if values is None else values
        one_stream = len({channel.stream for channel in members}) == 1
        return Feature(
            name,
            values[:, 0] if values.shape[1] == 1 else values,
            [channel.short if one_stream else channel.name for channel in members],
            [channel.name for channel in members],
            [channel.unit for channel in members],
            [channel.quantity for channel in members],
        )

    vectors: list[Feature] = []
    observed = [*state, *taxels] if params.tactile_in_state else state
    vectors += [vector("observation.state", observed)] if observed else []
    if params.actions:
        vectors.append(vector(ACTION, *frames.action_of(table, channels, params.actions)))
    signals = [channel for channel in channels if channel.signal and channel not in state]
    for stream in dict.fromkeys(channel.stream for channel in signals):
        touch = [channel for channel in signals if channel.stream == stream and channel in taxels]
        remaining = [channel for channel in signals if channel.stream == stream and channel not in taxels]
        vectors += [vector(f"observation.tactile.{stream}", touch)] if touch else []
        vectors += [vector(f"observation.{stream}", remaining)] if remaining else []
    latents = [channel for channel in channels if channel.quantity == frames.LATENT]
    vectors += [vector("observation.latents", latents)] if latents else []
    truth = [channel for channel in channels if channel.truth and channel.type in ("float", "double")]
    vectors += [vector(f"{ORIGINALS}.truth", truth)] if truth else []
    vectors.append(Feature(f"{ORIGINALS}.{TIME}", table.column(TIME).to_numpy(), [TIME], [TIME], ["ns"], ["time"]))
    placed = {channel.name for channel in (*state, *signals, *latents, *truth)}
    for channel in channels:
        if channel.name not in placed and (channel.number or channel.type == "string"):
            name = f"{channel.short}.{channel.stream}" if channel.stream else channel.short
            name = f"{ORIGINALS}.{name.replace('/', '_')}"
            values = table.column(channel.name).to_numpy()
            vectors.append(Feature(name, values, [channel.name], [channel.name], [channel.unit], [channel.quantity]))
    return vectors
