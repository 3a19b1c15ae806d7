"""The attributes of each recording of a dataset by name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from tacpipe.datasets.dataset import Dataset
from tacpipe.plugins.stage import Attribute


class OfRecordings(Mapping[str, Mapping[str, Attribute]]):
    """The attributes of each recording by name, in the order of names; of a large dataset each is read when asked for."""

    def __init__(self, dataset: Dataset) -> None:
        self._recordings = dataset.recordings

    def __getitem__(self, name: str) -> Mapping[str, Attribute]:
        return self._recordings[name].attributes

    def __iter__(self) -> Iterator[str]:
        return iter(self._recordings)

    def __len__(self) -> int:
        return len(self._recordings)
