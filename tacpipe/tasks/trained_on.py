"""List the recordings that a model was trained on: ``trained_on`` of its configuration, digests by name.

Evaluation reports these recordings separately, and calibration refuses them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


def merge(*parts: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Return the digests of recordings by name; each part holds pairs of name and digest."""
    return {name: digest for part in parts for name, digest in part}


def of_datasets(*parts: Dataset) -> dict[str, str]:
    """Return the digests of the recordings of several datasets by name."""
    return merge(*(((shard.name, shard.digest) for shard in part.recordings.values()) for part in parts))


def add_earlier(digests: Mapping[str, str], earlier: Mapping[str, str]) -> dict[str, str]:
    """Return the digests of a training by name, and those of the model that it began from under marked names.

    >>> add_earlier({"a": "1"}, {"a": "1", "b": "2"})
    {'b of the model before': '2', 'a': '1'}
    """
    current = set(digests.values())
    marked = {f"{name} of the model before": digest for name, digest in earlier.items() if digest not in current}
    return {**marked, **digests}


def add_calibration(digests: Mapping[str, str], calibration: Mapping[str, str]) -> dict[str, str]:
    """Return the digests of a training by name, and those that the model was calibrated on.

    A calibration recording whose name belongs to another recording of the training gets a marked name.

    >>> add_calibration({"a": "1"}, {"a": "2", "b": "3", "c": "1"})
    {'a': '1', 'a of calibration': '2', 'b': '3'}
    """
    current = set(digests.values())
    further = {name: digest for name, digest in calibration.items() if digest not in current}
    return {
        **digests,
        **{f"{name} of calibration" if name in digests else name: digest for name, digest in further.items()},
    }
