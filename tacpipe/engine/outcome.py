"""Collect the outcome of a command: counts, bad recordings, and notes on valid results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypedDict

from tacpipe.datasets.consistency import column_notes, label_notes
from tacpipe.engine import execution, provenance
from tacpipe.errors import TacpipeError
from tacpipe.plugins import registry
from tacpipe.plugins.rows import StageRows, stage_rows_from_json
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import listed
from tacpipe.store.records import ComputedResult, Summary

_NAMED = 5  # maximum number of recordings that a note names


class OutcomeJson(TypedDict):
    """The outcome as a command prints it; the fields are those of `Outcome`."""

    output: str
    key: str
    ran: int
    reused: int
    rows: int
    seconds: float
    bad: dict[str, str]
    differs: list[str]
    notes: list[str]


@dataclass
class Outcome:
    """Outcome of a command."""

    output: Path
    key: str = ""
    ran: int = 0
    reused: int = 0
    rows: int = 0
    seconds: float = 0.0
    bad: dict[str, str] = field(default_factory=dict)
    differs: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    # names of recordings by the stage's note about them
    recordings_by_note: dict[str, list[str]] = field(default_factory=dict)
    code: dict[str, dict[str, int]] = field(default_factory=dict)  # number of results by stage and digest of its code
    # number of results by plug-in package and digest of its code
    packages: dict[str, dict[str, int]] = field(default_factory=dict)
    stage_rows: dict[str, StageRows] = field(default_factory=dict)  # rows read, by stage
    columns: dict[str, dict[str, list[str]]] = field(default_factory=dict)  # names of columns by recording and stream
    unlike: list[str] = field(default_factory=list)  # differences between the computers that produced differing results

    def begin(self) -> None:
        """Reset all counts and summaries, before stored or computed results are added."""
        self.ran = self.reused = 0
        self.restore({})

    def add_record(self, stage: str, recording: str, record: ComputedResult) -> None:
        """Add the notes of a record, the code that computed it, and the rows that it accounts for."""
        made_by = record["provenance"]
        for note in made_by.get("notes") or ():
            self.recordings_by_note.setdefault(note, []).append(recording)
        if columns := made_by.get("columns"):
            self.columns[recording] = columns
        if code := made_by.get("code"):
            _add_counts(self.code, {stage: {code: 1}})
        packages = made_by.get("packages") or {}
        _add_counts(self.packages, {package: {code: 1} for package, code in packages.items()})
        if (rows := made_by.get("rows")) is not None:
            self.stage_rows.setdefault(stage, StageRows()).add(StageRows.from_json(rows))

    def add_dataset_notes(self, attributes_by_recording: Mapping[str, Mapping[str, Attribute]]) -> None:
        """Add notes on labels and columns that differ between the recordings of the dataset."""
        for note in [*label_notes(attributes_by_recording), *column_notes(self.columns)]:
            self.recordings_by_note.setdefault(note, [""])

    def add_group(self, summary: Summary) -> None:
        """Add the summary that `of_results` returned for a group of recordings."""
        for note, recordings in (summary.get("notes") or {}).items():
            self.recordings_by_note.setdefault(note, []).extend(recordings)
        _add_counts(self.code, summary.get("code") or {})
        _add_counts(self.packages, summary.get("packages") or {})
        for stage, rows in stage_rows_from_json(summary.get("stage_rows")).items():
            self.stage_rows.setdefault(stage, StageRows()).add(rows)

    def compare(self, stored: ComputedResult, recomputed: ComputedResult, name: str) -> None:
        """Compare two records of a result, and add the differences. ``name`` is the stage or the recording."""
        differs = execution.differences(stored["result"], recomputed["result"], name)
        self.differs += differs
        environment_differences = (
            provenance.environment_differences(stored["provenance"], recomputed["provenance"]) if differs else []
        )
        self.unlike += [difference for difference in environment_differences if difference not in self.unlike]

    def of_results(self) -> Summary:
        """Return the summary of all added records, to be stored in the record of a run."""
        stage_rows = {stage: rows.to_json() for stage, rows in self.stage_rows.items()}
        return {
            "code": self.code,
            "packages": self.packages,
            "notes": self.recordings_by_note,
            "stage_rows": stage_rows,
        }

    def restore(self, summary: Summary) -> None:
        """Restore a summary that `of_results` returned; older records contain none."""
        self.code, self.packages = summary.get("code") or {}, summary.get("packages") or {}
        self.recordings_by_note = summary.get("notes") or {}
        self.stage_rows = stage_rows_from_json(summary.get("stage_rows"))

    def describe_differences(self) -> str:
        """Describe the differences from the stored results, and whether rounding on another computer may explain them."""
        computers = f" (computed with other {'; '.join(self.unlike)}, which rounds differently)" if self.unlike else ""
        return f"these differ from what is stored: {'; '.join(self.differs)}{computers}"

    def describe_results(self) -> list[str]:
        """Return the notes of stages, unused rows, and warnings about results of an earlier version of the code."""
        count = self.ran + self.reused
        lines = []
        for text, names in self.recordings_by_note.items():
            subject = names[0]  # empty for a stage that reads whole datasets
            if len(names) > 1:
                some_recordings = f"{len(names)} recordings ({listed(sorted(names), _NAMED)})"
                subject = f"all {count} recordings" if len(names) == count else some_recordings
            lines.append(f"{subject}: {text}" if subject else text)
        sentences = (rows.describe_unused(registry.stage_name(stage)) for stage, rows in self.stage_rows.items())
        lines += [sentence for sentence in sentences if sentence]
        described_packages = set()
        for stage, counts in self.code.items():
            if warning := _other_code(stage, counts):
                lines.append(warning)
                described_packages.add(registry.package_of_stage(stage))
        for package, counts in self.packages.items():
            warning = _other_package(package, counts)
            if warning and package not in described_packages:
                lines.append(warning)
        return lines

    def to_json(self) -> OutcomeJson:
        """Return the outcome as JSON for the command's output."""
        return {
            "output": str(self.output),
            "key": self.key,
            "ran": self.ran,
            "reused": self.reused,
            "rows": self.rows,
            "seconds": self.seconds,
            "bad": self.bad,
            "differs": self.differs,
            "notes": self.notes,
        }


