"""Hold the newest sample of every stream at 50 Hz, with masks, in polars: the same rows as `tacpipe synchronize`."""

import os
import sys
from pathlib import Path

os.environ["POLARS_MAX_THREADS"] = "1"

import polars as pl

STEP_NS, GAP_NS = 20_000_000, 50_000_000
NOT_CHANNELS = ("t_ns", "t_uncertain_ns")
source, target = map(Path, sys.argv[1:])
target.mkdir(parents=True, exist_ok=True)
for folder in sorted(path for path in source.iterdir() if path.is_dir()):
    streams = {path.stem: pl.read_parquet(path) for path in sorted(folder.glob("*.parquet"))}
    start_ns, last_ns = streams["xela1"]["t_ns"][0], max(stream["t_ns"][-1] for stream in streams.values())
    grid_ns = pl.int_range((last_ns - start_ns) // STEP_NS + 1, eager=True) * STEP_NS + start_ns
    rows = pl.DataFrame({"t_ns": grid_ns}).filter(
        pl.col("t_ns") >= max(stream["t_ns"][0] for stream in streams.values())
    )
    for name, stream in streams.items():
        channels = [column for column in stream.columns if column not in NOT_CHANNELS]
        repeats = pl.all_horizontal(pl.col(channel) == pl.col(channel).shift(1) for channel in channels)
        samples = stream.select(
            pl.col("t_ns"),
            pl.col(channels).name.prefix(f"{name}_"),
            repeats.fill_null(value=False).alias(f"{name}_held"),
            pl.col("t_ns").alias("sample_ns"),
        )
        age_ns = pl.col("t_ns") - pl.col("sample_ns")
        rows = rows.join_asof(samples, on="t_ns", strategy="backward")
        rows = rows.with_columns((age_ns > GAP_NS).alias(f"{name}_gap"), age_ns.alias(f"{name}_dt_ns")).drop(
            "sample_ns"
        )
    rows.write_parquet(target / f"{folder.name}.parquet")
