"""A first layout for a folder of files that nobody described: what they show is filled in, what they do not is marked.

What a file cannot say of itself, above all what a column measures, is written as ``"?"``; a layout with such an entry is
refused until somebody who knows has replaced it.
"""

from __future__ import annotations

import functools
import itertools
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.formats import unread
from tacpipe.formats.table import binary, compressed, dialect, label_table, pattern
from tacpipe.formats.table.dialect import Dialect
from tacpipe.formats.table.layout import EXTENSIONS, TREES, UNKNOWN, extension, why_unreadable
from tacpipe.formats.table.text import LONGEST_LINE
from tacpipe.io import files as file_system
from tacpipe.printable import plain, shown

LINES = 200  # of a text file that are looked at
_TIME = re.compile(
    r"(t|time|timestamp|time_?stamp|stamp|clock|unix_?time|datetime|date)(_?(s|sec|ms|us|ns))?", re.IGNORECASE
)
VOCABULARY = (  # for who replaces a "?"
    "quantity: what a column measures, as tactile, position, orientation (a quaternion), joint_position, force, torque,",
    "  static_pressure, vibration, temperature, proximity; `tacpipe train TASK --requirements` lists what a task reads",
    "unit: as count, m, mm, 1 (of a quaternion), rad, N, kPa, V; of time s, ms, us, ns",
    '{taxel} and {axis} in match state where a tactile column lies; component = "x" which part of a vector it is',
)
_ISO = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d.*")
_MEANINGS = (  # how a name ends, and the quantity; the first that matches
    (r"(txl|tax|taxel|skin|tactile|cell|electrode|pad|sensel|touch)\w*", "tactile"),
    (r"(quat|quaternion|orientation|ori|rot|q)_?[xyzw]", "orientation"),
    (
        r"(velocity|vel|speed)\w*_(joint|j)_?\d+|(joint|j|q)_?\d+_?(velocity|vel|speed)\w*|(dq|qd)_?\d+",
        "joint_velocity",
    ),
    (r"(effort|torque|tau)\w*_?(joint|j)?_?\d+", "joint_torque"),
    (r"(joint|j|q)_?\d+(_?(pos|position))?(_?(rad|deg))?", "joint_position"),
    (r"(f|force)_?[xyz](_?m?n)?", "force"),
    (r"(t|tau|m|torque|moment)_?[xyz](_?nm)?", "torque"),
    (r"(pos|position|translation|p|ee|tcp)_?[xyz](_?m?m)?", "position"),
    (r"temp\w*", "temperature"),
    (r"press\w*", "static_pressure"),
)
_UNITS = {"orientation": "1"}  # of quantities that have but one
_SUFFIXES = (  # how a name ends that states its unit, and the quantities that it is a unit of
    (r"_(m)", "m", ("position",)),
    (r"_(mm)", "mm", ("position",)),
    (r"_(rad)", "rad", ("joint_position",)),
    (r"_(deg)", "deg", ("joint_position",)),
    (r"_(n)", "N", ("force",)),
    (r"_(nm)", "N m", ("torque", "joint_torque")),
)
_INTEGERS = (("uint16", 0, 2**16 - 1), ("int16", -(2**15), 2**15 - 1), ("int32", -(2**31), 2**31 - 1))


@dataclass(frozen=True)
class Looked:
    """What the first rows of a file show."""

    names: tuple[str, ...]
    values: Mapping[str, tuple[float | str | None, ...]]  # by column, of the first rows
    text: Dialect | None  # None: not a text file


@dataclass(frozen=True)
class _Group:
    stream: str
    pattern: str
    paths: tuple[Path, ...]
    first: Looked  # what the first of them shows


def layout(folder: Path) -> str:
    """Return the text of a layout for the files below ``folder``. Raises `UsageError` where none can be a stream."""
    every = [Path(place, name).relative_to(folder) for place, _, names in file_system.walk(folder) for name in names]
    data = [path for path in every if extension(path) in EXTENSIONS]
    if not data:
        raise UsageError(f"{folder} holds no file of {', '.join(EXTENSIONS)}; there is nothing to guess from.")
    groups, labels, damaged = _grouped(folder, data)
    if not groups:
        raise UsageError(f"{folder} holds no table with rows and stamps. {' '.join(damaged.values())}".rstrip())
    trees = _label_files(folder, [path for path in every if path.suffix.lower() in TREES], groups)
    in_groups = [*(group.paths for group in [*groups, *labels]), *trees.values()]
    read = [folder / path for paths in in_groups for path in paths]

    def reason(path: str) -> str:
        return damaged.get(path) or why_unreadable(
            path, "it is no stream, and no file of labels that each recording has"
        )

    parts = [_stream(group) for group in groups]
    parts += [_labels_of(group) for group in labels]
    parts += [f"[[labels]]\nfile = {_quoted(text)}" for text in trees]
    parts.append('[attributes]\nsensor = "?"  # the product, as xela-uskin or the lab\'s own name for it')
    head = [
        '# A first layout, guessed from the files. Replace each "?", check the rest, then look at what it reads:',
        "#   tacpipe ingest table FOLDER --layout THIS --dry-run",
        *(f"# {line}" for line in VOCABULARY),
        *(f"# {shown(line)}" for line in unread.describe(folder, read, reason)),
    ]
    return "\n\n".join(["\n".join(head), *parts]) + "\n"


