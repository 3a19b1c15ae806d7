"""Check that streams have the same columns in the same order in all recordings."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator
from typing import ClassVar

from tacpipe.checks.check import EXCLUDE, Check, CheckFinding, Stream, StreamName
from tacpipe.datasets.dataset import Dataset

REPAIR = "[streams.{subject}] columns: list the columns that all recordings have, with one type"


class ColumnSets(Check):
    """Find recordings whose columns differ from those of most recordings, and streams that some recordings lack."""

    sentences: ClassVar = {
        "missing-columns": ("{channels} of {subject} are missing in {recordings}.", REPAIR),
        "extra-columns": ("{channels} of {subject} exist only in {recordings}.", REPAIR),
        "column-types": ("{channels} of {subject} have another type in {recordings}.", REPAIR),
        "column-order": ("The columns of {subject} have another order in {recordings}.", REPAIR),
        "missing-streams": (
            "{subject}, a stream of most recordings, is missing in {recordings}.",
            f"{EXCLUDE}, or `--without {{subject}}` of `tacpipe synchronize`",
        ),
    }

    def __init__(self) -> None:
        super().__init__()
        self._schemas: dict[str, dict[StreamName, tuple[tuple[str, str], ...]]] = {}
        self._first: dict[str, StreamName] = {}  # any stream of each recording

    def examine(self, stream: Stream) -> None:
        """Remember names and types of the columns."""
        schema = tuple((column.name, str(column.type)) for column in stream.columns.schema)
        self._schemas.setdefault(stream.name, {})[stream.identity] = schema
        self._first.setdefault(stream.recording, stream.identity)

    def conclude(self, dataset: Dataset) -> Iterator[CheckFinding]:
        """Yield the findings; what most recordings have counts as right."""
        for name, schemas in self._schemas.items():
            (usual, _), *_ = Counter(schemas.values()).most_common(1)
            names = {column for schema in schemas.values() for column, _ in schema}
            for stream, schema in schemas.items():
                if schema == usual:
                    continue
                missing = names - {column for column, _ in schema}
                for column in sorted(missing):
                    self.note("missing-columns", stream, channel=column)
                if not missing and set(schema) == set(usual):
                    self.note("column-order", stream)
                for column in () if missing else sorted({column for column, _ in set(schema) - set(usual)}):
                    kind = "column-types" if column in {name for name, _ in usual} else "extra-columns"
                    self.note(kind, stream, channel=column)
            present = {stream.recording for stream in schemas}
            for recording in self._first.keys() - present if 2 * len(schemas) > len(self._first) else ():
                self.note("missing-streams", dataclasses.replace(self._first[recording], name=name))
        yield from super().conclude(dataset)
