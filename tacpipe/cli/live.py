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
    from tacpipe.live.session import Described
    from tacpipe.live.supervisor import Supervisor
    from tacpipe.recording import trials as trials_of
    from tacpipe.recording.recorder import Recorder
    from tacpipe.recording.rig import Rig

SCHEMA_VERSION = 1
HELP = """

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
            Path, typer.Option("--model", help="Trained model, as of `tacpipe train forward`, `material` or `touch`.")
        ],
        plan: Annotated[
            str,
            typer.Option(
                "--plan",
                help="Source of plans: measured (motion continues), udp::PORT, ws:HOST:PORT, rig:STREAM (its set-points).",
            ),
        ] = "measured",
        output: Annotated[Path | None, typer.Option("-o", "--output", help="Dataset to append recordings to.")] = None,
        publish: Annotated[
            list[str] | None,
            typer.Option("--publish", help="Where to publish: ws:HOST:PORT, udp:HOST:PORT, lsl:NAME, mcap:FILE."),
        ] = None,
        steps: Annotated[str, typer.Option("--steps", help="Steps ahead that are published; all by default.")] = "",
        quantiles: Annotated[
            str,
            typer.Option(
                "--quantiles", help="Quantiles published next to forecasts, percent, as 10,90; none by default."
            ),
        ] = "",
        alarms_per_hour: Annotated[
            float,
            typer.Option("--alarms-per-hour", help="False alarms an hour that each alarm may give; 0: no alarms."),
        ] = 0.0,
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
            str, typer.Option("--sensor", help="Sensor of the rig, of those that a model of materials knows.")
        ] = "",
        every_ms: Annotated[
            float, typer.Option("--every-ms", help="Time between two answers of a model of materials, ms.")
        ] = 100.0,
        least: Annotated[
            float, typer.Option("--least", help="Fraction of a slide before which its material is unknown, 0 to 1.")
        ] = 0.25,
        rank: Annotated[
            str, typer.Option("--rank", help="Criterion for a model of touch: contact, balance, level:0.4.")
        ] = "contact",
        settle_ms: Annotated[
            float, typer.Option("--settle-ms", help="Time after a row in which its samples are awaited, ms.")
        ] = 2.0,
        realtime: Annotated[
            bool, typer.Option("--realtime", help="Real-time scheduling of the session, where the system allows it.")
        ] = False,
        quiet: Annotated[bool, typer.Option("--quiet", help="Print only errors on stderr.")] = False,
        as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    ) -> None:
        from tacpipe.live import description, publishing, scheduling, session
        from tacpipe.live.options import Options
        from tacpipe.recording import completing
        from tacpipe.recording import rig as rigs

        _check(duration, alarms_per_hour, alarms_on, split, settle_ms)
        _check_slides(every_ms, least)
        if realtime:
            scheduling.check()
        for address in publish or []:
            publishing.check(address)
        about, digest = description.described(model)
        if isinstance(about, session.Described):
            wanted = _steps(steps, about.horizon)
            about = replace(about, quantiles=_quantiles(quantiles, about))
        elif steps or quantiles or plan != session.MEASURED or alarms_per_hour:
            raise UsageError(
                f"{model} is of the kind {about.kind}; --steps, --quantiles, --plan and --alarms-per-hour are for forecasts."
            )
        else:
            wanted = ()
        asked = session.with_plan(rigs.read(rig), plan)
        found = session.with_own(completing.completed(asked), about, wanted)
        options = Options(
            str(model.absolute()),
            found.text,
            tuple(asked.streams),
            wanted,
            about.quantiles if isinstance(about, session.Described) else (),
            tuple(publish or []),
            alarms_per_hour,
            "" if alarms_on is None else str(alarms_on.absolute()),
            "" if split is None else str(split.absolute()),
            settle_ms,
            plan_from=session.targets_of(asked, plan),
            kind=about.kind,
            sensor=sensor,
            every_ms=every_ms,
            least=least,
            rank=rank,
            realtime=realtime,
        )
        attributes = {"live_model": digest, "live_plan": plan, "live_alarms_per_hour": alarms_per_hour}
        _run(found, options, output, name, duration, label or [], attributes, quiet=quiet, as_json=as_json)


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

    store = location.locate()
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


def _check(
    duration_s: float | None, alarms_per_hour: float, alarms_on: Path | None, split: Path | None, settle_ms: float
) -> None:
    if duration_s is not None and duration_s <= 0:
        raise UsageError("--duration must be above 0.")
    if alarms_per_hour < 0 or not alarms_per_hour < 1e6:
        raise UsageError(f"--alarms-per-hour is {alarms_per_hour:g}; it must be 0 or more.")
    if bool(alarms_per_hour) != (alarms_on is not None):
        raise UsageError(
            "--alarms-per-hour and --alarms-on belong together: the levels of alarms are set on recordings, as in "
            "`--alarms-per-hour 6 --alarms-on data/segments --split data/split`."
        )
    if split is not None and alarms_on is None:
        raise UsageError("--split has no effect without --alarms-on.")
    if not 0 <= settle_ms <= 1000:
        raise UsageError(f"--settle-ms is {settle_ms:g}; it must be between 0 and 1000.")


def _check_slides(every_ms: float, least: float) -> None:
    if not 10 <= every_ms <= 10_000:
        raise UsageError(f"--every-ms is {every_ms:g}; it must be between 10 and 10,000.")
    if not 0 < least <= 1:
        raise UsageError(f"--least is {least:g}; it must be above 0 and at most 1.")


def _quantiles(text: str, about: Described) -> tuple[int, ...]:
    """Return the levels in percent that are published. Raises `UsageError` for others than the model has."""
    from tacpipe.errors import TacpipeError
    from tacpipe.tasks import calibrated

    if not text:
        return ()
    try:
        found = tuple(sorted({int(part) for part in text.split(",")}))
    except ValueError:
        raise UsageError(f"--quantiles {text} is not a list of percentages, as 10,90.") from None
    try:
        calibrated.quantiles_of(about if about.percents else None, found)
    except TacpipeError as error:
        raise UsageError(str(error)) from error
    return found


def _steps(text: str, horizon: int) -> tuple[int, ...]:
    """Return the steps ahead that are published. Raises `UsageError` for others than the model predicts."""
    if not text:
        return tuple(range(1, horizon + 1))
    try:
        found = tuple(sorted({int(part) for part in text.split(",")}))
    except ValueError:
        raise UsageError(f"--steps {text} is not a list of whole numbers, as 1,5,10.") from None
    if found[0] < 1 or found[-1] > horizon:
        raise UsageError(f"--steps {text}: the model predicts 1 to {horizon} steps ahead.")
    return found
