"""Read the params that a stage declares, and convert them from and to their stored form.

A stage has one dataclass of params, or a tagged union, ``Params = Small | Large``, of classes with the same first
field, such as ``architecture``, with different choices (``Literal``). That field selects the class, by default the
first one. Fields of other classes are invalid and not part of a key. The classes of a task's architectures are found
like plug-ins (`tacpipe.plugins.architectures`). A method ``check`` may reject combinations of values; it is not applied
to stored params. A static method ``upgrade`` converts stored params of any earlier version to current names and values.
``PRESETS`` contains named sets of values, ``PANELS`` the names of the fields in each panel of the help.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args, get_origin

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins import architectures, registry
from tacpipe.plugins import fields as fields_of
from tacpipe.plugins.constraints import StoredAs
from tacpipe.plugins.fields import build_dataclass as build_dataclass
from tacpipe.plugins.fields import choices as choices
from tacpipe.plugins.stage import AnyStage, Presets, StoredParams
from tacpipe.printable import excerpt

Kind = type[Any]  # a dataclass of params
Panels = Mapping[str, Sequence[str]]  # names of params by the panel of help that shows them


def kinds(stage: AnyStage) -> tuple[Kind, ...]:
    """Return the possible dataclasses of a stage's params, the default first."""
    return _members(stage.params)


def _members(union: Any) -> tuple[Kind, ...]:
    if architectures.task(union) is not None:
        return architectures.kinds(union)
    return get_args(union) if get_origin(union) in (typing.Union, types.UnionType) else (union,)


def tag(stage: AnyStage) -> str | None:
    """Return the name of the field that selects among several kinds of params, or None if there is one kind.

    Raises `TacpipeError` if that field does not distinguish them.
    """
    alternatives = kinds(stage)
    if len(alternatives) == 1:
        return None
    name = _tag_name(alternatives)
    choices_by_kind = [choices(kind, name) for kind in alternatives]
    if not all(choices_by_kind) or len(set().union(*choices_by_kind)) < sum(map(len, choices_by_kind)):
        raise TacpipeError(
            f"The params of {stage.function.__name__} are of {len(alternatives)} kinds, and their first field, {name}, does "
            f"not distinguish them: it must be a Literal in each, with choices that no other has."
        )
    return name


def _tag_name(alternatives: Sequence[Kind]) -> str:
    return dataclasses.fields(alternatives[0])[0].name


def fields(stage: AnyStage) -> Mapping[str, fields_of.Annotation]:
    """Return the annotation of each param of all kinds; choices of several kinds are joined."""
    return _fields(kinds(stage))


def choices_with(stage: AnyStage, field: str) -> list[str]:
    """Return the choices of the tag with which a param is used, or an empty list if it is always used."""
    name, alternatives = tag(stage), kinds(stage)
    owners = [kind for kind in alternatives if field in fields_of.hints(kind)]
    if name is None or len(owners) == len(alternatives):
        return []
    return [str(choice) for kind in owners for choice in choices(kind, name)]


def defaults(stage: AnyStage, field: str) -> list[Any]:
    """Return the different defaults of a param among the kinds; for the tag, the default of the default kind."""
    owners = kinds(stage)[:1] if field == tag(stage) else kinds(stage)
    declared = [kind.__dataclass_fields__[field] for kind in owners if field in kind.__dataclass_fields__]
    return list(
        {repr(item.default): item.default for item in declared if item.default is not dataclasses.MISSING}.values()
    )


def presets(stage: AnyStage) -> list[str]:
    """Return the names of a stage's presets."""
    return list(dict.fromkeys(preset for kind in kinds(stage) for preset in presets_of(kind)))


def panels(stage: AnyStage) -> dict[str, str]:
    """Return the help panel of each param, as declared in ``PANELS`` of its dataclasses; others have none.

    A param of an architecture without a declaration is in the panel of the architecture.
    """
    panel_of: dict[str, str] = {}
    for kind in kinds(stage):
        for owner in kind.__mro__:
            declared: Mapping[str, Sequence[str]] = vars(owner).get("PANELS", {})
            for panel, names in declared.items():
                panel_of |= {name: panel for name in names if name not in panel_of}
    if architectures.task(stage.params) is not None and architectures.TAG in panel_of:
        panel_of = {**dict.fromkeys(fields(stage), panel_of[architectures.TAG]), **panel_of}
    return panel_of


def added(default: Any) -> Any:
    """Return a field that was added to params later. It is part of a key only if it differs from its default.

    So earlier results keep their keys, provided that the default gives the same result.
    """
    return dataclasses.field(default=default, metadata={"added": True})


