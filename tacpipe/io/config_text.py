"""Read untrusted YAML, restricted to plain values and a limited size, and write values as TOML.

A few lines of YAML can expand to any amount of data through aliases of aliases and merged mappings, and deeply nested
brackets overflow the parser's stack. So the parser's events are counted first, with each alias counted as the value
that it refers to.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any

from tacpipe.printable import plain

_PLAIN = "tacpipe/plain"  # tag of text without quotes
MAX_DEPTH = 50  # maximum nesting depth of lists and mappings
MAX_VALUES = 100_000  # maximum number of values, including expanded aliases
MAX_CHARACTERS = 10_000_000  # maximum length of the text


def plain_value(text: str) -> str | int | float | bool | None:
    """Return the value of a text: true, false, a number if it is written as one, None if empty, else the text.

    A number with leading zeros is text, because it is usually a name.

    >>> [plain_value(text) for text in ("3", "0.5", "007", "true", "cork", "", "nan", "no", "12:30:45")]
    [3, 0.5, '007', True, 'cork', None, 'nan', 'no', '12:30:45']
    """
    stripped = text.strip()
    if stripped.lower() in ("true", "false"):
        return stripped.lower() == "true"
    if not stripped:
        return None
    digits = stripped.lstrip("-")
    if digits.isascii() and digits.isdigit() and (digits == "0" or not digits.startswith("0")):
        return int(stripped) if len(digits) < 19 else stripped
    try:
        number = float(stripped)
    except ValueError:
        return stripped
    is_number = math.isfinite(number) and not digits.startswith("00") and "_" not in stripped and not digits.isdigit()
    return number if is_number else stripped


def load_labels(content: str) -> Any:
    """Return the value of a YAML document of labels: text without quotes is read by `plain_value`, or null.

    Raises the errors of `load_yaml`.

    >>> load_labels("{a: no, b: 010, c: 12:30:45, d: 2, e: '2', f: null, g: 2024-05-01}")
    {'a': 'no', 'b': '010', 'c': '12:30:45', 'd': 2, 'e': '2', 'f': None, 'g': '2024-05-01'}
    """

    def parse_plain(text: str) -> str | int | float | bool | None:
        if text in ("~", "null", "Null", "NULL"):
            return None
        return (
            float(text.replace(".", "", 1)) if text.lower() in (".nan", ".inf", "-.inf", "+.inf") else plain_value(text)
        )

    return load_yaml(content, parse_plain)


def load_yaml(content: str | bytes, parse_plain: Callable[[str], Any] | None = None) -> Any:
    """Return the value of a YAML document; ``parse_plain`` replaces YAML's own reading of text without quotes.

    Raises `ValueError` with a one-line reason if the text is not YAML or is too large.
    """
    import yaml

    if len(content) > MAX_CHARACTERS:
        raise ValueError(f"it has {len(content)} characters, {MAX_CHARACTERS} are allowed")
    base_loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

    class Loader(base_loader):  # type: ignore[misc]
        """Reject a mapping with a repeated key, for which YAML's loaders use the last value."""

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            keys = set()
            for key_node, _ in node.value:
                if isinstance(key_node, yaml.ScalarNode) and key_node.tag != "tag:yaml.org,2002:merge":
                    key = self.construct_object(key_node)
                    if key in keys:
                        raise yaml.constructor.ConstructorError(
                            None, None, f"the key {key_node.value} occurs twice", key_node.start_mark
                        )
                    keys.add(key)
            return super().construct_mapping(node, deep)

        def resolve(self, kind: Any, value: Any, implicit: Any) -> Any:
            is_plain = kind is yaml.ScalarNode and implicit[0] and value != "<<"
            return _PLAIN if is_plain and parse_plain is not None else super().resolve(kind, value, implicit)

    if parse_plain is not None:
        Loader.add_constructor(_PLAIN, lambda _, node: parse_plain(node.value))
    try:
        _refuse_large(yaml.parse(content, Loader=base_loader))
        return yaml.load(content, Loader=Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f" in line {mark.line + 1}, column {mark.column + 1}" if mark is not None else ""
        raise ValueError(f"{plain(str(error.problem or error.context), 200)}{place}") from None
    except (yaml.YAMLError, AttributeError, TypeError, RecursionError) as error:  # wrong tags raise the other errors
        raise ValueError(plain(" ".join(str(error).split()), 200)) from None


def _refuse_large(events: Any) -> None:
    """Raise `ValueError` if the events represent too many values or nest too deeply."""
    import yaml

    sizes: dict[str, int] = {}  # number of values by anchor
    open_nodes: list[tuple[str | None, int]] = [(None, 0)]  # anchor and size of each open list or mapping
    total = 0
    for event in events:
        size, anchor = 0, None
        if isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append((event.anchor, 1))
            if len(open_nodes) > MAX_DEPTH:
                raise ValueError(f"it has more than {MAX_DEPTH} lists and mappings within one another")
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, size = open_nodes.pop()
        elif isinstance(event, yaml.ScalarEvent):
            anchor, size = event.anchor, 1
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor in (name for name, _ in open_nodes):
                raise ValueError(f"the alias {plain(str(event.anchor))} is part of its own value")
            size = sizes.get(str(event.anchor), 1)
        if size:
            open_nodes[-1] = open_nodes[-1][0], open_nodes[-1][1] + size
            total = max(total, sum(node_size for _, node_size in open_nodes))
        if anchor is not None:
            sizes[anchor] = size
        if total > MAX_VALUES:
            raise ValueError(f"it represents more than {MAX_VALUES} values, by aliases or as written")


def toml_value(item: Any) -> str:
    """Return a value on one line.

    >>> toml_value({"name": "taxel", "count": 3, "rate_hz": 1e3})
    '{ name = "taxel", count = 3, rate_hz = 1000.0 }'
    """
    if isinstance(item, Mapping):
        return "{ " + ", ".join(f"{toml_key(name)} = {toml_value(inner)}" for name, inner in item.items()) + " }"
    if isinstance(item, list | tuple):
        return "[" + ", ".join(map(toml_value, item)) + "]"
    if isinstance(item, float):
        return repr(item)  # repr writes digits on both sides of the point, as TOML requires, and inf and nan
    return json.dumps(item, ensure_ascii=False).replace("\x7f", "\\u007f")  # texts, whole numbers, true and false


def toml_key(name: str) -> str:
    """Return a key, quoted if necessary."""
    return name if name.isascii() and name.replace("_", "").replace("-", "").isalnum() else json.dumps(name)
