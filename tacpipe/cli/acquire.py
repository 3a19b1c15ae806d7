"""Parse the options of ``tacpipe acquire`` and print its report; `stages/acquire.py` does the recording."""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tacpipe.errors import DONE, FAILED, DeviceError, TacpipeError, UsageError
from tacpipe.io import terminal
from tacpipe.plugins import registry
from tacpipe.store.location import locate

if TYPE_CHECKING:
    from tacpipe.recording.rig import Rig
    from tacpipe.recording.trials import Recorded

SCHEMA_VERSION = 1
RATE_OFF = 0.1  # maximum relative deviation from the rig file's rate that is not reported


def add(program: typer.Typer, help_text: str) -> None:
    """Add the command to ``program``.

    It raises `UsageError` for missing arguments and `DeviceError` if streams were lost.
    """

    @program.command("acquire", help=help_text)
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
        pictures: Annotated[
            int | None, typer.Option("--pictures", help="Port at which a browser on this computer shows the cameras.")
        ] = None,
        realtime: Annotated[
            bool, typer.Option("--realtime", help="Record before ordinary programs, if the system allows it.")
        ] = False,
        quiet: Annotated[bool, typer.Option("--quiet", help="Print only errors on stderr.")] = False,
        as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    ) -> None:
        terminal.set_quiet(quiet)
        from tacpipe.recording import rig as rig_of
        from tacpipe.recording import trials as trials_of

        commands: Any = registry.load_command("acquire")
        store = locate(*([] if output is None else [output]))
        if rig is None and not recover:
            raise UsageError("Missing argument RIG. Give a rig file: tacpipe acquire rig.toml -o data/recordings.")
        parsed_rig = rig_of.read(rig) if rig is not None else None
        if parsed_rig is not None and dry_run:
            terminal.result(_dry_run(commands, parsed_rig, as_json=as_json))
            return
        if parsed_rig is not None and output is None and not recover:
            raise UsageError("Missing option -o. Give the dataset of recordings to append to, as -o data/recordings.")
        began_s = time.monotonic()
        sealed, unsealed_count = commands.recover(store, output, quiet=quiet)
        if recover and not quiet:
            commands.report_spools_of_others(store)
        if parsed_rig is None or output is None or recover:
            _report(output, sealed, began_s, as_json=as_json)
            raise typer.Exit(FAILED if unsealed_count else DONE)
        plan = trials_of.RecordingPlan(
            output,
            trials_of.recording_name(name),
            duration,
            trials,
            start,
            stop,
            contact_count,
            trials > 1 if tare is None else tare,
            keep_spool,
            trials_of.attributes(label or [], note),
            pictures,
            realtime,
        )
        recorded, lost = commands.record(parsed_rig, store, plan, quiet=quiet)
        failed = DeviceError("\n".join(["What came is recorded and kept, but streams were lost on the way.", *lost]))
        _report(output, recorded, began_s, as_json=as_json, failed=failed if lost else None)
        if lost and as_json:  # The JSON object on stdout already contains the error.
            terminal.note(f"tacpipe: {failed}")
            raise typer.Exit(failed.exit_code)
        if lost:
            raise failed


def _dry_run(commands: Any, rig: Rig, *, as_json: bool) -> str:
    """Measure every stream of a rig and return the figures as lines or as one JSON object."""
    from tacpipe.recording.recorder import complete_rig
    from tacpipe.recording.watch import describe_figures

    completed = complete_rig(rig)
    figures = commands.measure(completed)
    if as_json:
        return json.dumps({"schema_version": SCHEMA_VERSION, "streams": {n: asdict(f) for n, f in figures.items()}})
    lines = []
    for name, measured in figures.items():
        expected_hz = completed.streams[name].sensor.rate_hz
        deviates = expected_hz and abs(measured.rate_hz / expected_hz - 1) > RATE_OFF
        lines.append(describe_figures(name, measured) + (f"; {expected_hz:g} Hz were expected" if deviates else ""))
    return "\n".join(lines)


def _report(
    output: Path | None,
    recorded: list[Recorded],
    began_s: float,
    *,
    as_json: bool,
    failed: TacpipeError | None = None,
) -> None:
    """Print the dataset's path or, for JSON, one object with the recordings and the error ``failed``, if there is one."""
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
