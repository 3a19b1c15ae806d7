"""From defaults, ``params.yaml``, presets and options to a stage's params."""

from __future__ import annotations

import dataclasses
import inspect
import re
import sys
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args, get_origin

from tacpipe import regular, yaml_text
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.excerpt import excerpt, listed, plain
from tacpipe.stage import Stage

PRESETS = ("paper", "quick")


def build(
    name: str,
    stage: Stage,
    *,
    file: Path | None = None,
    block: str | None = None,
    preset: str | None = None,
    sets: Sequence[str] = (),
    options: Mapping[str, Any] | None = None,
) -> Any:
    """Return the params of stage ``name``: defaults, then file, preset, ``--set``, options, each over the one before.

    Raises `UsageError` for an unknown name or a value of the wrong type, with where it stands.
    """
    values: dict[str, Any] = {}
    if file is not None:
        values.update(_from_file(file, block or name, required=block is not None))
        where = f"{file}, block {block or name}"
        values = {key: check(stage, key, value, where) for key, value in values.items()}
    if preset is not None:
        values.update(_from_preset(name, stage, preset))
    for text in sets:
        key, _, value = text.partition("=")
        field = key.removeprefix(f"{name}.")
        values[field] = check(stage, field, _parse(value), f"--set {text}")
    for key, value in (options or {}).items():
        values[key] = check(stage, key, value, f"--{key.replace('_', '-')}")
    try:
        return stage.params(**values)
    except TypeError as error:
        raise UsageError(f"The params of {name} are not complete: {error}.") from error


def fields(stage: Stage) -> dict[str, Any]:
    """Return the type of each param of a stage."""
    hints = typing.get_type_hints(stage.params)
    return {field.name: hints[field.name] for field in dataclasses.fields(stage.params)}


def check(stage: Stage, key: str, value: Any, where: str) -> Any:
    """Return ``value`` if the param ``key`` can hold it, an int as a float where one is wanted.

    Raises `UsageError` otherwise.
    """
    return _checked(fields(stage), key, value, where, "param")


def _checked(known: Mapping[str, Any], key: str, value: Any, where: str, noun: str) -> Any:
    if key not in known:
        told = plain(key) if isinstance(key, str) else excerpt(key)
        raise UsageError(f"{where}: there is no {noun} {told}; there are {', '.join(known) or 'none'}.")
    wanted = known[key]
    fitted = _fit(value, wanted, f"{where}, {key}")
    if fitted is _NO:
        raise UsageError(f"{where}: {key} is {excerpt(value)}, which is no {_name(wanted)}.")
    return fitted


def filled(kind: type[Any], values: Mapping[str, Any], where: str, noun: str = "param") -> Any:
    """Return the dataclass ``kind`` with ``values`` over its defaults, an int as a float where one is wanted.

    Raises `UsageError` for an unknown name, a value of the wrong type, and one without a default that is missing.
    """
    hints = typing.get_type_hints(kind)
    known = {field.name: hints[field.name] for field in dataclasses.fields(kind)}
    fitting = {key: _checked(known, key, value, where, noun) for key, value in values.items()}
    missing = [
        field.name
        for field in dataclasses.fields(kind)
        if field.default is field.default_factory is dataclasses.MISSING and field.name not in fitting
    ]
    if missing:
        raise UsageError(f"{where}: {noun} {' and '.join(missing)} must be given.")
    return kind(**fitting)


def added(default: Any) -> Any:
    """Return a field that was added to params later: in keys only where it is not its default.

    So what was computed before keeps its key, where the default gives the same result.
    """
    return dataclasses.field(default=default, metadata={"added": True})


def to_json(params: Any) -> dict[str, Any]:
    """Return the params as they stand in keys and manifests; those `added` only where they are not the default."""
    silent = {
        field.name
        for field in dataclasses.fields(params)
        if field.metadata.get("added") and getattr(params, field.name) == field.default
    }
    values = {name: value for name, value in dataclasses.asdict(params).items() if name not in silent}
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def from_json(stage: Stage, values: Mapping[str, Any]) -> Any:
    """Return the params that `to_json` gave."""
    known = fields(stage)
    return stage.params(**{k: tuple(v) if get_origin(known.get(k)) is tuple else v for k, v in values.items()})


