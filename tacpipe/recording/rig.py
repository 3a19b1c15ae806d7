"""Read and write rig files: the streams of a rig, the sensor and the address of each, and the master stream.

master = "xela1"

[labels]
gripper = "left"

[[stream]]
name = "xela1"
sensor = "xela"
transport = "ws:127.0.0.1:5000"
options = { sensor = 1 }
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from tacpipe.channels.streams import EVENTS
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import config_text, regular
from tacpipe.io.credentials import refuse_credentials
from tacpipe.links import link
from tacpipe.plugins import params, registry
from tacpipe.plugins.stage import Attribute, Values
from tacpipe.printable import excerpt, plain
from tacpipe.sensors.sensor import Options, Sensor

NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")
RESERVED = (EVENTS, "truth")  # streams of a recording that no sensor may use
KEYS = ("name", "sensor", "transport", "options", "emulate")  # keys of a [[stream]] table


@dataclass(frozen=True)
class RigStream:
    """One stream of a rig: the sensor and its address."""

    name: str
    kind: str  # the sensor's registered name
    sensor: Sensor
    address: link.Address
    options: Options = field(default_factory=dict)  # options of the sensor, as written
    emulate: Options = field(default_factory=dict)  # options of `tacpipe sensors emulate`


@dataclass(frozen=True)
class Rig:
    """A rig: its streams by name, the master stream, and the labels of every recording."""

    streams: Mapping[str, RigStream]
    master: str
    labels: Mapping[str, Attribute] = field(default_factory=dict)
    live: Values = field(default_factory=dict)  # options of `tacpipe live`, as written
    text: str = ""  # the text of the file, which is stored with every recording


def read(path: Path) -> Rig:
    """Return the rig that a file describes. Raises `UsageError` for a mistake, with its location, and for credentials."""
    try:
        text = regular.content(path).decode()
    except TacpipeError as error:
        raise UsageError(str(error)) from error
    except FileNotFoundError:
        raise UsageError(f"The rig file {path} does not exist; its format is documented in docs/rig.md.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"The rig file {path} cannot be read: {error}.") from error
    refuse_credentials(text, str(path))  # the text is stored with the recordings
    return parse(text, str(path))


def parse(text: str, source: str = "rig.toml") -> Rig:
    """Return the rig that the text of a rig file describes. ``source`` is the file's name in errors.

    Raises `UsageError` for invalid TOML, an unknown key, sensor, option or address, or a reserved or repeated name.
    """
    try:
        contents = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # numbers with thousands of digits, deeply nested brackets
        raise UsageError(f"{source} is not valid TOML: {plain(str(error), 200)}.") from error
    _refuse_unknown(contents, ("master", "labels", "stream", "live"), source)
    tables = contents.get("stream")
    if not isinstance(tables, list) or not tables or not all(isinstance(table, dict) for table in tables):
        raise UsageError(f"{source} lists no stream; each is a table [[stream]] with name, sensor and transport.")
    streams: dict[str, RigStream] = {}
    for number, table in enumerate(tables, start=1):
        stream = _parse_stream(table, f"{source}, stream {_stream_label(table.get('name', number))}")
        if stream.name in streams:
            raise UsageError(f"{source} has two streams named {stream.name}; names must be unique.")
        streams[stream.name] = stream
    master = contents.get("master", next(iter(streams)))
    if not isinstance(master, str) or master not in streams:
        raise UsageError(
            f"{source}: the master is {excerpt(master)}; it must be one of the streams, {', '.join(streams)}."
        )
    labels = _table(contents, "labels", source)
    for name, value in labels.items():
        if not isinstance(value, str | int | float | bool) or (isinstance(value, float) and not math.isfinite(value)):
            described = f"label {plain(name)} is {excerpt(value)}"
            raise UsageError(f"{source}: {described}; it must be text, a finite number, true or false.")
    return Rig(streams, master, labels, _table(contents, "live", source), text)


def _parse_stream(table: Values, source: str) -> RigStream:
    """Return a stream of a rig file. Raises `UsageError` for a missing or invalid key, option or address."""
    _refuse_unknown(table, KEYS, source)
    for key in ("name", "sensor", "transport"):
        if not isinstance(table.get(key), str):
            raise UsageError(f"{source}: {key} is {excerpt(table.get(key))}; it must be text.")
    name = table["name"]
    if not NAME.fullmatch(name) or name in RESERVED:
        raise UsageError(
            f"{source}: {excerpt(name)} is not a valid stream name; use at most 64 lower-case letters, digits and _, and "
            f"none of {', '.join(RESERVED)}."
        )
    kind, options, emulate = table["sensor"], _table(table, "options", source), _table(table, "emulate", source)
    address = link.parse(table["transport"])
    sensor = build_sensor(kind, options, source)
    if address.scheme not in sensor.links:
        raise UsageError(
            f"{source}: {kind} cannot be reached by {plain(str(address))}; it must be {' or '.join(sensor.links)}, as in "
            f"{' or '.join(link.SCHEMES[scheme] for scheme in sensor.links)}."
        )
    object.__setattr__(sensor, "datagrams", address.scheme in link.DATAGRAM_SCHEMES)
    return RigStream(name, kind, sensor, address, options, emulate)


def _table(table: Values, key: str, source: str) -> Values:
    value = table.get(key, {})
    if not isinstance(value, dict):
        raise UsageError(f"{source}: {key} is {excerpt(value)}; it must be a table, as in {key} = {{ … }}.")
    return value


def build_sensor(kind: str, options: Values, source: str) -> Sensor:
    """Return a sensor with these options. Raises `UsageError` for an unknown option or a value of the wrong type."""
    sensor: Sensor = params.build_dataclass(registry.load_sensor(kind), options, source, "option")
    return sensor


def _stream_label(name: object) -> str:
    """Return the name of a stream for errors, or its number if it has no name."""
    return plain(name) if isinstance(name, str) else excerpt(name)


def _refuse_unknown(table: Iterable[str], keys: tuple[str, ...], source: str) -> None:
    for key in table:
        if key not in keys:
            raise UsageError(f"{source}: there is no key {plain(key)}; the keys are {', '.join(keys)}.")


def to_toml(rig: Rig) -> str:
    """Return the TOML text of a rig that has no file, or whose options were completed by its devices."""
    parts = [f"master = {config_text.toml_value(rig.master)}\n"]
    if rig.labels:
        parts.append(
            "[labels]\n"
            + "".join(
                f"{config_text.toml_key(name)} = {config_text.toml_value(value)}\n"
                for name, value in rig.labels.items()
            )
        )
    if rig.live:
        parts.append(
            "[live]\n"
            + "".join(
                f"{config_text.toml_key(name)} = {config_text.toml_value(value)}\n" for name, value in rig.live.items()
            )
        )
    for stream in rig.streams.values():
        lines = {"name": stream.name, "sensor": stream.kind, "transport": str(stream.address)}
        table = "".join(f"{name} = {config_text.toml_value(value)}\n" for name, value in lines.items())
        if stream.options:
            table += f"options = {config_text.toml_value(stream.options)}\n"
        parts.append("[[stream]]\n" + table)
    return "\n".join(parts)
