"""The rig file: which streams a rig has, what speaks on each and where, and which of them sets the grid.

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
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tacpipe.channels.streams import EVENTS
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import regular
from tacpipe.links import link
from tacpipe.plugins import params, registry
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt, plain
from tacpipe.sensors.sensor import Sensor

NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")
TAKEN = (EVENTS, "truth")  # streams that a recording has next to those of its sensors
KEYS = ("name", "sensor", "transport", "options", "emulate")


@dataclass(frozen=True)
class Stream:
    """One stream of a rig: the sensor, and where it is."""

    name: str
    kind: str  # the sensor's registered name
    sensor: Sensor
    address: link.Address
    options: Mapping[str, Any] = field(default_factory=dict)  # of the sensor, as written
    emulate: Mapping[str, Any] = field(default_factory=dict)  # what `tacpipe sensors emulate` reads


@dataclass(frozen=True)
class Rig:
    """A rig: its streams by name, the master, labels that every recording gets."""

    streams: Mapping[str, Stream]
    master: str
    labels: Mapping[str, Attribute] = field(default_factory=dict)
    emulate: Mapping[str, Any] = field(default_factory=dict)
    live: Mapping[str, Any] = field(default_factory=dict)  # what `tacpipe live` is asked for, as written
    text: str = ""  # the file as it was read, which goes along with what is recorded


def read(path: Path) -> Rig:
    """Return the rig that a file describes. Raises `UsageError` with the place of what is wrong."""
    try:
        text = regular.content(path).decode()
    except TacpipeError as error:
        raise UsageError(str(error)) from error
    except FileNotFoundError:
        raise UsageError(f"There is no rig file {path}; its format is documented in docs/rig.md.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"The rig file {path} cannot be read: {error}.") from error
    return parse(text, str(path))


def parse(text: str, where: str = "rig.toml") -> Rig:
    """Return the rig of a rig file's text; ``where`` names it in errors.

    Raises `UsageError` for what is not a TOML, for an unknown key, sensor, option or address, and for a name that is taken.
    """
    try:
        found = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # numbers of thousands of digits, brackets within brackets
        raise UsageError(f"{where} is not valid TOML: {plain(str(error), 200)}.") from error
    _known(found, ("master", "labels", "stream", "emulate", "live"), where)
    tables = found.get("stream")
    if not isinstance(tables, list) or not tables or not all(isinstance(table, dict) for table in tables):
        raise UsageError(f"{where} lists no stream; each is a table [[stream]] with name, sensor and transport.")
    streams: dict[str, Stream] = {}
    for number, table in enumerate(tables, start=1):
        stream = _stream(table, f"{where}, stream {_called(table, number)}")
        if stream.name in streams:
            raise UsageError(f"{where} has two streams named {stream.name}; names must be unique.")
        streams[stream.name] = stream
    master = found.get("master", next(iter(streams)))
    if not isinstance(master, str) or master not in streams:
        raise UsageError(
            f"{where}: the master is {excerpt(master)}; it must be one of the streams, {', '.join(streams)}."
        )
    labels = _table(found, "labels", where)
    for name, value in labels.items():
        if not isinstance(value, str | int | float | bool) or (isinstance(value, float) and not math.isfinite(value)):
            described = f"label {plain(name)} is {excerpt(value)}"
            raise UsageError(f"{where}: {described}; it must be text, a finite number, true or false.")
    return Rig(streams, master, labels, _table(found, "emulate", where), _table(found, "live", where), text)


def _stream(table: Mapping[str, Any], where: str) -> Stream:
    _known(table, KEYS, where)
    for key in ("name", "sensor", "transport"):
        if not isinstance(table.get(key), str):
            raise UsageError(f"{where}: {key} is {excerpt(table.get(key))}; it must be a text.")
    name = table["name"]
    if not NAME.fullmatch(name) or name in TAKEN:
        raise UsageError(
            f"{where}: {excerpt(name)} cannot name a stream; take small letters, digits and _, 64 at most, and "
            f"neither of {', '.join(TAKEN)}."
        )
    kind, options, emulate = table["sensor"], _table(table, "options", where), _table(table, "emulate", where)
    address = link.parse(table["transport"])
    sensor = make(kind, options, where)
    if address.scheme not in sensor.links:
        raise UsageError(
            f"{where}: {kind} cannot be reached by {plain(str(address))}; it must be {' or '.join(sensor.links)}, as in "
            f"{' or '.join(link.SCHEMES[scheme] for scheme in sensor.links)}."
        )
    return Stream(name, kind, sensor, address, options, emulate)


def _table(found: Mapping[str, Any], key: str, where: str) -> Mapping[str, Any]:
    value = found.get(key, {})
    if not isinstance(value, dict):
        raise UsageError(f"{where}: {key} is {excerpt(value)}; it must be a table, as in {key} = {{ … }}.")
    return value


def make(kind: str, options: Mapping[str, Any], where: str) -> Sensor:
    """Return a sensor with these options. Raises `UsageError` for an unknown one or a value of another type."""
    made: Sensor = params.filled(registry.load_sensor(kind), options, where, "option")
    return made


def _called(table: Mapping[str, Any], number: int) -> str:
    """Return how a stream is named in errors."""
    name = table.get("name", number)
    return plain(name) if isinstance(name, str) else excerpt(name)


def _known(table: Mapping[str, Any], keys: tuple[str, ...], where: str) -> None:
    for key in table:
        if key not in keys:
            raise UsageError(f"{where}: there is no key {plain(key)}; there are {', '.join(keys)}.")
