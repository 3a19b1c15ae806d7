"""Add the command ``tacpipe live``, which runs a trained model on a live rig and records the rig."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tacpipe.datasets import directory
from tacpipe.errors import DeviceError, UsageError
from tacpipe.io import terminal
from tacpipe.io.termination import EndRequest
from tacpipe.live import settings
from tacpipe.plugins import fields, params
from tacpipe.recording import clock
from tacpipe.store import location

if TYPE_CHECKING:
    from tacpipe.io.termination import EndRequest
    from tacpipe.live.preparation import PreparedSession
    from tacpipe.live.session import Supervisor
    from tacpipe.recording import trials as trials_of
    from tacpipe.recording.recorder import Recorder
    from tacpipe.recording.rig import Rig

SCHEMA_VERSION = 1
REPEATED = ("publish",)  # settings whose option may be repeated, once per item
HELP = """

The table [live] of the rig file can contain the settings. Options of the command override it.

The streams of the rig pass through the stages of the model without look-ahead, and the predictions are published. With -o,
the rig is recorded as by `tacpipe acquire`, and the recording also contains predictions, alarms and latencies. The recording
has priority: if the computer is too slow, predictions are skipped and counted.

Example: tacpipe live rig.toml --model models/forward -o data/live --publish ws:127.0.0.1:8765

Example: tacpipe live finger.toml --model models/surface -o data/live --publish udp:127.0.0.1:9000

Example: tacpipe live rig.toml --model models/calibrated --quantiles 10,90   # from `tacpipe calibrate`

Example: tacpipe live rig.toml --model models/forward --realtime   # on a busy computer

Example: tacpipe live rig.toml --model models/slip --plan udp::9000 --alarms-per-minute 1

Example: tacpipe live --replay data/recordings --model models/forward --publish ws:127.0.0.1:8765"""


def add(program: typer.Typer, summary: str) -> None:
    """Add the command ``live`` to ``program``, with an option for each setting of every task whose models can run live.

    The command raises `UsageError` for a duration that is not above 0.
    """

    def live(
        rig: Annotated[Path | None, typer.Argument(help="Rig file, as for `tacpipe acquire`.")] = None,
        replay: Annotated[
            Path | None, typer.Option("--replay", help="Recordings that are replayed in place of a rig.")
        ] = None,
        output: Annotated[Path | None, typer.Option("-o", "--output", help="Dataset to append recordings to.")] = None,
        duration: Annotated[
            float | None, typer.Option("--duration-s", help="Duration of the session, s; without it until Ctrl-C.")
        ] = None,
        label: Annotated[list[str] | None, typer.Option(help="Label of the recording, as name=value.")] = None,
        name: Annotated[
            str | None, typer.Option(help="Name of the recording; the time of its start by default.")
        ] = None,
        pictures: Annotated[
            int | None, typer.Option("--pictures", help="Port at which a browser on this computer shows the cameras.")
        ] = None,
        quiet: Annotated[bool, typer.Option("--quiet", help="Print only errors on stderr.")] = False,
        as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
        **options: Any,
    ) -> None:
        from tacpipe.live import preparation
        from tacpipe.recording import rig as rigs

        if duration is not None and duration <= 0:
            raise UsageError("--duration-s must be above 0.")
        option_texts = {key: tuple(value) if isinstance(value, list) else value for key, value in options.items()}
        source = rig or replay
        if source is None or (rig and replay):
            raise UsageError("Give a rig file, or --replay with recordings that are replayed in its place.")
        with _replayed(source) if replay else contextlib.nullcontext(rigs.read(source)) as parsed_rig:
            session = preparation.prepare(parsed_rig, str(source), option_texts)
            _run(session, output, name, duration, label or [], pictures, quiet=quiet, as_json=as_json)

    signature = inspect.signature(live, eval_str=True)
    common_parameters = [
        parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for parameter in signature.parameters.values()
        if parameter.kind != inspect.Parameter.VAR_KEYWORD
    ]
    full_signature = signature.replace(parameters=[*common_parameters, *_options()])
    function: Any = live
    function.__signature__ = full_signature  # Typer reads both the signature and the annotations.
    function.__annotations__ = {name: parameter.annotation for name, parameter in full_signature.parameters.items()}
    program.command("live", help=summary + HELP)(live)


@contextlib.contextmanager
def _replayed(path: Path) -> Iterator[Rig]:
    """Yield a rig that sends the recordings at ``path`` again and again during the block."""
    import tacpipe
    from tacpipe.simulation.emulation.emulator import ReplayEmulator
    from tacpipe.simulation.emulation.replay import rig_of

    recordings = tacpipe.open(path)
    with ReplayEmulator(rig_of(recordings[0]), recordings) as emulator:
        yield emulator.rig


def _options() -> list[inspect.Parameter]:
    """Return the options of common settings and of each task's settings; the first task to define a name wins."""
    options = _options_for(settings.Settings, None)
    for task, kind in settings.task_settings().items():
        options |= {
            name: option for name, option in _options_for(kind, f"Models of {task}").items() if name not in options
        }
    return list(options.values())


