"""Read chains of commands from a ``dvc.yaml`` file: their stages, what each reads and writes, and their order.

``${name}`` in text is replaced as DVC replaces it. A stage runs after the stages whose outputs it reads.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from itertools import product
from pathlib import Path
from typing import Any

from tacpipe.errors import UsageError
from tacpipe.io import Json, JsonObject, config_text, regular
from tacpipe.printable import excerpt, listed, plain

_FIELD = re.compile(r"(?<!\\)\$\{(?P<name>.*?)\}")
_PART = re.compile(r"[^.\[\]]+")


Variables = JsonObject  # values by name, of a chain's file or of its params


def fill_template(value: Any, values: Variables, place: str) -> Any:
    """Return ``value`` with each ``${name}`` in its texts replaced; a text that consists only of a name becomes its value.

    ``place`` is included in errors. Raises `UsageError` for a name without a value, and for a list or mapping inside a
    text.

    >>> fill_template(["${a.b[1]}", "x-${a.c}"], {"a": {"b": [1, 2], "c": True}}, "dvc.yaml")
    [2, 'x-true']
    """
    if isinstance(value, Mapping):
        return {fill_template(key, values, place): fill_template(item, values, place) for key, item in value.items()}
    if isinstance(value, list):
        return [fill_template(item, values, place) for item in value]
    if not isinstance(value, str):
        return value
    single = _FIELD.fullmatch(value)
    if single is not None:
        return _value(single["name"], values, place)
    text = _FIELD.sub(lambda match: _value_text(match["name"], values, place), value)
    return text.replace(r"\${", "${")


def expand(definition: Json, values: Variables, place: str) -> Iterator[tuple[str, Any, Variables]]:
    """Yield the stages of a definition: the part of the name after ``@``, the template and its values.

    A definition without ``foreach`` and ``matrix`` is one stage with an empty part. Raises `UsageError` if ``foreach``
    is not a list or mapping, or ``matrix`` not a mapping of lists.
    """
    if "foreach" in definition:
        for key, stage_values in _foreach_items(fill_template(definition["foreach"], values, place), place):
            yield key, definition.get("do"), {**values, **stage_values}
    elif "matrix" in definition:
        template = {name: value for name, value in definition.items() if name != "matrix"}
        for key, item in _combinations(fill_template(definition["matrix"], values, place), place):
            yield key, template, {**values, "item": item, "key": key}
    else:
        yield "", definition, values


def _foreach_items(items: Any, place: str) -> Iterator[tuple[str, Variables]]:
    """Yield the name part and the variables (``item``, and ``key`` for a mapping) of each stage of a ``foreach``.

    Raises `UsageError` if ``items`` is not a list or mapping.
    """
    if isinstance(items, Mapping):
        yield from ((_text(key), {"key": _text(key), "item": item}) for key, item in items.items())
    elif isinstance(items, list):
        nested = any(isinstance(item, Mapping | list) for item in items)
        yield from ((_text(number if nested else item), {"item": item}) for number, item in enumerate(items))
    else:
        raise UsageError(f"{place}: foreach is {excerpt(items)}; it must be a list or a mapping.")


def _combinations(axes: Any, place: str) -> Iterator[tuple[str, Variables]]:
    """Yield a name and the variables of each combination of a ``matrix``, which has a list of items per axis.

    Raises `UsageError` if ``axes`` is not a mapping of lists.
    """
    if not isinstance(axes, Mapping) or not all(isinstance(items, list) for items in axes.values()):
        raise UsageError(f"{place}: matrix is {excerpt(axes)}; it must be a mapping of lists.")
    for chosen in product(*(enumerate(items) for items in axes.values())):
        choice = dict(zip(axes, chosen, strict=True))
        parts = [
            f"{axis}{number}" if isinstance(item, Mapping | list) else _text(item)
            for axis, (number, item) in choice.items()
        ]
        yield "-".join(parts), {axis: item for axis, (_, item) in choice.items()}


def _value_text(name: str, values: Variables, place: str) -> str:
    value = _value(name, values, place)
    if isinstance(value, Mapping | list):
        raise UsageError(f"{place}: ${{{name}}} is {excerpt(value)}, which `tacpipe run` does not put into a text.")
    return _text(value)


def _value(name: str, values: Variables, place: str) -> Any:
    """Return the value of a name such as ``a.b[1]`` in ``values``. Raises `UsageError` if there is none."""
    value: Any = values
    for part in _PART.findall(name):
        try:
            value = value[int(part)] if isinstance(value, Sequence) and not isinstance(value, str) else value[part]
        except (LookupError, TypeError, ValueError):
            raise UsageError(f"{place}: ${{{name}}} has no value; give it one in params.yaml or under vars.") from None
    return value


def _text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


PARAMS = "params.yaml"  # params file whose values can be used in every text of a chain
_OUTPUTS = ("outs", "metrics", "plots")
_SHOWN = 8  # number of stage names listed in an error

# The schema of DVC 3: a type, a list with one schema, a mapping of keys, or a tuple of alternatives.
_VARS = [(str, dict)]
_OPTIONS = {
    **dict.fromkeys(("cache", "persist", "checkpoint", "push"), bool),
    **{"remote": str, "desc": str, "type": str, "labels": [str], "meta": object},
}
_PLOT = {**_OPTIONS, **dict.fromkeys(("template", "x", "y", "x_label", "y_label", "title"), str), "header": bool}
_STAGE = {
    **{"cmd": (str, list), "wdir": str, "deps": [str], "params": [(str, {str: object})], "vars": _VARS},
    **{"outs": [(str, {str: _OPTIONS})], "metrics": [(str, {str: _OPTIONS})], "plots": [(str, {str: _PLOT})]},
    **{"frozen": bool, "always_changed": bool, "meta": object, "desc": str},
}
_MATRIX = {**_STAGE, "matrix": {str: (str, list)}}
_FOREACH = {"foreach": (dict, list, str), "do": _STAGE}
_FILE = {
    **{"stages": {str: dict}, "vars": _VARS, "params": [str], "metrics": [str], "plots": [(str, {str: object})]},
    **{"datasets": object, "artifacts": {str: object}},
}
_EXPECTED = {
    **{"deps": "a list of paths, as [data/raw]", "params": "a list of names, or of mappings from a file to names"},
    **dict.fromkeys(
        _OUTPUTS, "a list of paths, or of mappings from a path to its options, as [{model: {cache: false}}]"
    ),
    **{
        "stages": "a mapping of names to stages: `dvc stage add` writes one",
        "vars": "a list of mappings and YAML files",
    },
    **{"cmd": "a command or a list of them", "frozen": "true or false", "always_changed": "true or false"},
    **{"foreach": "a list or a mapping", "do": "a mapping with a cmd", "matrix": "a mapping of lists"},
}


@dataclass(frozen=True)
class ChainStage:
    """One stage of a chain: its commands in order, and the paths that it reads and writes."""

    name: str  # full name, including the part after ``@``
    commands: Sequence[str]
    reads: Sequence[str]
    writes: Sequence[str]
    frozen: bool = False  # whether the stage is skipped

    @property
    def group(self) -> str:
        """The name in the file, without the part after ``@``."""
        return self.name.partition("@")[0]


@dataclass(frozen=True)
class Chain:
    """Stages in execution order, and the direct dependencies of each by name."""

    stages: Sequence[ChainStage]
    after: Mapping[str, frozenset[str]]


def load(file: Path, names: Sequence[str] = ()) -> Chain:
    """Return the stages of a ``dvc.yaml`` file in execution order.

    With ``names``, which are stages or groups (``train`` for every ``train@…``), only these and their dependencies are
    returned. Raises `UsageError` for an invalid file, for unsupported parts of DVC's format, for unknown names, and for
    circular dependencies.
    """
    by_name: dict[str, ChainStage] = {}
    for stage in _read_stages(file):
        if by_name.setdefault(stage.name, stage) != stage:
            raise UsageError(f"{file} has two stages {plain(stage.name)}; give one of them another name.")
    stages = list(by_name.values())
    after = _dependencies(stages, file)
    try:
        ordered = list(TopologicalSorter(after).static_order())
    except CycleError as error:
        raise UsageError(f"{file}: these stages depend on each other: {' -> '.join(error.args[1])}.") from None
    needed = _needed_stages(by_name, after, names, file)
    return Chain([by_name[name] for name in ordered if name in needed], after)


def _read_stages(file: Path) -> Iterator[ChainStage]:
    """Yield the stages of a ``dvc.yaml`` file, with ``foreach`` and ``matrix`` expanded.

    Raises `UsageError` if it is invalid.
    """
    content = _read_mapping(file)
    _check(content, _FILE, str(file))
    values = _values(file, content.get("vars", []), _read_mapping(file.with_name(PARAMS), missing=True), str(file))
    if not content.get("stages"):
        raise UsageError(f"{file} has no stages; it must hold them as a dvc.yaml does: `dvc stage add` writes one.")
    for name, definition in content["stages"].items():
        place = f"{file}, stage {plain(name)}"
        if not name or "@" in name:
            raise UsageError(f"{place}: give it a name without @, because names of foreach and matrix contain it.")
        is_group = "foreach" in definition or "do" in definition
        _check(definition, _FOREACH if is_group else _MATRIX, place)
        if is_group:
            for key in _FOREACH:
                if key not in definition:
                    raise UsageError(f"{place}: foreach and do belong together, and it has no {key}.")
            _check(definition["do"], _STAGE, f"{place}, do")
        for key, stage_definition, stage_values in expand(definition, values, place):
            yield _build_stage(f"{name}@{key}" if key else name, stage_definition, stage_values, file, place)


def _check(content: Json, schema: Json, place: str) -> None:
    """Raise `UsageError` for an unknown key in a part of the file, and for a value that does not match the schema."""
    for key, value in content.items():
        if key not in schema:
            raise UsageError(f"{place}: there is no key {excerpt(key)}; there are {listed(schema, len(schema))}.")
        # the keys of a mapping are checked below
        if not _fits(value, schema[key]) and not (key == "do" and isinstance(value, Mapping)):
            expected = _EXPECTED.get(key, "a text")
            raise UsageError(f"{place}: its {key} is {excerpt(value)}; it must be {expected}.")


def _fits(value: Any, schema: Any) -> bool:
    """Return whether a value matches a schema.

    A schema is a type, a tuple of alternatives, a list with the schema of its items, or a mapping with the schema of
    each key (``str`` for all keys).
    """
    if isinstance(schema, tuple):
        return any(_fits(value, choice) for choice in schema)
    if isinstance(schema, list):
        return isinstance(value, list) and all(_fits(item, schema[0]) for item in value)
    if not isinstance(schema, dict):
        return isinstance(value, schema)
    if not isinstance(value, Mapping):
        return False
    if str in schema:
        return all(isinstance(key, str) and _fits(item, schema[str]) for key, item in value.items())
    return all(key in schema and _fits(item, schema[key]) for key, item in value.items())


def _build_stage(name: str, definition: Json, values: Variables, file: Path, place: str) -> ChainStage:
    """Return a stage with its templates filled in.

    Raises `UsageError` for invalid commands and paths, and for a ``wdir`` other than the folder of ``file``.
    """
    stage_values = _values(file, definition.get("vars", []), values, place)
    used = {key: definition[key] for key in ("cmd", "deps", "params", *_OUTPUTS, "wdir") if key in definition}
    resolved = fill_template(used, stage_values, place)
    commands = resolved["cmd"] if isinstance(definition.get("cmd"), list) else [resolved.get("cmd")]
    if not commands or not all(isinstance(command, str) for command in commands):
        raise UsageError(f"{place}: its cmd is {excerpt(resolved.get('cmd'))}; it must be {_EXPECTED['cmd']}.")
    if posixpath.normpath(resolved.get("wdir", ".")) != ".":
        raise UsageError(
            f"{place}: it has the wdir {excerpt(resolved['wdir'])}, which `tacpipe run` does not know. Write the paths "
            f"relative to {file.name}, or run it with `dvc repro`."
        )
    folder = file.parent.absolute().as_posix()
    # params files other than params.yaml
    files = [entry for entry in resolved.get("params", []) if isinstance(entry, Mapping)]
    reads = _paths([*resolved.get("deps", []), *files], folder, place)
    writes = [path for kind in _OUTPUTS for path in dict.fromkeys(_paths(resolved.get(kind, []), folder, place))]
    for path in writes:
        if path == "." or _is_within(folder, path):
            raise UsageError(f"{place}: it writes {plain(path)}, the folder of {file.name}. Name what it writes there.")
        if path in reads or writes.count(path) > 1:
            raise UsageError(
                f"{place}: it has {plain(path)} twice. Name a path once, under deps, outs, metrics or plots."
            )
    return ChainStage(name, [command.strip() for command in commands], reads, writes, definition.get("frozen", False))


def _paths(entries: Sequence[Any], folder: str, place: str) -> list[str]:
    """Return the paths of entries, which are paths or mappings from paths to options.

    Paths within ``folder`` become relative to it, others absolute. Raises `UsageError` for an entry that is not a path.
    """
    paths = []
    for entry in entries:
        for path in entry if isinstance(entry, Mapping) else [entry]:
            if not isinstance(path, str) or not path:
                raise UsageError(f"{place}: {excerpt(path)} is not a path.")
            full = posixpath.normpath(posixpath.join(folder, path))
            paths.append(posixpath.relpath(full, folder) if _is_within(full, folder) else full)
    return paths


def _is_within(path: str, folder: str) -> bool:
    return posixpath.isabs(folder) and posixpath.commonpath([path, folder]) == folder


def _values(file: Path, entries: Sequence[Any], before: Variables, place: str) -> Variables:
    """Return the variables ``before``, overridden by ``entries`` of ``vars``: mappings, or names of YAML files.

    Raises `UsageError` for other entries.
    """
    values = before
    for entry in entries:
        is_file = isinstance(entry, str) and entry.endswith((".yaml", ".yml"))
        variables = _read_mapping(file.with_name(entry)) if is_file else entry
        if not isinstance(variables, Mapping):
            raise UsageError(f"{place}: vars has {excerpt(entry)}; `tacpipe run` reads mappings and YAML files there.")
        values = _merge_values(values, variables)
    return values


def _merge_values(before: Variables, over: Variables) -> Variables:
    """Return the variables ``before`` overridden by ``over``; mappings with the same name are merged."""
    merged = {
        key: _merge_values(existing, value)
        if isinstance(value, Mapping) and isinstance(existing := before.get(key), Mapping)
        else value
        for key, value in over.items()
    }
    return {**before, **merged}


def _read_mapping(file: Path, *, missing: bool = False) -> Json:
    """Return the content of a YAML file; an empty mapping if the file does not exist and may be ``missing``.

    Raises `UsageError` if it cannot be read as a mapping.
    """
    try:
        value = config_text.load_yaml(regular.content(file, config_text.MAX_CHARACTERS))
    except FileNotFoundError:
        if missing:
            return {}
        raise UsageError(f"There is no {file}. Name a file that describes a chain as dvc.yaml does.") from None
    except IsADirectoryError:
        raise UsageError(f"{file} is a folder. Name a file that describes a chain as dvc.yaml does.") from None
    except ValueError as error:
        raise UsageError(f"{file} is not YAML: {error}.") from None
    if not isinstance(value, Mapping):
        raise UsageError(f"{file} holds {excerpt(value)}; it must hold a mapping.")
    return value


def _dependencies(stages: Sequence[ChainStage], file: Path) -> dict[str, frozenset[str]]:
    """Return, for each stage, the names of the stages whose outputs (or files within them) it reads.

    Raises `UsageError` if two stages write to the same path, or one within a path of the other.
    """
    writers: dict[str, str] = {}
    writers_below: dict[str, set[str]] = {}  # stages that write below a folder, by folder
    for stage in stages:
        for path in stage.writes:
            if writers.setdefault(path, stage.name) != stage.name:
                raise UsageError(f"{file}: the stages {writers[path]} and {stage.name} both write {plain(path)}.")
            for folder in _above(path):
                writers_below.setdefault(folder, set()).add(stage.name)
    for path, name in writers.items():
        for folder in _above(path):
            if folder in writers:
                raise UsageError(
                    f"{file}: the stage {name} writes {plain(path)} within {plain(folder)}, which {writers[folder]} writes."
                )
    dependencies = {}
    for stage in stages:
        providers = {
            writers[location] for path in stage.reads for location in (path, *_above(path)) if location in writers
        }
        providers |= {name for path in stage.reads for name in writers_below.get(path, ())}
        dependencies[stage.name] = frozenset(providers - {stage.name})
    return dependencies


def _above(path: str) -> Iterator[str]:
    while (folder := posixpath.dirname(path)) != path and folder:
        yield folder
        path = folder


def _needed_stages(
    stages: Mapping[str, ChainStage], dependencies: Mapping[str, frozenset[str]], names: Sequence[str], file: Path
) -> set[str]:
    """Return the stages that must run for ``names``, which are stages or groups, or all stages if there are no names.

    ``dependencies`` contains the stages that each stage depends on. Raises `UsageError` for an unknown name.
    """
    if not names:
        return set(stages)
    needed: set[str] = set()
    for name in names:
        matching = {stage.name for stage in stages.values() if name in (stage.name, stage.group)}
        if not matching:
            groups = dict.fromkeys(stage.group for stage in stages.values())
            raise UsageError(f"{file} has no stage {plain(name)}; it has {listed(groups, _SHOWN)}.")
        needed |= matching
    unvisited = list(needed)
    while unvisited:
        unseen = dependencies[unvisited.pop()] - needed
        needed |= unseen
        unvisited += unseen
    return needed
