"""What the annotation of a dataclass's field allows: fit values to it, parse text for it, describe it in words.

Annotations are ``bool``, ``int``, ``float``, ``str``, ``Literal``, another dataclass, a ``tuple`` or a union of these, and
``Annotated`` with a `Constraint`, of which `tacpipe.plugins.constraints` has the usual ones.
"""

from __future__ import annotations

import dataclasses
import re
import sys
import types
import typing
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Protocol, get_args, get_origin, runtime_checkable

from tacpipe.errors import UsageError
from tacpipe.printable import excerpt, plain, suggestion

REFUSED = object()
_EXPONENT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+")  # YAML 1.1 takes 1e-3 for text, and nobody else does
_HINTS: dict[type[Any], Mapping[str, Any]] = {}  # to evaluate annotations takes milliseconds for many fields
_UNIONS = (typing.Union, types.UnionType)


@runtime_checkable
class Constraint(Protocol):
    """Metadata of ``Annotated`` that allows some values of a type."""

    def allows(self, value: Any) -> bool:
        """Return whether a value of the type is allowed."""

    def describe(self, kind: str) -> str:
        """Return what is allowed, as in "it must be …"; ``kind`` describes the type alone, as "a whole number"."""


def hints(kind: type[Any]) -> Mapping[str, Any]:
    """Return the annotation of each field of a dataclass, constraints included."""
    if kind not in _HINTS:
        found = typing.get_type_hints(kind, include_extras=True)
        _HINTS[kind] = {field.name: found[field.name] for field in dataclasses.fields(kind)}
    return _HINTS[kind]


def bare(wanted: Any) -> Any:
    """Return an annotation without constraints, and without None where that is the only alternative.

    >>> bare(Annotated[int, "of 1 or more"]), bare(float | None)
    (<class 'int'>, <class 'float'>)
    """
    if get_origin(wanted) is Annotated:
        return bare(get_args(wanted)[0])
    kinds = [kind for kind in get_args(wanted) if kind is not types.NoneType] if get_origin(wanted) in _UNIONS else []
    return bare(kinds[0]) if len(kinds) == 1 else wanted


def choices(kind: type[Any], name: str) -> tuple[Any, ...]:
    """Return the choices of the field ``name`` of a dataclass; empty where it is not a Literal."""
    wanted = bare(hints(kind).get(name))
    return get_args(wanted) if get_origin(wanted) is Literal else ()


def constraints(wanted: Any) -> list[Constraint]:
    """Return the constraints of an annotation, also of one that None is the only alternative to."""
    return [one for one in metadata(wanted) if isinstance(one, Constraint)]


def metadata(wanted: Any) -> tuple[Any, ...]:
    """Return what follows the type in ``Annotated``, also where None is the only alternative; empty for other types."""
    kinds = [kind for kind in get_args(wanted) if kind is not types.NoneType] if get_origin(wanted) in _UNIONS else []
    if len(kinds) == 1:
        return metadata(kinds[0])
    return get_args(wanted)[1:] if get_origin(wanted) is Annotated else ()


def check(value: Any, wanted: Any, name: str, where: str = "") -> Any:
    """Return ``value`` as the annotation ``wanted`` has it, an int as a float where one is wanted.

    ``name`` and ``where`` name in messages what holds the value. Raises `UsageError` where it is not allowed.
    """
    fitted = _fit(value, wanted, f"{where}, {name}" if where else name)
    if fitted is REFUSED:
        subject = f"{where}: {name}" if where else name
        raise UsageError(f"{subject} is {shown(value)}; it must be {describe(wanted)}.")
    return fitted


def shown(value: Any) -> str:
    """Return a value as a message has it: short, and a whole number as such.

    >>> shown(-5.0), shown("x"), shown(0.5)
    ('-5', "'x'", '0.5')
    """
    whole = isinstance(value, float) and value.is_integer() and abs(value) < 1e15
    return str(int(value)) if whole else excerpt(value)


def fits(value: Any, wanted: Any) -> bool:
    """Return whether the annotation ``wanted`` allows ``value``."""
    return _fit(value, wanted, "") is not REFUSED


