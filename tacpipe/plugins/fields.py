"""Convert values to the annotations of dataclass fields, parse text for them, and describe the valid values.

Annotations are ``bool``, ``int``, ``float``, ``str``, ``Literal``, another dataclass, a ``tuple`` or a union of these,
and ``Annotated`` with a `Constraint`; `tacpipe.plugins.constraints` has common ones.
"""

from __future__ import annotations

import dataclasses
import re
import sys
import types
import typing
from collections.abc import Collection, Mapping
from typing import Annotated, Any, Literal, Protocol, get_args, get_origin, runtime_checkable

from tacpipe.errors import UsageError
from tacpipe.plugins.stage import Values
from tacpipe.printable import excerpt, plain, suggestion

REFUSED = object()
# YAML 1.1 reads 1e-3 as text, contrary to all other formats
_EXPONENT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+")
Annotation: typing.TypeAlias = Any  # type of a field, such as int | None or Literal["a", "b"]
# cache, because evaluating the annotations of many fields takes milliseconds
_HINTS: dict[type[Any], Mapping[str, Any]] = {}
_UNIONS = (typing.Union, types.UnionType)


@runtime_checkable
class Constraint(Protocol):
    """Metadata of ``Annotated`` that restricts the values of a type."""

    def allows(self, value: Any) -> bool:
        """Return whether a value of the type is valid."""

    def describe(self, kind: str) -> str:
        """Return the description that completes "it must be …". ``kind`` describes the type, as in "a whole number"."""


def hints(kind: type[Any]) -> Mapping[str, Annotation]:
    """Return the annotation of each field of a dataclass, including constraints."""
    if kind not in _HINTS:
        annotations = typing.get_type_hints(kind, include_extras=True)
        _HINTS[kind] = {field.name: annotations[field.name] for field in dataclasses.fields(kind)}
    return _HINTS[kind]


def bare(annotation: Any) -> Any:
    """Return an annotation without constraints; also without None if only one other type remains.

    >>> bare(Annotated[int, "of 1 or more"]), bare(float | None)
    (<class 'int'>, <class 'float'>)
    """
    if get_origin(annotation) is Annotated:
        return bare(get_args(annotation)[0])
    kinds = (
        [kind for kind in get_args(annotation) if kind is not types.NoneType]
        if get_origin(annotation) in _UNIONS
        else []
    )
    return bare(kinds[0]) if len(kinds) == 1 else annotation


def choices(kind: type[Any], name: str) -> tuple[Any, ...]:
    """Return the choices of a dataclass field, or an empty tuple if it is not a Literal."""
    annotation = bare(hints(kind).get(name))
    return get_args(annotation) if get_origin(annotation) is Literal else ()


def constraints(annotation: Any) -> list[Constraint]:
    """Return the constraints of an annotation, also if it is optional."""
    return [mark for mark in metadata(annotation) if isinstance(mark, Constraint)]


def metadata(annotation: Any) -> tuple[Any, ...]:
    """Return the metadata of ``Annotated``, also if it is optional; an empty tuple for other annotations."""
    kinds = (
        [kind for kind in get_args(annotation) if kind is not types.NoneType]
        if get_origin(annotation) in _UNIONS
        else []
    )
    if len(kinds) == 1:
        return metadata(kinds[0])
    return get_args(annotation)[1:] if get_origin(annotation) is Annotated else ()


def check(value: Any, annotation: Any, name: str, place: str = "", noun: str = "key") -> Any:
    """Return ``value`` converted to the type of ``annotation``: an int becomes a float if a float is expected.

    ``name`` and ``place`` identify the value in messages, and ``noun`` is the word for keys of a table in it. Raises
    `UsageError` if it is invalid.
    """
    fitted = _fit(value, annotation, f"{place}, {name}" if place else name, noun)
    if fitted is REFUSED:
        subject = f"{place}: {name}" if place else name
        raise UsageError(f"{subject} is {format_value(value)}; it must be {describe(annotation)}.")
    return fitted


def format_value(value: Any) -> str:
    """Format a value for a message: short, and whole floats without a decimal point.

    >>> format_value(-5.0), format_value("x"), format_value(0.5)
    ('-5', "'x'", '0.5')
    """
    is_whole = isinstance(value, float) and value.is_integer() and abs(value) < 1e15
    return str(int(value)) if is_whole else excerpt(value)


def fits(value: Any, annotation: Any) -> bool:
    """Return whether ``value`` is valid for ``annotation``."""
    return _fit(value, annotation, "", "key") is not REFUSED


