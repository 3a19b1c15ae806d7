"""Write the layout of a container as the file itself declares it, for a person to change."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa

from tacpipe.errors import TacpipeError, is_input_error
from tacpipe.formats import unread
from tacpipe.formats.containers import kinds
from tacpipe.formats.containers.container import Contents, SourceStream, Time
from tacpipe.formats.table import pattern
from tacpipe.formats.table.columns import TYPES
from tacpipe.formats.table.layout import why_unreadable
from tacpipe.printable import plain

_KINDS = {kind: name for name, kind in TYPES.items()}


def declared_layout(kind: str, source: Path) -> str:
    """Return the text of the layout that states what the first container at or below ``source`` with a stream declares.

    Given back with ``--layout`` it reads the same. Comments name the containers before it, and files that are no container.
    Raises `UsageError` where there is no container, `TacpipeError` where none holds a stream.
    """
    paths = kinds.find_containers(kind, source)
    if not paths:
        raise kinds.no_container_error(kind, source)
    passed_over: list[str] = []
    for path in paths:
        try:
            file = kinds.open_container(kind, path)
            contents = file.look(next(iter(file.episodes()), None))
        except TacpipeError as error:
            if not is_input_error(error):
                raise
            passed_over.append(plain(str(error), 400))
            continue
        if contents.streams:
            unread_files = unread.describe(
                source, paths, lambda path_within: _why_unread(kind, source / path_within, paths)
            )
            return _layout_text(contents, f"tacpipe ingest {kind}", path, [*passed_over, *unread_files])
        reasons = [f"{plain(name)}: {problem}" for name, problem in contents.skipped.items()]
        passed_over.append(f"{path} holds no stream that can be read. {'; '.join(reasons)}".rstrip())
    raise TacpipeError(" ".join([f"No recording of ingest {kind} at {source} holds a stream.", *passed_over[:3]]))


def _why_unread(kind: str, path: Path, containers: Sequence[Path]) -> str:
    """Return why a file is no container, "" where it lies in one."""
    inside = any(path.is_relative_to(container) for container in containers)
    return "" if inside else why_unreadable(path.name, "", kind)


def _layout_text(contents: Contents, command: str, path: Path, remarks: Sequence[str] = ()) -> str:
    """Return the text of the layout that states what a container declares; ``command`` is the one that reads it.

    ``remarks`` are sentences about other files, which become comments.
    """
    parts = [
        f"# What {plain(path.name)} itself declares. Change what is wrong, remove streams that are not wanted, then look:\n"
        f"#   {command} FOLDER --layout THIS --dry-run"
    ]
    parts += [f"# {plain(source)} is left out: {reason}" for source, reason in contents.skipped.items()]
    parts += [f"# {plain(remark, 400)}" for remark in [*contents.notes, *remarks]]
    parts += [_stream_text(stream) for stream in contents.streams]
    return "\n\n".join(parts) + "\n"


def _stream_text(stream: SourceStream) -> str:
    rows = "" if stream.rows is None else f"  # {stream.rows} rows"
    lines = [f"[streams.{stream.name}]", f"source = {_quoted(stream.source)}{rows}"]
    declared = f"# time = {_time_text(stream.time)}, if nothing else is written here"
    lines.append(declared if stream.time.is_declared else 'time = { rate_hz = "?" }  # not in the file')
    fields = [field for field in stream.schema if field.name != stream.time.column and not _is_time(field)]
    rules = [f"    {rule}" for rule in _column_rules(fields)]
    return "\n".join([*lines, *(["columns = [", *rules, "]"] if rules else [])])


def _is_time(field: pa.Field) -> bool:
    return (field.metadata or {}).get(b"quantity") == b"time"


def _time_text(time: Time) -> str:
    entries = [("column", time.column), ("unit", time.unit if time.column else "s"), ("origin", time.origin)]
    entries += [("zone", time.zone), ("start", time.start)]
    default = Time(unit="s" if not time.column else "iso8601" if time.unit == "s" else "s")  # a unit is always written
    entries_text = [f"{key} = {_quoted(value)}" for key, value in entries if value != getattr(default, key)]
    entries_text += [] if time.rate_hz is None else [f"rate_hz = {time.rate_hz:g}"]
    return "{ " + ", ".join(entries_text) + " }"


def _column_rules(fields: Sequence[pa.Field]) -> list[str]:
    """Return an entry for each set of columns whose names differ in numbers alone and that are declared alike."""
    fields = [field for field in fields if not set("{}*") & set(field.name)]  # these are left as they are declared
    alike: dict[tuple[str, str, str, str], list[str]] = {}
    for field in fields:
        about = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
        declared = (about.get("quantity", ""), about.get("unit", ""), _KINDS.get(field.type, ""))
        alike.setdefault((re.sub(r"\d+", "*", field.name), *declared), []).append(field.name)
    patterns = {
        declared_rule: names
        for declared_rule, names in alike.items()
        if len(names) > 1 and _matches_only(declared_rule[0], fields, names)
    }
    exact = [
        ((name, *declared_rule[1:]), [name])
        for declared_rule, names in alike.items()
        if declared_rule not in patterns
        for name in names
    ]
    return [_rule_text(*declared_rule) for declared_rule, _ in [*exact, *patterns.items()]]


def _matches_only(text: str, fields: Sequence[pa.Field], names: Sequence[str]) -> bool:
    return [field.name for field in fields if pattern.match(text, field.name) is not None] == list(names)


def _rule_text(match: str, quantity: str, unit: str, kind: str) -> str:
    unknown = kind not in ("text", "binary") and [
        name for name, value in (("quantity", quantity), ("unit", unit)) if not value
    ]
    entries = [("match", match), ("quantity", quantity), ("unit", unit), ("type", kind)]
    comment = f"  # not in the file: {', '.join(unknown)}" if unknown else ""
    return (
        "{ "
        + ", ".join(f"{key} = {_quoted(value)}" for key, value in entries if value or key in (unknown or ()))
        + f" }},{comment}"
    )


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=not text.isprintable())
