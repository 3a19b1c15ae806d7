"""Predict with a forecaster: tables from recordings, and arrays for controllers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast, overload

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyFloats, Float32s, Times
from tacpipe.datasets.dataset import Dataset, Recording
from tacpipe.errors import TacpipeError
from tacpipe.io.parquet import one_after_another
from tacpipe.io.spill import Gathered, Spill
from tacpipe.models.windows import ARM, POSE
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.tasks.forward import headline
from tacpipe.tasks.forward.evaluation import KEPT_BYTES, check_rate, model_quantiles
from tacpipe.tasks.forward.forecaster import Forecaster, WindowArrays
from tacpipe.tasks.forward.predictors import forecasts
from tacpipe.tasks.forward.quantiles import CHUNK
from tacpipe.tasks.forward.training import check_codec
from tacpipe.tasks.recordings import open_for_model

if TYPE_CHECKING:
    import pyarrow as pa


def predict(
    model: Mapping[str, bytes], recordings: Dataset, steps: Sequence[int], quantiles: Sequence[int] = ()
) -> Result:
    """Return one table per recording with each prediction's time and each channel's counts above rest ``steps`` later.

    Columns are named like ``xela1_taxel01_z_t5``, and those of ``quantiles`` (percent) like ``xela1_taxel01_z_t5_q90``.
    Raises `TacpipeError` for a step beyond the model's horizon, for quantiles that the model does not have, and for
    recordings that the model cannot read.
    """
    tables = _collect_predictions(Forecaster.load(model), recordings, steps, quantiles)
    return Result({name: RecordingOutput(gathered.rows()) for name, gathered in tables.items()})


def tables(
    forecaster: Forecaster, recordings: Dataset, steps: Sequence[int], quantiles: Sequence[int] = ()
) -> dict[str, pa.Table]:
    """Return each recording's table of predictions; steps and errors are those of `predict`."""
    rows = {
        name: table.rows() for name, table in _collect_predictions(forecaster, recordings, steps, quantiles).items()
    }
    return {name: table if isinstance(table, pa.Table) else table.read_all() for name, table in rows.items()}


def _collect_predictions(
    forecaster: Forecaster, recordings: Dataset, steps: Sequence[int], quantiles: Sequence[int]
) -> dict[str, Gathered]:
    """Return the predictions of each recording by name, computed in batches of windows. ``steps`` are counted from 1.

    Raises the errors of `predict`.
    """
    check_steps(steps, forecaster.horizon)
    level_indices = forecaster.quantile_places(quantiles)
    check_codec(forecaster.codec_files, recordings.files)
    step_indices, channels = [step - 1 for step in steps], len(forecaster.codec.channels)
    spill, gathered = Spill(KEPT_BYTES), {}
    no_windows = np.zeros((len(steps), channels, 0), np.float32)
    empty = prediction_table(forecaster, np.zeros(0, np.int64), no_windows, steps, dict.fromkeys(quantiles, no_windows))
    for name, shard in sorted(recordings.recordings.items()):
        track = forecaster.track(shard)
        check_rate(track, forecaster)
        starts = track.starts(forecaster.context, forecaster.horizon)
        track.count_rows(starts, forecaster.context + forecaster.horizon)
        gathered[name] = Gathered(spill, empty)
        for forecast in forecasts(forecaster, track, starts):
            # (step, channel, window)
            counts = forecast.count[:, step_indices].transpose(1, 2, 0).astype(np.float32, order="C")
            bands = np.empty((len(level_indices), *counts.shape), np.float32)  # (level, step, channel, window)
            for first in range(0, len(forecast.count) if level_indices else 0, CHUNK):
                batch = slice(first, min(first + CHUNK, len(forecast.count)))
                all_quantiles = model_quantiles(forecaster, track, forecast, batch)
                bands[..., batch] = all_quantiles[:, step_indices][..., level_indices].transpose(3, 1, 2, 0)
            t_ns = track.t_ns[forecast.now]
            rows = prediction_table(forecaster, t_ns, counts, steps, dict(zip(quantiles, bands, strict=True)))
            gathered[name].add(rows)
            del forecast, counts, bands, rows  # frees the memory for the next windows
        del track
    return gathered


def check_steps(steps: Sequence[int], horizon: int) -> None:
    """Raise `TacpipeError` for a step beyond a model's horizon."""
    for step in steps:
        if not 1 <= step <= horizon:
            raise TacpipeError(f"The model predicts 1 to {horizon} steps ahead, not {step}. Give --steps of these.")


def inputs(forecaster: Forecaster, recordings: Dataset) -> WindowArrays:
    """Return the windows of a dataset's only recording as `Forecaster.predict` reads them.

    Raises `TacpipeError` if the recording does not fit the model.
    """
    check_codec(forecaster.codec_files, recordings.files)
    (shard,) = recordings.recordings.values()
    track = forecaster.track(shard)
    check_rate(track, forecaster)
    starts = track.starts(forecaster.context, forecaster.horizon)
    window_rows = starts[:, None] + np.arange(forecaster.context + forecaster.horizon)
    past, ahead = np.split(window_rows, [forecaster.context], axis=1)
    arm_columns = [*range(len(forecaster.pose.columns)), *(range(POSE, ARM) if forecaster.derived_columns else ())]
    moved = track.arm[past][..., arm_columns].astype(np.float64)
    plan = track.planned_arm(ahead)[..., arm_columns].astype(np.float64)
    window = np.concatenate([track.tactile[past], moved, track.finger[past][..., None]], axis=-1)
    return WindowArrays(window, plan, track.t_ns[past[:, -1]])


