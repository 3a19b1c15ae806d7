"""Add the commands of ``tacpipe sensors``, which list, identify and emulate sensors."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypedDict

import typer

from tacpipe.errors import DEVICE, TacpipeError
from tacpipe.io import config_text, terminal
from tacpipe.plugins import registry
from tacpipe.sensors.sensor import Options

if TYPE_CHECKING:
    from tacpipe.links.link import Address
    from tacpipe.links.probing import Report

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
SCHEMA_VERSION = 1


def add(program: typer.Typer, summary: str) -> None:
    """Add the group ``sensors`` to ``program``."""
    group = typer.Typer(help=summary, no_args_is_help=True, rich_markup_mode=None)
    group.command("list")(list_)
    group.command("probe")(probe)
    group.command("emulate", help=EMULATE_SUMMARY + EMULATE_EXAMPLE)(emulate)
    program.add_typer(group, name="sensors")


def list_(as_json: AsJson = False) -> None:
    """List the sensors that a rig file can name.

    Prints the links, the rate and a description of each.

    Example: tacpipe sensors list
    """
    rows = [_sensor_row(name) for name in registry.sensors()]
    if as_json:
        terminal.result_json({"schema_version": SCHEMA_VERSION, "sensors": rows})
        return
    lines = [["sensor", "links", "rate", "baud", "what it is"]]
    for row in rows:
        values = {"links": row["links"], "rate_hz": row["rate_hz"], "baud": row["baud"], "summary": row["summary"]}
        lines.append([row["name"], *(_cell(key, value) for key, value in values.items())])
    widths = [max(len(cells[column]) for cells in lines) for column in range(len(lines[0]))]
    for cells in lines:
        terminal.result("  ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)).rstrip())


def probe(
    port: Annotated[
        str | None, typer.Argument(help="Address such as serial:/dev/ttyACM0, or a path; without it, all ports.")
    ] = None,
    passive: Annotated[bool, typer.Option("--passive", help="Only listen; send nothing to a device.")] = False,
    as_json: AsJson = False,
) -> None:
    """Identify the sensor on each port, with the evidence.

    Listens first, then sends the requests with which each driver starts a recording. A port that is not USB is only
    listened to, unless it is named. Exits with 5 if nothing was recognised.

    Example: tacpipe sensors probe serial:/dev/ttyACM0
    """
    from tacpipe.links import probing

    ports = [(_address(port), _usb_id(port))] if port else list(probing.list_addresses())
    reports = []
    for address, usb_id in ports:
        listen_only = passive or (port is None and not usb_id)  # An internal port may be a console.
        reports.append(probing.probe(address, usb_id, passive=listen_only, progress=_report))
        if not as_json:
            terminal.result(_text(reports[-1]))
    if as_json:
        terminal.result_json({"schema_version": SCHEMA_VERSION, "ports": [_json(report) for report in reports]})
    elif not ports:
        terminal.result("No serial port and no HID device is present. Plug one in, or name an address.")
    if not any(report.findings for report in reports):
        raise typer.Exit(DEVICE)


class SensorRow(TypedDict):
    """A row in the list of sensors."""

    name: str
    links: list[str]
    rate_hz: float | None
    baud: int | None
    summary: str
    exclusive: str


def _sensor_row(name: str) -> SensorRow:
    """Return the row of a sensor in the list; one that cannot be loaded has its error as the summary."""
    try:
        kind = registry.load_sensor(name)
    except TacpipeError as error:  # An error in one plug-in must not hide the other sensors.
        return {"name": name, "links": [], "rate_hz": None, "baud": None, "summary": str(error), "exclusive": ""}
    defaults = {field.name: field.default for field in dataclasses.fields(kind)}
    described = {key: value for key, value in defaults.items() if value is not dataclasses.MISSING}
    baud = described.get("baud") if "serial" in kind.links else None
    return {
        "name": name,
        "links": list(kind.links),
        "rate_hz": described.get("rate_hz"),
        "baud": baud,
        "summary": kind.summary,
        "exclusive": kind.exclusive,
    }


def _cell(key: str, value: Any) -> str:
    """Return a value of the list of sensors as text, "-" for none."""
    if not value:
        return "-"
    if key == "links":
        return ", ".join(value)
    if key == "rate_hz":
        return f"{value:g} Hz"
    return f"{value:,}" if key == "baud" else str(value)


def _address(port: str) -> Address:
    from tacpipe.links import link

    return link.parse(f"serial:{port}" if port.startswith("/") else port)


def _usb_id(port: str) -> str:
    """Return the vendor and product of a USB serial port, or "" for any other address."""
    from tacpipe.links import ports

    if not port.startswith(("/", "serial:")):
        return ""
    return next(
        (serial_port.usb_id for serial_port in ports.serial_ports() if serial_port.address == str(_address(port))), ""
    )


def _report(step: str) -> None:
    if sys.stderr.isatty():
        terminal.note(step)


def _text(report: Report) -> str:
    """Return the report on a port as text: the recognised sensors and lines for a rig file, or why there are none."""
    if report.error:
        return f"{report.address}: {report.error}"
    if not report.heard and not report.findings:
        return f"{report.address}: no bytes, whichever driver asked. Check that the device is switched on."
    if not report.findings:
        described = f"{report.address}: {report.heard:,} bytes came that match no driver"
        return f"{described}; describe the sensor with `generic`, or with `lines` if it sends text."
    first, *alternatives = report.findings
    baud_text = f" at {report.baud:,} baud" if report.baud else ""
    request_text = " once asked" if report.requested else ""
    lines = [f"{report.address} speaks {first}{baud_text}{request_text}."]
    lines += [f"    or {alternative}" for alternative in alternatives]
    return "\n".join([*lines, *(f"    {line}" for line in _stanza(report))])


def _stanza(report: Report) -> list[str]:
    """Return rig file lines for the most likely sensor, with comments on guessed options."""
    candidate = report.findings[0].candidate
    options = dict(candidate.options)
    if report.baud and report.baud != type(candidate.sensor).__dict__.get("baud"):
        options["baud"] = report.baud
    notes = candidate.sensor.guesses
    option_lines = [f"options = {config_text.toml_value(options)}"] if options else []
    return [
        "[[stream]]",
        f'name = "{candidate.kind.replace("-", "_")}"',
        f'sensor = "{candidate.kind}"',
        f'transport = "{report.address}"',
        *(_format_options(options, notes) if notes else option_lines),
    ]


def _format_options(options: Options, notes: Mapping[str, str]) -> list[str]:
    """Return options with their notes as a TOML table, one per line; lists of tables span several lines."""
    lines = ["", "[stream.options]"]
    for name, value in options.items():
        note = f"  # {notes[name]}" if name in notes else ""
        if isinstance(value, list) and any(isinstance(item, Mapping) for item in value):
            lines += [f"{name} = [{note}", *(f"    {config_text.toml_value(item)}," for item in value), "]"]
        else:
            lines.append(f"{name} = {config_text.toml_value(value)}{note}")
    return lines


class FindingJson(TypedDict):
    """A sensor that may have sent the bytes, in the format of ``--json``."""

    sensor: str
    options: Options
    frames: int
    rate_hz: float
    explained: float
    chance: float


class PortJson(TypedDict):
    """Findings at an address, in the format of ``--json``."""

    address: str
    baud: int | None
    asked: bool
    bytes: int
    error: str | None
    certain: bool
    findings: list[FindingJson]


def _json(report: Report) -> PortJson:
    """Return the JSON value of the report on a port."""
    return {
        "address": report.address,
        "baud": report.baud,
        "asked": report.requested,
        "bytes": report.heard,
        "error": report.error or None,
        "certain": report.certain,
        "findings": [
            {
                "sensor": finding.name,
                "options": dict(finding.candidate.options),
                "frames": finding.frames,
                "rate_hz": round(finding.rate_hz, 3),
                "explained": round(finding.explained, 6),
                "chance": round(finding.chance, 6),
            }
            for finding in report.findings
        ],
    }


EMULATE_SUMMARY = "Replay recordings as the devices of a rig."
EMULATE_EXAMPLE = (
    "\n\nEach stream sends its recorded samples at their times, again and again, as its sensor's own bytes. "
    "FOLDER/rig.toml is the rig file with the emulated addresses: give it to `tacpipe acquire`. A device that waits for "
    "requests, and a link such as HID or CAN, is replaced by the sensor `generic` with the same columns."
    "\n\nExample: tacpipe sensors emulate rigs/first-paper.toml data/recordings -o emulated"
)
EMULATION_MARK = b"\nsimulated = true\n"  # line that marks the rig file of an emulated rig


def emulate(
    rig: Annotated[Path, typer.Argument(help="Rig file.")],
    recordings: Annotated[Path, typer.Argument(help="Recordings of acquire, simulate or ingest.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for rig.toml and pseudo-terminals.")],
    duration: Annotated[
        float | None, typer.Option("--duration-s", help="Duration, s; without it, until Ctrl-C.")
    ] = None,
) -> None:
    """Serve a rig."""
    import tacpipe
    from tacpipe.datasets import replacing
    from tacpipe.io.files import readable_errors, write_whole
    from tacpipe.io.termination import EndRequest
    from tacpipe.recording import rig as rig_files
    from tacpipe.simulation.emulation.emulator import ReplayEmulator

    parsed_rig, path = rig_files.read(rig), output / "rig.toml"
    dataset = tacpipe.open(recordings)
    replacing.refuse_foreign(path, EMULATION_MARK)
    emulator = ReplayEmulator(parsed_rig, dataset, output)
    with EndRequest() as is_over, readable_errors(output), emulator:
        write_whole(str(path), rig_files.to_toml(emulator.rig).encode(), f"{path}.draft")
        terminal.result(path)
        for name, stream in emulator.rig.streams.items():
            replaced = parsed_rig.streams[name].kind
            note = f", instead of {replaced}" if replaced != stream.kind else ""
            terminal.note(f"{name}: {stream.kind} at {stream.address}{note}")
        is_over.wait(duration)
