"""A first layout for a folder of files that nobody described: what they show is filled in, what they do not is marked.

What a file cannot say of itself, above all what a column measures, is written as ``"?"``; a layout with such an entry is
refused until somebody who knows has replaced it.
"""

from __future__ import annotations

import datetime
import itertools
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.channels import vocabulary
from tacpipe.errors import MissingModuleError, TacpipeError, UsageError
from tacpipe.formats import unread
from tacpipe.formats.table import binary, dialect, label_table, pattern, stamp_formats, stamps
from tacpipe.formats.table.binary import ArrayMember
from tacpipe.formats.table.columns import TYPES
from tacpipe.formats.table.dialect import LINES, Dialect
from tacpipe.formats.table.layout import EXTENSIONS, TREES, UNKNOWN, Stream, extension, why_unreadable
from tacpipe.formats.table.workbook import Workbook
from tacpipe.io import files as file_system
from tacpipe.printable import plain, shown

_TIME_WORDS = r"(t|time|times|time_?stamps?|stamps?|clock|unix_?time|epoch|datetime|date[_ ]?time|date|uhrzeit|zeit)"
_TIME = re.compile(rf"{_TIME_WORDS}([_ ]?(s|sec|seconds|ms|us|ns))?", re.IGNORECASE)
_ENDS_IN_TIME = re.compile(rf"\w+_{_TIME_WORDS}(_(s|sec|ms|us|ns))?", re.IGNORECASE)
_UNIT_IN_NAME = re.compile(r"(?P<base>.*?)[ _]*[\[(](?P<unit>[^\])]*)[\])]\s*")
_DAYS = ("", "%d.%m.%Y ", "%d/%m/%Y ", "%m/%d/%Y ", "%Y/%m/%d ", "%Y-%m-%d_", "%d-%m-%Y ", "%d %b %Y ", "%b %d %Y ")
_CLOCKS = ("%H:%M:%S.%f", "%H:%M:%S,%f", "%H-%M-%S.%f", "%H:%M")
_STAMP_FORMATS = (
    *(f"{day}{clock}" for clock in _CLOCKS for day in _DAYS),
    *("%Y%m%d_%H%M%S", "%Y%m%d %H%M%S", "%Y%m%d%H%M%S"),
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
    (r"(joint_?(velocity|velocities|vel|speeds?)|qvel)_?\d+", "joint_velocity"),
    (r"(joint_?(positions?|pos|angles?|states?)|joints|qpos)_?\d+", "joint_position"),
    (r"(effort|torque|tau)\w*_?(joint|j)?_?\d+", "joint_torque"),
    (r"(joint|j|q)_?\d+(_?(pos|position))?(_?(rad|deg))?", "joint_position"),
    (r"(f|force|kraft)_?[xyz](_?m?n)?", "force"),
    (r"(t|tau|m|torque|moment)_?[xyz](_?nm)?", "torque"),
    (r"(pos|position|translation|p|ee|tcp)_?[xyz](_?m?m)?", "position"),
    (r"temp\w*", "temperature"),
    (r"(press|druck)\w*", "static_pressure"),
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
    values: Mapping[str, tuple[Any, ...]]  # by column, of the first rows
    text: Dialect | None = None  # None: not a text file
    encoding: str = "utf-8"
    arrays: Mapping[str, ArrayMember] = field(default_factory=dict)  # of a file of arrays
    units: Mapping[str, str] = field(default_factory=dict)  # by column, as a row below the header states them

    @property
    def rows(self) -> int | None:
        """How many rows an array has; None of other files."""
        return next((array.rows for array in self.arrays.values()), None)

    def only(self, arrays: Sequence[str]) -> Looked:
        """Return what the file shows of some of its arrays."""
        names = [name for name in self.names if any(_is_of(name, array) for array in arrays)]
        values = {name: self.values[name] for name in names}
        return replace(self, names=tuple(names), values=values, arrays={name: self.arrays[name] for name in arrays})


@dataclass(frozen=True)
class _Group:
    stream: str
    pattern: str
    paths: tuple[Path, ...]
    first: Looked  # what the first of them shows
    stamps: str = ""  # pattern of the files that hold the stamps
    clock: Looked | None = None  # what the first of these shows
    skipped: tuple[str, ...] = ()  # arrays of the file that are other streams


def layout(folder: Path) -> str:
    """Return the text of a layout for the files below ``folder``. Raises `UsageError` where none can be a stream."""
    every = [Path(place, name).relative_to(folder) for place, _, names in file_system.walk(folder) for name in names]
    data = [path for path in every if extension(path) in EXTENSIONS]
    if not data:
        raise UsageError(f"{folder} holds no file of {', '.join(EXTENSIONS)}; there is nothing to guess from.")
    groups, labels, damaged = _grouped(folder, data)
    groups, stamps = _with_stamps(groups)
    if not groups:
        raise UsageError(f"{folder} holds no table with rows and stamps. {' '.join(damaged.values())}".rstrip())
    trees = _label_files(folder, [path for path in every if path.suffix.lower() in TREES], groups)
    in_groups = [*(group.paths for group in [*groups, *stamps, *labels]), *trees.values()]
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
        except MissingModuleError:
            raise
        except TacpipeError as error:
            damaged |= {path.as_posix(): str(error).rstrip(".") for path in paths}
            continue
        shared = len(paths) == 1 < len(data) and _is_labels(looked)
        group = _Group(_stream_name(paths, used), pattern.generalize(paths), tuple(paths), looked)
        single = looked.text is not None and looked.text.header and len(looked.text.rows) == 1 and len(paths) > 1
        if shared or single:
            labels.append(group)
        else:
            streams += _by_length(group)
    return streams, labels, damaged


def _by_length(group: _Group) -> list[_Group]:
    """Return the streams of one kind of file: one per length of the arrays in it, else one."""
    by_length: dict[int, list[str]] = {}
    for name, array in group.first.arrays.items():
        by_length.setdefault(array.rows, []).append(name)
    if len(by_length) < 2:
        return [group]
    groups = []
    for names in by_length.values():
        widest = max(names, key=lambda name: group.first.arrays[name].width or 1)
        others = tuple(name for name in group.first.arrays if name not in names)
        stream = re.sub(r"\W", "_", widest) if widest.isascii() and not widest[0].isdigit() else group.stream
        groups.append(replace(group, stream=stream, first=group.first.only(names), skipped=others))
    return groups


def _with_stamps(groups: Sequence[_Group]) -> tuple[list[_Group], list[_Group]]:
    """Return the streams, those without stamps with files of stamps of their length, and the groups of these files."""
    clocks = [group for group in groups if len(group.first.names) == 1 and _is_clock(group)]
    used: list[_Group] = []
    streams: list[_Group] = []
    for group in groups:
        if group in clocks:
            continue
        candidates = [
            clock
            for clock in clocks
            if clock.pattern.rpartition("/")[0] == group.pattern.rpartition("/")[0]
            and (group.first.rows is None or clock.first.rows in (None, group.first.rows))
        ]
        if _time_column(group.first) is None and candidates:
            clock = max(candidates, key=lambda clock: group.stream in clock.stream)
            used.append(clock)
            streams.append(replace(group, stamps=clock.pattern, clock=clock.first))
        else:
            streams.append(group)
    return [*streams, *(clock for clock in clocks if clock not in used)], used


def _is_clock(group: _Group) -> bool:
    """Return whether a file of one column holds stamps: by its name, as they rise."""
    stem = group.paths[0].name.partition(".")[0]
    named = _TIME.fullmatch(stem) or _ENDS_IN_TIME.fullmatch(stem)
    (values,) = group.first.values.values()
    return bool(named) and (_rises(values) or any(isinstance(value, str) for value in values))


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
        encoding = dialect.encoding(path)
        found = dialect.of(dialect.first_lines(path, encoding))
        columns = list(zip(*found.rows, strict=True)) or [()] * len(found.names)
        values = {
            name: tuple(_value(cell, found) for cell in cells) for name, cells in zip(found.names, columns, strict=True)
        }
        return Looked(found.names, values, found, encoding, units=dict(zip(found.names, found.units, strict=False)))
    if kind == "xlsx":
        return _first_rows(Workbook(path, Stream("table", format="xlsx")))
    file = binary.opened(path, kind)
    if isinstance(file, binary.NumpyArchive):
        file = replace(file, time_axis=_time_axis(file.arrays()))
        return replace(_first_rows(file), arrays=file.arrays())
    return _first_rows(file)


def _first_rows(file: binary.ParquetFile | binary.NumpyArchive | binary.JsonLines | Workbook) -> Looked:
    """Return what the first rows of a file that is not text show."""
    names = file.names()
    if isinstance(file, binary.JsonLines):
        columns = {name: file.head().column(name) for name in file.head().column_names}
    elif isinstance(file, binary.NumpyArchive):  # whose arrays may have different lengths
        columns = {name: next(iter(file.batches({name: pa.null()}))).column(name) for name in names}
    else:
        block = next(iter(file.batches(dict.fromkeys(names, pa.string()))), pa.table({}))
        columns = {name: block.column(name) for name in block.column_names}
    return Looked(tuple(columns), {name: tuple(column.slice(0, LINES).to_pylist()) for name, column in columns.items()})


def _time_axis(arrays: Mapping[str, ArrayMember]) -> int:
    """Return the dimension along which the rows of arrays follow one another.

    It is the first, unless the only array has another one that is so much longer that the first is a part of the sensor.
    """
    shape = next(iter(arrays.values())).shape if len(arrays) == 1 else ()
    longest = shape.index(max(shape)) if shape else 0
    return longest if shape and len(shape) > 1 and shape[0] < 100 and shape[longest] >= 4 * shape[0] else 0


def _is_of(column: str, array: str) -> bool:
    """Return whether a column is one of an array's."""
    return column == array or (column.startswith(f"{array}_") and column[len(array) + 1 :].isdigit())


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
    time = None if group.stamps else _time_column(found)
    apart = {time} if time else set()
    lines = [
        f"[streams.{group.stream}]",
        f"files = {_quoted(group.pattern)}  # {len(group.paths)} file{'s' * (len(group.paths) != 1)}",
    ]
    if found.text is not None:
        lines += _written(found, group.paths[0])
    axis = next((array.time_axis for array in found.arrays.values()), 0)
    if axis:
        lines.append(f"time_axis = {axis}  # of the shape {next(iter(found.arrays.values())).shape}, the longest")
    several = next((name for name in found.names if label_table.RECORDING.fullmatch(name)), None)
    if several is not None and len(group.paths) == 1:
        lines.append(f"recording = {_quoted(several)}  # the column that names the recording of a row")
        apart.add(several)
    if group.clock is not None:
        lines.append(f"time = {_time(group.clock, group.clock.names[0], f'file = {_quoted(group.stamps)}')}")
    else:
        lines.append(f"time = {_time(found, time)}")
    rules = [*_array_rules(found, apart), *_rules(found, [name for name in found.names if name not in apart])]
    rules += [f"{{ match = {_quoted(f'{name}*')}, skip = true }}," for name in group.skipped]
    lines += ["columns = [", *(f"    {rule}" for rule in rules), "]"]
    return "\n".join(lines)


def _array_rules(found: Looked, apart: set[str]) -> list[str]:
    """Return an entry for each array of several values per row; its columns are added to ``apart``."""
    rules = []
    placed = [name for name, array in found.arrays.items() if _shape(name, array)]
    for name in placed:
        array = found.arrays[name]
        shape = _shape(name, array)
        kind = array.dtype.name if array.dtype.name in TYPES else "float64"
        axes = ["x", "y", "z"] if shape[-1] == 3 else []
        quantity, unit = meaning(name, kind)
        if quantity == UNKNOWN and shape == (3,):
            quantity, unit = meaning(f"{name}_x", kind)
        named = (
            f'name = "{name}{{taxel}}{"_{axis}" if axes else ""}", '
            if len(placed) > 1 and quantity == "tactile"
            else ""
        )
        entries = f"match = {_quoted(f'{name}_*')}, {named}quantity = {_quoted(quantity)}, unit = {_quoted(unit)}"
        entries += f", type = {_quoted(kind)}, shape = {list(shape)}" + (f", axes = {json.dumps(axes)}" if axes else "")
        rules.append(f"{{ {entries} }},")
        apart |= {column for column in found.names if _is_of(column, name)}
    return rules


def _shape(name: str, array: ArrayMember) -> tuple[int, ...]:
    """Return the shape of an array's rows where it places values in a sensor or a vector, else nothing."""
    vector = array.row_shape == (3,)
    return (
        array.row_shape
        if len(array.row_shape) > 1 or vector or (array.width and meaning(name, "")[0] == "tactile")
        else ()
    )


def _written(found: Looked, path: Path) -> list[str]:
    """Return the entries that state how a text file is written."""
    text = found.text
    assert text is not None
    usual = "\t" if ".tsv" in [suffix.lower() for suffix in path.suffixes] else ","
    entries = [
        ("encoding", found.encoding, "utf-8"),
        ("separator", text.separator, usual),
        ("decimal", text.decimal, "."),
        ("comment", text.comment, ""),
    ]
    lines = [f"{name} = {_quoted(value)}" for name, value, default in entries if value != default]
    if text.skip_lines:
        lines.append(f"skip_lines = {text.skip_lines}")
    if text.units:
        lines.append(f"header = [{', '.join(map(_quoted, text.names))}]  # below them the file has a row of units")
    elif not text.header:
        lines.append("header = false  # or a list of the columns' names")
    if text.missing:
        lines.append(f"missing = [{', '.join(map(_quoted, text.missing))}]")
    return lines


def _time_column(found: Looked) -> str | None:
    """Return the column that holds stamps: one so named, else the first column where its numbers always rise."""
    rising = [name for name in found.names if _rises(found.values[name]) and not label_table.RECORDING.fullmatch(name)]
    stamped = {
        name
        for name in found.names
        if name in rising
        or any(isinstance(value, str | datetime.datetime | datetime.time) for value in found.values[name])
    }
    for named in (_TIME, _ENDS_IN_TIME):
        for name in found.names:
            if name in stamped and named.fullmatch(_base(name)):
                return name
    return rising[0] if rising and rising[0] == found.names[0] else None


def _base(name: str) -> str:
    """Return a column's name without the unit that it states in brackets.

    >>> _base("Fx [N]"), _base("time (ms)"), _base("pad[3]")
    ('Fx', 'time', 'pad[3]')
    """
    match = _UNIT_IN_NAME.fullmatch(name.strip())
    return match["base"] if match and match["base"] and not match["unit"].isdigit() else name.strip()


def _stated_unit(found: Looked, name: str) -> str:
    """Return the unit that the header or the row below it states of a column, '' where neither does."""
    match = _UNIT_IN_NAME.fullmatch(name.strip())
    text = found.units.get(name, "") or (match["unit"] if match and match["base"] else "")
    return vocabulary.unit_from_text(text.strip().strip("[]()"))


def _rises(values: Sequence[float | str | None]) -> bool:
    numbers = [value for value in values if isinstance(value, int | float)]
    return (
        len(numbers) == len(values) > 1
        and bool(np.all(np.diff(np.array(numbers, float)) >= 0))
        and numbers[-1] > numbers[0]
    )


def _time(found: Looked, column: str | None, file: str = "") -> str:
    """Return the entry ``time`` for stamps in a column; ``file`` names the file that holds it where it is another one."""
    if column is None:
        return f'{{ rate_hz = "{UNKNOWN}" }}  # no column rises as stamps do; write the rate'
    where = file or f"column = {_quoted(column)}"
    values = found.values[column]
    texts = [value for value in values if isinstance(value, str)]
    if any(isinstance(value, datetime.datetime | datetime.time) for value in values):
        return f"{{ {where} }}"
    if any(_ISO.match(text) for text in texts):
        return f'{{ {where}, unit = "iso8601" }}'
    if texts:
        return _text_time(texts, where)
    first = next((abs(value) for value in values if isinstance(value, int | float)), 0.0)
    for most, unit in ((1e11, "s"), (1e14, "ms"), (1e17, "us"), (float("inf"), "ns")):
        if 1e8 <= first < most:
            return f'{{ {where}, unit = "{unit}" }}'
    suffix = re.search(r"(?:^|[_ ])(ms|us|ns|s|sec|seconds)$", _base(column), re.IGNORECASE)
    stated = _stated_unit(found, column) or vocabulary.unit_from_text(suffix[1] if suffix else "")
    steps = np.diff([value for value in values if isinstance(value, float)])
    if not stated and len(steps) and 0 < float(np.median(steps)) < 0.5:  # thousands of rows per second otherwise
        stated = "s"
    unit = stated if stated in stamps.DIGITS else UNKNOWN
    return f'{{ {where}, unit = "{unit}", origin = "start" }}  # counts from the start of the recording'


def _text_time(texts: Sequence[str], where: str) -> str:
    """Return the entry ``time`` for stamps that are text, in the formats that read all of them with days in order."""
    fitting = []
    for text in _STAMP_FORMATS:
        t_ns, valid = stamp_formats.nanoseconds(pa.array(texts), text)
        if valid.all():
            fitting.append((int(t_ns.max() - t_ns.min()), text))
    if not fitting:
        return f'{{ {where}, format = "{UNKNOWN}" }}  # as strptime has it, for texts such as {_quoted(texts[0])}'
    text = min(fitting)[1]
    if not stamp_formats.has_date(text):
        return f'{{ {where}, format = "{text}" }}  # the time of day; start = "2026-05-01" adds the day'
    others = [other for span, other in fitting if other != text and span == min(fitting)[0]]
    return f'{{ {where}, format = "{text}" }}' + (f"  # or {', '.join(others)}" if others else "")


def _rules(found: Looked, names: Sequence[str]) -> list[str]:
    """Return an entry for each set of columns whose names differ in numbers alone and whose values are alike."""
    by_rule: dict[tuple[str, ...], list[str]] = {}
    matches = {_match(_base(name)) for name in names}
    for name in names:
        values = [value for value in found.values[name] if value is not None]
        kind = _kind(values)
        quantity, unit = meaning(_base(name), kind)
        unit = _stated_unit(found, name) or unit
        match, bracket = _match(_base(name)), name.strip()[len(_base(name)) :]
        if quantity == "tactile" and {f"{match[:-1]}{axis}" for axis in "xyz"} <= matches:
            match = f"{match[:-1]}{{axis}}"
        by_rule.setdefault((match, bracket, quantity, unit, kind), []).append(name)
    rules = []
    whole = {part for name in names for part in [_part(_base(name))] if part}
    for (match, bracket, quantity, unit, kind), members in by_rule.items():
        base = _base(members[0]) if len(members) == 1 else _of_taxels(match, quantity, kind)
        if (
            quantity == UNKNOWN
            and kind.startswith("float")
            and {_place(_base(name)) for name in members} <= {"x", "y", "z"}
        ):
            quantity = "position" if whole >= set("xyzw") or unit in ("m", "cm", "mm") else quantity
        if kind == "text":
            rules.append(f"{{ match = {_quoted(base + bracket)}, skip = true }},")
            continue
        renamed = _identifier(base).lower() if bracket else _identifier(base)
        name = f"name = {_quoted(renamed)}, " if renamed != base + bracket else ""
        unlisted = len(members) >= 6 and "{" in base and not (found.text and found.text.header)
        comment = '  # of an array: add shape = [16, 3], axes = ["x", "y", "z"]' if unlisted else ""
        rules.append(
            f"{{ match = {_quoted(base + bracket)}, {name}quantity = {_quoted(quantity)}, unit = {_quoted(unit)}, "
            f"type = {_quoted(kind)} }},{comment}"
        )
    return sorted(rules, key=lambda rule: rule.partition("quantity")[0].count("{"))  # exact names before patterns


def _identifier(base: str) -> str:
    """Return a column's name as letters, digits and underscores, with its placeholders.

    >>> _identifier("Taxel {taxel}"), _identifier("fx"), _identifier("F.x")
    ('taxel_{taxel}', 'fx', 'f_x')
    """
    if re.fullmatch(r"[\w{}]+", base):
        return base
    return re.sub(r"[^\w{}]+", "_", base.lower()).strip("_") or base


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
    if not taxels or match.replace("{axis}", "").count("{") != 1:
        return match
    return re.sub(r"\{(?!axis\})\w+\}", "{taxel}", match)


def _match(name: str) -> str:
    """Return a name with its numbers as placeholders.

    >>> _match("taxel3_x"), _match("t12"), _match("r1c2")
    ('taxel{taxel}_x', 't{number}', 'r{r}c{c}')
    """
    counter = itertools.count(2)
    seen: set[str] = set()

    def placeholder(found: re.Match[str]) -> str:
        word = found[1].strip("_ .").lower()
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

    return re.sub(r"([A-Za-z_]*[ .]?)\d+", placeholder, name)


def meaning(name: str, kind: str) -> tuple[str, str]:
    """Return the quantity and the unit that a name shows.

    >>> meaning("force_x_n", "float64"), meaning("fx", "float64"), meaning("taxel3", "uint16")
    (('force', 'N'), ('force', '?'), ('tactile', 'count'))
    """
    text = _identifier(name.strip())
    if is_label(text):
        return "label", "1"
    if is_clock(text):
        return "time", UNKNOWN
    for wanted, quantity in _MEANINGS:
        if re.search(rf"(?:^|_)(?:{wanted})$", text, re.IGNORECASE):
            if quantity == "tactile" and "int" in kind:
                return quantity, "count"
            said = (unit for end, unit, of in _SUFFIXES if quantity in of and re.search(f"{end}$", text, re.IGNORECASE))
            return quantity, _UNITS.get(quantity) or next(said, UNKNOWN)
    return UNKNOWN, UNKNOWN


def is_label(name: str) -> bool:
    """Return whether a name is that of labels, which are no readings, even where the name begins with a sensor.

    >>> is_label("tactile_slips_label"), is_label("skin_mask"), is_label("label_free_force")
    (True, True, False)
    """
    return bool(
        re.search(
            r"(?:^|[_./ ])(?:labels?|mask|class(?:es)?|annotations?|ground_?truth|target_?class)$", name, re.IGNORECASE
        )
    )


def is_clock(name: str) -> bool:
    """Return whether a name is that of stamps, whatever sensor it names too.

    >>> is_clock("tactile_timestamps"), is_clock("obs/time_ns"), is_clock("contact_time_constant")
    (True, True, False)
    """
    last = re.split(r"[/.]", name)[-1]
    return bool(_TIME.fullmatch(last) or (_ENDS_IN_TIME.fullmatch(last) and not re.search(r"_t$", last)))


def _kind(values: Sequence[float | str]) -> str:
    if not values or any(isinstance(value, str) for value in values):
        return "text" if values else "float64"
    if any(isinstance(value, bool) for value in values):
        return "bool"
    if not all(isinstance(value, int | float) for value in values):
        return "text"
    if any(isinstance(value, float) for value in values):  # 2.0 too: a cell below it may hold 2.5
        return "float64"
    numbers = [int(value) for value in values]
    return next((kind for kind, least, most in _INTEGERS if least <= min(numbers) and max(numbers) <= most), "float64")


def _quoted(text: str) -> str:
    return json.dumps(plain(text, 500) if not text.isprintable() and text != "\t" else text, ensure_ascii=False)
