"""Predict for recordings and for arrays: the model of the task ``forward`` that `tacpipe.load` returns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, cast, overload

from tacpipe.arrays import AnyFloats
from tacpipe.io.parquet import one_after_another
from tacpipe.tasks.forward import prediction
from tacpipe.tasks.forward.forecaster import Forecaster, WindowArrays
from tacpipe.tasks.opened import opened

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording

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
        ``xela1_taxel01_z_t5_q90``. Raises `UsageError` where the recordings did not go through the stages that
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
        `largest_level` goes unnoticed. A model without `largest_level` skips this check with a warning.
        """
        if plan is not None:
            window = cast("AnyFloats", data)
            return self.predict_quantiles(window, plan, quantiles) if quantiles else self.predict_windows(window, plan)
        recordings = opened(cast("Dataset | Recording", data), self.chain)
        return one_after_another(prediction.tables(self, recordings, sorted(set(steps)), sorted(set(quantiles))))

    def windows(self, recording: Recording) -> WindowArrays:
        """Return all windows of a recording as `predict` reads them: ``window``, ``plan`` and ``t_ns``, when each was known.

        Rows in gaps are in none of them. The recorded motion serves as the plan. Raises as `predict`.
        """
        return prediction.inputs(self, opened(recording.alone, self.chain))
