"""Run a model's chain of stages causally on samples as they arrive: grid rows, latents, windows and forecasts.

This module reads no clock, file or link. The result depends only on the samples, their timestamps and the plan, not on
how they were divided into batches. `tacpipe predict --causal` feeds a recording to the same `LiveChain`, so it
reproduces the messages of a live session bit for bit. docs/explanation/causal.md states the rules.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import Flag, auto
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tacpipe.arrays import AnyFloats, Float32s, Floats, Times
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import Json
from tacpipe.live.decoding import BatchColumns
from tacpipe.live.plans import PlanHistory
from tacpipe.live.rows import SynchronizedRows
from tacpipe.live.stages import live_channels, refuse_look_ahead
from tacpipe.models.tensors import one_thread
from tacpipe.models.windows import ARM
from tacpipe.printable import listed
from tacpipe.sensors.plan import NAME as PLAN
from tacpipe.signals.resampling import GAP_NS
from tacpipe.store.records import Step
from tacpipe.synchronization.causal import GridRows
from tacpipe.tasks.forward import causal, headline
from tacpipe.tasks.forward.causal import Arm, Rolling
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.live.inputs import InputLayout
from tacpipe.tasks.forward.live.plans import Targets, facing
from tacpipe.tasks.forward.live.stages import causal_stages
from tacpipe.video.channels import LiveChannels

if TYPE_CHECKING:
    import pyarrow as pa

CODEC_GAP = 1.5  # periods between two rows above which a codec starts a new run, as `run_starts` does offline


class Cause(Flag):
    """Why there is no forecast at a grid point, or what input it lacks. Flags can be combined."""

    NONE = 0
    START = auto()  # a stream has not started, or the rest level is not yet known: no forecast
    CONTEXT = auto()  # fewer successive usable rows than the model's context: no forecast
    GAP = auto()  # the newest sample of a stream is older than the gap of the chain: no forecast
    VALUE = auto()  # a value of the row is not finite: no forecast
    SKIPPED = auto()  # a later grid point was predicted instead, on request: no forecast
    NO_PLAN = auto()  # no planned motion: the hand is assumed to continue its motion
    PLAN_ENDED = auto()  # the plan ends before the horizon: the hand is assumed to stay at its end
    TIME = auto()  # the time at which the row was measured is unknown: no forecast
    MEASURED = auto()  # a newer row arrived together with this one, so what follows is already measured: no forecast


BLOCKING = Cause.START | Cause.CONTEXT | Cause.GAP | Cause.VALUE | Cause.SKIPPED | Cause.TIME | Cause.MEASURED


@dataclass(frozen=True, slots=True)
class GridForecast:
    """The result at one grid point, which may be that no forecast is possible."""

    t_ns: int  # time of the grid point; on a uniform grid, step k is at t_ns + k * period
    made_from_t_ns: int  # arrival of the newest sample that was read; 0 before the streams have started
    count: Float32s | None  # (horizon, channel), above rest; None if `cause` has a flag of `BLOCKING`
    now: Float32s | None  # (channel,), above rest at t_ns; None before the rest level is known
    cause: Cause
    gaps: tuple[str, ...] = ()  # streams whose newest sample is too old
    # (horizon, channel, quantile), above rest, the requested ones; None without `count`
    quantiles: Float32s | None = None


def _gap_ms(synchronize: Any, forecaster: Forecaster, stream: str) -> float:
    """Return the age of the newest sample of a stream above which there is a gap, as in the model's recordings."""
    stored: Mapping[str, float] = forecaster.config.get("gap_ms", {})
    return float(stored.get(stream, GAP_NS / 1e6) if synchronize.gap_ms is None else synchronize.gap_ms)


class _Row(NamedTuple):
    """One row of the grid, before the rest level is subtracted."""

    t_ns: int
    arrival_ns: int
    tactile: Floats  # (channel,)
    arm: Float32s  # (13,)
    finger_m: float
    gaps: tuple[str, ...]
    at_arrival: bool  # True if the sampling time is unknown


