"""Recordings taken through the stages that a model was trained behind within another stage, without a store."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from tacpipe.errors import UsageError
from tacpipe.io.hashing import digest
from tacpipe.plugins import params, registry
from tacpipe.plugins.stage import RecordingOutput

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording


@dataclass(frozen=True)
class InMemory:
    """What a stage reads of a recording, of tables in memory."""

    name: str
    tables: Mapping[str, pa.Table]
    attributes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def streams(self) -> tuple[str, ...]:
        """The names of its streams."""
        return tuple(sorted(self.tables))

    @property
    def digest(self) -> str:
        """A digest that no stored recording has."""
        return digest(["in memory", self.name])

    def table(self, stream: str = "", columns: Sequence[str] | None = None) -> pa.Table:
        """Return a stream."""
        return self.tables[stream] if columns is None else self.tables[stream].select(list(columns))

    def columns(self, stream: str = "") -> pa.Table:
        """Return a stream, whose columns are in memory already."""
        return self.tables[stream]


@dataclass(frozen=True)
class Recordings:
    """What a task reads of a dataset: recordings by name, and files."""

    recordings: Mapping[str, Any]
    files: Mapping[str, bytes] = field(default_factory=dict)


def recorded(recording: Recording) -> dict[str, pa.Table]:
    """Return the streams of a recording. Raises `UsageError` for one that went through `synchronize` already."""
    if set(recording.streams) == {""}:
        raise UsageError(
            "this recording went through a stage already, and what had arrived when cannot be seen from it. Give the "
            "recordings themselves; the model's own stages are run on them."
        )
    return {name: recording.table(name) for name in recording.streams}


def continued(recording: Recording, model: Dataset) -> Any:
    """Return a recording as it is after the stages of a model's chain; it went through none of them yet."""
    found: Any = recording
    for step in model.source.chain:
        stage = registry.load(step["stage"])
        arguments: dict[str, Any] = {
            name: found if kind == "Recording" else {one: model.files[one] for one in step["fitted"] or {}}
            for name, kind in stage.arguments.items()
        }
        returned = stage(params.from_json(stage, step["params"]), **arguments)
        made = returned if isinstance(returned, RecordingOutput) else RecordingOutput(returned)
        tables: dict[str, Any] = {
            name: one.read_all() if hasattr(one, "read_all") else one for name, one in made.streams.items()
        }
        found = InMemory(recording.name, tables, {**found.attributes, **made.attributes})
    return found
