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


def filled(value: Any, values: Values, place: str) -> Any:
    """Return ``value`` with each ``${name}`` in its texts replaced; a text that is only such a name becomes its value.

    Errors state ``place``. Raises `UsageError` for a name that has no value, and for a list or a mapping within a text.

    >>> filled(["${a.b[1]}", "x-${a.c}"], {"a": {"b": [1, 2], "c": True}}, "dvc.yaml")
    [2, 'x-true']
    """
    if isinstance(value, Mapping):
        return {filled(key, values, place): filled(item, values, place) for key, item in value.items()}
    if isinstance(value, list):
        return [filled(item, values, place) for item in value]
    if not isinstance(value, str):
        return value
    single = _FIELD.fullmatch(value)
    if single is not None:
        return _value(single["name"], values, place)
    text = _FIELD.sub(lambda match: _as_text(match["name"], values, place), value)
    return text.replace(r"\${", "${")


def expand(definition: Mapping[str, Any], values: Values, place: str) -> Iterator[tuple[str, Any, Values]]:
    """Yield the stages of a definition: the part of each name after ``@``, the template and its values.

    A definition without ``foreach`` and ``matrix`` is one stage, with an empty part. Raises `UsageError` where
    ``foreach`` is not a list or mapping, or ``matrix`` not a mapping of lists.
    """
    if "foreach" in definition:
        for key, stage_values in _foreach_items(filled(definition["foreach"], values, place), place):
            yield key, definition.get("do"), {**values, **stage_values}
    elif "matrix" in definition:
        template = {name: value for name, value in definition.items() if name != "matrix"}
        for key, item in _combinations(filled(definition["matrix"], values, place), place):
            yield key, template, {**values, "item": item, "key": key}
    else:
        yield "", definition, values


def _foreach_items(items: Any, place: str) -> Iterator[tuple[str, Values]]:
    if isinstance(items, Mapping):
        yield from ((_text(key), {"key": _text(key), "item": item}) for key, item in items.items())
    elif isinstance(items, list):
        nested = any(isinstance(item, Mapping | list) for item in items)
        yield from ((_text(number if nested else item), {"item": item}) for number, item in enumerate(items))
    else:
        raise UsageError(f"{place}: foreach is {excerpt(items)}; it must be a list or a mapping.")


def _combinations(axes: Any, place: str) -> Iterator[tuple[str, Values]]:
    if not isinstance(axes, Mapping) or not all(isinstance(items, list) for items in axes.values()):
        raise UsageError(f"{place}: matrix is {excerpt(axes)}; it must be a mapping of lists.")
    for chosen in product(*(enumerate(items) for items in axes.values())):
        choice = dict(zip(axes, chosen, strict=True))
        parts = [
            f"{axis}{number}" if isinstance(item, Mapping | list) else _text(item)
            for axis, (number, item) in choice.items()
        ]
        yield "-".join(parts), {axis: item for axis, (_, item) in choice.items()}


def _as_text(name: str, values: Values, place: str) -> str:
    value = _value(name, values, place)
    if isinstance(value, Mapping | list):
        raise UsageError(f"{place}: ${{{name}}} is {excerpt(value)}, which `tacpipe run` does not put into a text.")
    return _text(value)


def _value(name: str, values: Values, place: str) -> Any:
    value: Any = values
    for part in _PART.findall(name):
        try:
            value = value[int(part)] if isinstance(value, Sequence) and not isinstance(value, str) else value[part]
        except (LookupError, TypeError, ValueError):
            raise UsageError(f"{place}: ${{{name}}} has no value; give it one in params.yaml or under vars.") from None
    return value


def _text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
