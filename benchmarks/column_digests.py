"""What reading one column of a wide shard would take if columns had digests of their own.

    python benchmarks/column_digests.py [--columns 200] [--rows 30000]

A shard is verified whole before any of it is decoded. Measured beside that: hashing the footer and the bytes of the
wanted columns alone, which is the least that digests of columns or pages could take, and no hashing at all.
"""

from __future__ import annotations

import argparse
import hashlib
import tempfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import timing

from tacpipe.io import parquet
from tacpipe.store.store import Store


def main() -> None:
    """Write a shard, read some of its columns in each way, and print what that takes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--columns", type=int, default=200)
    parser.add_argument("--rows", type=int, default=30_000)
    given = parser.parse_args()
    steps = np.random.default_rng(0).integers(-40, 41, (given.columns, given.rows))
    values = (30_000 + steps.cumsum(axis=1) // 4).astype(np.uint16)  # (channel, time)
    content = parquet.to_parquet(pa.table({f"c{number:03d}": one for number, one in enumerate(values)}))
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder) / ".tacpipe")
        store.prepare()
        name = store.put(content).digest
        path = store.object_path(name)
        print(f"{given.columns} columns of {given.rows:,} rows, {len(content) / 1e6:.1f} MB")
        for count in (1, 10, given.columns):
            wanted = [f"c{number:03d}" for number in range(count)]
            times = timing.interleaved(
                {
                    "whole": lambda: parquet.from_parquet(store.read(name), wanted),  # noqa: B023
                    "columns": lambda: _columns(path, wanted, hashed=True),  # noqa: B023
                    "none": lambda: _columns(path, wanted, hashed=False),  # noqa: B023
                },
                15,
            )
            print(f"read {count}: " + ", ".join(f"{one} {1000 * timing.median(times, one):.2f} ms" for one in times))


def _columns(path: str, wanted: list[str], *, hashed: bool) -> pa.Table:
    with open(path, "rb") as file:
        read = pq.ParquetFile(file)
        chunks = [
            read.metadata.row_group(group).column(number)
            for group in range(read.num_row_groups)
            for number in range(len(wanted))
        ]
        for chunk in chunks if hashed else ():
            file.seek(chunk.data_page_offset)
            hashlib.sha256(file.read(chunk.total_compressed_size)).hexdigest()
        return read.read(wanted)


if __name__ == "__main__":
    main()
