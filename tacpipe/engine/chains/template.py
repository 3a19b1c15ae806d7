"""Texts of a ``dvc.yaml`` in which ``${name}`` represents a value, filled in as DVC fills them in."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Any

from tacpipe.errors import UsageError
from tacpipe.printable import excerpt

_FIELD = re.compile(r"(?<!\\)\$\{(?P<name>.*?)\}")
_PART = re.compile(r"[^.\[\]]+")
Values = Mapping[str, Any]


def filled(value: Any, values: Values, where: str) -> Any:
    """Return ``value``, each ``${name}`` in its texts replaced; a text that is one such name alone becomes its value.

    ``where`` names the place in errors. Raises `UsageError` for a name that has no value, and for a list or a mapping within
    a text.

    >>> filled(["${a.b[1]}", "x-${a.c}"], {"a": {"b": [1, 2], "c": True}}, "dvc.yaml")
    [2, 'x-true']
    """
    if isinstance(value, Mapping):
        return {filled(key, values, where): filled(one, values, where) for key, one in value.items()}
    if isinstance(value, list):
        return [filled(one, values, where) for one in value]
    if not isinstance(value, str):
        return value
    whole = _FIELD.fullmatch(value)
    if whole is not None:
        return _value(whole["name"], values, where)
    text = _FIELD.sub(lambda found: _within(found["name"], values, where), value)
    return text.replace(r"\${", "${")


def several(definition: Mapping[str, Any], values: Values, where: str) -> Iterator[tuple[str, Any, Values]]:
    """Yield the stages that a definition describes: what follows ``@`` in the name of each, its template and its values.

    One without ``foreach`` and ``matrix`` describes one stage, whose name has no such part. Raises `UsageError` where
    ``foreach`` is not a list or mapping, or ``matrix`` not a mapping of lists.
    """
    if "foreach" in definition:
        for key, given in _each(filled(definition["foreach"], values, where), where):
            yield key, definition.get("do"), {**values, **given}
    elif "matrix" in definition:
        template = {name: value for name, value in definition.items() if name != "matrix"}
        for key, item in _combinations(filled(definition["matrix"], values, where), where):
            yield key, template, {**values, "item": item, "key": key}
    else:
        yield "", definition, values


def _each(items: Any, where: str) -> Iterator[tuple[str, Values]]:
    if isinstance(items, Mapping):
        yield from ((_text(key), {"key": _text(key), "item": item}) for key, item in items.items())
    elif isinstance(items, list):
        nested = any(isinstance(item, Mapping | list) for item in items)
        yield from ((_text(number if nested else item), {"item": item}) for number, item in enumerate(items))
    else:
        raise UsageError(f"{where}: foreach is {excerpt(items)}; it must be a list or a mapping.")


def _combinations(axes: Any, where: str) -> Iterator[tuple[str, Values]]:
    if not isinstance(axes, Mapping) or not all(isinstance(items, list) for items in axes.values()):
        raise UsageError(f"{where}: matrix is {excerpt(axes)}; it must be a mapping of lists.")
    for chosen in product(*(enumerate(items) for items in axes.values())):
        named = dict(zip(axes, chosen, strict=True))
        parts = [
            f"{axis}{number}" if isinstance(item, Mapping | list) else _text(item)
            for axis, (number, item) in named.items()
        ]
        yield "-".join(parts), {axis: item for axis, (_, item) in named.items()}


def _within(name: str, values: Values, where: str) -> str:
    value = _value(name, values, where)
    if isinstance(value, Mapping | list):
        raise UsageError(f"{where}: ${{{name}}} is {excerpt(value)}, which `tacpipe run` does not put into a text.")
    return _text(value)


def _value(name: str, values: Values, where: str) -> Any:
    found: Any = values
    for part in _PART.findall(name):
        try:
            found = found[int(part)] if isinstance(found, Sequence) and not isinstance(found, str) else found[part]
        except (LookupError, TypeError, ValueError):
            raise UsageError(f"{where}: ${{{name}}} has no value; give it one in params.yaml or under vars.") from None
    return found


def _text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
