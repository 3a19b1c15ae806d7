"""Predict with a forecaster: tables for recordings, arrays for controllers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast, overload

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyFloats, Float32s, Times
from tacpipe.errors import TacpipeError
from tacpipe.io.parquet import one_after_another
from tacpipe.io.spill import Gathered, Spill
from tacpipe.models.windows import ARM, POSE
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.tasks.forward import headline
from tacpipe.tasks.forward.evaluation import KEPT_BYTES, band, check_rate
from tacpipe.tasks.forward.forecaster import Forecaster, WindowArrays
from tacpipe.tasks.forward.predictors import forecasts
from tacpipe.tasks.forward.quantiles import CHUNK
from tacpipe.tasks.forward.training import check_codec
from tacpipe.tasks.recordings import open_for_model

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording


def predict(
    model: Mapping[str, bytes], recordings: Dataset, steps: Sequence[int], quantiles: Sequence[int] = ()
) -> Result:
    """Return a table a recording: when each prediction was known, and each channel's counts above rest ``steps`` later.

    Columns are named like ``xela1_taxel01_z_t5``, and with ``quantiles`` (percent) like ``xela1_taxel01_z_t5_q90`` too.
    Raises `TacpipeError` for a step that the model does not reach, for quantiles that it does not have, and where the
    recordings are not what it reads.
    """
    tables = _gathered(Forecaster.load(model), recordings, steps, quantiles)
    return Result({name: RecordingOutput(gathered.rows()) for name, gathered in tables.items()})


def tables(
    forecaster: Forecaster, recordings: Dataset, steps: Sequence[int], quantiles: Sequence[int] = ()
) -> dict[str, pa.Table]:
    """Return the table of each recording's predictions; steps and errors are those of `predict`."""
    rows = {name: table.rows() for name, table in _gathered(forecaster, recordings, steps, quantiles).items()}
    return {name: table if isinstance(table, pa.Table) else table.read_all() for name, table in rows.items()}


def _gathered(
    forecaster: Forecaster, recordings: Dataset, steps: Sequence[int], quantiles: Sequence[int]
) -> dict[str, Gathered]:
    """Return the predictions of each recording, put aside some windows at a time."""
    check_steps(steps, forecaster.horizon)
    levels = forecaster.quantiles_of(quantiles)[1] if quantiles else []
    check_codec(forecaster.codec_files, recordings.files)
    columns, channels = [step - 1 for step in steps], len(forecaster.codec.channels)
    spill, gathered = Spill(KEPT_BYTES), {}
    none = np.zeros((len(steps), channels, 0), np.float32)
    empty = prediction_table(forecaster, np.zeros(0, np.int64), none, steps, dict.fromkeys(quantiles, none))
    for name, shard in sorted(recordings.recordings.items()):
        track = forecaster.track(shard)
        check_rate(track, forecaster)
        starts = track.starts(forecaster.context, forecaster.horizon)
        gathered[name] = Gathered(spill, empty)
        for forecast in forecasts(forecaster, track, starts):
            counts = (
                forecast.count[:, columns].transpose(1, 2, 0).astype(np.float32, order="C")
            )  # (step, channel, window)
            bands = np.empty((len(levels), *counts.shape), np.float32)
            for first in range(0, len(forecast.count) if levels else 0, CHUNK):
                part = slice(first, min(first + CHUNK, len(forecast.count)))
                quantiles_of_part = band(forecaster, track, forecast, part)[:, columns][..., levels].transpose(
                    3, 1, 2, 0
                )
                bands[..., part] = quantiles_of_part
            t_ns = track.t_ns[forecast.now]
            rows = prediction_table(forecaster, t_ns, counts, steps, dict(zip(quantiles, bands, strict=True)))
            gathered[name].add(rows)
            del forecast, counts, bands, rows  # frees the memory for the next windows
        del track
    return gathered


def check_steps(steps: Sequence[int], horizon: int) -> None:
    """Raise `TacpipeError` for a step ahead that a model does not reach."""
    for step in steps:
        if not 1 <= step <= horizon:
            raise TacpipeError(f"The model predicts 1 to {horizon} steps ahead, not {step}. Give --steps of these.")


