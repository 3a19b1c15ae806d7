"""A live session's model, opened: its chain for a rig, and the levels of its alarms on validation recordings."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.errors import UsageError
from tacpipe.live import alarms as alarms_of
from tacpipe.live.alarms import Alarms
from tacpipe.live.chain import Chain
from tacpipe.live.engine import Chainlike, Engine
from tacpipe.live.options import Options
from tacpipe.recording import rig as rigs
from tacpipe.tasks.forward.forecaster import Forecaster

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset

SLIP_COLUMN = "slip"  # where `tacpipe segment slips` states that the object slips


def engine(options: Options) -> Engine:
    """Return the engine of a session. Raises `TacpipeError` where model, rig and recordings do not belong together."""
    import tacpipe

    model = tacpipe.open(options.model)
    if not model.source.chain and not model.files:
        raise UsageError(f"{options.model} is not a model; give a trained one.")
    rig = rigs.parse(options.rig)
    sensors = {name: rig.streams[name].sensor for name in options.streams}
    forecaster = Forecaster.load(model.files)
    opened = functools.partial(chain, forecaster, model.source.chain, rig.master)
    first: list[Alarms] = []

    def levels(made: Chainlike) -> Alarms:
        if not first:
            first.append(_alarms(options, model, made))
        return first[0]

    found = Engine(sensors, opened, levels, options.steps or None, settle_ns=round(options.settle_ms * 1e6))
    if options.steps and max(options.steps) > found.chain.horizon:
        raise UsageError(f"The model predicts 1 to {found.chain.horizon} steps ahead; give --steps of these.")
    forecaster.prepare_single()
    return found


def chain(
    forecaster: Forecaster, steps: Sequence[Mapping[str, Any]], master: str, layouts: Mapping[str, pa.Schema]
) -> Chain:
    """Return the chain of a model for streams of these layouts; raises as `Chain.of`."""
    return Chain.of(forecaster, steps, layouts, master)


def _alarms(options: Options, model: Dataset, made: Chainlike) -> Alarms:
    if not options.alarms_per_hour:
        return Alarms.unset(made.layout)
    import tacpipe

    recordings = tacpipe.open(options.alarms_on)
    if options.split:
        recordings = recordings.select(split=options.split, role="val")
    return on_recordings(model, recordings, options.alarms_per_hour)


def on_recordings(model: Dataset, recordings: Dataset, per_hour: float) -> Alarms:
    """Return alarms of a model with levels for ``per_hour`` false alarms each on recordings, each row's forecast made."""
    from tacpipe.tasks.forward import tracks
    from tacpipe.tasks.forward.alarms import Loads
    from tacpipe.tasks.forward.predictors import MODEL, Prediction, forecasts
    from tacpipe.tasks.opened import Chain as Stages
    from tacpipe.tasks.opened import opened

    forecaster = Forecaster.load(model.files)
    loads = Loads(forecaster.codec.layout, forecaster.horizon)
    slips: list[Any] = []
    for shard in opened(recordings, Stages(model)).recordings.values():
        track = tracks.track(shard, forecaster.codec, forecaster.pose)
        loads.begin(track)
        for some in forecasts(forecaster, track, track.starts(forecaster.context, forecaster.horizon)):
            loads.add_one(MODEL, some.now, Prediction(some.features, some.count))
        slips.append(slips_of(shard))
    if not slips:
        raise UsageError("There is no validation recording that alarms could be set on; give --alarms-on others.")
    known = None if any(one is None for one in slips) else np.concatenate(slips)
    return alarms_of.set_on(
        np.concatenate(loads.truth),
        np.concatenate(loads.ahead[MODEL]),
        np.concatenate(loads.groups),
        known,
        loads.layout,
        horizon=loads.horizon,
        rate_hz=loads.rate_hz,
        per_hour=per_hour,
    )


def slips_of(shard: Any) -> Any:
    """Return where an object slips (time,), by label or the simulator's truth; None where nothing states that."""
    table = shard.columns()
    for name in (SLIP_COLUMN, "gt_slip"):
        if name in table.column_names:
            return np.asarray(table.column(name).to_numpy()) > 0
    return None