def _grouped(folder: Path, data: Sequence[Path]) -> tuple[list[_Group], list[_Group], dict[str, str]]:
    """Return files that are one stream of several recordings each, files that hold labels, and why others are neither."""
    by_template: dict[str, list[Path]] = {}
    for path in sorted(data):
        by_template.setdefault(_template(path), []).append(path)
    streams: list[_Group] = []
    labels: list[_Group] = []
    damaged: dict[str, str] = {}
    used: set[str] = set()
    for paths in itertools.chain.from_iterable(map(_apart, by_template.values())):
        try:
            looked = _look(folder / paths[0])
        except TacpipeError as error:
            damaged |= {path.as_posix(): str(error).rstrip(".") for path in paths}
            continue
        shared = len(paths) == 1 < len(data) and _is_labels(looked)
        group = _Group(_stream_name(paths, used), pattern.generalize(paths), tuple(paths), looked)
        single = looked.text is not None and looked.text.header and len(looked.text.rows) == 1 and len(paths) > 1
        (labels if shared or single else streams).append(group)
    return streams, labels, damaged


def _stream_name(paths: Sequence[Path], used: set[str]) -> str:
    """Return a name for the stream of these files that is not in ``used``, and add it there."""
    stem = re.sub(r"\{\w+\}", "", pattern.generalize([Path(path.name) for path in paths])).partition(".")[0].lower()
    name = re.sub(r"[^a-z0-9]+", "_", stem).replace("trial", "").strip("_")
    name = name if name.isidentifier() else "table"
    name = name if name not in used else next(f"{name}{n}" for n in itertools.count(2) if f"{name}{n}" not in used)
    used.add(name)
    return name


def _label_files(folder: Path, paths: Sequence[Path], streams: Sequence[_Group]) -> dict[str, list[Path]]:
    """Return YAML and JSON files with labels by their pattern: one file of each recording, or one of all recordings."""
    by_template: dict[str, list[Path]] = {}
    for path in paths:
        by_template.setdefault(_template(path), []).append(path)
    shared = set.intersection(*(set(pattern.placeholders(group.pattern)) for group in streams))
    recordings = [pattern.match(streams[0].pattern, path.as_posix()) or {} for path in streams[0].paths]
    labels = {}
    for same in by_template.values():
        text, names = pattern.generalize(same), {path.as_posix() for path in same}
        placeholders = set(pattern.placeholders(text))
        if not placeholders:
            is_labels = _is_table_of_labels(folder / same[0])
        else:
            is_labels = placeholders <= shared and {pattern.filled(text, values) for values in recordings} <= names
        if is_labels:
            labels[text] = same
    return labels


def _is_table_of_labels(path: Path) -> bool:
    """Return whether a YAML or JSON file holds labels by the name of their recording."""
    try:
        return bool(label_table.read(path).rows)
    except TacpipeError:
        return False


def _apart(paths: Sequence[Path]) -> list[list[Path]]:
    """Return files of one template as streams: by name where each of several folders holds the same names, else all."""
    by_folder: dict[Path, set[str]] = {}
    for path in paths:
        by_folder.setdefault(path.parent, set()).add(path.name)
    names = set.union(*by_folder.values())
    if len(by_folder) > 1 and len(names) > 1 and all(found == names for found in by_folder.values()):
        return [[path for path in paths if path.name == name] for name in sorted(names)]
    return [list(paths)]


def _template(path: Path) -> str:
    """Return what files of one stream share: the depth, and the file's name without its numbers."""
    return "/".join(["{}"] * (len(path.parts) - 1) + [re.sub(r"\d+", "{}", path.name)])


def _look(path: Path) -> Looked:
    """Return what the first rows of a file show."""
    kind = EXTENSIONS[extension(path)]
    if kind == "csv":
        found = dialect.of(_lines(path))
        columns = list(zip(*found.rows, strict=True)) or [()] * len(found.names)
        values = {
            name: tuple(_value(cell, found) for cell in cells) for name, cells in zip(found.names, columns, strict=True)
        }
        return Looked(found.names, values, found)
    file = binary.opened(path, kind)
    if isinstance(file, binary.JsonLines):
        block = file.head()
    else:
        block = next(iter(file.batches(dict.fromkeys(file.names()))), pa.table({}))
    block, names = block.slice(0, LINES), block.column_names
    return Looked(tuple(names), {name: tuple(block.column(name).to_pylist()) for name in names}, None)