def inputs(forecaster: Forecaster, recordings: Dataset) -> WindowArrays:
    """Return the windows of a dataset's only recording, as `Forecaster.predict` reads them."""
    check_codec(forecaster.codec_files, recordings.files)
    (shard,) = recordings.recordings.values()
    track = forecaster.track(shard)
    check_rate(track, forecaster)
    starts = track.starts(forecaster.context, forecaster.horizon)
    window_rows = starts[:, None] + np.arange(forecaster.context + forecaster.horizon)
    past, ahead = np.split(window_rows, [forecaster.context], axis=1)
    read = [*range(len(forecaster.pose.columns)), *(range(POSE, ARM) if forecaster.derived_columns else ())]
    moved = track.arm[past][..., read].astype(np.float64)
    plan = track.planned(ahead)[..., read].astype(np.float64)
    window = np.concatenate([track.tactile[past], moved, track.finger[past][..., None]], axis=-1)
    return WindowArrays(window, plan, track.t_ns[past[:, -1]])


def prediction_table(
    forecaster: Forecaster,
    t_ns: Times,
    counts: Float32s,
    steps: Sequence[int],
    bands: Mapping[int, Float32s] | None = None,
) -> pa.Table:
    """Return the table of predicted ``counts`` (step, channel, window), which become its columns without a copy.

    ``bands`` holds quantiles of the same shape by their level in percent, in columns behind each one's prediction.
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


STEPS = (1, 3, 5, 10)  # ahead, that are predicted unless others are asked for, as by `tacpipe predict`


class ForwardModel(Forecaster):
    """Predicts future tactile signals of recordings, or of arrays."""

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
        """Return predicted tactile signals: of a dataset or one of its recordings as a table, of arrays as an array.

        **Recordings** (``tacpipe.open(PATH)``, or one of its recordings) give the arrow table that `tacpipe predict` writes
        and ``tacpipe.open(OUTPUT).table()`` reads: ``recording``, ``t_ns`` (when it was known) and for each channel and each
        of ``steps`` the counts above rest that many rows later, as ``xela1_taxel01_z_t5``, float32; a row a window.
        ``.to_pandas()`` makes a frame of it. ``quantiles`` (percent, of those of `tacpipe calibrate`) adds columns such as
        ``xela1_taxel01_z_t5_q90``. Raises `UsageError` if the recordings did not go through the stages that
        the model was trained behind, `TacpipeError` for a step beyond the horizon.

        **Arrays**, for controllers: ``window`` (context, column) or (window, context, column), newest row last, has
        `window_columns` or these, `derived_columns` and the width of the gripper; ``plan`` (horizon, column) or (window,
        horizon, column), the rows to come, has `plan_columns`, or these and `derived_columns`. `windows` makes both of a
        recording. Velocities that are left out are differences of the poses. Returns counts above rest, float64 (horizon,
        channel) or (window, horizon, channel); with ``quantiles`` these instead, float32 (…, channel, quantile).

        Raises `TacpipeError` for other shapes, for values that are not finite, and for raw counts instead of counts above
        rest: where the median of a window's counts, by absolute value over rows and channels, is more than twice
        `largest_level`, half of all channels are further from rest than in training hardly any channel ever was. Offsets
        of a XELA uSkin are at least four times `largest_level` on 52 published trials; true windows reach 0.9 of it if
        the model was trained on the weakest of these trials alone, and 0.1 if on all. An offset below twice
        `largest_level` goes unnoticed.
        """
        if plan is not None:
            window = cast("AnyFloats", data)
            return self.predict_quantiles(window, plan, quantiles) if quantiles else self.predict_windows(window, plan)
        recordings = open_for_model(cast("Dataset | Recording", data), self.chain)
        return one_after_another(tables(self, recordings, sorted(set(steps)), sorted(set(quantiles))))

    def windows(self, recording: Recording) -> WindowArrays:
        """Return all windows of a recording as `predict` reads them: ``window``, ``plan`` and ``t_ns``, when each was known.

        Rows in gaps are in none of them. The recorded motion serves as the plan. Raises as `predict`.
        """
        return inputs(self, open_for_model(recording.alone, self.chain))
