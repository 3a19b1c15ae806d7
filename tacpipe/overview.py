"""What is in a dataset: recordings, streams, rates, gaps, holds, saturation, labels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tacpipe import pipeline
from tacpipe.dataset import Dataset, Shard

_SHOWN = 20  # recordings listed before the rest is counted
_GAP_FACTOR = 3.0  # a step this many times the median step is a gap


def of(path: Path) -> dict[str, Any]:
    """Return what is in the dataset at ``path``: numbers a stream of each recording, labels, files."""
    opened = pipeline.open_dataset(path)
    manifest = opened.source
    return {
        "stage": manifest.stage,
        "digest": manifest.digest,
        "recordings": {name: _recording(shard) for name, shard in opened.shards.items()},
        "attributes": {name: dict(shard.attributes) for name, shard in opened.shards.items()},
        "excluded": _excluded(opened),
        "skipped": dict(manifest.skipped),
        "files": {name: file["bytes"] for name, file in manifest.files.items()},
        "bytes": sum(shard["bytes"] for entry in manifest.recordings.values() for shard in entry["shards"].values()),
        "rows": manifest.rows,
    }


def _excluded(opened: Dataset) -> dict[str, str]:
    entries = opened.source.recordings
    return {name: str(why) for name, entry in entries.items() if (why := entry["attributes"].get("excluded"))}


def _recording(shard: Shard) -> dict[str, Any]:
    return {stream: _stream(shard, stream) for stream in shard.streams}


def _stream(shard: Shard, stream: str) -> dict[str, Any]:
    import numpy as np
    import pyarrow as pa

    table = shard.table(stream)
    found: dict[str, Any] = {"rows": table.num_rows, "columns": table.num_columns}
    if "t_ns" in table.column_names and table.num_rows > 1:
        step_ns = np.diff(table["t_ns"].to_numpy())  # (time - 1,)
        median_ns = float(np.median(step_ns))
        found["duration_s"] = round(float(step_ns.sum()) / 1e9, 3)
        found["rate_hz"] = round(1e9 / median_ns, 3) if median_ns else None
        found["gaps"] = int((step_ns > _GAP_FACTOR * median_ns).sum())
        if "seq" in table.column_names and step_ns.sum() > 0:  # the device counts: late arrivals are then no gaps
            steps = np.diff(table["seq"].to_numpy())
            found["rate_hz"] = round(float(steps.sum() / step_ns.sum()) * 1e9, 3)
            found["gaps"] = int((steps > 1).sum())
    integers = [
        table[field.name].to_numpy()
        for field in table.schema
        if pa.types.is_integer(field.type) and (field.metadata or {}).get(b"quantity") == b"tactile"
    ]
    if integers and table.num_rows > 1:
        values = np.column_stack(integers)  # (time, channel)
        limits = np.iinfo(values.dtype)
        found["held_share"] = round(float((values[1:] == values[:-1]).all(axis=1).mean()), 4)
        found["saturated"] = int(((values == limits.max) | (values == limits.min)).sum())
    return found


def to_text(value: dict[str, Any], *, full: bool = False) -> str:
    """Return the overview as lines: one a stream of each recording, then labels, files and totals."""
    names = sorted(value["recordings"])
    shown = names if full else names[:_SHOWN]
    lines = [
        f"{'recording':<24} {'stream':<10} {'rows':>7} {'columns':>7} {'s':>8} {'Hz':>8} "
        f"{'gaps':>5} {'held':>5} {'saturated':>9}"
    ]
    for name in shown:
        for stream, found in value["recordings"][name].items():
            held = f"{found['held_share']:.0%}" if "held_share" in found else ""
            lines.append(
                f"{name:<24} {stream or '-':<10} {found['rows']:>7} {found['columns']:>7} {found.get('duration_s', ''):>8} "
                f"{found.get('rate_hz', '') or '':>8} {found.get('gaps', ''):>5} {held:>5} {found.get('saturated', ''):>9}"
            )
    if len(names) > len(shown):
        lines.append(f"… and {len(names) - len(shown)} more (--full)")
    lines += ["", *_labels(value["attributes"])]
    lines += [f"excluded: {name}: {why}" for name, why in value["excluded"].items()]
    lines += [f"left out: {name}: {why}" for name, why in value["skipped"].items()]
    lines += [f"file: {name}, {size} bytes" for name, size in value["files"].items()]
    lines.append(
        f"{len(names)} recordings, {value['rows']} rows, {value['bytes'] / 1e6:.1f} MB, "
        f"made by {value['stage']} [{value['digest'][:12]}]"
    )
    return "\n".join(lines)


def _labels(attributes: dict[str, dict[str, Any]]) -> list[str]:
    """Return one line a label that takes few values, with how often it takes each."""
    lines = []
    for label in sorted({label for labels in attributes.values() for label in labels}):
        values = [labels[label] for labels in attributes.values() if label in labels]
        if any(isinstance(value, float) for value in values):
            numbers = [value for value in values if isinstance(value, int | float)]
            lines.append(f"{label}: {min(numbers):g} to {max(numbers):g}")
            continue
        counts = {str(value): [str(other) for other in values].count(str(value)) for value in values}
        if len(counts) <= _SHOWN:
            lines.append(f"{label}: " + ", ".join(f"{value} ({count})" for value, count in sorted(counts.items())))
        else:
            lines.append(f"{label}: {len(counts)} values")
    return lines
