"""The text of a rig file, for a rig that is not as its file states: of the emulator, or completed by its devices."""

from __future__ import annotations

from tacpipe.io import toml
from tacpipe.recording.rig import Rig


def of(rig: Rig) -> str:
    """Return the TOML of a rig; `tacpipe.recording.rig.parse` reads it."""
    parts = [f"master = {toml.toml_value(rig.master)}\n"]
    if rig.labels:
        parts.append(
            "[labels]\n"
            + "".join(f"{toml.toml_key(name)} = {toml.toml_value(value)}\n" for name, value in rig.labels.items())
        )
    if rig.live:
        parts.append(
            "[live]\n"
            + "".join(f"{toml.toml_key(name)} = {toml.toml_value(value)}\n" for name, value in rig.live.items())
        )
    for stream in rig.streams.values():
        lines = {"name": stream.name, "sensor": stream.kind, "transport": str(stream.address)}
        table = "".join(f"{name} = {toml.toml_value(value)}\n" for name, value in lines.items())
        if stream.options:
            table += f"options = {toml.toml_value(stream.options)}\n"
        parts.append("[[stream]]\n" + table)
    return "\n".join(parts)
