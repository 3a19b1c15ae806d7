"""Stages on a store in a bucket beside the same on a folder: seconds and requests for 1,000 recordings.

    python benchmarks/bucket_stages.py [--trials 1000] [--server localbucket|seaweedfs] [--delay-ms 30]

The server runs on this computer, behind the proxy of the tests, which counts requests and delays each by ``--delay-ms``, as
a bucket far away does; needs the extra bucket and what tests need. Two computers are two folders in front of one bucket.
Each command is a process of its own.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import timing

from tests.stores import places, proxy

ENTRY_POINTS = "[tacpipe.stages]\nsimulate.small = small_stages:make\nadd = small_stages:add\n"
ADD = "tacpipe add data/r -o data/s --quiet"


def measure(
    folder: Path, trials: int, bucket: dict[str, str], faulty: proxy.Proxy, fault: str | None
) -> list[tuple[str, float, float, int]]:
    """Return what was done, its seconds on a folder and on a bucket, and the requests that the latter took."""
    plugin = str(timing.plugin(folder, "small_stages", ENTRY_POINTS))
    simulate = "tacpipe simulate small --rows 200 -o data/r --quiet --trials"
    computers = {"folder": {"TACPIPE_STORE": str(folder / "store")}}
    for name in ("first", "second"):
        computers[name] = {**bucket, "TACPIPE_STORE": "s3://lab/bench", "TACPIPE_CACHE": str(folder / name / "cache")}

    def taken(name: str, command: str) -> tuple[float, int]:
        project = folder / name / "project"
        project.mkdir(parents=True, exist_ok=True)
        (project / "dvc.yaml").touch()
        faulty.begin(lambda number: fault)
        began_s = time.perf_counter()
        timing.run(command, project, PYTHONPATH=plugin, **computers[name])
        return time.perf_counter() - began_s, faulty.requests

    found = []
    for what, command, gone, elsewhere in (
        (f"simulate {trials} recordings", f"{simulate} {trials}", "", False),
        ("a map stage of them", ADD, "", False),
        ("the same again: nothing to do", ADD, "", False),
        ("a hit whose directory is gone", ADD, "data/s", False),
        (f"simulate {trials + 1} recordings, another run", f"{simulate} {trials + 1}", "", False),
        ("the map stage of the one that is new", ADD, "", False),
        ("on a second computer: what was simulated", f"{simulate} {trials + 1}", "data/r", True),
        ("on a second computer: the map stage", ADD, "data/s", True),
    ):
        for name in ("folder", "first"):
            if gone:
                shutil.rmtree(folder / name / "project" / gone)
        plain_s, _ = taken("folder", command)
        seconds, requests = taken("second" if elsewhere else "first", command)
        found.append((what, plain_s, seconds, requests))
        print(f"| {what} | {plain_s:.2f} | {seconds:.2f} | {requests:,} |", flush=True)
    return found


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--delay-ms", type=float, default=0.0, help="Delay of each request.")
    parser.add_argument("--server", default="localbucket", choices=["localbucket", "seaweedfs"])
    given = parser.parse_args()
    proxy.WAIT_S = given.delay_ms / 1000
    serve = {"localbucket": places.localbucket, "seaweedfs": places.seaweedfs}[given.server]
    with (
        tempfile.TemporaryDirectory() as folder,
        serve(Path(folder) / "server") as endpoint,
        proxy.between(endpoint) as faulty,
    ):
        print("| what | folder, s | bucket, s | requests |\n| --- | ---: | ---: | ---: |", flush=True)
        measure(
            Path(folder), given.trials, places.environment(faulty.endpoint), faulty, "slow" if given.delay_ms else None
        )


if __name__ == "__main__":
    main()
