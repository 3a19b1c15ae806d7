"""``tacpipe live``: a trained model forecasts while a rig runs, and the rig is recorded as ever."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tacpipe.errors import DeviceError, UsageError
from tacpipe.io import terminal

if TYPE_CHECKING:
    from tacpipe.io.termination import Ended
    from tacpipe.live.options import Options
    from tacpipe.live.supervisor import Supervisor
    from tacpipe.recording import trials as trials_of
    from tacpipe.recording.recorder import Recorder
    from tacpipe.recording.rig import Rig

SCHEMA_VERSION = 1
HELP = """

What the table [live] of the rig file states need not be given; options of the command win.

The streams of the rig go through the model's own stages, with no look-ahead, and at each row of the model its forecast is
published. With -o the rig is recorded as by `tacpipe acquire`, and forecasts, alarms and latencies are streams of the
recording. The recording has priority: where the computer does not keep up, forecasts are left out and counted.

Example: tacpipe live rig.toml --model models/forward -o data/live --publish ws:127.0.0.1:8765

A model of materials names the surface during a slide, with a probability of each, and at the end of the recording
what `tacpipe predict` gives. One of touch ranks candidate grasps on a cloud, which come to a stream of the sensor grasps.

Example: tacpipe live finger.toml --model models/material -o data/live --publish udp:127.0.0.1:9000

Example: tacpipe live rig.toml --model models/calibrated --quantiles 10,90   # as `tacpipe calibrate` gave it

Example: tacpipe live rig.toml --model models/forward --realtime   # on a computer that does other work too

