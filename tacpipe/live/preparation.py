"""What a live session is started with, from a rig and what is asked for."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.live import description, own_streams, publishing, scheduling
from tacpipe.live.description import Described, Grasped, Surfaces
from tacpipe.live.options import Options
from tacpipe.live.settings import MEASURED, Settings
from tacpipe.recording import completing
from tacpipe.recording.rig import Rig
from tacpipe.tasks import calibrated
from tacpipe.tasks.forward.live import plans


@dataclass(frozen=True)
class Prepared:
    """A live session that may start."""

    rig: Rig  # with the session's own streams
    options: Options  # what the model's process is asked for
    model_digest: str


def prepared(rig: Rig, asked: Settings) -> Prepared:
    """Return what a session is started with.

    Raises `UsageError` that names option, or file and key, for what this computer, the model or the rig does not allow.
    """
    if asked.realtime:
        with asked.naming("realtime"):
            scheduling.check()
    with asked.naming("publish"):
        for address in asked.publish:
            publishing.check(address)
    with asked.naming("model"):
        about, digest = description.described(Path(asked.model), allow_look_ahead=asked.allow_look_ahead)
    about, steps = _forecast(about, asked) if isinstance(about, Described) else (_other(about, asked), ())
    with asked.naming("plan"):
        planned = plans.with_plan(rig, asked.plan, asked.plan_from)
    found = own_streams.added(completing.completed(planned), about, steps)
    options = Options(
        _absolute(asked.model),
        found.text,
        tuple(planned.streams),
        steps,
        about.quantiles if isinstance(about, Described) else (),
        asked.publish,
        asked.alarms_per_hour,
        _absolute(asked.alarms_on),
        _absolute(asked.split),
        asked.settle_ms,
        plan_stream=plans.targets_of(planned, asked.plan),
        kind=about.kind,
        sensor=asked.sensor,
        every_ms=asked.every_ms,
        least=asked.least,
        pause_s=asked.pause_s,
        rank=asked.rank,
        realtime=asked.realtime,
        allow_look_ahead=asked.allow_look_ahead,
    )
    return Prepared(found, options, digest)


def _forecast(about: Described, asked: Settings) -> tuple[Described, tuple[int, ...]]:
    """Return what a model of forecasts is asked for: itself with these quantiles, and the steps that are published."""
    with asked.naming("steps"):
        steps = asked.steps_of(about.horizon)
    with asked.naming("quantiles"):
        _check_quantiles(asked.quantiles, about)
    return replace(about, quantiles=tuple(sorted(set(asked.quantiles)))), steps


def _other(about: Surfaces | Grasped, asked: Settings) -> Surfaces | Grasped:
    """Return a model that forecasts nothing. Raises `UsageError` where it is asked for what only forecasts have."""
    if asked.steps or asked.quantiles or asked.plan != MEASURED or asked.alarms_per_hour:
        raise UsageError(
            f"{asked.model} is of the kind {about.kind}; "
            f"--steps, --quantiles, --plan and --alarms-per-hour are for forecasts."
        )
    return about


def _check_quantiles(percents: tuple[int, ...], about: Described) -> None:
    """Raise `UsageError` for quantiles that the model does not have."""
    if not percents:
        return
    try:
        calibrated.quantiles_of(about if about.percents else None, percents)
    except TacpipeError as error:
        raise UsageError(str(error)) from error


def _absolute(path: str) -> str:
    return str(Path(path).absolute()) if path else ""
