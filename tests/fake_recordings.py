"""A recording without a store, for functions that read recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import pyarrow as pa

from tacpipe.io.columns import Columns
from tacpipe.io.parquet import to_parquet
from tacpipe.plugins.stage import Attribute


@dataclass
class FakeRecording:
    """What a stage sees of one recording: tables by stream name."""

    tables: Mapping[str, pa.Table]
    name: str = "trial"
    attributes: Mapping[str, Attribute] = field(default_factory=dict)

    @property
    def streams(self) -> tuple[str, ...]:
        return tuple(sorted(self.tables))

    def table(self, stream: str = "", columns: Sequence[str] | None = None) -> pa.Table:
        return self.tables[stream] if columns is None else self.tables[stream].select(list(columns))

    def columns(self, stream: str = "") -> Columns:
        return Columns(to_parquet(self.tables[stream]))
