"""One recording as a forecaster reads it: latents, pose of the arm and raw channels side by side, and its windows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tacpipe.codecs import codec as codecs
from tacpipe.codecs import tactile
from tacpipe.errors import TacpipeError
from tacpipe.signals.rotations import continuous
from tacpipe.signals.windows import window_starts

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.dataset import Shard

Floats = NDArray[np.floating[Any]]

POSITION = tuple(f"robot_position_{axis}_m" for axis in "xyz")
ORIENTATION = tuple(f"robot_orientation_{axis}" for axis in "xyzw")
STATE = POSITION + ORIENTATION
TRUTH = "gt_"  # how the simulator's ground truth begins, which no model may see


@dataclass(frozen=True)
class Track:
    """The rows of one recording; tactile channels in counts above rest, latents in the codec's unit."""

    name: str
    t_ns: NDArray[np.int64]  # (time,)
    contact: NDArray[np.int64]  # (time,)
    groups: NDArray[np.int64]  # (time,), equal within what a window may span
    usable: NDArray[np.bool_]  # (time,)
    latent: Floats  # (time, latent)
    state: Floats  # (time, state), position in metres and unit quaternion
    tactile: Floats  # (time, channel)
    logged: bool = False  # whether the rows are as they were logged, rather than on a uniform grid

    def starts(self, context: int, horizon: int) -> NDArray[np.int64]:
        """Return the first rows of all windows of ``context + horizon`` rows, shape (window,)."""
        return window_starts(self.groups, self.usable, context, horizon, 1)


def codec_of(table: pa.Table, files: Mapping[str, bytes]) -> codecs.Codec:
    """Return the codec among a dataset's files, or the one that leaves channels as they are where there is none.

    Raises `TacpipeError` where table and files do not belong together.
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
        raise TacpipeError("The table has no tactile channel (field metadata quantity=tactile) to forecast.")
    return codecs.Raw(channels, tuple(tactile.layout(table.schema, channels)))


def inputs(table: pa.Table, names: Sequence[str]) -> Floats:
    """Return the named columns as float64, shape (time, column).

    Raises `TacpipeError` for a column that is absent, and for the simulator's ground truth.
    """
    for name in names:
        if name.startswith(TRUTH):
            raise TacpipeError(f"{name} is the simulator's ground truth; a model that reads it has learned nothing.")
        if name not in table.column_names:
            raise TacpipeError(
                f"There is no column {name}. Give recordings that went through `tacpipe synchronize` and "
                "`tacpipe segment contacts`, with the arm's state in a stream named robot."
            )
    return tactile.matrix(table, names)


def track(shard: Shard, codec: codecs.Codec) -> Track:
    """Return the track of a recording; its latents are those stored, or its channels where ``codec`` is raw.

    Rows in a gap of any stream, outside contact or with a value that is not finite are unusable. Raises `TacpipeError`
    naming the recording where a column is absent or its channels are not the codec's.
    """
    table = shard.table()
    try:
        codecs.check_channels(codec.channels, tactile.columns(table.schema, "tactile"))
        above_rest = tactile.above_rest(table, codec.channels)
        latent = above_rest if codec.kind == "raw" else inputs(table, codec.latents)
        state = np.hstack([inputs(table, POSITION), _orientation(inputs(table, ORIENTATION))])
        t_ns, contact = (whole_numbers(table, name) for name in ("t_ns", "contact"))
    except TacpipeError as error:
        raise TacpipeError(f"{shard.name}: {error}") from error
    finite = np.isfinite(latent).all(axis=1) & np.isfinite(state).all(axis=1) & np.isfinite(above_rest).all(axis=1)
    usable = finite & ~tactile.gaps(table) & (contact >= 0)
    latent, state = latent.astype(np.float32), state.astype(np.float32)
    logged = shard.attributes.get("grid") == "logged"
    return Track(shard.name, t_ns, contact, _groups(t_ns, contact), usable, latent, state, above_rest, logged)


def whole_numbers(table: pa.Table, name: str) -> NDArray[np.int64]:
    """Return an integer column, shape (time,). Raises `TacpipeError` where it is absent."""
    if name not in table.column_names:
        raise TacpipeError(f"There is no column {name}. Run `tacpipe segment contacts` on the synchronized recordings.")
    return np.asarray(table.column(name).to_numpy(), dtype=np.int64)


def aligned(state: Floats, reference: Floats) -> Floats:
    """Return the poses (time, state) with the quaternions' common sign nearest to that of ``reference`` (4,).

    A quaternion and its negative are the same rotation. Within a recording the sign is continuous already; between
    recordings it is a matter of chance, and a model would take it for another pose.
    """
    finite = state[np.isfinite(state).all(axis=1), 3:]
    if len(finite) and finite[0] @ reference < 0:
        return np.hstack([state[:, :3], -state[:, 3:]])
    return state


def rate_hz(tracks: Sequence[Track]) -> float:
    """Return the median rate of the tracks' grids in Hz; 0 where none has two rows.

    On the rows as logged a step is a row, however long it takes; so rates may differ there. Else raises `TacpipeError`
    where they do by more than 1 %, and where only some of the tracks are as logged.
    """
    if len({one.logged for one in tracks}) > 1:
        logged = next(one.name for one in tracks if one.logged)
        raise TacpipeError(
            f"{logged} has its rows as logged and others a uniform grid. Synchronize all with one --grid."
        )
    rates = {one.name: 1e9 / float(np.median(np.diff(one.t_ns))) for one in tracks if len(one.t_ns) > 1}
    if not rates:
        return 0.0
    slow, fast = min(rates, key=lambda name: rates[name]), max(rates, key=lambda name: rates[name])
    if rates[fast] > 1.01 * rates[slow] and not tracks[0].logged:
        raise TacpipeError(
            f"{slow} runs at {rates[slow]:.2f} Hz and {fast} at {rates[fast]:.2f} Hz, so a step is not the same time. "
            "Synchronize all recordings with one --rate-hz."
        )
    return round(float(np.median(list(rates.values()))), 3)


def _orientation(quaternions: Floats) -> Floats:
    """Return unit quaternions (time, 4) of continuous sign; those that cannot be normalised become NaN."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return continuous(quaternions.astype(np.float64))


def _groups(t_ns: NDArray[np.int64], contact: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return a number for each row (time,) that changes with the contact and where rows are missing from the grid."""
    if len(t_ns) < 2:
        return np.zeros(len(t_ns), dtype=np.int64)
    apart = np.diff(t_ns)
    new = (np.diff(contact) != 0) | (apart > 1.5 * np.median(apart))
    return np.concatenate([[0], np.cumsum(new)]).astype(np.int64)