def _options_for(kind: type[Any], panel: str | None) -> dict[str, inspect.Parameter]:
    """Return an option for each setting of a class, by name, in a panel of the help."""
    helps = params.comments_of(kind)
    options = {}
    for name in settings.keys(kind):
        annotation = fields.hints(kind)[name]
        flag = settings.option(name)
        is_flag = fields.bare(annotation) is bool
        flags = [f"{flag}/--no-{flag.removeprefix('--')}"] if is_flag else [flag]
        option_type: Any = str | None
        if is_flag:
            option_type = bool | None
        elif name in REPEATED:
            option_type = list[str] | None
        about = helps.get(name, "")
        option = typer.Option(
            None,
            *flags,
            help=f"{about}." if about else "",
            show_default=False,
            metavar="NUMBER" if fields.bare(annotation) in (int, float) else None,
            rich_help_panel=panel,
        )
        options[name] = inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=option, annotation=option_type)
    return options


def _run(
    prepared: PreparedSession,
    output: Path | None,
    name: str | None,
    duration_s: float | None,
    labels: list[str],
    pictures: int | None,
    *,
    quiet: bool,
    as_json: bool,
) -> None:
    """Run a session, with a recording if there is an ``output``, and print its summary.

    Raises the errors of the rig and the model, and ends the program with an error if streams were lost.
    """
    from tacpipe.live import session
    from tacpipe.recording import appending, trials
    from tacpipe.recording.pictures import serve_pictures
    from tacpipe.recording.recorder import Recorder
    from tacpipe.recording.watch import RigView

    store = location.locate(*([] if output is None else [output]))
    plan: trials_of.RecordingPlan | None = None
    if output is not None:
        attributes = {**trials.attributes(labels, None), **prepared.attributes}
        plan = trials.RecordingPlan(output, trials.recording_name(name), duration_s, attributes=attributes)
        store.prepare()
        directory.check_output(store, output)
        appending.refuse_existing_names(output, plan.names)
    recorder = Recorder(prepared.rig, realtime=prepared.options.settings.realtime)
    recorded: list[Any] = []
    lost: list[str] = []
    with (
        EndRequest() as is_over,
        session.run_model(recorder, prepared.options, is_over) as supervisor,
        recorder.open(),
        serve_pictures(recorder.watches, pictures),
        RigView(recorder.watches, quiet=quiet, footer=lambda: _lines(supervisor)).open() as view,
    ):
        recorder.await_first(is_over)
        if plan is None:
            _run_unrecorded(recorder, duration_s, view, is_over)
            lost = recorder.lost()
        else:
            recorded, lost = trials.run(recorder, store, plan, view, is_over)
    figures = supervisor.figures()
    if not quiet:
        for recording in recorded:
            terminal.note(recording.line())
        for line in session.describe_figures(figures):
            terminal.note(line)
    _report(output, recorded, figures, supervisor, lost, as_json=as_json)


def _lines(supervisor: Supervisor) -> list[str]:
    from tacpipe.live import session

    return session.describe_figures(supervisor.figures())


def _run_unrecorded(recorder: Recorder, duration_s: float | None, view: Any, is_over: EndRequest) -> None:
    """Run the rig without recording until it ``is_over`` or ``duration_s`` have passed; None for no limit."""
    start_s = clock.now_s()
    recorder.follow()

    def should_end() -> bool:
        return is_over() or (duration_s is not None and clock.now_s() - start_s >= duration_s)

    recorder.run(should_end, lambda: view.show(f"live, not recorded, {clock.now_s() - start_s:.0f} s"))


def _report(
    output: Path | None, recorded: list[Any], figures: Any, supervisor: Supervisor, lost: list[str], *, as_json: bool
) -> None:
    """Print the dataset's path, or one JSON object.

    Raises `DeviceError`, or exits with its code for JSON, if streams were lost.
    """
    failed = DeviceError("\n".join(["What came is kept, but streams were lost on the way.", *lost])) if lost else None
    if as_json:
        value = {
            "schema_version": SCHEMA_VERSION,
            "output": None if output is None else str(output),
            "recordings": [asdict(recording) for recording in recorded],
            "live": figures,
        }
        error = {} if failed is None else {"error": str(failed), "exit_code": failed.exit_code}
        terminal.result_json({**value, **error})
    elif output is not None:
        terminal.result(output)
    if failed is not None and as_json:  # The JSON object on stdout already contains the error.
        terminal.note(f"tacpipe: {failed}")
        raise typer.Exit(failed.exit_code)
    if failed is not None:
        raise failed
