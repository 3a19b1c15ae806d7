"""Combine the params from ``params.yaml``, presets and options, and check them before any data is read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import config_text, regular
from tacpipe.plugins import architectures
from tacpipe.plugins import fields as fields_of
from tacpipe.plugins import params as params_of
from tacpipe.plugins.constraints import TomlFile
from tacpipe.plugins.params import Kind
from tacpipe.plugins.stage import AnyStage, Values
from tacpipe.printable import excerpt, listed


class _Setting(NamedTuple):
    """A value and its source."""

    origin: str
    key: str
    value: Any
    option: bool = False

    @property
    def name(self) -> str:
        return self.origin if self.option else self.key

    @property
    def place(self) -> str:
        return "" if self.option else self.origin


def build(
    name: str,
    stage: AnyStage,
    *,
    file: Path | None = None,
    block: str | None = None,
    preset: str | None = None,
    sets: Sequence[str] = (),
    options: Values | None = None,
) -> Any:
    """Return the params of stage ``name``.

    Defaults are overridden by the file, the preset, ``--set`` and options, in this order. Raises `UsageError` for unknown
    names, invalid values, params of an architecture other than the chosen one, and invalid combinations.
    """
    file_settings = [] if file is None else _from_file(file, block or name, required=block is not None)
    option_settings = [_from_set(name, text) for text in sets]
    option_settings += [
        _Setting(f"--{key.replace('_', '-')}", key, value, True) for key, value in (options or {}).items()
    ]
    kind = _choose_kind(stage, file_settings, option_settings, preset)
    preset_settings = [] if preset is None else _from_preset(name, stage, kind, preset)
    values: dict[str, Any] = {}
    tag_name = params_of.tag(stage)
    for setting in (*file_settings, *preset_settings, *option_settings):
        is_overridden = setting.key == tag_name and setting.value not in params_of.choices(kind, setting.key)
        if not is_overridden:
            values[setting.key] = _convert_setting(stage, kind, setting, values)
    try:
        params = kind(**values)
    except TypeError as error:
        raise UsageError(f"The params of {name} are not complete: {error}.") from error
    if hasattr(params, "check"):
        params.check()
    return params


def _choose_kind(stage: AnyStage, early: Sequence[_Setting], late: Sequence[_Setting], preset: str | None) -> Kind:
    """Return the kind of params chosen by an option, or else by the preset if the file's kind does not have it."""
    kind = _kind_by_tag(stage, early)
    if any(setting.key == params_of.tag(stage) for setting in late):
        return _kind_by_tag(stage, late)
    if preset is None or preset in params_of.presets_of(kind):
        return kind
    return next(
        (alternative for alternative in params_of.kinds(stage) if preset in params_of.presets_of(alternative)), kind
    )


def _kind_by_tag(stage: AnyStage, settings: Sequence[_Setting]) -> Kind:
    """Return the kind selected by the last tag among ``settings``, or the default kind.

    Raises `UsageError` for a tag that no kind has.
    """
    name, kind = params_of.tag(stage), params_of.kinds(stage)[0]
    for setting in settings:
        if setting.key == name:
            architectures.require(stage.params, setting.value)
            value = fields_of.check(setting.value, params_of.fields(stage)[name], setting.name, setting.place)
            kind = next(
                candidate for candidate in params_of.kinds(stage) if value in params_of.choices(candidate, str(name))
            )
    return kind


def _convert_setting(stage: AnyStage, kind: Kind, setting: _Setting, before: Values) -> Any:
    """Return the value of ``setting`` converted to the type of its field in ``kind``.

    ``before`` contains the values converted so far. Raises `UsageError` for a name or value that this kind does not
    accept.
    """
    annotations, name = fields_of.hints(kind), params_of.tag(stage)
    if setting.key not in params_of.fields(stage):
        raise fields_of.unknown(setting.key, params_of.fields(stage), setting.origin, "param")
    subject = setting.name if setting.option else f"{setting.place}: {setting.key}"
    current = before.get(name, kind.__dataclass_fields__[name].default) if name else None
    if setting.key in annotations:
        annotation = annotations[setting.key]
        if fields_of.fits(setting.value, params_of.fields(stage)[setting.key]) and not fields_of.fits(
            setting.value, annotation
        ):
            rule = f"with {name} {current} it must be {fields_of.describe(annotation)}"
            raise UsageError(f"{subject} is {fields_of.format_value(setting.value)}; {rule}.")
        value = fields_of.check(setting.value, annotation, setting.name, setting.place)
        toml_files = [constraint for constraint in fields_of.metadata(annotation) if isinstance(constraint, TomlFile)]
        return toml_files[0].read(value) if toml_files else value
    owners = params_of.choices_with(stage, setting.key)
    raise UsageError(
        f"{subject} belongs to the {name} {_or(owners)}, and the {name} is {current}. "
        f"Leave it out, or set {name} to {_or(owners)}."
    )


def _or(names: Sequence[str]) -> str:
    return "".join(names) if len(names) < 2 else f"{', '.join(names[:-1])} or {names[-1]}"


def _from_preset(name: str, stage: AnyStage, kind: Kind, preset: str) -> list[_Setting]:
    """Return the settings of a preset.

    Raises `UsageError` if the stage has no such preset, or only for another kind of params.
    """
    presets = params_of.presets_of(kind)
    if preset not in params_of.presets(stage):
        have = f"it has {', '.join(params_of.presets(stage))}" if params_of.presets(stage) else "it has none"
        raise UsageError(f"There is no preset {preset} for {name}; {have}.")
    if preset not in presets:
        choices = _or(list(map(str, params_of.choices(kind, params_of.tag(stage) or ""))))
        have = f"it has {', '.join(presets)}" if presets else "it has none"
        raise UsageError(f"There is no preset {preset} for the {params_of.tag(stage)} {choices} of {name}; {have}.")
    return [_Setting(f"preset {preset} of {name}", key, value) for key, value in presets[preset].items()]


def _from_set(name: str, text: str) -> _Setting:
    key, _, value = text.partition("=")
    return _Setting(f"--set {text}", key.removeprefix(f"{name}."), _parse(value))


def _parse(text: str) -> Any:
    try:
        return config_text.load_yaml(text)
    except ValueError:
        return text


def _from_file(path: Path, block: str, *, required: bool) -> list[_Setting]:
    place = f"{path}, block {block}"
    return [_Setting(place, key, value) for key, value in _read_block(path, block, required=required).items()]


def _read_block(path: Path, block: str, *, required: bool) -> Values:
    """Return a mapping in a YAML file, given by its keys joined by dots.

    If it does not exist, returns an empty mapping, or raises `UsageError` if it is ``required``. Raises `UsageError` if
    the file cannot be read, and for a value that is not a mapping.
    """
    try:
        content = config_text.load_yaml(regular.content(path)) or {}
    except FileNotFoundError:
        raise UsageError(f"There is no file {path} to read params from.") from None
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error
    except TacpipeError as error:
        raise UsageError(str(error)) from error
    except ValueError as error:
        raise UsageError(f"{path} cannot be read: {error}.") from error
    for part in block.split("."):
        if not isinstance(content, dict):
            raise UsageError(f"{path}: {part} of block {block} is in {excerpt(content)}, which is not a mapping.")
        if part not in content:
            if required:
                raise UsageError(f"{path} has no block {block}; at {part} there are {listed(content)}.")
            return {}
        content = content[part]
    if not isinstance(content, dict):
        raise UsageError(f"{path}: block {block} is {excerpt(content)}; it should be a mapping of params.")
    return content
