"""A live session's model, opened: its chain for a rig, and the levels of its alarms on validation recordings."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from tacpipe.errors import FAILED, TacpipeError, UsageError
from tacpipe.live.options import Options
from tacpipe.recording import rig as rigs
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.live import alarms as alarms_of
from tacpipe.tasks.forward.live.alarms import Alarms
from tacpipe.tasks.forward.live.chain import Beginning, Chain
from tacpipe.tasks.forward.live.engine import Chainlike, Engine

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset
    from tacpipe.live.process import Engine as Working
    from tacpipe.recording.rig import Rig
    from tacpipe.sensors.sensor import Sensor


def engine(options: Options) -> Working:
    """Return the engine of a session. Raises `UsageError` where model, rig and recordings do not belong together."""
    from tacpipe.engine.pipeline import open_dataset

    model = open_dataset(options.model)
    rig = rigs.parse(options.rig)
    sensors = {name: rig.streams[name].sensor for name in options.streams}
    made = {"forecast": forecasts, "material": materials, "touch": touches}[options.kind]
    try:
        return made(options, model, rig, sensors)
    except TacpipeError as error:
        if error.exit_code != FAILED:
            raise
        raise UsageError(str(error)) from error  # the session was asked for with a rig that the model cannot read


def materials(options: Options, model: Dataset, rig: Rig, sensors: Mapping[str, Sensor]) -> Working:
    """Return the engine of a session with a model of materials. Raises as `engine`."""
    from tacpipe.tasks.material.live import opening as material_opening

    return material_opening.engine(options, model, sensors)


def touches(options: Options, model: Dataset, rig: Rig, sensors: Mapping[str, Sensor]) -> Working:
    """Return the engine of a session with a model of touch. Raises as `engine`."""
    from tacpipe.tasks.touch.live import ranking as touch_ranking
    from tacpipe.tasks.touch.live.engine import TouchEngine
    from tacpipe.tasks.touch.predictor import Predictor

    return TouchEngine(sensors, Predictor.load(model.files), touch_ranking.criterion(options.rank))


def forecasts(options: Options, model: Dataset, rig: Rig, sensors: Mapping[str, Sensor]) -> Engine:
    """Return the engine of a session with a model of future signals. Raises as `engine`."""
    forecaster = Forecaster.load(model.files)
    opened = functools.partial(
        chain,
        forecaster,
        model.source.chain,
        rig.master,
        options.plan_stream,
        quantiles=options.quantiles,
        allow_look_ahead=options.allow_look_ahead,
    )
    first: list[Alarms] = []

    def levels(made: Chainlike) -> Alarms:
        if not first:
            first.append(_alarms(options, model, made))
        return first[0]

    settle_ns = round(options.settle_ms * 1e6)
    found = Engine(sensors, opened, levels, options.steps or None, settle_ns=settle_ns, quantiles=options.quantiles)
    if options.steps and max(options.steps) > found.chain.horizon:
        raise UsageError(f"The model predicts 1 to {found.chain.horizon} steps ahead; give --steps of these.")
    forecaster.prepare_single()
    return found


def chain(
    forecaster: Forecaster,
    steps: Sequence[Mapping[str, Any]],
    master: str,
    plan_from: str,
    layouts: Mapping[str, pa.Schema],
    beginning: Beginning | None = None,
    *,
    quantiles: Sequence[int] = (),
    allow_look_ahead: bool = False,
) -> Chain:
    """Return the chain of a model for streams of these layouts, which continues another's session; raises as `Chain.of`."""
    return Chain.of(
        forecaster, steps, layouts, master, beginning, plan_from, quantiles, allow_look_ahead=allow_look_ahead
    )


def _alarms(options: Options, model: Dataset, made: Chainlike) -> Alarms:
    if not options.alarms_per_hour:
        return Alarms.unset(made.layout)
    from tacpipe.engine.pipeline import open_dataset

    recordings = open_dataset(options.alarms_on)
    if options.split:
        recordings = recordings.select(split=options.split, role="val")
    return on_recordings(model, recordings, options.alarms_per_hour)


def on_recordings(model: Dataset, recordings: Dataset, per_hour: float) -> Alarms:
    """Return alarms of a model with levels for ``per_hour`` false alarms each on recordings, each row's forecast made."""
    from tacpipe.tasks.forward import predictors, tracks
    from tacpipe.tasks.forward.alarms import Loads
    from tacpipe.tasks.forward.headline import MODEL
    from tacpipe.tasks.forward.slip_alarms import SlipAlarms
    from tacpipe.tasks.opened import Chain as Stages
    from tacpipe.tasks.opened import opened

    forecaster = Forecaster.load(model.files)
    loads, slipping = Loads(forecaster.codec.layout, forecaster.horizon), SlipAlarms.of(forecaster)
    for shard in opened(recordings, Stages(model)).recordings.values():
        track = tracks.track(shard, forecaster.codec, forecaster.pose)
        loads.begin(track)
        slipping.begin(track)
        for some in predictors.forecasts(forecaster, track, track.starts(forecaster.context, forecaster.horizon)):
            loads.add_one(MODEL, some.now, predictors.Prediction(some.features, some.count))
            slipping.add_one(MODEL, some.now, track.tactile[some.now], some.count)
    if not loads.truth:
        raise UsageError("There is no validation recording that alarms could be set on; give --alarms-on others.")
    return alarms_of.set_on(loads, slipping, MODEL, per_hour)