Example: tacpipe live rig.toml --model models/forward --alarms-per-hour 6 --alarms-on data/segments --split data/split"""


def add(program: typer.Typer, summary: str) -> None:
    """Add the command to ``program``."""

    @program.command("live", help=summary + HELP)
    def live(
        rig: Annotated[Path, typer.Argument(help="Rig file, as of `tacpipe acquire`.")],
        model: Annotated[
            Path | None,
            typer.Option("--model", help="Trained model, as of `tacpipe train forward`, `material` or `touch`."),
        ] = None,
        plan: Annotated[
            str | None,
            typer.Option(
                "--plan",
                help="Source of plans: measured (motion continues; default), udp::PORT, ws:HOST:PORT, rig:STREAM (its "
                "set-points).",
            ),
        ] = None,
        plan_from: Annotated[
            str | None,
            typer.Option("--plan-from", help="IP address whose plans are accepted, for --plan udp:HOST:PORT."),
        ] = None,
        output: Annotated[Path | None, typer.Option("-o", "--output", help="Dataset to append recordings to.")] = None,
        publish: Annotated[
            list[str] | None,
            typer.Option("--publish", help="Where to publish: ws:HOST:PORT, udp:HOST:PORT, lsl:NAME, mcap:FILE."),
        ] = None,
        steps: Annotated[
            str | None, typer.Option("--steps", help="Steps ahead that are published; all by default.")
        ] = None,
        quantiles: Annotated[
            str | None,
            typer.Option(
                "--quantiles", help="Quantiles published next to forecasts, percent, as 10,90; none by default."
            ),
        ] = None,
        alarms_per_hour: Annotated[
            float | None,
            typer.Option(
                "--alarms-per-hour", help="False alarms an hour that each alarm may give; 0: no alarms (default)."
            ),
        ] = None,
        alarms_on: Annotated[
            Path | None, typer.Option("--alarms-on", help="Recordings that the levels of alarms are set on.")
        ] = None,
        split: Annotated[
            Path | None, typer.Option("--split", help="Split whose validation recordings --alarms-on means.")
        ] = None,
        duration: Annotated[
            float | None, typer.Option(help="Duration of the session, s; without it until Ctrl-C.")
        ] = None,
        label: Annotated[list[str] | None, typer.Option(help="Label of the recording, as name=value.")] = None,
        name: Annotated[
            str | None, typer.Option(help="Name of the recording; the time of its start by default.")
        ] = None,
        sensor: Annotated[
            str | None, typer.Option("--sensor", help="Sensor of the rig, of those that a model of materials knows.")
        ] = None,
        every_ms: Annotated[
            float | None, typer.Option("--every-ms", help="Time between two answers of a model of materials, ms [100].")
        ] = None,
        least: Annotated[
            float | None,
            typer.Option("--least", help="Fraction of a slide before which its material is unknown, 0 to 1 [0.25]."),
        ] = None,
        pause_s: Annotated[
            float | None,
            typer.Option(
                "--pause-s",
                help="Pause after which a slide is over and another may begin, s; 0: a recording is one slide [0].",
            ),
        ] = None,
        rank: Annotated[
            str | None,
            typer.Option("--rank", help="Criterion for a model of touch: contact (default), balance, level:0.4."),
        ] = None,
        settle_ms: Annotated[
            float | None, typer.Option("--settle-ms", help="Time after a row in which its samples are awaited, ms [2].")
        ] = None,
        realtime: Annotated[
            bool | None,
            typer.Option(
                "--realtime/--no-realtime", help="Real-time scheduling of the session, where the system allows it."
            ),
        ] = None,
        allow_look_ahead: Annotated[
            bool | None,
            typer.Option("--allow-look-ahead", help="Accept a model that was trained on rows that look ahead."),
        ] = None,
        quiet: Annotated[bool, typer.Option("--quiet", help="Print only errors on stderr.")] = False,
        as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    ) -> None:
        from tacpipe.live import preparation
        from tacpipe.live.settings import Settings
        from tacpipe.recording import rig as rigs

        if duration is not None and duration <= 0:
            raise UsageError("--duration must be above 0.")
        read = rigs.read(rig)
        given = {
            "model": None if model is None else str(model),
            "plan": plan,
            "plan_from": plan_from,
            "publish": tuple(publish) if publish else None,
            "steps": None if steps is None else _steps(steps),
            "quantiles": None if quantiles is None else _percents(quantiles),
            "alarms_per_hour": alarms_per_hour,
            "alarms_on": None if alarms_on is None else str(alarms_on),
            "split": None if split is None else str(split),
            "sensor": sensor,
            "every_ms": every_ms,
            "least": least,
            "pause_s": pause_s,
            "rank": rank,
            "settle_ms": settle_ms,
            "realtime": realtime,
            "allow_look_ahead": allow_look_ahead,
        }
        asked = Settings.of(read.live, str(rig), given)
        prepared = preparation.prepared(read, asked)
        attributes = {
            "live_model": prepared.model_digest,
            "live_plan": asked.plan,
            "live_alarms_per_hour": asked.alarms_per_hour,
            **({"live_pause_s": asked.pause_s, "live_least": asked.least} if asked.pause_s else {}),
        }
        _run(
            prepared.rig,
            prepared.options,
            output,
            name,
            duration,
            label or [],
            attributes,
            quiet=quiet,
            as_json=as_json,
        )


def _run(
    rig: Rig,
    options: Options,
    output: Path | None,
    name: str | None,
    duration_s: float | None,
    labels: list[str],
    attributes: dict[str, Any],
    *,
    quiet: bool,
    as_json: bool,
) -> None:
    """Run a session and print what it did."""
    from tacpipe.cli import acquire
    from tacpipe.datasets import directory
    from tacpipe.io.termination import Ended
    from tacpipe.live import session
    from tacpipe.recording import appending, trials
    from tacpipe.recording.recorder import Recorder
    from tacpipe.recording.view import View
    from tacpipe.store import location

    store = location.locate(*([] if output is None else [output]))
    plan: trials_of.Plan | None = None
    if output is not None:
        kept = {**acquire.attributes(labels, None), **attributes}
        plan = trials.Plan(output, acquire.checked_name(name), duration_s, attributes=kept)
        store.prepare()
        directory.check_output(store, output)
        appending.refuse_taken(output, plan.names)
    recorder = Recorder(rig)
    recorded: list[Any] = []
    lost: list[str] = []
    with (
        Ended() as ended,
        session.running(recorder, options, ended) as supervisor,
        recorder.open(),
        View(recorder.watches, quiet=quiet, more=lambda: _lines(supervisor)).open() as view,
    ):
        recorder.await_first(ended)
        if plan is not None and supervisor.alarms.get("levels"):
            levels = json.dumps(supervisor.alarms, separators=(",", ":"))
            plan = replace(plan, attributes={**plan.attributes, "live_alarm_levels": levels})
        if plan is None:
            _follow(recorder, duration_s, view, ended)
            lost = recorder.lost()
        else:
            recorded, lost = trials.run(recorder, store, plan, view, ended)
    figures = supervisor.figures()
    if not quiet:
        for one in recorded:
            terminal.note(one.line())
        for line in session.lines(figures):
            terminal.note(line)
    _report(output, recorded, figures, supervisor, lost, as_json=as_json)


def _lines(supervisor: Supervisor) -> list[str]:
    from tacpipe.live import session

    return session.lines(supervisor.figures())


def _follow(recorder: Recorder, duration_s: float | None, view: Any, ended: Ended) -> None:
    """Run the rig without recording it."""
    from tacpipe.recording import clock

    began_s = clock.now_s()
    recorder.follow()

    def over() -> bool:
        return ended() or (duration_s is not None and clock.now_s() - began_s >= duration_s)

    recorder.run(over, lambda: view.show(f"live, not recorded, {clock.now_s() - began_s:.0f} s"))


def _report(
    output: Path | None, recorded: list[Any], figures: Any, supervisor: Supervisor, lost: list[str], *, as_json: bool
) -> None:
    from dataclasses import asdict

    failed = DeviceError("\n".join(["What came is kept, but streams were lost on the way.", *lost])) if lost else None
    if as_json:
        value = {
            "schema_version": SCHEMA_VERSION,
            "output": None if output is None else str(output),
            "recordings": [asdict(one) for one in recorded],
            "live": figures,
            "alarm_levels": supervisor.alarms,
        }
        error = {} if failed is None else {"error": str(failed), "exit_code": failed.exit_code}
        terminal.result_json({**value, **error})
    elif output is not None:
        terminal.result(output)
    if failed is not None and as_json:  # the object on stdout holds the error already
        terminal.note(f"tacpipe: {failed}")
        raise typer.Exit(failed.exit_code)
    if failed is not None:
        raise failed


def _percents(text: str) -> tuple[int, ...]:
    """Return a list of percentages; none for an empty text."""
    try:
        return tuple(sorted({int(part) for part in text.split(",")})) if text else ()
    except ValueError:
        raise UsageError(f"--quantiles {text} is not a list of percentages, as 10,90.") from None


def _steps(text: str) -> tuple[int, ...]:
    """Return a list of steps; none for an empty text."""
    try:
        return tuple(int(part) for part in text.split(",")) if text else ()
    except ValueError:
        raise UsageError(f"--steps {text} is not a list of whole numbers, as 1,5,10.") from None