def to_json(params: Any) -> dict[str, Any]:
    """Return the params as stored in keys and models: with `StoredAs` names, without unchanged `added` fields.

    For an architecture of another package they include its name and version.
    """
    silent = {
        field.name
        for field in dataclasses.fields(params)
        if field.metadata.get("added") and getattr(params, field.name) == field.default
    }
    values = {name: value for name, value in dataclasses.asdict(params).items() if name not in silent}
    stored = _stored(
        type(params), {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}
    )
    package = architectures.plugin(type(params))
    return stored if package is None else {**stored, architectures.PLUGIN: package}


def to_input(params: Any) -> StoredParams:
    """Return the params with the names and choices used by options, ``params.yaml`` and ``--set``."""
    values = dataclasses.asdict(params)
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def from_json(stage: AnyStage, values: StoredParams) -> Any:
    """Return the params from the result of `to_json`, of this or an older version, without checking values.

    Fields of other kinds are ignored, and removed fields are ignored if the stage reads whole datasets. Raises
    `TacpipeError` if a stage that works recording by recording has no such field, and if another version of an
    architecture's package is installed, because its result would be stored under a wrong name.
    """
    kind, current = _current(kinds(stage), values)
    architectures.check_installed(stage.params, values, kind)
    kind = kind or kinds(stage)[0]
    architectures.check_version(values, kind)
    annotations = fields_of.hints(kind)
    removed = sorted(set(current) - set(fields(stage)))
    if removed and stage.mapped:
        raise TacpipeError(
            f"What is stored was computed by another version of {stage.function.__name__}, with the param {removed[0]}, "
            f"which this version does not have. Run the stage again, or use that version."
        )
    return kind(**{name: _field_value(v, annotations[name]) for name, v in current.items() if name in annotations})


def _field_value(value: Any, annotation: fields_of.Annotation) -> Any:
    origin: Any = get_origin(annotation)
    return tuple(value) if origin is tuple else value


def used_params(stage: AnyStage, values: StoredParams) -> StoredParams:
    """Return the stored params that the chosen kind has, with current names; older versions stored those of all kinds.

    Returns all of them if the tag names no kind, such as an architecture that is not installed.
    """
    kind, current = _current(kinds(stage), values)
    return {name: value for name, value in current.items() if kind is None or name in fields_of.hints(kind)}


def kind_of(stage: AnyStage, values: StoredParams) -> Kind | None:
    """Return the kind of stored params, or None if the tag names no kind, such as an architecture that is not installed."""
    return _current(kinds(stage), values)[0]


def with_current_names(stage: str, values: StoredParams) -> StoredParams:
    """Return stored params with current names and choices, or unchanged if ``stage`` is not installed."""
    try:
        alternatives = kinds(registry.load(stage))
    except TacpipeError:
        return dict(values)
    return _current(alternatives, values)[1]


def read(union: Any, values: StoredParams, place: str) -> Any:
    """Return the params ``values`` of a model's configuration as a dataclass, one of the members of ``union``.

    The configuration may be of an older version: missing fields get their default, removed fields are ignored, and only
    types are checked, because ranges and choices may have changed. Raises `TacpipeError`, which starts with ``place``,
    for a value of the wrong type and for an unknown tag.
    """
    members = _members(union)
    kind, current_values = _current(members, values)
    architectures.check_installed(union, values, kind)
    if kind is None:
        name = _tag_name(members)
        allowed = [str(choice) for member in members for choice in choices(member, name)]
        tag_text = excerpt(values.get(_stored_as(members[0], name).name))
        raise TacpipeError(f"{place}: {name} is {tag_text}; it must be one of {', '.join(allowed)}.")
    architectures.warn_of_version(values, kind)
    annotations = fields_of.hints(kind)
    converted = {
        name: _convert_type(value, annotations[name], name, place)
        for name, value in current_values.items()
        if name in annotations
    }
    return kind(**converted)


def _convert_type(value: Any, annotation: Any, name: str, place: str) -> Any:
    """Return ``value`` in the type of an annotation without its constraints.

    Raises `TacpipeError` if it has another type.
    """
    kind = fields_of.bare(annotation)
    if get_origin(kind) is Literal:
        kind = typing.Union[tuple({type(choice) for choice in get_args(kind)})]  # noqa: UP007
    optional = annotation if fields_of.fits(None, annotation) else kind
    try:
        return fields_of.check(value, kind if value is not None else optional, name, place)
    except UsageError as error:  # the mistake is in a file, not in a command
        raise TacpipeError(str(error)) from None


# ---- stored names


