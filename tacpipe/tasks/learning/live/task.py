"""Run models of quantities and of classes live: session plan, engine, and causal predictions."""

from __future__ import annotations

import functools
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError
from tacpipe.live.settings import LiveTask, SessionPlan, Settings, TaskSettings
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.sensors.live import Declaration
from tacpipe.tasks.learning.live.messages import CLASS, CLASSES, ESTIMATE, ESTIMATES

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Model, Recording
    from tacpipe.io import Json
    from tacpipe.recording.rig import Rig
    from tacpipe.sensors.sensor import Options, Sensor
    from tacpipe.store.records import Step
    from tacpipe.tasks.learning.live.windows import LiveWindows, WindowEngine
    from tacpipe.tasks.learning.model import LearnedModel
    from tacpipe.tasks.task import PredictionRequest

SYNCHRONIZE, BLOCKS = "synchronize", "segment.blocks"
CAUSAL = (SYNCHRONIZE, BLOCKS)  # stages whose rows a session computes; blocks only cut recordings


class LearnedLive(LiveTask):
    """An answer at each row."""

    settings: ClassVar[type[TaskSettings]] = TaskSettings
    stream: ClassVar[str]  # the recorded stream

    def plan(self, model: Dataset, rig: Rig, settings: Settings) -> SessionPlan:
        """Return the streams of answers and latencies.

        Raises `TacpipeError` if the model reads what a session cannot know, and `UsageError` if the rig lacks a stream.
        """
        config = model_files.tree(model.files, model_files.CONFIG, {"inputs": list, "answers": dict, "params": dict})
        check_causal(model.source.chain, config, allow_look_ahead=settings.allow_look_ahead)
        require_inputs(config, model.source.chain, rig)
        targets = config["answers"].get("targets")
        options: Options = {
            "channels": [target["name"] for target in targets] if targets else config["answers"]["classes"]
        }
        if targets:
            options = {**options, "unit": ",".join(target["unit"] or "1" for target in targets)}
        return SessionPlan(rig, settings.task, {self.stream: options, "latency": {}})

    def engine(self, model: Dataset, rig: Rig, sensors: Mapping[str, Sensor], settings: Settings) -> WindowEngine:
        """Return the engine of a session, which has answered its first window.

        Raises `UsageError` if a stream or a channel that the model reads is missing.
        """
        from tacpipe.live.decoding import likely_schema
        from tacpipe.tasks.learning.live.answering import AnswerEngine
        from tacpipe.tasks.learning.model import LearnedModel

        loaded = LearnedModel.load(model.files)
        schemas = {name: likely_schema(sensor) for name, sensor in sensors.items()}
        open_windows = functools.partial(
            windows_for, loaded, model.source.chain, schemas, rig.master or str(loaded.config["master"])
        )
        engine = AnswerEngine(loaded, sensors, open_windows, settle_ns=round(settings.settle_ms * 1e6))
        engine.prepare()  # this imports and allocates everything, so that the first sample does not wait
        return engine

    def predict(self, model: Model, recordings: Dataset, request: PredictionRequest) -> Result:
        """Return the answers that a session would publish for recordings as they were recorded."""
        from tacpipe.tasks.learning.model import LearnedModel

        loaded = LearnedModel.load(model.files)
        chain = model.source.chain
        check_causal(chain, loaded.config, allow_look_ahead=request.allow_look_ahead)
        levels = loaded.quantile_places(request.quantiles)
        return Result(
            {
                name: RecordingOutput(causal_answers(loaded, chain, recording, levels), {"causal": True})
                for name, recording in sorted(recordings.recordings.items())
            }
        )

    def evaluate(self, model: Model, recordings: Dataset) -> Result:
        """Return the evaluation of recorded sessions."""
        from tacpipe.tasks.learning.live import evaluation
        from tacpipe.tasks.learning.model import LearnedModel

        predict = functools.partial(causal_answers, LearnedModel.load(model.files), model.source.chain)
        return evaluation.evaluate(model, recordings, self.stream, predict)