def _lines(path: Path) -> list[str]:
    with compressed.opened(path) as file:
        lines = iter(functools.partial(file.readline, LONGEST_LINE), b"")
        return [line.decode(errors="replace") for line in itertools.islice(lines, LINES)]


def _value(cell: str, found: Dialect) -> float | str | None:
    number = found.number(cell)
    return number if number is not None else (None if cell in dialect.MISSING else cell)


def _is_labels(found: Looked) -> bool:
    """Return whether a table is one of labels: no column is stamps, some hold text, and it is short."""
    if found.text is None:
        return False
    texts = any(isinstance(value, str) for values in found.values.values() for value in values)
    return texts and _time_column(found) is None and 0 < len(found.text.rows) < LINES - 1


def _labels_of(group: _Group) -> str:
    lines = ["[[labels]]", f"file = {_quoted(group.pattern if len(group.paths) > 1 else group.paths[0].as_posix())}"]
    if len(group.paths) == 1:
        found = group.first
        keys = [name for name, values in found.values.items() if len(set(values)) == len(values)]
        named = next((name for name in keys if label_table.RECORDING.fullmatch(name)), keys[0] if keys else UNKNOWN)
        lines.append(f"key = {_quoted(named)}  # the column that names recordings")
    return "\n".join(lines)


def _stream(group: _Group) -> str:
    found = group.first
    time = _time_column(found)
    apart = {time} if time else set()
    lines = [
        f"[streams.{group.stream}]",
        f"files = {_quoted(group.pattern)}  # {len(group.paths)} file{'s' * (len(group.paths) != 1)}",
    ]
    if found.text is not None:
        lines += _written(found.text, group.paths[0])
    several = next((name for name in found.names if label_table.RECORDING.fullmatch(name)), None)
    if several is not None and len(group.paths) == 1:
        lines.append(f"recording = {_quoted(several)}  # the column that names the recording of a row")
        apart.add(several)
    lines.append(f"time = {_time(found, time)}")
    rules = _rules(found, [name for name in found.names if name not in apart])
    lines += ["columns = [", *(f"    {rule}," for rule in rules), "]"]
    return "\n".join(lines)


def _written(found: Dialect, path: Path) -> list[str]:
    usual = "\t" if ".tsv" in [suffix.lower() for suffix in path.suffixes] else ","
    entries = [
        ("separator", found.separator, usual),
        ("decimal", found.decimal, "."),
        ("comment", found.comment, ""),
    ]
    lines = [f"{name} = {_quoted(value)}" for name, value, default in entries if value != default]
    if found.skip_lines:
        lines.append(f"skip_lines = {found.skip_lines}")
    if not found.header:
        lines.append("header = false")
    if found.missing:
        lines.append(f"missing = [{', '.join(map(_quoted, found.missing))}]")
    return lines


def _time_column(found: Looked) -> str | None:
    """Return the column that holds stamps: one so named, else the first whose numbers always rise."""
    named = [name for name in found.names if _TIME.fullmatch(name)]
    rising = [name for name in found.names if _rises(found.values[name]) and not label_table.RECORDING.fullmatch(name)]
    both = [name for name in named if name in rising or any(isinstance(value, str) for value in found.values[name])]
    return next(iter(both), None) or (rising[0] if rising and rising[0] == found.names[0] else None)


def _rises(values: Sequence[float | str | None]) -> bool:
    numbers = [value for value in values if isinstance(value, int | float)]
    return (
        len(numbers) == len(values) > 1
        and bool(np.all(np.diff(np.array(numbers, float)) >= 0))
        and numbers[-1] > numbers[0]
    )


def _time(found: Looked, column: str | None) -> str:
    if column is None:
        return f'{{ rate_hz = "{UNKNOWN}" }}  # no column rises as stamps do; write the rate'
    values = found.values[column]
    if any(isinstance(value, str) and _ISO.match(value) for value in values):
        return f'{{ column = {_quoted(column)}, unit = "iso8601" }}'
    first = next((abs(value) for value in values if isinstance(value, int | float)), 0.0)
    for most, unit in ((1e11, "s"), (1e14, "ms"), (1e17, "us"), (float("inf"), "ns")):
        if 1e8 <= first < most:
            return f'{{ column = {_quoted(column)}, unit = "{unit}" }}'
    suffix = re.search(r"_?(ms|us|ns|s|sec)$", column, re.IGNORECASE)
    unit = {"sec": "s"}.get(suffix[1].lower(), suffix[1].lower()) if suffix else UNKNOWN
    return (
        f'{{ column = {_quoted(column)}, unit = "{unit}", origin = "start" }}  # counts from the start of the recording'
    )