def build_dataclass(kind: type[Any], values: Values, place: str, noun: str = "param", inner_noun: str = "key") -> Any:
    """Return the dataclass ``kind`` with ``values`` in place of defaults; an int becomes a float if a float is expected.

    ``noun`` is the word for its names in messages, and ``inner_noun`` that for names in tables within it.

    Raises `UsageError` for unknown names, invalid values, and missing values without a default.
    """
    annotations = hints(kind)
    fitting = {}
    for key, value in values.items():
        if key not in annotations:
            raise unknown(key, annotations, place, noun)
        fitting[key] = check(value, annotations[key], key, place, inner_noun)
    missing = [
        field.name
        for field in dataclasses.fields(kind)
        if field.default is field.default_factory is dataclasses.MISSING and field.name not in fitting
    ]
    if missing:
        raise UsageError(f"{place}: {noun} {' and '.join(missing)} must be given.")
    return kind(**fitting)


def unknown(key: Any, names: Collection[str], place: str, noun: str) -> UsageError:
    """Return the error for a key that is not among ``names``."""
    shown_key = plain(key) if isinstance(key, str) else excerpt(key)
    valid = ", ".join(names) or "none"
    return UsageError(f"{place}: there is no {noun} {shown_key}; there are {valid}.{suggestion(str(key), names)}")


def parse_text(text: str, annotation: Any) -> Any:
    """Return the value that ``text`` represents for an annotation, or the text itself if it represents none.

    >>> parse_text("3", int), parse_text("3", float), parse_text("3", str), parse_text("x", int)
    (3, 3.0, '3', 'x')
    >>> parse_text("3", Literal[1, 3])
    3
    """
    kind = bare(annotation)
    if get_origin(kind) is Literal:
        return next((choice for choice in get_args(kind) if str(choice) == text), text)
    if kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            return text
    return text


def describe(annotation: Any) -> str:
    """Return a description of the valid values that completes "it must be …".

    >>> describe(Literal["a", "b"]), describe(int | None), describe(tuple[float, ...])
    ('one of a, b', 'a whole number', 'a list, each item a number')
    """
    if get_origin(annotation) is Annotated:
        text = describe(get_args(annotation)[0])
        for constraint in constraints(annotation):
            text = constraint.describe(text)
        return text
    if get_origin(annotation) is Literal:
        return "one of " + ", ".join(map(str, get_args(annotation)))
    if get_origin(annotation) in _UNIONS:
        return " or ".join(describe(kind) for kind in get_args(annotation) if kind is not types.NoneType)
    if get_origin(annotation) is tuple:
        return f"a list, each item {describe(get_args(annotation)[0])}"
    if dataclasses.is_dataclass(annotation):
        return f"a table of {', '.join(field.name for field in dataclasses.fields(annotation))}"
    names = {float: "a number", int: "a whole number", str: "text", bool: "true or false"}
    return names.get(annotation, str(annotation))


def _fit(value: Any, annotation: Any, place: str, noun: str) -> Any:
    """Return ``value`` converted to the type of ``annotation``, or `REFUSED` if it is invalid.

    A mapping fills a dataclass, with the errors of `build_dataclass`.
    """
    origin = get_origin(annotation)
    if origin is Annotated:
        fit = _fit(value, get_args(annotation)[0], place, noun)
        return (
            fit
            if fit is not REFUSED and all(constraint.allows(fit) for constraint in constraints(annotation))
            else REFUSED
        )
    if origin in _UNIONS:
        fits = (_fit(value, kind, place, noun) for kind in get_args(annotation))
        return next((fit for fit in fits if fit is not REFUSED), REFUSED)
    if origin is Literal:  # 1, 1.0 and True are equal, but give three different keys
        return next(
            (choice for choice in get_args(annotation) if choice == value and type(choice) is type(value)), REFUSED
        )
    if origin is tuple:
        if not isinstance(value, list | tuple):
            return REFUSED
        kind = get_args(annotation)[0]
        fitted = [_fit(item, kind, f"{place} {row}", noun) for row, item in enumerate(value, start=1)]
        return REFUSED if any(fit is REFUSED for fit in fitted) else tuple(fitted)
    if dataclasses.is_dataclass(annotation):
        if isinstance(value, Mapping):
            return build_dataclass(typing.cast(type, annotation), value, place, noun)
        return value if isinstance(value, typing.cast(type, annotation)) else REFUSED
    return _fit_plain(value, annotation)


def _fit_plain(value: Any, kind: Any) -> Any:
    """Return ``value`` as a bool, an int, a float, a text or None, or `REFUSED` if it is invalid."""
    if kind is float and isinstance(value, str) and _EXPONENT.fullmatch(value):
        value = float(value)
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value) + 0.0 if abs(value) <= sys.float_info.max else REFUSED  # NaN is invalid; -0.0 becomes 0.0
    if kind is str and isinstance(value, str) and not is_encodable(value):
        return REFUSED
    if kind is types.NoneType:
        return value if value is None else REFUSED
    is_kind = isinstance(value, kind) and (kind is bool or not isinstance(value, bool))
    return value if is_kind else REFUSED


def is_encodable(text: str) -> bool:
    """Return whether text is valid Unicode; undecodable bytes on the command line become lone surrogates."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True
