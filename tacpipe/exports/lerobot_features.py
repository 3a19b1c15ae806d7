"""Features of a LeRobot frame: which columns of a synchronized table are state, action and tactile observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.channels.streams import TRUTH
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

    every = frames.channels(table)
    state = frames.state_of(every, [one.strip() for one in params.state.split(",") if one.strip()])
    taxels = [one for one in every if one.signal and one.quantity == frames.TACTILE]
    state = [one for one in state if one not in taxels]

    def vector(name: str, chosen: Sequence[frames.Channel], values: AnyArray | None = None) -> Feature:
        values = frames.matrix(table, chosen, np.dtype(np.float32)) if values is None else values
        several = {one.stream for one in chosen}
        names = [one.short if len(several) == 1 else one.name for one in chosen]
        flat = values[:, 0] if values.shape[1] == 1 else values
        return Feature(
            name,
            flat,
            names,
            [one.name for one in chosen],
            [one.unit for one in chosen],
            [one.quantity for one in chosen],
        )

    found: list[Feature] = []
    whole = [*state, *taxels] if params.tactile_in_state else state
    found += [vector("observation.state", whole)] if whole else []
    if params.actions:
        found.append(vector(ACTION, *frames.action_of(table, every, params.actions)))
    rest = [one for one in every if one.signal and one not in state]
    for stream in dict.fromkeys(one.stream for one in rest):
        touch = [one for one in rest if one.stream == stream and one in taxels]
        other = [one for one in rest if one.stream == stream and one not in taxels]
        found += [vector(f"observation.tactile.{stream}", touch)] if touch else []
        found += [vector(f"observation.{stream}", other)] if other else []
    latents = [one for one in every if one.quantity == "latent"]
    found += [vector("observation.latents", latents)] if latents else []
    truth = [one for one in every if one.name.startswith(TRUTH) and one.type in ("float", "double")]
    found += [vector(f"{ORIGINALS}.truth", truth)] if truth else []
    found.append(Feature(f"{ORIGINALS}.{TIME}", table.column(TIME).to_numpy(), [TIME], [TIME], ["ns"], ["time"]))
    taken = {one.name for one in (*state, *rest, *latents, *truth)}
    for one in every:
        if one.name not in taken:
            name = f"{one.short}.{one.stream}" if one.stream else one.short
            values = table.column(one.name).to_numpy()
            name = f"{ORIGINALS}.{name.replace('/', '_')}"
            found.append(Feature(name, values, [one.name], [one.name], [one.unit], [one.quantity]))
    return found
