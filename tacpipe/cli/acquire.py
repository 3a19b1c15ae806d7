"""``tacpipe acquire``: record a rig, look at it without recording, or seal what a crash left behind."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tacpipe.errors import DONE, FAILED, DeviceError, TacpipeError, UsageError
from tacpipe.io import terminal

if TYPE_CHECKING:
    from tacpipe.plugins.stage import Attribute
    from tacpipe.recording.rig import Rig
    from tacpipe.recording.trials import Recorded
    from tacpipe.store.store import Store

SCHEMA_VERSION = 1
DRY_RUN_S = 3.0
NAME = re.compile(r"[\w-][\w.-]*")
RATE_OFF = 0.1  # Largest relative deviation from the rig file's rate that is not reported


def add(program: typer.Typer, summary: str) -> None:
    """Add the command to ``program``."""

    @program.command(
        "acquire",
        help=f"{summary}\n\nExample: tacpipe acquire rig.toml -o data/recordings --duration-s 30 --label material=cork",
    )
    def acquire(
        rig: Annotated[
            Path | None, typer.Argument(help="Rig file, in TOML; its format is documented under Rig file.")
        ] = None,
        output: Annotated[
            Path | None,
            typer.Option("-o", "--output", help="Dataset to append to."),
        ] = None,
        duration: Annotated[
            float | None,
            typer.Option("--duration-s", help="Duration of a recording, s; without it until Ctrl-C or --stop."),
        ] = None,
        trials: Annotated[int, typer.Option(help="Number of recordings, one after another.")] = 1,
        label: Annotated[list[str] | None, typer.Option(help="Label of every recording, as name=value.")] = None,
        note: Annotated[str | None, typer.Option(help="Free text, stored with every recording.")] = None,
        name: Annotated[
            str | None, typer.Option(help="Name of the recording; the time of its start by default.")
        ] = None,
        start: Annotated[str, typer.Option(help="Start of a trial: now, key, contact or tap.")] = "now",
        stop: Annotated[str, typer.Option(help="End of a trial in addition to --duration-s: key, contact or tap.")] = (
            "duration"
        ),
        contact_count: Annotated[
            float, typer.Option(help="Deviation from rest that counts as contact, in the sensor's unit.")
        ] = 50.0,
        tare: Annotated[
            bool | None,
            typer.Option("--tare/--no-tare", help="Tare the devices before each trial; default with --trials."),
        ] = None,
        dry_run: Annotated[
            bool, typer.Option("--dry-run", help="Open the streams and check their rates for 3 s; record nothing.")
        ] = False,
        recover: Annotated[
            bool, typer.Option("--recover", help="Complete recordings that a crash cut off, and exit.")
        ] = False,
        keep_spool: Annotated[
            bool,
            typer.Option("--keep-spool", help="Keep the raw bytes of the links; the path of the spool is printed."),
        ] = False,
        quiet: Annotated[bool, typer.Option("--quiet", help="Print only errors on stderr.")] = False,
        as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    ) -> None:
        terminal.set_quiet(quiet)
        from tacpipe.recording import rig as rig_of
        from tacpipe.recording import trials as trials_of
        from tacpipe.store.location import locate

        store = locate(*([] if output is None else [output]))
        if rig is None and not recover:
            raise UsageError("Missing argument RIG. Give a rig file: tacpipe acquire rig.toml -o data/recordings.")
        parsed_rig = rig_of.read(rig) if rig is not None else None
        if parsed_rig is not None and dry_run:
            terminal.result(_dry_run(parsed_rig, as_json=as_json))
            return
        if parsed_rig is not None and output is None and not recover:
            raise UsageError("Missing option -o. Give the dataset of recordings to append to, as -o data/recordings.")
        began_s = time.monotonic()
        sealed, unsealed_count = _recovered(store, output, quiet=quiet)
        if recover and not quiet:
            _report_others(store)
        if parsed_rig is None or output is None or recover:
            _report(output, sealed, began_s, as_json=as_json)
            raise typer.Exit(FAILED if unsealed_count else DONE)
        plan = trials_of.RecordingPlan(
            output,
            checked_name(name),
            duration,
            trials,
            start,
            stop,
            contact_count,
            trials > 1 if tare is None else tare,
            keep_spool,
            attributes(label or [], note),
        )
        recorded, lost = _record(parsed_rig, store, plan, quiet=quiet)
        failed = DeviceError("\n".join(["What came is recorded and kept, but streams were lost on the way.", *lost]))
        _report(output, recorded, began_s, as_json=as_json, failed=failed if lost else None)
        if lost and as_json:  # The JSON object on stdout has the error already.
            terminal.note(f"tacpipe: {failed}")
            raise typer.Exit(failed.exit_code)
        if lost:
            raise failed


def _record(rig: Rig, store: Store, plan: Any, *, quiet: bool) -> tuple[list[Recorded], list[str]]:
    from tacpipe.datasets import directory
    from tacpipe.io.termination import EndRequest
    from tacpipe.recording import appending, trials, triggers
    from tacpipe.recording.recorder import Recorder, complete_rig
    from tacpipe.recording.watch import RigView

    for value, option, choices in ((plan.start, "--start", triggers.STARTS), (plan.stop, "--stop", triggers.STOPS)):
        if value not in choices:
            raise UsageError(f"There is no {option} {value}; it must be one of {', '.join(choices)}.")
    checked_name(plan.name)
    if plan.trials < 1 or (plan.duration_s is not None and plan.duration_s <= 0):
        raise UsageError("--trials and --duration-s must be above 0.")
    if plan.trials > 1 and plan.stop == "duration" and plan.duration_s is None:
        raise UsageError("--trials needs --duration-s or --stop, or the first trial never ends.")
    store.prepare()
    directory.check_output(store, plan.output)
    appending.refuse_taken(plan.output, plan.names)
    recorder = Recorder(complete_rig(rig))
    with EndRequest() as is_over, recorder.open(), RigView(recorder.watches, quiet=quiet).open() as view:
        recorder.await_first(is_over)
        recorded, lost = trials.run(recorder, store, plan, view, is_over)
    for recording in recorded if not quiet else ():
        terminal.note(recording.line())
    return recorded, lost


def _recovered(store: Store, output: Path | None, *, quiet: bool) -> tuple[list[Recorded], int]:
    """Seal the spools that earlier processes of this user left; return the recordings and the number not sealed."""
    from tacpipe.recording import trials

    sealed, unsealed_count = list[Any](), 0
    for recovered in trials.recover_spools(store, output):
        if isinstance(recovered, trials.Unsealed):
            terminal.note(f"tacpipe: {recovered.line()}")
            unsealed_count += 1
            continue
        sealed.append(recovered)
        if not quiet:
            terminal.note(f"recovered {recovered.line()}")
    return sealed, unsealed_count


def _report_others(store: Store) -> None:
    """Print the owners of the spools that other users left in a shared store."""
    from tacpipe.recording import trials

    for folder, owner in trials.spools_of_others(store).items():
        terminal.note(f"The spool {folder} belongs to {owner}, who alone can seal it.")


def _dry_run(rig: Rig, *, as_json: bool) -> str:
    """Open every stream and return its figures. Raises `DeviceError` for streams that do not open or send nothing."""
    from dataclasses import asdict

    from tacpipe.io.termination import EndRequest
    from tacpipe.recording import clock
    from tacpipe.recording.recorder import Recorder, complete_rig
    from tacpipe.recording.watch import describe_figures

    rig = complete_rig(rig)
    recorder = Recorder(rig)
    with EndRequest() as is_over, recorder.open():
        recorder.await_first(is_over)
        until_s = clock.now_s() + DRY_RUN_S
        recorder.run(lambda: is_over() or clock.now_s() > until_s)
        figures = {name: watch.figures(clock.now_ns()) for name, watch in recorder.watches.items()}
    if as_json:
        return json.dumps({"schema_version": SCHEMA_VERSION, "streams": {n: asdict(f) for n, f in figures.items()}})
    lines = []
    for name, measured in figures.items():
        expected_hz = rig.streams[name].sensor.rate_hz
        off = expected_hz and abs(measured.rate_hz / expected_hz - 1) > RATE_OFF
        lines.append(describe_figures(name, measured) + (f"; {expected_hz:g} Hz were expected" if off else ""))
    return "\n".join(lines)


def checked_name(name: str | None) -> str:
    """Return the name of a recording, by default the current time. Raises `UsageError` for an invalid file name."""
    from tacpipe.recording import spool_folders

    recording_name = name or time.strftime("%Y%m%d-%H%M%S", time.gmtime())
    if not NAME.fullmatch(recording_name) or not spool_folders.is_name(recording_name):
        raise UsageError(
            f"--name {recording_name!r} names no file; take letters, digits, _, - and dots, no dot in front."
        )
    return recording_name


def attributes(labels: list[str], note: str | None) -> dict[str, Attribute]:
    """Return labels and a note as attributes of a recording. Raises `UsageError` for malformed labels."""
    from tacpipe.datasets import labels as labels_of

    parsed = labels_of.parse(labels, None, include=False) if labels else {}
    return {**parsed, **({"note": note} if note else {})}


def _report(
    output: Path | None,
    recorded: list[Recorded],
    began_s: float,
    *,
    as_json: bool,
    failed: TacpipeError | None = None,
) -> None:
    from dataclasses import asdict

    if as_json:
        seconds = round(time.monotonic() - began_s, 3)
        described = [asdict(recording) for recording in recorded]
        output_text = None if output is None else str(output)
        rows = sum(sum(recording.rows.values()) for recording in recorded)
        value = {
            "schema_version": SCHEMA_VERSION,
            "output": output_text,
            "recordings": described,
            "rows": rows,
            "seconds": seconds,
        }
        error = {} if failed is None else {"error": str(failed), "exit_code": failed.exit_code}
        terminal.result_json({**value, **error})
        return
    if output is not None:
        terminal.result(output)
