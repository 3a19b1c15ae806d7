"""Select streams of recordings by the options ``--streams`` and ``--without`` of stages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, ClassVar

from tacpipe.errors import TacpipeError
from tacpipe.plugins.constraints import CommaList, Names
from tacpipe.plugins.params import added
from tacpipe.plugins.stage import RecordingOutput
from tacpipe.printable import suggestion

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.io.columns import Columns

WILDCARDS = "*?["


@dataclass(frozen=True, kw_only=True)
class StreamSelection:
    """Params of a stage that reads or writes selected streams of recordings; `Stage` calls the methods."""

    PANELS: ClassVar[Mapping[str, Sequence[str]]] = {"Streams": ("streams", "without")}

    streams: Names = added("")  # names of streams to read, with * as wildcard; empty for all
    without: Names = added("")  # names of streams to exclude, with * as wildcard

    def narrow(self, recording: Any) -> Any:
        """Return a recording with the selected streams, or with their columns if it is synchronized.

        Raises `TacpipeError` if the recording has no stream of a name, or if no stream remains.
        """
        if not (self.streams or self.without):
            return recording
        if set(recording.streams) != {""}:
            return _Narrowed(recording, self._select(recording.name, recording.streams))
        columns = recording.columns()
        owners = [(field.metadata or {}).get(b"stream", b"").decode() for field in columns.schema]
        selected = self._select(recording.name, sorted({owner for owner in owners if owner}))
        names = [
            field.name
            for field, owner in zip(columns.schema, owners, strict=True)
            if not owner or owner in selected or field.name == "t_ns"
        ]
        return _Narrowed(recording, [""], columns.select(names))

    def narrow_output(self, output: RecordingOutput) -> RecordingOutput:
        """Return the selected streams of a recording that was read from files. Raises the errors of `narrow`."""
        if not (self.streams or self.without):
            return output
        selected = self._select("", output.streams)
        return replace(output, tables={stream: output.streams[stream] for stream in selected})

    def _select(self, recording: str, names: Iterable[str]) -> list[str]:
        """Return the names of the selected streams, in order. Raises the errors of `narrow`."""
        existing = list(names)
        requested = self._matching(recording, existing, "--streams", self.streams) if self.streams else existing
        left_out = self._matching(recording, existing, "--without", self.without)
        selected = [name for name in existing if name in requested and name not in left_out]
        if not selected:
            raise TacpipeError(
                f"{_recording_phrase(recording)} has no stream left; it has {', '.join(existing)}. Select others."
            )
        return selected

    @staticmethod
    def _matching(recording: str, names: Sequence[str], option: str, text: str) -> set[str]:
        """Return the streams that match the patterns in the ``text`` of an option.

        Raises `TacpipeError` for a name without wildcard that no stream has.
        """
        matching: set[str] = set()
        for pattern in CommaList().items(text):
            matches = [name for name in names if fnmatchcase(name, pattern)]
            if not matches and not any(sign in pattern for sign in WILDCARDS):
                raise TacpipeError(
                    f"{_recording_phrase(recording)} has no stream {pattern!r}, which {option} names; it has "
                    f"{', '.join(names)}.{suggestion(pattern, names)}"
                )
            matching.update(matches)
        return matching


def _recording_phrase(recording: str) -> str:
    return f"Recording {recording}" if recording else "The recording"


class _Narrowed:
    """A recording with some of its streams, or with some of its ``columns`` if it is synchronized."""

    def __init__(self, recording: Any, streams: Sequence[str], columns: Columns | None = None) -> None:
        self._recording, self._columns = recording, columns
        self.streams = tuple(streams)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._recording, name)

    def table(self, stream: str = "", columns: Sequence[str] | None = None) -> pa.Table:
        """Return a stream, as `tacpipe.datasets.dataset.Recording.table` does."""
        if self._columns is None or stream:
            return self._recording.table(stream, columns)
        return self._columns.read(self._columns.column_names if columns is None else columns)

    def columns(self, stream: str = "") -> Columns:
        """Return a stream, as `tacpipe.datasets.dataset.Recording.columns` does."""
        if self._columns is None or stream:
            columns: Columns = self._recording.columns(stream)
            return columns
        return self._columns
