"""Replay stages with known results, after the same reads and checkpoints, so that trials cost only file operations."""

import dataclasses
import functools
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa

from tacpipe.engine import execution
from tacpipe.io.hashing import digest
from tacpipe.plugins.stage import AnyStage, RecordingOutput, Result, Stage


class Replay:
    """Takes note of what stages read, save and return while it is ``listening``, and plays it back afterwards.

    Stages that read files of their own are always run; so are those that find a checkpoint to go on from.
    """

    def __init__(self) -> None:
        self.listening = True
        self._identity = ""
        self._read: Callable[[str, str], bytes] = _refuse_read
        self._events: list[tuple[Any, ...]] = []
        self._recorded: dict[str, tuple[list[tuple[Any, ...]], Callable[[], Any]]] = {}
        self._parquet: dict[int, tuple[Any, bytes]] = {}

    def install(self) -> None:
        """Replace what executes stages, for the rest of this process."""
        from tacpipe.io import parquet
        from tacpipe.training import loop

        execute, reader, stage, to_parquet = execution.execute, execution.reader, Stage.__call__, parquet.to_parquet
        self._save, self._resume = loop.write_checkpoint, loop.read_checkpoint

        def executing(task: Any, *arguments: Any, **options: Any) -> Any:
            self._identity = digest([task.name, task.identity, task.recording])
            return execute(task, *arguments, **options)

        def reading(*arguments: Any, **options: Any) -> Callable[[str, str], bytes]:
            read = reader(*arguments, **options)

            def noted(name: str, path: str) -> bytes:
                content = read(name, path)
                self._events.append(("read", name, path))
                return content

            self._read = noted
            return noted

        def saving(folder: Path, tensors: Any, history: Any) -> None:
            self._events.append(("save", {name: tensor.clone() for name, tensor in tensors.items()}, _copy(history)))
            self._save(folder, tensors, history)

        def resuming(folder: Path) -> Any:
            self._events.append(("resume",))
            return self._resume(folder)

        def calling(called_stage: AnyStage, params: Any, **arguments: Any) -> Any:
            return self._call(called_stage, arguments, lambda: stage(called_stage, params, **arguments))

        def packing(table: Any) -> bytes:
            if id(table) not in self._parquet:
                self._parquet[id(table)] = table, to_parquet(table)
            return self._parquet[id(table)][1]

        execution.execute, execution.reader, Stage.__call__ = executing, reading, calling  # type: ignore
        loop.write_checkpoint, loop.read_checkpoint, parquet.to_parquet = saving, resuming, packing

    def _call(self, stage: AnyStage, arguments: dict[str, Any], run: Callable[[], Any]) -> Any:
        workspace = next((arguments[name] for name, kind in stage.arguments.items() if kind == "Workspace"), None)
        recorded = self._recorded.get(self._identity)
        if recorded is None or self.listening or (workspace is not None and any(workspace.iterdir())):
            start, identity = len(self._events), self._identity
            returned = run()
            if self.listening and not stage.source:
                repeat = _repeatable(returned)
                self._recorded[identity] = self._events[start:], repeat
                return repeat()
            return returned
        events, repeat = recorded
        place = workspace or Path()
        for kind, *details in events:
            if kind == "read":
                self._read(*details)
            elif kind == "save":
                self._save(place, *details)
            else:
                self._resume(place)
        return repeat()


def _repeatable(returned: Any) -> Callable[[], Any]:
    """Return a function that returns the result of a stage anew: its streams and written files can be consumed once."""
    if isinstance(returned, RecordingOutput):
        streams = {name: _repeatable_stream(stream) for name, stream in returned.streams.items()}
        return lambda: dataclasses.replace(returned, tables={name: stream() for name, stream in streams.items()})
    if not isinstance(returned, Result) or not returned.written:
        return lambda: returned
    contents = {}
    for name, write in returned.written.items():
        sink = io.BytesIO()
        write(sink)
        contents[name] = sink.getvalue()
    writers = {name: functools.partial(_write, content) for name, content in contents.items()}
    repeatable = dataclasses.replace(returned, written=writers)
    return lambda: repeatable


def _repeatable_stream(stream: pa.Table | pa.RecordBatchReader) -> Callable[[], pa.Table | pa.RecordBatchReader]:
    """Return a function that returns the table, or a new reader of the same batches."""
    if isinstance(stream, pa.Table):
        return lambda: stream
    return functools.partial(pa.RecordBatchReader.from_batches, stream.schema, list(stream))


def _write(content: bytes, sink: Any) -> None:
    sink.write(content)


def _refuse_read(name: str, path: str) -> bytes:
    raise AssertionError("no stage has been given anything to read")


def _copy(value: Any) -> Any:
    import copy

    return copy.deepcopy(value)