class RegressLive(LearnedLive):
    """Estimates of quantities."""

    declaration: ClassVar[Declaration] = ESTIMATES
    stream: ClassVar[str] = ESTIMATE


class ClassifyLive(LearnedLive):
    """Names of classes."""

    declaration: ClassVar[Declaration] = CLASSES
    stream: ClassVar[str] = CLASS


def causal_answers(
    model: LearnedModel, chain: Sequence[Step], recording: Recording, levels: Sequence[int] = ()
) -> pa.Table:
    """Return the answers of a session to a recording as it was recorded, with the quantiles at these indices."""
    from tacpipe.live.stages import arrival_streams, streams_as_recorded
    from tacpipe.tasks.learning.live.answering import outputs_of
    from tacpipe.tasks.learning.live.windows import replayed

    tables = streams_as_recorded(recording)
    schemas = {stream: table.schema for stream, table in tables.items()}
    master = str(recording.attributes.get("master") or model.config["master"])
    windows = windows_for(model, chain, schemas, master, None, arrival_streams(recording, tables))
    rows = [row for row in replayed(windows, tables) if row.windows is not None]
    return model.to_table([row.t_ns for row in rows], outputs_of(model, rows), levels)


def check_causal(chain: Sequence[Step], config: Mapping[str, Any], *, allow_look_ahead: bool) -> None:
    """Raise `TacpipeError` for a model of rows that a session cannot compute, or that looks ahead."""
    from tacpipe.live.stages import refuse_look_ahead

    require_stages(chain, CAUSAL)
    params = config["params"]
    if params.get("recentre") and "level_from" not in config:
        raise TacpipeError(
            f"The model subtracts the median over all rows of each {params['recentre']}, which a session cannot know. Run "
            f"`tacpipe recentre MODEL RECORDINGS -o ADAPTED` on recordings of the session, and give the new model."
        )
    if not allow_look_ahead:
        refuse_look_ahead(config, chain)


def require_stages(chain: Sequence[Step], allowed: Collection[str] = ()) -> None:
    """Raise `TacpipeError` for a model that was trained on the output of a stage that a session does not run."""
    for step in chain:
        if step["stage"] not in allowed:
            or_synchronized = ", or on the output of `tacpipe synchronize`" if SYNCHRONIZE in allowed else ""
            raise TacpipeError(
                f"The model was trained on the output of `tacpipe {step['stage'].replace('.', ' ')}`, which a session does "
                f"not run. Train it on recordings{or_synchronized}."
            )


def require_inputs(config: Mapping[str, Any], chain: Sequence[Step], rig: Rig) -> None:
    """Raise `UsageError` if a rig lacks a stream or a channel of a model with this configuration."""
    from tacpipe.live.decoding import likely_schema
    from tacpipe.tasks.learning.live.windows import recorded_names

    schemas = {name: likely_schema(stream.sensor) for name, stream in rig.streams.items()}
    synchronized = any(step["stage"] == SYNCHRONIZE for step in chain)
    for stream in config["inputs"]:
        recorded_names(stream["stream"], stream["channels"], schemas, synchronized=synchronized)


def windows_for(
    model: LearnedModel,
    chain: Sequence[Step],
    schemas: Mapping[str, pa.Schema],
    master: str,
    beginning: Json | None,
    arrivals: Collection[str] = (),
) -> LiveWindows:
    """Return the windows of a model in streams with these ``schemas``, which continue a beginning if it is not None.

    Raises `UsageError` if a stream or a channel is missing.
    """
    from tacpipe.live.stages import stage_params
    from tacpipe.tasks.learning.live.windows import RecordedWindows, SynchronizedWindows

    synchronize = next((stage_params(step) for step in chain if step["stage"] == SYNCHRONIZE), None)
    if synchronize is None:
        return RecordedWindows(model.inputs, beginning)
    return SynchronizedWindows(model.inputs, beginning, synchronize, schemas, synchronize.master or master, arrivals)