def filled(kind: type[Any], values: Mapping[str, Any], where: str, noun: str = "param") -> Any:
    """Return the dataclass ``kind`` with ``values`` over its defaults, an int as a float where one is wanted.

    Raises `UsageError` for an unknown name, a value that is not allowed, and one without a default that is missing.
    """
    known = hints(kind)
    fitting = {}
    for key, value in values.items():
        if key not in known:
            raise unknown(key, known, where, noun)
        fitting[key] = check(value, known[key], key, where)
    missing = [
        field.name
        for field in dataclasses.fields(kind)
        if field.default is field.default_factory is dataclasses.MISSING and field.name not in fitting
    ]
    if missing:
        raise UsageError(f"{where}: {noun} {' and '.join(missing)} must be given.")
    return kind(**fitting)


def unknown(key: Any, known: Mapping[str, Any], where: str, noun: str) -> UsageError:
    """Return the error for a name that is not among those known."""
    shown_key = plain(key) if isinstance(key, str) else excerpt(key)
    names = ", ".join(known) or "none"
    return UsageError(f"{where}: there is no {noun} {shown_key}; there are {names}.{suggestion(str(key), known)}")


def parsed(text: str, wanted: Any) -> Any:
    """Return what ``text``, of a command line or of a list, means for an annotation; the text itself if nothing.

    >>> parsed("3", int), parsed("3", float), parsed("3", str), parsed("x", int), parsed("3", Literal[1, 3])
    (3, 3.0, '3', 'x', 3)
    """
    kind = bare(wanted)
    if get_origin(kind) is Literal:
        return next((choice for choice in get_args(kind) if str(choice) == text), text)
    if kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            return text
    return text


def describe(wanted: Any) -> str:
    """Return what an annotation allows, as in "it must be …".

    >>> describe(Literal["a", "b"]), describe(int | None), describe(tuple[float, ...])
    ('one of a, b', 'a whole number', 'a list, each item a number')
    """
    if get_origin(wanted) is Annotated:
        text = describe(get_args(wanted)[0])
        for constraint in constraints(wanted):
            text = constraint.describe(text)
        return text
    if get_origin(wanted) is Literal:
        return "one of " + ", ".join(map(str, get_args(wanted)))
    if get_origin(wanted) in _UNIONS:
        return " or ".join(describe(kind) for kind in get_args(wanted) if kind is not types.NoneType)
    if get_origin(wanted) is tuple:
        return f"a list, each item {describe(get_args(wanted)[0])}"
    if dataclasses.is_dataclass(wanted):
        return f"a table of {', '.join(field.name for field in dataclasses.fields(wanted))}"
    names = {float: "a number", int: "a whole number", str: "text", bool: "true or false"}
    return names.get(wanted, str(wanted))


def _fit(value: Any, wanted: Any, where: str) -> Any:
    """Return ``value`` as what is wanted, or `REFUSED`; a mapping fills a dataclass, which raises as `filled` does."""
    origin = get_origin(wanted)
    if origin is Annotated:
        fit = _fit(value, get_args(wanted)[0], where)
        return fit if fit is not REFUSED and all(one.allows(fit) for one in constraints(wanted)) else REFUSED
    if origin in _UNIONS:
        fits = (_fit(value, kind, where) for kind in get_args(wanted))
        return next((fit for fit in fits if fit is not REFUSED), REFUSED)
    if origin is Literal:  # 1, 1.0 and True are equal, and three values in a key
        return next((one for one in get_args(wanted) if one == value and type(one) is type(value)), REFUSED)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            return REFUSED
        fitted = [_fit(item, get_args(wanted)[0], f"{where} {row}") for row, item in enumerate(value, start=1)]
        return REFUSED if any(fit is REFUSED for fit in fitted) else tuple(fitted)
    if dataclasses.is_dataclass(wanted):
        if isinstance(value, Mapping):
            return filled(typing.cast(type, wanted), value, where, "key")
        return value if isinstance(value, typing.cast(type, wanted)) else REFUSED
    return _fit_plain(value, wanted)


def _fit_plain(value: Any, wanted: Any) -> Any:
    """Return ``value`` as a bool, an int, a float, a text or None, or `REFUSED`."""
    if wanted is float and isinstance(value, str) and _EXPONENT.fullmatch(value):
        value = float(value)
    if wanted is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value) + 0.0 if abs(value) <= sys.float_info.max else REFUSED  # NaN is none; -0.0 becomes 0.0
    if wanted is str and isinstance(value, str) and not _encodes(value):
        return REFUSED
    if wanted is types.NoneType:
        return value if value is None else REFUSED
    right = isinstance(value, wanted) and (wanted is bool or not isinstance(value, bool))
    return value if right else REFUSED


def _encodes(text: str) -> bool:
    """Return whether text is Unicode: of other bytes on the command line halves of characters are made."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True