def comments(stage: Stage) -> dict[str, str]:
    """Return the comment behind each field of a stage's params, which is its help."""
    try:
        lines = inspect.getsource(stage.params).splitlines()
    except (OSError, TypeError):
        return {}
    found = (re.match(r"\s+(\w+)\s*:[^#]*#\s*(.*)", line) for line in lines)
    return {match[1]: match[2] for match in found if match}


_NO = object()
_EXPONENT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+")  # YAML 1.1 takes 1e-3 for text, and nobody else does


def _fit(value: Any, wanted: Any, where: str) -> Any:
    """Return ``value`` as what is wanted, or `_NO`; a mapping fills a dataclass, which raises as `filled` does."""
    origin = get_origin(wanted)
    if origin in (typing.Union, types.UnionType):
        return next((fit for kind in get_args(wanted) if (fit := _fit(value, kind, where)) is not _NO), _NO)
    if origin is typing.Literal:  # 1, 1.0 and True are equal, and three values in a key
        return next((one for one in get_args(wanted) if one == value and type(one) is type(value)), _NO)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            return _NO
        fits = [_fit(item, get_args(wanted)[0], f"{where} {row}") for row, item in enumerate(value, start=1)]
        return _NO if any(fit is _NO for fit in fits) else tuple(fits)
    if dataclasses.is_dataclass(wanted):
        if isinstance(value, Mapping):
            return filled(typing.cast(type, wanted), value, where, "key")
        return value if isinstance(value, typing.cast(type, wanted)) else _NO
    if wanted is float and isinstance(value, str) and _EXPONENT.fullmatch(value):
        value = float(value)
    if wanted is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value) + 0.0 if abs(value) <= sys.float_info.max else _NO  # NaN is none; -0.0 becomes 0.0
    if wanted is str and isinstance(value, str) and not _encodes(value):
        return _NO
    if wanted is type(None):
        return value if value is None else _NO
    right = isinstance(value, wanted) and (wanted is bool or not isinstance(value, bool))
    return value if right else _NO


def _encodes(text: str) -> bool:
    """Return whether text is Unicode: of other bytes on the command line halves of characters are made."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _name(wanted: Any) -> str:
    if get_origin(wanted) is typing.Literal:
        return "one of " + ", ".join(map(str, get_args(wanted)))
    kinds = [kind for kind in get_args(wanted) if kind is not type(None)]
    if get_origin(wanted) in (typing.Union, types.UnionType) and len(kinds) == 1:
        return _name(kinds[0])
    if get_origin(wanted) is tuple:
        return f"list, each {_name(kinds[0])}"
    if dataclasses.is_dataclass(wanted):
        return f"table of {', '.join(field.name for field in dataclasses.fields(wanted))}"
    names = {float: "number", int: "whole number", str: "text", bool: "true or false"}
    return names.get(wanted, str(wanted))


def _parse(text: str) -> Any:
    try:
        return yaml_text.load(text)
    except ValueError:
        return text


def _from_file(path: Path, block: str, *, required: bool) -> dict[str, Any]:
    try:
        found = yaml_text.load(regular.content(path)) or {}
    except FileNotFoundError:
        raise UsageError(f"There is no file {path} to read params from.") from None
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error
    except TacpipeError as error:
        raise UsageError(str(error)) from error
    except ValueError as error:
        raise UsageError(f"{path} cannot be read: {error}.") from error
    for part in block.split("."):
        if not isinstance(found, dict):
            raise UsageError(f"{path}: {part} of block {block} stands in {excerpt(found)}, which is no mapping.")
        if part not in found:
            if required:
                raise UsageError(f"{path} has no block {block}; at {part} there are {listed(found)}.")
            return {}
        found = found[part]
    if not isinstance(found, dict):
        raise UsageError(f"{path}: block {block} is {excerpt(found)}; it should be a mapping of params.")
    return found


def _from_preset(name: str, stage: Stage, preset: str) -> dict[str, Any]:
    presets = getattr(stage.params, "PRESETS", {})
    known = dict.fromkeys([*PRESETS, *presets])
    if preset not in known:
        raise UsageError(f"There is no preset {preset}; there are {', '.join(known)}.")
    return {
        key: check(stage, key, value, f"preset {preset} of {name}") for key, value in presets.get(preset, {}).items()
    }
