"""A recording with several streams, made by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pyarrow as pa

from tacpipe.io.columns import Columns
from tacpipe.io.parquet import to_parquet


@dataclass
class StreamShard:
    """A recording with several streams."""

    name: str
    tables: Mapping[str, pa.Table]
    attributes: dict[str, Any] = field(default_factory=dict)

    @property
    def streams(self) -> tuple[str, ...]:
        return tuple(sorted(self.tables))

    def table(self, stream: str = "", columns: Sequence[str] | None = None) -> pa.Table:
        return self.tables[stream] if columns is None else self.tables[stream].select(list(columns))

    def columns(self, stream: str = "") -> Columns:
        return Columns(to_parquet(self.tables[stream]))
