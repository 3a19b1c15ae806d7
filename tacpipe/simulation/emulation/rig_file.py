"""The text of a rig file, for a rig whose addresses were made by the emulator."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from tacpipe.recording.rig import Rig


def text(rig: Rig) -> str:
    """Return the TOML of a rig; `tacpipe.recording.rig.parse` reads it."""
    parts = [f"master = {_value(rig.master)}\n"]
    if rig.labels:
        parts.append("[labels]\n" + "".join(f"{_key(name)} = {_value(value)}\n" for name, value in rig.labels.items()))
    for stream in rig.streams.values():
        lines = {"name": stream.name, "sensor": stream.kind, "transport": str(stream.address)}
        table = "".join(f"{name} = {_value(value)}\n" for name, value in lines.items())
        if stream.options:
            table += f"options = {_value(stream.options)}\n"
        parts.append("[[stream]]\n" + table)
    return "\n".join(parts)


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(name)} = {_value(one)}" for name, one in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(one) for one in value) + "]"
    if isinstance(value, float):
        return repr(value)  # TOML wants a digit on both sides of the point, which repr gives, and knows inf and nan
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")  # of texts, whole numbers, true and false


def _key(name: str) -> str:
    return name if name.isascii() and name.replace("_", "").replace("-", "").isalnum() else json.dumps(name)
