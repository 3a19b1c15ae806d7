"""A container format for tests: a JSON file of streams."""

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from tacpipe.errors import TacpipeError
from tacpipe.formats.container import Container, EpisodeContents, SourceStream, Time


@dataclass(frozen=True)
class Fake(Container):
    path: Path

    def episodes(self) -> Sequence[str]:
        return list(self._content().get("episodes", {}))

    def read(self, sources: Collection[str] | None, episode: str | None) -> EpisodeContents:
        content = self._content()
        streams = content["streams"] if episode is None else content["episodes"][episode]
        return EpisodeContents(
            [_stream(name, value) for name, value in streams.items() if sources is None or name in sources],
            {"robot": content.get("robot", "panda")},
            content.get("skipped", {}),
            content.get("notes", ()),
        )

    def _content(self) -> Any:
        try:
            return json.loads(self.path.read_text())
        except ValueError as error:
            raise TacpipeError(f"{self.path} is not a container.") from error


def _stream(source: str, values: dict[str, list[float]]) -> SourceStream:
    fields = [pa.field("stamp", pa.int64(), metadata={"clock": "header stamp"})]
    fields += [
        pa.field(name, pa.float32(), metadata={"quantity": "tactile", "taxel": "7"})
        for name in values
        if name != "stamp"
    ]
    table = pa.table([pa.array(values[field.name], field.type) for field in fields], pa.schema(fields))
    return SourceStream(source, source.strip("/"), Time("stamp", "ns"), table, table.num_rows)


def opened(path: Path) -> Fake:
    return Fake(path)


def write(path: Path, streams: dict[str, Any] | None = None, **content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    skin = {"stamp": [10**9, 2 * 10**9], "t1": [0.5, float("nan")], "t2": [1.5, 2.5]}
    path.write_text(json.dumps({"streams": streams or {"/skin": skin}, **content}))
