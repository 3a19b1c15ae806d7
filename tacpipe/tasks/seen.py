"""The recordings that a model was trained on, which its evaluation reports apart."""

from __future__ import annotations

from collections.abc import Mapping


def seen(now: Mapping[str, str], before: Mapping[str, str]) -> dict[str, str]:
    """Return the digests of all recordings that a model was trained on, by name.

    ``now`` are those of this training, ``before`` those of the model that it began with: their names are marked.

    >>> seen({"a": "1"}, {"a": "1", "b": "2"})
    {'b of the model before': '2', 'a': '1'}
    """
    known = set(now.values())
    older = {f"{name} of the model before": digest for name, digest in before.items() if digest not in known}
    return {**older, **now}
