"""The README.md of an export: what it holds, where it comes from, how to open it, and what its format does not carry."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from tacpipe.exports.contents import Contents, stream_label
from tacpipe.printable import listed, plain

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

NAME = "README.md"
_VALUES = 8  # listed values per attribute
_SHOWN = 3  # recordings that a line names


def readme_text(title: str, opening: str, recordings: Dataset, contents: Contents) -> bytes:
    """Return the README as Markdown: ``title``, how to open the export (Markdown), and the sections of `sections`."""
    return "\n\n".join([f"# {title}", opening.strip(), *sections(recordings, contents)]).encode() + b"\n"


def sections(recordings: Dataset, contents: Contents) -> list[str]:
    """Return what any export describes: contents, streams with units, what is not carried, provenance."""
    return [_contents(recordings, contents), _streams(contents), _losses(recordings, contents), provenance(recordings)]


def loss_notes(recordings: Dataset, contents: Contents) -> list[str]:
    """Return what the format does not carry, a sentence each, for the command's output."""
    return [f"not carried: {loss}{_affected_recordings(names, recordings)}" for loss, names in contents.losses.items()]


def provenance(recordings: Dataset) -> str:
    """Return the section that names the stages behind the recordings and their digest."""
    source = recordings.source
    steps = [step for step in source.chain if step["stage"] != source.stage]
    steps.append({"stage": source.stage, "version": source.version, "params": source.params})
    rows = [f"| `{stage['stage']}` | {stage['version']} | {_params(stage['params'])} |" for stage in steps]
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
    counts: dict[str, Counter[str]] = {}
    for recording in recordings:
        for name, value in recording.attributes.items():
            if isinstance(value, str | bool) and not name.startswith("gt_"):
                counts.setdefault(name, Counter())[str(value)] += 1
    return counts


def _streams(contents: Contents) -> str:
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


def _params(params: Mapping[str, object]) -> str:
    return _cell(", ".join(f"{name} {json.dumps(value)}" for name, value in params.items() if value not in ("", None)))


def _cell(value: str) -> str:
    return plain(value, 300).replace("|", "\\|").replace("<", "&lt;")
