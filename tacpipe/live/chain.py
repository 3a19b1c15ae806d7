"""A model's chain of stages, fed samples as they arrive: rows on the model's grid, latents, windows and forecasts.

Nothing here reads a clock, a file or a link: what comes out depends on the samples, their stamps and the plan alone, and
not on how they were cut into batches. `tacpipe predict --causal` feeds a recording to the same `Chain`, and so gives bit
for bit what a live session published.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Flag, auto
from typing import TYPE_CHECKING, Any, NamedTuple

from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import AnyFloats, Float32s, Floats, Times

PLAN = "plan"  # name of the stream of planned motion, in `Chain.push` and in recordings of live sessions


class Cause(Flag):
    """Why there is no forecast at a grid point, or what one was made without; several may hold."""

    NONE = 0
    START = auto()  # a stream has not begun, or the level at rest is not yet known: no forecast
    CONTEXT = auto()  # fewer usable rows in a row than the model's context: no forecast
    GAP = auto()  # the newest sample of a stream is older than the chain's gap: no forecast
    VALUE = auto()  # a value of the row is not finite: no forecast
    NO_PLAN = auto()  # no planned motion: the hand was assumed to move on as it did
    PLAN_ENDED = auto()  # the plan ends before the horizon: the hand was assumed to stay at its end


BLOCKING = Cause.START | Cause.CONTEXT | Cause.GAP | Cause.VALUE


class Forecast(NamedTuple):
    """What was predicted at one grid point; one is returned for each grid point, also where nothing can be predicted."""

    t_ns: int  # of the grid point; step k is the time t_ns + k * period, on a uniform grid
    made_from_t_ns: int  # stamp of the newest sample that was read, never above t_ns
    count: Float32s | None  # (horizon, channel), above rest; None where `cause` has a flag of `BLOCKING`
    now: Float32s | None  # (channel,), above rest at t_ns; None before the level at rest is known
    cause: Cause
    gaps: tuple[str, ...] = ()  # streams whose newest sample is too old


class Chain:
    """The stages that a model was trained behind and the model, causally; one a live session, for one thread.

    Feed every decoded sample with `push`, and state with `advance` up to when all has come: rows and forecasts of the grid
    points up to then are made. The order of pushes between two calls of `advance` is without effect.
    """

    @classmethod
    def of(
        cls, model: Mapping[str, bytes], steps: Sequence[Mapping[str, Any]], layouts: Mapping[str, pa.Schema]
    ) -> Chain:
        """Return the chain of a model: its files, the stages it was trained behind, and the schema of each recorded stream.

        ``model`` and ``steps`` are ``files`` and ``source.chain`` of the dataset that `tacpipe.open` gives for a model.
        ``layouts`` holds the schemas (with field metadata) of the rig's streams, as they are recorded, with `PLAN` among
        them where a plan comes. Raises `TacpipeError` where the model is not of a task that runs live, was trained behind a
        stage that looks ahead and has no causal rule, or needs a stream or channel that ``layouts`` lacks or has
        otherwise.
        """
        raise TacpipeError("This model cannot run live yet.")

    @property
    def streams(self) -> tuple[str, ...]:
        """Names of the streams that are read; others may be pushed and are ignored."""
        raise NotImplementedError

    @property
    def master(self) -> str:
        """The stream whose samples start the grid."""
        raise NotImplementedError

    @property
    def rate_hz(self) -> float:
        """Grid points a second; of a grid ``logged`` or ``fresh``, the median of training."""
        raise NotImplementedError

    @property
    def horizon(self) -> int:
        """How many steps ahead are predicted: steps 1 to `horizon`."""
        raise NotImplementedError

    @property
    def context(self) -> int:
        """How many rows are read."""
        raise NotImplementedError

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the predicted channels, such as ``xela1_taxel01_z``."""
        raise NotImplementedError

    @property
    def layout(self) -> tuple[Mapping[str, str], ...]:
        """Stream, taxel and axis of each channel."""
        raise NotImplementedError

    @property
    def unit(self) -> str:
        """Unit of the predicted channels, as ``count``."""
        raise NotImplementedError

    @property
    def reads_plan(self) -> bool:
        """Whether the model reads planned motion."""
        raise NotImplementedError

    @property
    def rest(self) -> Floats | None:
        """Level at rest (channel,), None as long as it is not known."""
        raise NotImplementedError

    @property
    def late(self) -> Mapping[str, int]:
        """How many samples of each stream were pushed with a stamp that `advance` had passed; rows were made without."""
        raise NotImplementedError

    def push(self, stream: str, batch: pa.RecordBatch | pa.Table) -> None:
        """Take samples of a stream in the order of their arrival, with ``t_ns`` and the columns of its layout."""
        raise NotImplementedError

    def plan(self, arrived_ns: int, t_ns: Times, poses: AnyFloats) -> None:
        """Take planned motion that arrived at ``arrived_ns``; it replaces the plan before it.

        ``t_ns`` (point,) are the times, ascending, on the clock of the samples, at which the hand is to be at ``poses``
        (point, 3 or 7): position in m and quaternion x, y, z, w in the frame of the recorded pose. Between points the
        position is interpolated linearly and the orientation along the shorter arc. The same as pushing rows of `PLAN`.
        """
        raise NotImplementedError

    def advance(self, t_ns: int) -> list[Forecast]:
        """Return the forecasts of the grid points up to ``t_ns``: the caller states that all samples up to it were pushed.

        A sample or plan with a stamp up to ``t_ns`` that comes later is counted in `late`.
        """
        raise NotImplementedError