class LiveChain:
    """The preprocessing stages of a model and the model itself, causally; one per live session, for one thread.

    Pass every decoded sample to `push`, and call `advance` with the time up to which all samples have arrived: it
    computes the rows and forecasts of the grid points up to that time. The order of pushes between two calls of
    `advance` has no effect, as long as the samples of each stream are in order.
    """

    def __init__(
        self,
        forecaster: Forecaster,
        steps: Sequence[Step],
        layout: InputLayout,
        beginning: Json | None = None,
        targets: Targets | None = None,
        quantiles: Sequence[int] = (),
        cameras: Mapping[str, LiveChannels | None] | None = None,
        arrivals: Collection[str] = (),
    ) -> None:
        """Create a chain from compatible parts; `for_model` checks them."""
        self._targets = targets
        # channels computed from frames, by stream; None if the session's first frame, to which they refer, is missing
        self._cameras = dict(cameras or {})
        # indices, among the model's quantiles, of those that are published
        self._quantiles = forecaster.quantile_places(quantiles)
        stages = causal_stages(steps)
        self._forecaster, self._stages, self._layout = forecaster, stages, layout
        sync = stages.synchronize
        gap_ns = {stream: round(_gap_ms(sync, forecaster, stream) * 1e6) for stream in layout.columns}
        origin_ns = None if beginning is None else int(beginning["origin_ns"])
        self._synchronized = SynchronizedRows(
            layout.columns, layout.schemas, layout.master, sync, gap_ns, origin_ns, arrivals
        )
        self._grid = self._synchronized.grid
        if beginning is not None:
            for stream, levels in layout.levels(beginning["rest"]).items():
                self._grid.continue_from(stream, levels)
        self._rolling = Rolling(forecaster, continues=beginning is not None)
        self._arm = Arm(forecaster.orientation)
        # rows collected until the rest level is known; None afterwards
        self._resting: list[_Row] | None = [] if beginning is None else None
        self._rest: Floats | None = None if beginning is None else np.array(beginning["rest"])
        self._rest_rows = "unknown" if beginning is None else "of an earlier process"
        self._plans = PlanHistory()
        self._late_plans = 0
        self._until_ns: int | None = None
        period_ns = 1e9 / self.rate_hz
        self._apart_ns = stages.largest_step * period_ns
        self._codec_ns = CODEC_GAP * period_ns
        self._period_ns = period_ns
        self._times: deque[int] = deque(maxlen=forecaster.context)  # times of the newest rows

    @classmethod
    def for_model(
        cls,
        model: Mapping[str, bytes] | Forecaster,
        steps: Sequence[Step],
        layouts: Mapping[str, pa.Schema],
        master: str = "",
        beginning: Json | None = None,
        plan_from: str = "",
        quantiles: Sequence[int] = (),
        *,
        allow_look_ahead: bool = False,
        arrivals: Collection[str] = (),
    ) -> LiveChain:
        """Return the chain of a model, from its files, its preprocessing stages, and the schema of each recorded stream.

        ``model`` and ``steps`` are ``files`` and ``source.chain`` of the dataset that `tacpipe.open` returns for a
        model. To create several chains, pass the loaded model, because loading it and its first forecast take a second.
        ``layouts`` has the schemas (with field metadata) of the rig's streams, as they are recorded; ``master`` is the
        rig file's, used if the model's stages do not have one. Raises `TacpipeError` if the model's task does not run
        live, a stage looks ahead and has no causal rule, or a stream or channel that the model needs is missing or
        differs in ``layouts``.

        ``beginning`` is that of an earlier chain of the session: the grid and the rest level are continued, so that
        this chain predicts the same after it has read a few more rows than the model reads. Counts that had wrapped
        around are unwrapped to the values nearest to the rest level.

        ``plan_from`` is the stream of an arm whose set-points are the planned motion (`Targets`), instead of the stream
        ``plan``. Raises `UsageError` if it has no set-points.

        ``quantiles`` (percent) are added to each forecast. Raises `TacpipeError` if the model does not have them.

        ``arrivals`` are the streams whose times are arrivals although their schemas do not state it.

        Raises `TacpipeError` for a model that was trained on rows that look ahead, unless ``allow_look_ahead``.
        """
        forecaster = model if isinstance(model, Forecaster) else Forecaster.load(model)
        if forecaster.actions == "shuffled":
            raise TacpipeError(
                "This model was trained on shuffled plans, a control that needs many recordings at once; train one with "
                "--actions planned or none."
            )
        stages = causal_stages(steps)
        if not allow_look_ahead:
            refuse_look_ahead(forecaster.config, steps)
        if plan_from and plan_from not in layouts:
            raise UsageError(f"There is no stream {plan_from} that plans could come from; there are {listed(layouts)}.")
        targets = Targets(plan_from, layouts[plan_from]) if plan_from else None
        cameras = live_channels(steps, layouts)
        read_layouts = {**layouts, **{name: camera.schema for name, camera in cameras.items()}}
        layout = InputLayout.for_forecaster(forecaster, stages.synchronize, read_layouts, master)
        known = cameras if beginning is None else dict.fromkeys(cameras)
        return cls(forecaster, steps, layout, beginning, targets, quantiles, known, arrivals)

    @property
    def streams(self) -> tuple[str, ...]:
        """The names of the streams that are read; samples of others are ignored."""
        plans = PLAN if self._targets is None else self._targets.stream
        return tuple(dict.fromkeys([*self._layout.columns, *([plans] if self.reads_plan else [])]))

    @property
    def master(self) -> str:
        """The stream whose samples start the grid."""
        return self._layout.master

    @property
    def rate_hz(self) -> float:
        """Grid points per second; for a ``logged`` or ``fresh`` grid, the median rate of training."""
        rate_hz = self._stages.synchronize.rate_hz
        return float(self._forecaster.config["rate_hz"] if rate_hz is None else rate_hz)

    @property
    def horizon(self) -> int:
        """The number of predicted steps, 1 to `horizon`."""
        return self._forecaster.horizon

    @property
    def channels(self) -> tuple[str, ...]:
        """The names of the predicted channels, such as ``xela1_taxel01_z``."""
        return tuple(self._forecaster.codec.channels)

    @property
    def unit(self) -> str:
        """The unit of the predicted channels, such as ``count``."""
        return str(self._forecaster.config["inputs"].get("unit", headline.COUNT))

    @property
    def reads_plan(self) -> bool:
        """Whether the model reads planned motion."""
        return self._forecaster.actions == "planned" and bool(self._forecaster.pose.position)

    @property
    def beginning(self) -> Json | None:
        """Grid and rest level, for a chain that continues the session; None until they are known."""
        origin_ns = self._grid.origin_ns
        return (
            None if self._rest is None or origin_ns is None else {"origin_ns": origin_ns, "rest": self._rest.tolist()}
        )

    @property
    def rest_rows(self) -> str:
        """The rows that gave the level at rest, in words."""
        return self._rest_rows

    @property
    def late(self) -> Mapping[str, int]:
        """The number of late samples by stream, which arrived after a newer sample or after `advance` passed their time.

        Forecasts made meanwhile lack them, and so differ from those of `tacpipe predict --causal`.
        """
        return {**self._grid.late, **({PLAN: self._late_plans} if self.reads_plan else {})}

    def push(self, stream: str, batch: pa.RecordBatch | pa.Table | BatchColumns) -> None:
        """Add samples of a stream in the order of their arrival, with ``t_ns`` and the columns of its layout."""
        if self._targets is not None and stream == self._targets.stream and batch.num_rows:
            self._targets.push(batch)
        if stream == PLAN:
            self._push_plans(batch)
        elif stream in self._layout.columns and batch.num_rows:
            samples = batch
            if stream in self._cameras:
                camera = self._cameras[stream]
                if camera is None:
                    return
                samples = camera.push(batch)
            self._synchronized.push(stream, samples)

    def take_over(self, previous: LiveChain) -> None:
        """Take the plans of an earlier chain of the session, and its cameras' channels, which know the untouched gels."""
        self._cameras, self._plans, self._targets = dict(previous._cameras), previous._plans, previous._targets

    def advance(self, t_ns: int, *, newest_only: bool = False) -> list[GridForecast]:
        """Return the forecasts of the grid points up to ``t_ns``, up to which all samples must have been pushed.

        A sample or plan with a timestamp up to ``t_ns`` that arrives afterwards is counted in `late`. With
        ``newest_only``, for a caller that has fallen behind, only the newest grid point is predicted; the others have
        the cause SKIPPED.
        """
        self._until_ns = t_ns if self._until_ns is None else max(t_ns, self._until_ns)
        rows = self._grid.rows(t_ns)
        forecasts: list[GridForecast] = []
        if not len(rows.t_ns):
            return forecasts
        arrived_with_next = np.append(np.diff(rows.arrival_ns) == 0, False)  # (row,)
        with one_thread():
            for index, at_ns in enumerate(rows.t_ns.tolist()):
                if not rows.has_samples[index]:
                    forecasts.append(GridForecast(at_ns, 0, None, None, Cause.START))
                    continue
                row = self._row(rows, index)
                cause = Cause.MEASURED if arrived_with_next[index] else Cause.NONE
                if newest_only and index < len(rows.t_ns) - 1:
                    cause = Cause.SKIPPED
                forecasts.append(self._forecast(row, cause))
        return forecasts

    def _row(self, rows: GridRows, index: int) -> _Row:
        """Return the row ``index`` of the grid, in the form that the model reads."""
        t_ns, arrival_ns = int(rows.t_ns[index]), int(rows.arrival_ns[index])
        gaps = tuple(name for name, gap in rows.gap.items() if gap[index])
        layout = self._layout
        row = layout.row({name: columns[index] for name, columns in rows.values.items()})
        arm = self._arm.row(t_ns, *layout.arm_state(row))
        at_arrival = bool(rows.at_arrival[index])
        return _Row(t_ns, arrival_ns, row[layout.tactile], arm, layout.finger_m(row), gaps, at_arrival)

    def _forecast(self, row: _Row, unneeded: Cause) -> GridForecast:
        """Add a row and return its forecast, which has no values until the rest level is known and the window is full.

        ``unneeded`` is the cause for which the row is not predicted although it could be, or NONE.
        """
        if self._resting is not None:
            first_ns = next((resting.t_ns for resting in self._resting if not resting.at_arrival), None)
            if first_ns is None or row.t_ns <= first_ns + round(self._stages.contacts.rest_s * 1e9):
                self._resting.append(row)
                return GridForecast(row.t_ns, row.arrival_ns, None, None, Cause.START, row.gaps)
            at_rest = [resting for resting in self._resting if not resting.at_arrival]
            self._rest = self._layout.rest_levels(self._stages.contacts, [resting.tactile for resting in at_rest])
            rest_s = (at_rest[-1].t_ns - at_rest[0].t_ns) / 1e9
            self._rest_rows = f"{len(at_rest)} rows over {rest_s:.3f} s"
            for resting in self._resting:
                self._take(resting)
            self._resting = None
        finite = self._take(row)
        cause = Cause.GAP if row.gaps else Cause.NONE
        cause |= Cause.TIME if row.at_arrival else Cause.NONE
        cause |= Cause.NONE if finite else Cause.VALUE
        cause |= Cause.NONE if cause or self._rolling.is_ready else Cause.CONTEXT
        cause |= Cause.NONE if cause else unneeded
        now = self._rolling.now.astype(np.float32)
        if cause:
            return GridForecast(row.t_ns, row.arrival_ns, None, now, cause, row.gaps)
        ahead, lacking = self._planned_rows(row)
        count = self._rolling.predict(ahead)
        quantiles = self._rolling.quantiles(ahead, count)[..., self._quantiles] if self._quantiles else None
        return GridForecast(row.t_ns, row.arrival_ns, count, now, lacking, quantiles=quantiles)

    def _take(self, row: _Row) -> bool:
        """Add a row to the model's window; return whether its values are finite."""
        since_ns = row.t_ns - self._times[-1] if self._times else None
        self._times.append(row.t_ns)
        assert self._rest is not None
        return self._rolling.add(
            row.tactile - self._rest,
            row.arm,
            row.finger_m,
            follows=since_ns is not None and since_ns <= self._apart_ns,
            encodes=since_ns is not None and since_ns <= self._codec_ns,
            usable=not row.gaps and not row.at_arrival,
        )

    def _planned_rows(self, row: _Row) -> tuple[AnyFloats, Cause]:
        """Return the arm's planned rows (horizon, 13), and the cause if the plan is missing or too short, else NONE."""
        now, ahead_ns = self._rolling.arm, row.t_ns + self._steps_ns()
        if not self.reads_plan:  # a model without plans uses the newest row instead
            return np.broadcast_to(now, (self.horizon, ARM)), Cause.NONE
        if self._targets is not None:
            aimed = self._targets.state(row.arrival_ns)
            cause = Cause.NO_PLAN if aimed is None else Cause.NONE
            return causal.extrapolate_arm(row.t_ns, ahead_ns, now if aimed is None else facing(aimed, now)), cause
        self._plans.forget_before(row.arrival_ns)
        plan = self._plans.newest(row.arrival_ns)
        if plan is None:
            return causal.extrapolate_arm(row.t_ns, ahead_ns, now), Cause.NO_PLAN
        cause = Cause.PLAN_ENDED if plan.t_ns[-1] < ahead_ns[-1] else Cause.NONE
        return causal.rows(plan, row.t_ns, ahead_ns, now), cause

    def _steps_ns(self) -> Times:
        """Return the times of the predicted rows relative to the newest one (horizon,).

        If rows are at the timestamps of a stream, their mean period in the context is used, because rates differ
        between recordings.
        """
        period_ns = self._period_ns
        if self._stages.synchronize.rate_hz is None and len(self._times) > 1:
            period_ns = (self._times[-1] - self._times[0]) / (len(self._times) - 1)
        steps_ns: Times = np.rint(np.arange(1, self.horizon + 1) * period_ns).astype(np.int64)
        return steps_ns

    def _push_plans(self, batch: pa.RecordBatch | pa.Table | BatchColumns) -> None:
        """Add rows of plans."""
        if not self.reads_plan:
            return
        arrivals = self._plans.push(batch)
        if self._until_ns is not None:
            self._late_plans += int((arrivals <= self._until_ns).sum())