def prediction_table(
    forecaster: Forecaster,
    t_ns: Times,
    counts: Float32s,
    steps: Sequence[int],
    bands: Mapping[int, Float32s] | None = None,
) -> pa.Table:
    """Return the table of predicted ``counts`` (step, channel, window), which become columns without a copy.

    ``bands`` contains quantiles of the same shape by level in percent; their columns follow the prediction's.
    """
    fields = [pa.field("t_ns", pa.int64(), metadata={"quantity": "time", "unit": "ns"})]
    columns: list[Any] = [pa.array(t_ns)]
    unit = str(forecaster.config["inputs"].get("unit", headline.COUNT))
    for channel, name in enumerate(forecaster.codec.channels):
        for index, step in enumerate(steps):
            about = {"quantity": "prediction", "unit": unit, "step": str(step), **forecaster.codec.layout[channel]}
            fields.append(pa.field(f"{name}_t{step}", pa.float32(), metadata=about))
            columns.append(pa.array(counts[index, channel]))
            for percent, values in (bands or {}).items():
                level = {**about, "quantile": f"{percent / 100:g}"}
                fields.append(pa.field(f"{name}_t{step}_q{percent}", pa.float32(), metadata=level))
                columns.append(pa.array(values[index, channel]))
    return pa.Table.from_arrays(columns, schema=pa.schema(fields))


STEPS = (1, 3, 5, 10)  # default steps ahead, as in `tacpipe predict`


class ForwardModel(Forecaster):
    """Model that predicts future tactile signals from recordings or arrays."""

    @overload
    def predict(
        self, recordings: Dataset | Recording, /, *, steps: Sequence[int] = STEPS, quantiles: Sequence[int] = ()
    ) -> pa.Table: ...

    @overload
    def predict(self, window: AnyFloats, plan: AnyFloats, /, *, quantiles: Sequence[int] = ()) -> AnyFloats: ...

    def predict(
        self,
        data: Dataset | Recording | AnyFloats,
        plan: AnyFloats | None = None,
        /,
        *,
        steps: Sequence[int] = STEPS,
        quantiles: Sequence[int] = (),
    ) -> pa.Table | AnyFloats:
        """Return predicted tactile signals: a table for a dataset or one of its recordings, an array for arrays.

        **Recordings** (``tacpipe.open(PATH)``, or one of its recordings) give the arrow table that `tacpipe predict`
        writes and ``tacpipe.open(OUTPUT).table()`` reads, with one row per window: ``recording``, ``t_ns`` (the time of
        the prediction) and for each channel and each of ``steps`` the counts above rest that many rows later, such as
        ``xela1_taxel01_z_t5``, float32. ``.to_pandas()`` converts it to a data frame. ``quantiles`` (percent, from
        those of `tacpipe calibrate`) adds columns such as ``xela1_taxel01_z_t5_q90``. Raises `UsageError` if the
        recordings were not processed by the stages that preceded the model's training, and `TacpipeError` for a step
        beyond the horizon.

        **Arrays**, for controllers: ``window`` (context, column) or (window, context, column), newest row last,
        contains `window_columns`, or these and `derived_columns` and the width of the gripper; ``plan`` (horizon,
        column) or (window, horizon, column), the future rows, contains `plan_columns`, or these and `derived_columns`.
        `windows` creates both from a recording. Missing velocities are computed as differences of the poses. Returns
        counts above rest, float64 (horizon, channel) or (window, horizon, channel); with ``quantiles`` the quantiles
        instead, float32 (…, channel, quantile).

        Raises `TacpipeError` for other shapes, for values that are not finite, and for raw counts instead of counts
        above rest. Counts are considered raw if the median absolute count of a window, over rows and channels, is more
        than twice `largest_level`: half of all channels are then further from rest than almost any channel was in
        training. Offsets of a XELA uSkin are at least four times `largest_level` on 52 published trials; true windows
        reach 0.9 of it if the model was trained only on the weakest of these trials, and 0.1 if on all. An offset below
        twice `largest_level` is not detected.
        """
        if plan is not None:
            return self.predict_windows(cast("AnyFloats", data), plan, quantiles)
        recordings = open_for_model(cast("Dataset | Recording", data), self.chain)
        return one_after_another(tables(self, recordings, sorted(set(steps)), sorted(set(quantiles))))

    def windows(self, recording: Recording) -> WindowArrays:
        """Return a recording's windows as `predict` reads them: ``window``, ``plan`` and ``t_ns``, the prediction times.

        Excludes windows with rows in gaps. The recorded motion serves as the plan. Raises the same errors as `predict`.
        """
        return inputs(self, open_for_model(recording.alone, self.chain))
