"""What `tacpipe show` and `tacpipe explain` print of what has many files, and what `store link` removes of it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys

import pyarrow as pa

from tacpipe.cli import show
from tacpipe.datasets.dataset import Recording
from tacpipe.io.parquet import to_parquet
from tests.conftest import Lab

MANY = 12


def _export(lab: Lab) -> Lab:
    """Have the lab export to many files, in folders within folders."""
    lab.run("simulate forward --trials 1 --duration-s 4 -o data/recordings")
    lab.run("synchronize data/recordings -o data/synced")
    lab.run("export zarr data/synced -o out")
    return lab


def test_of_an_export_the_files_are_counted_and_the_first_are_named(lab: Lab) -> None:
    _export(lab)
    found = json.loads(lab.run("show out --json").out)
    assert found["kind"] == "export" and len(found["files"]) > MANY
    text = lab.run("show out").out
    assert f"{len(found['files'])}, together" in text and "README.md" in text
    assert sum(name in text for name in found["files"]) < MANY
    every = " ".join(lab.run("show out --full").out.split())
    assert all(name in every for name in found["files"])
    traced = lab.run("explain out").out
    assert f"{len(found['files'])} files" in traced and sum(name in traced for name in found["files"]) < MANY


def test_link_removes_the_drafts_in_every_folder_of_an_export(lab: Lab) -> None:
    _export(lab)
    out = lab.folder / "out"
    deep = next(path for path in out.rglob("*") if path.is_file() and len(path.relative_to(out).parts) > 3)
    draft = deep.with_name(f".{deep.name}.0123456789ab.draft")
    draft.write_bytes(b"half")
    lab.run("store link out")
    assert deep.exists() and not draft.exists()


def test_a_lost_connection_after_show_raises_an_error_and_ends_no_process(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    before = signal.getsignal(signal.SIGPIPE)
    lab.run("show data/r")

    assert signal.getsignal(signal.SIGPIPE) == before == signal.SIG_IGN


def test_show_ends_when_nobody_reads_what_it_prints(lab: Lab) -> None:
    lab.run("simulate toy --trials 40 -o data/r")
    readable, writable = os.pipe()
    os.close(readable)
    command = [sys.executable, "-m", "tacpipe", "show", "data/r", "--full"]
    done = subprocess.run(command, cwd=lab.folder, stdout=writable, stderr=subprocess.PIPE, check=False)
    os.close(writable)

    assert (done.returncode, done.stderr) == (-signal.SIGPIPE, b"")


def test_the_numbers_of_a_stream_are_those_of_its_samples() -> None:
    tactile = {b"quantity": b"tactile"}
    rows = {
        pa.field("t_ns", pa.int64()): [0, 10**7, 2 * 10**7, 3 * 10**7, 9 * 10**7],
        pa.field("one", pa.uint16(), metadata=tactile): [0, 0, 65535, 7, 7],
        pa.field("other", pa.int8(), metadata=tactile): [5, 5, 5, None, 127],
        pa.field("force", pa.float32(), metadata=tactile): [0.0] * 5,
    }
    content = to_parquet(pa.table(list(rows.values()), schema=pa.schema(list(rows))))
    shard = Recording("a", {"attributes": {}, "shards": {"skin": {"digest": "d"}}}, lambda digest, path: content)

    assert show._stream(shard, "skin") == {
        "rows": 5,
        "columns": 4,
        "duration_s": 0.09,
        "rate_hz": 100.0,
        "gaps": 1,
        "held_share": 0.25,  # of four steps one has both channels as before; where there is no value nothing is held
        "saturated": 4,  # 65535, 127 and twice the 0 of an unsigned channel
    }
