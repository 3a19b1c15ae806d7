"""`tacpipe store push` and `pull` of a bucket beside plain copies of the same files by obstore and by boto3.

    AWS_ENDPOINT_URL=http://127.0.0.1:8333 AWS_ACCESS_KEY_ID=… AWS_SECRET_ACCESS_KEY=… \\
        python benchmarks/bucket.py s3://BUCKET/FOLDER [--rounds 3] [--kinds small large]

Needs the extra bucket, and boto3 for its rows. 1,000 small shards, and 1 GB in shards of 10 MB. tacpipe's times are those of
whole commands: they hash what they send and what they get, look at what is there, and send records and a root.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import timing

from tacpipe.store.addresses import Address, parsed, settings
from tacpipe.store.backend import AT_ONCE
from tacpipe.store.bucket import Bucket

KINDS = {
    "small": ("small_stages", "simulate.small = small_stages:make", "simulate small --trials 1000 --rows 200"),
    "large": (
        "long_stages",
        "simulate.long = long_stages:make",
        "simulate long --trials 100 --rows 305000 --kind moving",
    ),
}


def boto3_client(address: Address) -> Any:
    """Return boto3's client of the same server, None where it is not installed."""
    try:
        import boto3
        from botocore.config import Config
    except ImportError:
        return None
    endpoint = settings(address).config.get("endpoint") or None
    return boto3.client(
        "s3", endpoint_url=endpoint, region_name="us-east-1", config=Config(max_pool_connections=AT_ONCE)
    )


def at_once(work: Callable[[Path], object], files: list[Path]) -> None:
    """Do ``work`` on all files, as many at once as tacpipe does."""
    with ThreadPoolExecutor(AT_ONCE) as threads:
        list(threads.map(work, files))


def seconds(work: Callable[[], object]) -> float:
    """Return how long ``work`` takes."""
    began_s = time.perf_counter()
    work()
    return time.perf_counter() - began_s


def measure(kind: str, folder: Path, text: str, rounds: int) -> dict[str, list[float]]:
    """Return the seconds of each way, by name, round by round."""
    import obstore

    module, points, command = KINDS[kind]
    plugin = timing.plugin(folder, module, f"[tacpipe.stages]\n{points}\n")
    here = folder / kind
    (here / ".tacpipe").mkdir(parents=True)
    timing.run(f"tacpipe {command} -o data --quiet", here, PYTHONPATH=str(plugin))
    files = sorted((here / "data").glob("*.parquet"))
    print(f"{kind}: {len(files)} files, {sum(file.stat().st_size for file in files) / 1e6:,.1f} MB", flush=True)
    address = parsed(text)
    assert isinstance(address, Address)
    bucket, _, prefix = address.path.partition("/")
    boto3 = boto3_client(address)
    times: dict[str, list[float]] = {}
    for number in range(rounds):
        place = f"{text}/{kind}-{number}-{time.time_ns()}"
        client = Bucket(parsed(f"{place}/plain"))._client  # type: ignore[arg-type]
        key = f"{prefix}/boto3-{time.time_ns()}"
        there, got = folder / f"clone-{kind}-{number}", folder / "got"
        (there / ".tacpipe").mkdir(parents=True)
        got.mkdir()

        def put(file: Path, client: Any = client) -> None:
            obstore.put(client, file.name, file.read_bytes(), mode="create")

        def get(file: Path, client: Any = client, got: Path = got) -> None:
            (got / file.name).write_bytes(obstore.get(client, file.name).bytes())

        ways: dict[str, Callable[[], object]] = {
            "push, tacpipe": partial(timing.run, f"tacpipe store push {place}/ours data", here),
            "push, obstore": partial(at_once, put, files),
            "pull, tacpipe": partial(timing.run, f"tacpipe store pull {place}/ours data", there),
            "pull, obstore": partial(at_once, get, files),
            "second push, tacpipe": partial(timing.run, f"tacpipe store push {place}/ours data", here),
        }
        if boto3 is not None:

            def upload(file: Path, key: str = key) -> None:
                boto3.upload_file(str(file), bucket, f"{key}/{file.name}")

            def download(file: Path, key: str = key, got: Path = got) -> None:
                boto3.download_file(bucket, f"{key}/{file.name}", str(got / file.name))

            ways["push, boto3"] = partial(at_once, upload, files)
            ways["pull, boto3"] = partial(at_once, download, files)
        for name, work in ways.items():
            times.setdefault(name, []).append(seconds(work))
            print(f"  {name}: {times[name][-1]:.2f} s", flush=True)
        shutil.rmtree(there)
        shutil.rmtree(got)
    return times


def main() -> None:
    """Print a table of medians, and of ratios to the plain copies."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("address")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS))
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for kind in given.kinds:
            times = measure(kind, Path(folder), given.address, given.rounds)
            middle = {name: statistics.median(found) for name, found in times.items()}
            print(f"| {kind} | s | beside obstore | beside boto3 |\n| --- | ---: | ---: | ---: |")
            for name, taken_s in middle.items():
                verb, _, who = name.partition(", ")
                others = [middle.get(f"{verb.split()[-1]}, {one}") for one in ("obstore", "boto3")]
                ratios = [f"{taken_s / one:.2f}" if one and who == "tacpipe" else "" for one in others]
                print(f"| {name} | {taken_s:.2f} | {ratios[0]} | {ratios[1]} |")


if __name__ == "__main__":
    main()
