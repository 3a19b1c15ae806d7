"""The stages of a ``dvc.yaml`` file, and the order in which they run: each after those whose outputs it reads."""

from __future__ import annotations

import posixpath
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

from tacpipe.engine.chains import template
from tacpipe.errors import UsageError
from tacpipe.io import regular, yaml_text
from tacpipe.printable import excerpt, listed, plain

PARAMS = "params.yaml"  # whose values every text may use
_OUTPUTS = ("outs", "metrics", "plots")
_SHOWN = 8  # names of stages that an error lists


@dataclass(frozen=True)
class ChainStage:
    """One stage of a chain: its commands in their order, and the paths that it reads and writes."""

    name: str  # with what follows ``@`` where it is one of several
    commands: Sequence[str]
    reads: Sequence[str]
    writes: Sequence[str]
    frozen: bool = False  # it is not run

    @property
    def group(self) -> str:
        """The name as it stands in the file."""
        return self.name.partition("@")[0]


@dataclass(frozen=True)
class Chain:
    """Stages in the order in which they run, and the names of those that each depends on directly."""

    stages: Sequence[ChainStage]
    after: Mapping[str, frozenset[str]]


def load(file: Path, wanted: Sequence[str] = ()) -> Chain:
    """Return the stages of a file of the format of ``dvc.yaml``, in their order.

    ``wanted`` are names of stages, or of groups of them (``train`` for every ``train@…``): then it is these and all that
    they depend on. Raises `UsageError` for a file that is not such a one, for what DVC knows and this does not, for names
    that are not in it, and where stages depend on each other in a circle.
    """
    found = list(_stages(file))
    by_name = {stage.name: stage for stage in found}
    after = _dependencies(found, file)
    try:
        ordered = list(TopologicalSorter(after).static_order())
    except CycleError as error:
        raise UsageError(f"{file}: these stages depend on each other: {' -> '.join(error.args[1])}.") from None
    needed = _needed(by_name, after, wanted, file)
    return Chain([by_name[name] for name in ordered if name in needed], after)


def _stages(file: Path) -> Iterator[ChainStage]:
    content = _mapping(file)
    values = _values(file, content.get("vars") or [], _mapping(file.with_name(PARAMS), missing=True), str(file))
    stages = content.get("stages")
    if not isinstance(stages, Mapping) or not stages:
        raise UsageError(f"{file} has no stages; it must hold them as a dvc.yaml does: `dvc stage add` writes one.")
    for name, definition in stages.items():
        where = f"{file}, stage {plain(str(name))}"
        if not isinstance(definition, Mapping):
            raise UsageError(f"{where}: it is {excerpt(definition)}; it must be a mapping with a cmd.")
        for key, given, known in template.several(definition, values, where):
            if not isinstance(given, Mapping):
                raise UsageError(f"{where}: it has no `do` with a cmd.")
            yield _stage(f"{name}@{key}" if key else str(name), given, known, file, where)


def _stage(name: str, given: Mapping[str, Any], values: template.Values, file: Path, where: str) -> ChainStage:
    values = _values(file, given.get("vars") or [], values, where)
    used = {key: given[key] for key in ("cmd", "deps", "params", *_OUTPUTS, "wdir") if key in given}
    made = template.filled(used, values, where)
    commands = made.get("cmd")
    commands = [commands] if isinstance(commands, str) else commands
    if not isinstance(commands, list) or not commands or not all(isinstance(one, str) for one in commands):
        raise UsageError(f"{where}: its cmd is {excerpt(commands)}; it must be a command or a list of them.")
    if made.get("wdir", ".") != ".":
        raise UsageError(
            f"{where}: it has the wdir {excerpt(made['wdir'])}, which `tacpipe run` does not know. Write the paths "
            f"relative to {file.name}, or run it with `dvc repro`."
        )
    files = [one for one in made.get("params") or [] if isinstance(one, Mapping)]  # of params, but for params.yaml
    reads = [*_paths(made.get("deps"), where), *(path for one in files for path in map(str, one))]
    writes = [path for kind in _OUTPUTS for path in _paths(made.get(kind), where)]
    return ChainStage(name, [one.strip() for one in commands], reads, writes, bool(given.get("frozen")))


def _paths(given: Any, where: str) -> list[str]:
    """Return the paths of a list, whose entries are paths or mappings from one to its options."""
    found = []
    for one in given or []:
        path = next(iter(one), None) if isinstance(one, Mapping) else one
        if not isinstance(path, str):
            raise UsageError(f"{where}: {excerpt(one)} is not a path.")
        found.append(posixpath.normpath(path))
    return found


def _values(file: Path, given: Any, before: template.Values, where: str) -> template.Values:
    """Return the values that texts may use: those of ``before``, and over them those of ``vars``."""
    values = dict(before)
    if not isinstance(given, list):
        raise UsageError(f"{where}: vars is {excerpt(given)}; it must be a list.")
    for one in given:
        if isinstance(one, str) and one.endswith((".yaml", ".yml")):
            one = _mapping(file.with_name(one))
        if not isinstance(one, Mapping):
            raise UsageError(f"{where}: vars has {excerpt(one)}; `tacpipe run` reads mappings and YAML files there.")
        values = _merged(values, one)
    return values


def _merged(before: template.Values, over: template.Values) -> dict[str, Any]:
    both = {
        key: _merged(before[key], value)
        if isinstance(value, Mapping) and isinstance(before.get(key), Mapping)
        else value
        for key, value in over.items()
    }
    return {**before, **both}


def _mapping(file: Path, *, missing: bool = False) -> Mapping[str, Any]:
    """Return what a YAML file holds; nothing of one that may be ``missing`` and is."""
    try:
        value = yaml_text.load(regular.content(file, yaml_text.LONGEST))
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
    """Return the names of the stages that each stage reads an output of: a path, or what lies within one."""
    writers: dict[str, str] = {}
    within: dict[str, set[str]] = {}  # folder to the stages that write below it
    for stage in stages:
        for path in stage.writes:
            if writers.setdefault(path, stage.name) != stage.name:
                raise UsageError(f"{file}: the stages {writers[path]} and {stage.name} both write {plain(path)}.")
            for folder in _above(path):
                within.setdefault(folder, set()).add(stage.name)
    after = {}
    for stage in stages:
        found = {writers[one] for path in stage.reads for one in (path, *_above(path)) if one in writers}
        found |= {name for path in stage.reads for name in within.get(path, ())}
        after[stage.name] = frozenset(found - {stage.name})
    return after


def _above(path: str) -> Iterator[str]:
    while (folder := posixpath.dirname(path)) != path and folder:
        yield folder
        path = folder


def _needed(
    stages: Mapping[str, ChainStage], after: Mapping[str, frozenset[str]], wanted: Sequence[str], file: Path
) -> set[str]:
    if not wanted:
        return set(stages)
    found: set[str] = set()
    for name in wanted:
        chosen = {stage.name for stage in stages.values() if name in (stage.name, stage.group)}
        if not chosen:
            groups = dict.fromkeys(stage.group for stage in stages.values())
            raise UsageError(f"{file} has no stage {plain(name)}; it has {listed(groups, _SHOWN)}.")
        found |= chosen
    waiting = list(found)
    while waiting:
        new = after[waiting.pop()] - found
        found |= new
        waiting += new
    return found
