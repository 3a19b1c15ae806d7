"""Add the commands of ``tacpipe sensors``."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping
from importlib.util import find_spec
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tacpipe.errors import DEVICE, TacpipeError
from tacpipe.io import terminal, toml
from tacpipe.plugins import registry

if TYPE_CHECKING:
    from tacpipe.links.link import Address
    from tacpipe.links.probing import Report

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
SCHEMA_VERSION = 1
EMULATION = "tacpipe.cli.emulate"


def add(program: typer.Typer, summary: str) -> None:
    """Add the group ``sensors`` to ``program``."""
    group = typer.Typer(help=summary, no_args_is_help=True, rich_markup_mode=None)
    group.command("list")(list_)
    group.command("probe")(probe)
    if find_spec("tacpipe.simulation.emulation") and find_spec(EMULATION):
        from tacpipe.cli import emulate

        emulate.add(group)
    program.add_typer(group, name="sensors")


def list_(as_json: AsJson = False) -> None:
    """List the sensors that a rig file can name.

    Each with its links, its rate and a description.

    Example: tacpipe sensors list
    """
    rows = [_row(name) for name in registry.sensors()]
    if as_json:
        terminal.result_json({"schema_version": SCHEMA_VERSION, "sensors": rows})
        return
    head = {"name": "sensor", "links": "links", "rate_hz": "rate", "baud": "baud", "summary": "what it is"}
    table = [[head[key] for key in head], *([_cell(key, row[key]) for key in head] for row in rows)]
    widths = [max(len(line[column]) for line in table) for column in range(len(head))]
    for line in table:
        terminal.result("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip())


def probe(
    port: Annotated[
        str | None, typer.Argument(help="Address such as serial:/dev/ttyACM0, or a path; without it, all ports.")
    ] = None,
    passive: Annotated[bool, typer.Option("--passive", help="Only listen; send nothing to a device.")] = False,
    as_json: AsJson = False,
) -> None:
    """Identify the sensor on each port, with the evidence.

    Listens first, then sends the requests with which each driver begins a recording. A port that is not USB is only
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


def _row(name: str) -> dict[str, Any]:
    try:
        kind = registry.load_sensor(name)
    except TacpipeError as error:  # An error of one plug-in must not hide the other sensors.
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
    if not value:
        return "-"
    if key == "links":
        return ", ".join(value)
    return f"{value:g} Hz" if key == "rate_hz" else f"{value:,}" if key == "baud" else str(value)


def _address(port: str) -> Address:
    from tacpipe.links import link

    return link.parse(f"serial:{port}" if port.startswith("/") else port)


def _usb_id(port: str) -> str:
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
    """Return the lines of a rig file for the likeliest sensor, with comments on guessed options."""
    candidate = report.findings[0].candidate
    options = dict(candidate.options)
    if report.baud and report.baud != type(candidate.sensor).__dict__.get("baud"):
        options["baud"] = report.baud
    notes = candidate.sensor.guesses
    return [
        "[[stream]]",
        f'name = "{candidate.kind.replace("-", "_")}"',
        f'sensor = "{candidate.kind}"',
        f'transport = "{report.address}"',
        *(_described(options, notes) if notes else [f"options = {toml.toml_value(options)}"] if options else []),
    ]


def _described(options: Mapping[str, Any], notes: Mapping[str, str]) -> list[str]:
    """Return options as a TOML table, one per line, lists of tables over several lines, each with its note."""
    lines = ["", "[stream.options]"]
    for name, value in options.items():
        note = f"  # {notes[name]}" if name in notes else ""
        if isinstance(value, list) and any(isinstance(item, Mapping) for item in value):
            lines += [f"{name} = [{note}", *(f"    {toml.toml_value(item)}," for item in value), "]"]
        else:
            lines.append(f"{name} = {toml.toml_value(value)}{note}")
    return lines


def _json(report: Report) -> dict[str, Any]:
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
