"""Bytes on disk of integer streams, beside their raw integers and what pandas writes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import timing

from tacpipe import open as open_dataset

ROOT = Path(__file__).parents[1]
BAR = 0.35
SIMULATED = {
    "smooth, 12 s": "--hold-probability 0",
    "smooth, 60 s": "--hold-probability 0 --duration-s 60",
    "smooth, 60 s at 100 Hz": "--hold-probability 0 --duration-s 60 --tactile-rate-hz 100",
    "three quarters held, 60 s": "--hold-probability 0.75 --duration-s 60",
}


def measure(folder: Path, rounds: int) -> list[timing.Line]:
    """Return stored bytes of each kind of stream as a share of its integers' bytes, time left out of the latter."""
    project = folder / "sizes"
    (project / ".tacpipe").mkdir(parents=True)
    lines = []
    for what, options in SIMULATED.items():
        place = what.replace(" ", "-").replace(",", "")
        timing.run(f"tacpipe simulate forward --trials 4 {options} -o {place}", project)
        lines.append(_line(f"tactile streams, simulated, {what}", project / place))
    published = Path(os.environ.get("TACPIPE_SAMPLE_DATA", ROOT.parent / "shared" / "data")) / "xela_flat_pick_move"
    if published.is_dir():
        timing.run(["tacpipe", "ingest", "xela-flat", str(published), "-o", "published"], project)
        lines.append(_line("tactile streams, published uSkin trials", project / "published"))
    return lines


def _line(what: str, dataset: Path) -> timing.Line:
    raw = ours = pandas = 0
    for path, table in _tactile(dataset):
        raw += sum(
            column.nbytes for name, column in zip(table.column_names, table.columns, strict=True) if name != "t_ns"
        )
        ours += path.stat().st_size
        draft = dataset / "pandas.parquet"
        table.to_pandas().to_parquet(draft)
        pandas += draft.stat().st_size
    share = ours / raw
    return timing.Line(
        what,
        f"{ours / 1e6:.2f} MB of {raw / 1e6:.2f} MB",
        f"pandas.to_parquet: {pandas / raw:.3f} of the integers",
        f"{share:.3f} of the integers",
        f"at most {BAR}",
        share <= BAR,
    )


def _tactile(dataset: Path) -> Iterator[tuple[Path, pa.Table]]:
    """Yield the file and the table of each stream whose channels are all tactile and integer."""
    for name, shard in open_dataset(dataset).recordings.items():
        for stream in shard.streams:
            table = shard.table(stream)
            channels = [field for field in table.schema if field.name != "t_ns"]
            if all((field.metadata or {}).get(b"quantity") == b"tactile" for field in channels):
                assert all(pa.types.is_integer(field.type) for field in channels), f"{name}/{stream} holds no integers"
                yield dataset / name / f"{stream}.parquet", table
