"""`tacpipe label DATASET --from TABLE`: set the labels of many recordings from a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tacpipe.errors import UsageError
from tacpipe.io import terminal
from tacpipe.printable import excerpt, listed, plain

SHOWN = 20  # Largest number of recordings whose changes are printed


def refuse_others(names: Sequence[str] | None, sets: Sequence[str] | None, exclude: str | None, include: bool) -> None:
    """Raise `UsageError` where labels come from a table and from the command line."""
    if names or sets or exclude is not None or include:
        raise UsageError(
            "--from names recordings and labels itself; leave out names, --label, --exclude and --include."
        )


def refuse_alone(names: Sequence[str] | None, key: str, dry_run: bool) -> None:
    """Raise `UsageError` for options of --from without it, and where no recording is named."""
    if key or dry_run:
        raise UsageError("--key and --dry-run go with --from; leave them out, or give a table with --from.")
    if not names:
        raise UsageError("Name the recordings to label, or give a table with --from; * and ? match any letters.")


def run(dataset: Path, path: Path, key: str, *, dry_run: bool, as_json: bool) -> None:
    """Set the labels of a table on a dataset's recordings, or print what would change."""
    from tacpipe.datasets import labels
    from tacpipe.formats.table.label_table import LabelTable, read_label_table

    table: list[LabelTable] = []

    def labels_for(current_labels: labels.ByRecording) -> labels.ByRecording:
        table.append(read_label_table(path, key, current_labels))
        return table[-1].by_recording(current_labels)

    current, changes = labels.planned(dataset, labels_for)
    unmatched = sorted(set(current) - set(table[-1].by_recording(current)))
    value: dict[str, Any] = {"schema_version": 1, "output": str(dataset), "key": table[-1].key, "without": unmatched}
    if dry_run:
        value |= {"recordings": sorted(changes), "labels": changes}
        terminal.result_json(value) if as_json else terminal.result(
            _described(current, changes, len(current), unmatched)
        )
        return
    changed = labels.change_each(dataset, labels_for) if changes else None
    value |= {"recordings": [] if changed is None else changed.recordings, "labels": changes}
    if unmatched:
        terminal.note(f"tacpipe: {path} has no row for {len(unmatched)} recordings: {listed(unmatched)}.")
    if as_json:
        terminal.result_json(value)
        return
    terminal.note(f"{len(changes)} of {len(current)} recordings changed")
    terminal.result(dataset if changed is None else changed.directory)


def _described(current: Mapping[str, Any], changes: Mapping[str, Any], count: int, unmatched: Sequence[str]) -> str:
    """Return one line per recording whose labels would change, then their number."""
    lines = [
        f"{plain(name)}: "
        + ", ".join(f"{plain(key)} {_shown(current[name].get(key))} → {_shown(value)}" for key, value in labels.items())
        for name, labels in sorted(changes.items())[:SHOWN]
    ]
    lines += [f"… and {len(changes) - SHOWN} more"] if len(changes) > SHOWN else []
    lines += [f"no row for {listed(unmatched)}"] if unmatched else []
    return "\n".join([*lines, f"{len(changes)} of {count} recordings would change"])


def _shown(value: Any) -> str:
    return "none" if value is None else excerpt(value)
