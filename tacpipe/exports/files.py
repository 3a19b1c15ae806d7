"""Write the files of an export with a README.md: contents, provenance, how to open it, and the format's losses."""

from __future__ import annotations

import io
import json
import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Self

from tacpipe.channels.schema import TRUTH
from tacpipe.errors import StorageError
from tacpipe.exports.contents import Contents, stream_label
from tacpipe.plugins.stage import StoredParams
from tacpipe.printable import listed, plain

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

Content = bytes | Callable[[], bytes]


class Files(Mapping[str, bytes]):
    """Files by name; the content of each is bytes, or a function that returns them."""

    def __init__(self, contents: Mapping[str, Content]) -> None:
        self._contents = contents

    def __getitem__(self, name: str) -> bytes:
        content = self._contents[name]
        return content if isinstance(content, bytes) else content()

    def __iter__(self) -> Iterator[str]:
        return iter(self._contents)

    def __len__(self) -> int:
        return len(self._contents)


class Scratch(io.RawIOBase):
    """A temporary file whose writes never raise, because a failing write, as on a full disk, would crash HDF5.

    `check` raises the first error, after which nothing is written. The file is closed with the last reference to it.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115  (closed by `close`)
        self._error: OSError | None = None

    def write(self, content: Any) -> int:
        """Write all of ``content``, unless an earlier write failed."""
        remaining = memoryview(content).cast("B")
        size = len(remaining)
        while remaining and self._error is None:
            try:
                remaining = remaining[self._file.write(remaining) :]  # a nearly full disk accepts only a part
            except OSError as error:
                self._error = error
        if remaining:
            self._file.seek(len(remaining), io.SEEK_CUR)
        return size

    def truncate(self, size: int | None = None) -> int:
        """Resize the file to ``size`` bytes."""
        try:
            return self._file.truncate(size)
        except OSError as error:
            self._error = self._error or error
            return size or 0

    def readinto(self, buffer: Any) -> int:
        """Fill ``buffer`` from the file."""
        return int(self._file.readinto(buffer))

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Move to a position."""
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        """Return the position."""
        return self._file.tell()

    def close(self) -> None:
        """Close the file, which deletes it."""
        self._file.close()
        super().close()

    def piece(self, offset: int, size: int) -> bytes:
        """Return a part of the written content."""
        return os.pread(self._file.fileno(), size, offset)

    def check(self) -> Self:
        """Return the file. Raises `StorageError` if a write failed."""
        if self._error is not None:
            raise StorageError(
                f"The folder of temporary files {tempfile.gettempdir()} cannot be written: {self._error.strerror}. Free "
                f"some space or set TMPDIR to another folder, and run the same command again."
            )
        return self


def copy_to_sink(file: Scratch) -> Callable[[Any], None]:
    """Return a function that copies a file to its argument, and closes it."""

    def write(sink: Any) -> None:
        with file:
            file.seek(0)
            shutil.copyfileobj(file, sink, 1 << 20)

    return write


README_NAME = "README.md"
_VALUES = 8  # number of listed values per attribute
_SHOWN = 3  # number of recordings named in a line


def readme_text(title: str, opening: str, recordings: Dataset, contents: Contents) -> bytes:
    """Return the README as Markdown: ``title``, ``opening`` (how to open the export), and the sections of `sections`."""
    return "\n\n".join([f"# {title}", opening.strip(), *sections(recordings, contents)]).encode() + b"\n"


def sections(recordings: Dataset, contents: Contents) -> list[str]:
    """Return the sections that every export has: contents, streams with units, losses, provenance."""
    return [_contents(recordings, contents), _streams(contents), _losses(recordings, contents), provenance(recordings)]


def loss_notes(recordings: Dataset, contents: Contents) -> list[str]:
    """Return one sentence per loss of the format, for the command's output."""
    return [f"not carried: {loss}{_affected_recordings(names, recordings)}" for loss, names in contents.losses.items()]


def provenance(recordings: Dataset) -> str:
    """Return the section with the stages that produced the recordings and their digest."""
    source = recordings.source
    stages = [
        (step["stage"], step["version"], step["params"]) for step in source.chain if step["stage"] != source.stage
    ]
    stages.append((source.stage, source.version, source.params))
    rows = [f"| `{stage}` | {version} | {_params(params)} |" for stage, version, params in stages]
    return "\n".join(
        [
            "## Where it comes from",
            "",
            f"Exported by tacpipe from {len(recordings)} recordings with the digest `{recordings.digest}`. "
            "`manifest.json` has the digest of every file and of the inputs; `tacpipe explain` shows the whole lineage.",
            "",
            "| stage | version | params |",
            "| --- | --- | --- |",
            *rows,
        ]
    )


def _contents(recordings: Dataset, contents: Contents) -> str:
    """Return the section with number, duration and date of the recordings, and labels with few values."""
    lines = ["## What it holds", "", f"- {len(recordings)} recordings, {contents.seconds:.1f} s"]
    if contents.first_ns is not None and contents.first_ns > 0:
        lines.append(f"- recorded from {datetime.fromtimestamp(contents.first_ns // 10**9, UTC):%Y-%m-%d} (UTC)")
    for name, values in _labels(recordings).items():
        if len(values) <= _VALUES:
            lines.append(
                f"- {_cell(name)}: {', '.join(f'{_cell(value)} ({count})' for value, count in sorted(values.items()))}"
            )
    return "\n".join(lines)


def _labels(recordings: Dataset) -> Mapping[str, Counter[str]]:
    """Return the number of recordings by value of each label that is text or boolean."""
    counts: dict[str, Counter[str]] = {}
    for recording in recordings:
        for name, value in recording.attributes.items():
            if isinstance(value, str | bool) and not name.startswith(TRUTH):
                counts.setdefault(name, Counter())[str(value)] += 1
    return counts


def _streams(contents: Contents) -> str:
    """Return the section with a table of the streams."""
    lines = [
        "## Streams",
        "",
        "| stream | recordings | rows | rate (Hz) | columns: quantity (unit) |",
        "| --- | --- | --- | --- | --- |",
    ]
    for stream in contents.streams.values():
        rates = [f"{rate:g}" for rate in dict.fromkeys(stream.rates_hz)]
        kinds = Counter((column.quantity or "not stated", column.unit or "not stated") for column in stream.columns)
        about = ", ".join(f"{count} {_cell(quantity)} ({_cell(unit)})" for (quantity, unit), count in kinds.items())
        rate = " to ".join(rates) or "none"
        lines.append(
            f"| {_cell(stream_label(stream.name))} | {len(stream.recordings)} | {stream.rows} | {rate} | {about} |"
        )
    return "\n".join(lines)


def _losses(recordings: Dataset, contents: Contents) -> str:
    lines = [f"- {loss}{_affected_recordings(names, recordings)}" for loss, names in contents.losses.items()]
    return "\n".join(
        ["## Not carried", "", *(lines or ["Nothing: values, types, units and labels are all in these files."])]
    )


def _affected_recordings(names: Sequence[str], recordings: Dataset) -> str:
    is_everywhere = len(names) == len(recordings)
    return "" if is_everywhere else f" ({len(names)} of {len(recordings)} recordings: {listed(names, _SHOWN)})"


def _params(params: StoredParams) -> str:
    return _cell(", ".join(f"{name} {json.dumps(value)}" for name, value in params.items() if value not in ("", None)))


def _cell(value: str) -> str:
    return plain(value, 300).replace("|", "\\|").replace("<", "&lt;")
