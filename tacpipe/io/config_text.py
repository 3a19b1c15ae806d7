"""Read untrusted YAML, plain values only and of limited size, and write values as TOML.

A few lines of YAML can represent any amount of data, by aliases of aliases and merged mappings, and brackets within
brackets end the parser's stack. So the text's events are counted first, each alias as what it represents.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from tacpipe.printable import plain

MAX_DEPTH = 50  # levels of lists and mappings within one another
MAX_VALUES = 100_000  # values, with those that aliases represent
MAX_CHARACTERS = 10_000_000  # characters


def load_yaml(content: str | bytes) -> Any:
    """Return the value of a YAML document.

    Raises `ValueError`, with a line that states why, for text that is not YAML or is too large.
    """
    import yaml

    if len(content) > MAX_CHARACTERS:
        raise ValueError(f"it has {len(content)} characters, {MAX_CHARACTERS} are allowed")
    fast: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

    class Loader(fast):  # type: ignore[misc]
        """Refuses a mapping that names a key twice, of which YAML's loaders keep the last."""

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

    try:
        _refuse_large(yaml.parse(content, Loader=fast))
        return yaml.load(content, Loader=Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f" in line {mark.line + 1}, column {mark.column + 1}" if mark is not None else ""
        raise ValueError(f"{plain(str(error.problem or error.context), 200)}{place}") from None
    except (yaml.YAMLError, AttributeError, TypeError, RecursionError) as error:  # wrong tags raise the latter
        raise ValueError(plain(" ".join(str(error).split()), 200)) from None


def _refuse_large(events: Any) -> None:
    """Raise `ValueError` if the events of a text represent too much."""
    import yaml

    sizes: dict[str, int] = {}  # number of values of each anchor
    open_nodes: list[tuple[str | None, int]] = [(None, 0)]  # anchor and size of each list or mapping that is open
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
        return repr(item)  # TOML wants a digit on both sides of the point, which repr gives, and knows inf and nan
    return json.dumps(item, ensure_ascii=False).replace("\x7f", "\\u007f")  # texts, whole numbers, true and false


def toml_key(name: str) -> str:
    """Return a key, in quotes where it needs them."""
    return name if name.isascii() and name.replace("_", "").replace("-", "").isalnum() else json.dumps(name)
