"""Run all checks on a dataset, and remember accepted findings beside it."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path

import numpy as np

from tacpipe.arrays import AnyArray
from tacpipe.checks.check import Check, CheckFinding, Stream
from tacpipe.datasets.dataset import Dataset
from tacpipe.datasets.manifest import NAME
from tacpipe.datasets.overview import NO_SIGNALS
from tacpipe.errors import UsageError
from tacpipe.io import JsonObject, regular, terminal
from tacpipe.io.files import readable_errors, write_whole
from tacpipe.plugins import registry
from tacpipe.printable import format_count, grouped_failures, lines, listed

ACCEPTED = ".accepted.json"  # end of the name of the file beside a dataset
_EMPTY: JsonObject = {"schema_version": 1, "accepted": {}}


@dataclass
class Examination:
    """The findings of a dataset, and the digests of those that the user accepted."""

    path: Path
    recordings: int
    findings: Sequence[CheckFinding]
    accepted: dict[str, str] = field(default_factory=dict)  # sentence by digest

    @property
    def open_findings(self) -> list[CheckFinding]:
        """The findings that are not accepted."""
        return [finding for finding in self.findings if finding.digest not in self.accepted]

    def accept(self, ids: Sequence[str]) -> None:
        """Store the acceptance of findings beside the dataset. Raises `UsageError` for an identifier without finding."""
        by_id = {finding.id: finding for finding in self.findings}
        for identifier in ids:
            if identifier not in by_id:
                raise UsageError(f"There is no finding {identifier}; there are {listed(sorted(by_id))}.")
            self.accepted[by_id[identifier].digest] = f"{identifier}: {by_id[identifier].sentence}"
        place = acceptance_file(self.path)
        content = json.dumps({**_EMPTY, "accepted": self.accepted}, indent=1, sort_keys=True) + "\n"
        with readable_errors(place.parent):
            write_whole(str(place), content.encode(), f"{place}.draft")

    def to_json(self) -> JsonObject:
        """Return the examination as plain values."""
        findings = [{**finding.to_json(), "accepted": finding.digest in self.accepted} for finding in self.findings]
        return {"schema_version": 1, "recordings": self.recordings, "findings": findings}

    def to_text(self) -> str:
        """Return the answer, then two lines per finding; accepted ones come last, with one line each."""
        remaining = self.open_findings
        accepted = [finding for finding in self.findings if finding not in remaining]
        count = format_count(len(self.findings), "findings")
        suffix = f", {len(accepted)} accepted" if accepted else ""
        answer = f"{count} in {format_count(self.recordings, 'recordings')}{suffix}"
        texts = [answer]
        for finding in remaining:
            texts += [f"{finding.id}: {finding.sentence} {finding.place()}", f"    repair: {finding.repair}"]
        return lines([*texts, *(f"accepted {finding.id}: {finding.sentence}" for finding in accepted)])


def acceptance_file(path: Path) -> Path:
    """Return the file beside a dataset, or a folder of files, with the findings that the user accepted."""
    folder = Path(os.path.abspath(path.parent if path.name == NAME else path))  # noqa: PTH100  (links stay)
    return folder.with_name(folder.name + ACCEPTED)


def examine(dataset: Dataset, path: Path) -> Examination:
    """Return the findings of the recordings in ``dataset``, with those accepted for ``path``."""
    findings = [*_unreadable(dataset), *examine_dataset(dataset)]
    accepted = {}
    if acceptance_file(path).exists():
        accepted = json.loads(regular.content(acceptance_file(path), regular.JSON_BYTES))["accepted"]
    return Examination(path, len(dataset), findings, accepted)


def examine_dataset(dataset: Dataset) -> list[CheckFinding]:
    """Return the findings of all registered checks, sorted. Each stream is read once, one channel at a time."""
    checks: list[Check] = [registry.load_check(name)() for name in registry.checks()]
    with terminal.progress_bar("check", len(dataset)) as advance:
        for recording in dataset:
            digests = recording.digests
            for name in recording.streams:
                if name not in NO_SIGNALS and recording.rows[name]:
                    _examine_stream(Stream(recording.name, name, digests[name], recording.columns(name)), checks)
            for check in checks:
                check.finish(recording.name)
            advance(note=recording.name)
    findings = [finding for check in checks for finding in check.conclude(dataset)]
    return sorted(findings, key=lambda finding: (finding.kind, finding.subject, finding.digest))


def _examine_stream(stream: Stream, checks: Sequence[Check]) -> None:
    for check in checks:
        check.examine(stream)
    for channel in stream.channels():
        if str(channel.type) in ("string", "large_string"):
            continue
        values = _values(stream, channel.name, binary="binary" in str(channel.type))
        for check in checks:
            check.examine_channel(stream, channel, values)


def _values(stream: Stream, name: str, *, binary: bool) -> AnyArray:
    """Return a channel (time,); packets are replaced by hashes, because a video does not fit in memory."""
    if not binary:
        values: AnyArray = stream.columns.column(name).to_numpy()
        return values

    hashes = (
        blake2b(packet or b"", digest_size=8).digest()
        for batch in stream.columns.batches([name])
        for packet in batch[name].to_pylist()
    )
    return np.frombuffer(b"".join(hashes), np.uint64)


def _unreadable(dataset: Dataset) -> Iterator[CheckFinding]:
    """Yield a finding for each reason why recordings could not be read."""
    for line in grouped_failures(dataset.source.skipped):
        names = [name for name in dataset.source.skipped if name in line]
        yield CheckFinding("unreadable", "", line, "as the sentence says", dict.fromkeys(names, ()), [line])