def _stored_as(kind: Kind, name: str) -> StoredAs:
    marks = [mark for mark in fields_of.metadata(fields_of.hints(kind)[name]) if isinstance(mark, StoredAs)]
    return marks[0] if marks else StoredAs(name)


def _stored(kind: Kind, values: StoredParams) -> dict[str, Any]:
    """Return params of ``kind`` with their stored names and choices."""
    stored = {}
    for name, value in values.items():
        mark = _stored_as(kind, name)
        stored[mark.name] = mark.choices.get(value, value) if isinstance(value, str) else value
    return stored


def _current(alternatives: Sequence[Kind], values: StoredParams) -> tuple[Kind | None, StoredParams]:
    """Return the kind of stored params, or None if there is no such kind, and the params with current names and choices.

    Names that the kind does not have are unchanged.
    """
    name = _tag_name(alternatives) if len(alternatives) > 1 else None
    chosen = next((kind for kind in alternatives if name is None or _has_tag(kind, name, values)), None)
    upgrade = getattr(chosen, "upgrade", None)
    names = _current_names(tuple(kind for kind in (chosen, *alternatives) if kind is not None))
    current = {}
    for stored_name, value in (values if upgrade is None else upgrade(values)).items():
        field, choices = names.get(stored_name, (stored_name, {}))
        current[field] = choices.get(value, value) if isinstance(value, str) else value
    return chosen, current


@functools.cache
def _current_names(kinds_in_order: tuple[Kind, ...]) -> Mapping[str, tuple[str, Mapping[str, str]]]:
    """Return the current field name, and the current choice by stored choice, of each stored name.

    If several kinds have the name, the first in ``kinds_in_order`` determines them.
    """
    current: dict[str, tuple[str, Mapping[str, str]]] = {}
    for kind in kinds_in_order:
        for field in fields_of.hints(kind):
            mark = _stored_as(kind, field)
            current.setdefault(mark.name, (field, {old: new for new, old in mark.choices.items()}))
    return current


def _has_tag(kind: Kind, name: str, values: StoredParams) -> bool:
    """Return whether stored params have a choice of the tag ``name`` that belongs to ``kind``."""
    mark = _stored_as(kind, name)
    stored = values.get(mark.name)
    return stored in [mark.choices.get(choice, choice) for choice in choices(kind, name)]


def comments(stage: AnyStage) -> dict[str, str]:
    """Return the help of each param: the comment after its field, or on the lines above."""
    texts_by_name: dict[str, list[str]] = {}
    for kind in kinds(stage):
        inherited: dict[str, str] = {}
        for owner in reversed(kind.__mro__):
            inherited |= comments_of(owner) if dataclasses.is_dataclass(owner) else {}
        for name, text in inherited.items():
            if text not in texts_by_name.setdefault(name, []) and text:
                texts_by_name[name].append(text)
    return {name: "; ".join(texts) for name, texts in texts_by_name.items()}


def comments_of(kind: Kind) -> dict[str, str]:
    """Return the comment after each field of a dataclass, or on the lines above."""
    try:
        lines = inspect.getsource(kind).splitlines()
    except (OSError, TypeError):
        return {}
    comments: dict[str, str] = {}
    above: list[str] = []
    for line in lines:
        if match := re.match(r"\s+#\s*(.*)", line):
            above.append(match[1])
        elif match := re.match(r"\s+(\w+)\s*:[^#]*(?:#\s*(.*))?$", line):
            comments[match[1]] = match[2] or " ".join(above)
            above = []
        else:
            above = []
    return comments


# ---- kinds of params


@functools.cache
def _fields(alternatives: tuple[Kind, ...]) -> Mapping[str, fields_of.Annotation]:
    """Return the annotation of each field; if the alternatives differ, one that accepts the values of each."""
    annotations: dict[str, list[fields_of.Annotation]] = {}
    for kind in alternatives:
        for name, annotation in fields_of.hints(kind).items():
            if annotation not in annotations.setdefault(name, []):
                annotations[name].append(annotation)
    return {name: _join_annotations(options) for name, options in annotations.items()}


def _join_annotations(annotations: Sequence[Any]) -> Any:
    """Return an annotation that accepts every value that one of ``annotations`` accepts."""
    if all(get_origin(fields_of.bare(annotation)) is Literal for annotation in annotations):
        return Literal[
            tuple(
                dict.fromkeys(choice for annotation in annotations for choice in get_args(fields_of.bare(annotation)))
            )
        ]
    return annotations[0] if len(annotations) == 1 else typing.Union[tuple(annotations)]  # noqa: UP007


def presets_of(kind: Kind | None) -> Presets:
    """Return the values of each preset of a kind of params, by its name."""
    return getattr(kind, "PRESETS", {})