def _add_counts(total: dict[str, dict[str, int]], counts: Mapping[str, Mapping[str, int]]) -> None:
    """Add ``counts``, the number of results by stage or package and by code, to ``total``."""
    for name, numbers in counts.items():
        added = total.setdefault(name, {})
        for code, number in numbers.items():
            added[code] = added.get(code, 0) + number


def _other_package(package: str, counts: Mapping[str, int]) -> str:
    """Return a warning if results were computed by other code of a plug-in package; else an empty string.

    ``counts`` are the numbers of results by code.
    """
    now = registry.package_code(package)  # None if the package was removed; its results stay valid
    outdated = sum(number for code, number in counts.items() if code != now)
    if now is None or not outdated:
        return ""
    return (
        f"{outdated} of these results were computed by other code of the package {package} than is installed now. Raise the "
        f"version of the package or of the stage if they differ, or compute them again with --rerun."
    )


def _other_code(name: str, counts: Mapping[str, int]) -> str:
    """Return the warning if results of a stage were computed by other code (``counts`` by code); else an empty string."""
    try:
        stage = registry.load_step(name)
    except TacpipeError:  # The plug-in was removed; its results stay valid
        return ""
    now = provenance.code(stage)
    outdated = sum(number for code, number in counts.items() if code != now)
    if now is None or not outdated:
        return ""
    return (
        f"{outdated} of these results were computed by other code of {name} than there is now in "
        f"{stage.function.__module__}, under the same version {stage.version}. Raise its version if they differ, "
        f"or compute them again with --rerun."
    )