def _rules(found: Looked, names: Sequence[str]) -> list[str]:
    """Return an entry for each set of columns whose names differ in numbers alone and whose values are alike."""
    by_rule: dict[tuple[str, ...], list[str]] = {}
    for name in names:
        values = [value for value in found.values[name] if value is not None]
        kind = _kind(values)
        by_rule.setdefault((_match(name), *meaning(name, kind), kind), []).append(name)
    rules = []
    whole = {part for name in names for part in [_part(name)] if part}
    for (match, quantity, unit, kind), members in by_rule.items():
        one = members[0] if len(members) == 1 else _of_taxels(match, quantity, kind)
        if quantity == UNKNOWN and kind.startswith("float") and {_place(name) for name in members} <= {"x", "y", "z"}:
            quantity = "position" if whole >= set("xyzw") else quantity
        if kind == "text":
            rules.append(f"{{ match = {_quoted(one)}, skip = true }}")
            continue
        rules.append(
            f"{{ match = {_quoted(one)}, quantity = {_quoted(quantity)}, unit = {_quoted(unit)}, type = {_quoted(kind)} }}"
        )
    return sorted(rules, key=lambda rule: rule.count("{"))  # exact names before patterns


def _place(name: str) -> str:
    """Return the letter of a column that is called x, y or z alone, else its name."""
    return name.strip().lower()


def _part(name: str) -> str:
    """Return the component that a column of a quaternion or a place has by its name, as x of qx."""
    found = re.fullmatch(r"(?:(?:quat|quaternion|orientation|ori|rot|q)_?)?([xyzw])", _place(name))
    return found[1] if found else ""


def _of_taxels(match: str, quantity: str, kind: str) -> str:
    """Return the pattern of numbered columns with {taxel} for their number, where they are or can be taxels.

    >>> _of_taxels("pad{pad}", "tactile", "float64"), _of_taxels("q{number}", "joint_position", "float64")
    ('pad{taxel}', 'q{number}')
    """
    taxels = quantity == "tactile" or (quantity == UNKNOWN and "int" in kind)
    return re.sub(r"\{\w+\}", "{taxel}", match) if taxels and match.count("{") == 1 else match


def _match(name: str) -> str:
    """Return a name with its numbers as placeholders.

    >>> _match("taxel3_x"), _match("t12"), _match("r1c2")
    ('taxel{taxel}_x', 't{number}', 'r{r}c{c}')
    """
    counter = itertools.count(2)
    seen: set[str] = set()

    def placeholder(found: re.Match[str]) -> str:
        word = found[1].strip("_").lower()
        called = (
            word
            if (word.isidentifier() and len(word) > 1) or (name.count(word) and len(re.findall(r"\d+", name)) > 1)
            else "number"
        )
        called = called if called.isidentifier() else "number"
        while called in seen:
            called = f"{called}{next(counter)}"
        seen.add(called)
        return f"{found[1]}{{{called}}}"

    return re.sub(r"([A-Za-z_]*)\d+", placeholder, name)


def meaning(name: str, kind: str) -> tuple[str, str]:
    """Return the quantity and the unit that a name shows.

    >>> meaning("force_x_n", "float64"), meaning("fx", "float64"), meaning("taxel3", "uint16")
    (('force', 'N'), ('force', '?'), ('tactile', 'count'))
    """
    text = name.strip()
    for wanted, quantity in _MEANINGS:
        if re.search(rf"(?:^|_)(?:{wanted})$", text, re.IGNORECASE):
            if quantity == "tactile" and "int" in kind:
                return quantity, "count"
            said = (unit for end, unit, of in _SUFFIXES if quantity in of and re.search(f"{end}$", text, re.IGNORECASE))
            return quantity, _UNITS.get(quantity) or next(said, UNKNOWN)
    return UNKNOWN, UNKNOWN


def _kind(values: Sequence[float | str]) -> str:
    if not values or any(isinstance(value, str) for value in values):
        return "text" if values else "float64"
    if any(isinstance(value, bool) for value in values):
        return "bool"
    if any(isinstance(value, float) for value in values):  # 2.0 too: a cell below it may hold 2.5
        return "float64"
    numbers = [int(value) for value in values]
    return next((kind for kind, least, most in _INTEGERS if least <= min(numbers) and max(numbers) <= most), "float64")


def _quoted(text: str) -> str:
    return json.dumps(plain(text, 500) if not text.isprintable() and text != "\t" else text, ensure_ascii=False)
