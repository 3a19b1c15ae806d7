"""Measure the bytes of tactile integer streams as Parquet, next to the raw integers and to what pandas writes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import timing

from tacpipe import open as open_dataset
from tacpipe.io import parquet

ROOT = Path(__file__).parents[1]
AIM = 0.35
SIMULATED = {
    "smooth, 12 s": "--hold-probability 0",
    "smooth, 60 s": "--hold-probability 0 --duration-s 60",
    "smooth, 60 s at 100 Hz": "--hold-probability 0 --duration-s 60 --tactile-rate-hz 100",
    "three quarters held, 60 s": "--hold-probability 0.75 --duration-s 60",
}


def measure(folder: Path, rounds: int) -> list[timing.Line]:
    """Return the bytes of each kind of stream as a share of its integers' bytes, which leave the time out."""
    project = folder / "sizes"
    (project / ".tacpipe").mkdir(parents=True)
    lines = []
    for case, options in SIMULATED.items():
        place = case.replace(" ", "-").replace(",", "")
        timing.run(f"tacpipe simulate forward --trials 4 {options} -o {place}", project)
        lines.append(_line(f"tactile streams, simulated, {case}", project / place))
    published = Path(os.environ.get("TACPIPE_SAMPLE_DATA", ROOT.parent / "shared" / "data")) / "xela_flat_pick_move"
    if published.is_dir():
        timing.run(["tacpipe", "ingest", "xela-flat", str(published), "-o", "published"], project)
        lines.append(_line("tactile streams, published uSkin trials", project / "published"))
    return lines


def _line(case: str, dataset: Path) -> timing.Line:
    raw = ours = pandas = 0
    draft = dataset / "pandas.parquet"
    for table in _tactile(dataset):
        raw += sum(column.nbytes for column in table.columns[1:])
        ours += len(parquet.to_parquet(table))
        table.to_pandas().to_parquet(draft)
        pandas += draft.stat().st_size
    share = ours / raw
    return timing.Line(
        case,
        f"{ours / 1e6:.2f} MB of {raw / 1e6:.2f} MB",
        f"pandas.to_parquet: {pandas / raw:.3f} of the integers",
        f"{share:.3f} of the integers",
        f"at most {AIM}",
        share <= AIM,
    )


def _tactile(dataset: Path) -> Iterator[pa.Table]:
    """Yield the time and the tactile integer channels of each stream that has any."""
    for shard in open_dataset(dataset).recordings.values():
        for stream in shard.streams:
            table = shard.table(stream)
            channels = [
                field.name
                for field in table.schema
                if (field.metadata or {}).get(b"quantity") == b"tactile" and pa.types.is_integer(field.type)
            ]
            if channels:
                yield table.select(["t_ns", *channels])
