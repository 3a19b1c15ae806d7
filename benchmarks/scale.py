"""How commands grow with the number of recordings, measured on simulated stores of tiny shards.

    python benchmarks/scale.py [--counts 10000 100000] [--folder FOLDER] [--manifest-alone]

Objects, records and directories are written by the library's own functions, in bulk and without waiting for the disk.
Each recording is a copy of one that was simulated, with bytes of its own before the footer, so that each has another
digest. Each command is a process of its own: seconds, peak of resident memory, bytes read and system calls that look at
files (by `strace`, where it is installed, in a run of its own) are those of the process. With ``--manifest-alone`` all
recordings share the shards of one, and none lies in the dataset's directory: a million takes minutes and no inodes, and
the steps are those that look at the manifest.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import timing

from tacpipe.datasets import directory
from tacpipe.datasets.manifest import NAME, InputDataset, find
from tacpipe.engine import keys
from tacpipe.io import parquet
from tacpipe.io.hashing import digest
from tacpipe.store.records import Content, Record, RecordingEntry, Shard
from tacpipe.store.store import Store

COUNTS = (10_000, 100_000)
SIMULATE = "simulate forward --trials 1 --duration-s 4 --tactile-rate-hz 25 --robot-rate-hz 50 -o seed --quiet"
STREAM, COLUMNS = "xela1", 5  # Stream of the simulated recording, and the columns of it that each recording keeps.
LOOKS = "newfstatat,stat,lstat,statx,access,openat,getdents64"
HIT = "synchronize recordings -o synced --quiet"
OPEN = "import tacpipe; tacpipe.open('synced')['trial-0000001']"


@dataclass(frozen=True)
class Measured:
    """The cost of one step."""

    cost: timing.Cost
    looks: int | None = None  # system calls that look at files, where they were counted


class Lab:
    """A project of many recordings, all of which were synchronized before, each alone."""

    def __init__(self, folder: Path, count: int, *, manifest_alone: bool = False) -> None:
        folder.mkdir(parents=True)
        (folder / ".tacpipe").mkdir()
        self.folder, self.store = folder, Store(folder / ".tacpipe")
        timing.run(f"tacpipe {SIMULATE}", folder)
        seed = find(folder / "seed").manifest
        shard = seed.recordings["trial-000"]["shards"][STREAM]
        table = parquet.from_parquet(self.store.read(shard["digest"]))
        self._raw = parquet.to_parquet(table.select(table.column_names[:COLUMNS]))
        self._rows = table.num_rows
        self._template = replace(seed, recordings={})
        self.count = 0
        self._listed = "", ""  # digests of the dataset and of its manifest, that was listed last
        self.entries: dict[str, RecordingEntry] = {}
        self.add(1)
        timing.run(f"tacpipe {HIT}", folder)
        synced = find(folder / "synced").manifest
        self._step = synced.chain[-1]
        self._synced_record = self._record(self.entries)
        (stored,) = self._synced_record["result"]["recordings"][""]["shards"].values()
        self._synced = self.store.read(stored["digest"])
        if manifest_alone:
            self.list_alone(count)
        else:
            self.add(count - 1, synchronized=True)

    def add(self, count: int, *, synchronized: bool = False) -> None:
        """Add recordings to the dataset, whose results are in the store where they were ``synchronized``."""
        new = {f"trial-{number:07d}": self._entry(number) for number in range(self.count, self.count + count)}
        self.count += count
        self.entries |= new
        if synchronized:
            result, provenance = self._synced_record["result"], self._synced_record["provenance"]
            for number, task in enumerate(
                keys.shard_tasks(self.store, replace(self._template, recordings=new), self._step, ())
            ):
                entry = result["recordings"][""]
                shard: Shard = {**entry["shards"][""], **self._put_numbered(self._synced, number)}
                numbered: RecordingEntry = {**entry, "shards": {"": shard}}
                self.store.commit(task.identity, {"recordings": {"": numbered}, "files": {}}, provenance)
        manifest = replace(self._template, recordings=self.entries)
        manifest.keep(self.store)
        directory.publish(self.store, manifest, self.folder / "recordings")

    def list_alone(self, count: int) -> None:
        """Have both manifests name ``count`` recordings with the shards of one, and write nothing else."""
        for place in ("recordings", "synced"):
            manifest = find(self.folder / place).manifest
            (entry,) = manifest.recordings.values()
            entries: dict[str, RecordingEntry] = {
                f"trial-{number:07d}": {**entry, "attributes": {**entry["attributes"], "trial": number}}
                for number in range(count)
            }
            inputs: dict[str, list[InputDataset]] = (
                {}
                if place == "recordings"
                else {"datasets": [{"dataset": self._listed[0], "manifest": self._listed[1]}]}
            )
            listed = replace(manifest, recordings=entries, inputs=inputs)
            self._listed = listed.digest, listed.keep(self.store).digest
            self.store.roots.set(self.folder / place, self._listed[1])
            (self.folder / place / NAME).write_bytes(listed.content)

    def _entry(self, number: int) -> RecordingEntry:
        return {
            "attributes": {"material": f"m{number % 20}", "sensor": "xela-uskin", "trial": number},
            "shards": {STREAM: {**self._put_numbered(self._raw, number), "rows": self._rows}},
        }

    def _record(self, entries: dict[str, RecordingEntry]) -> Record:
        (task,) = keys.shard_tasks(self.store, replace(self._template, recordings=entries), self._step, ())
        return self.store.read_record(digest(task.identity))

    def _put_numbered(self, content: bytes, number: int) -> Content:
        """Store a Parquet file with a number before its footer, where no reader looks."""
        footer = int.from_bytes(content[-8:-4], "little") + 8
        return self.store.put(content[:-footer] + number.to_bytes(8, "little") + content[-footer:]).to_json()


STEPS = {  # Steps run in this order; those that change the dataset come last.
    "all results stored, the run new": HIT,
    "first hit": HIT,  # each file is looked at, which is noted
    "hit": HIT,
    "open, one recording": OPEN,
    "show": "show recordings",
    "explain": "explain synced",
    "split": "split synced -o split --quiet",
    "store status": "store status",
    "store verify": "store verify",
    "store gc": "store gc --dry-run",
    "one label": "label recordings trial-0000001 --set material=felt",
    "one label, synchronized": HIT,
    "one new recording": HIT,
}


OF_MANIFEST = ("open, one recording", "show", "explain", "split", "one label")  # look at no shard, or at twenty


def measure(lab: Lab) -> dict[str, Measured]:
    """Return what each step costs."""
    results = {}
    for name, command in STEPS.items():
        if name == "one new recording":
            lab.add(1)
        results[name] = run_step(lab, command)
    lab.add(1)
    for name in ("one new recording", "first hit", "hit", "show", "explain"):
        results[name] = replace(results[name], looks=looks(lab, STEPS[name]))
    return results


def run_step(lab: Lab, command: str) -> Measured:
    """Return the cost of a command of tacpipe, its system calls not counted."""
    words = [timing.PYTHON, "-c", command] if command == OPEN else ["tacpipe", *shlex.split(command)]
    return Measured(timing.cost(words, lab.folder))


def looks(lab: Lab, command: str) -> int | None:
    """Return how many system calls of a command look at files, or None without strace."""
    if shutil.which("strace") is None:
        return None
    with tempfile.NamedTemporaryFile("r") as counts:
        trace = ["strace", "-f", "-c", "--seccomp-bpf", "-U", "calls,name", "-o", counts.name, "-e", f"trace={LOOKS}"]
        timing.run([*trace, "tacpipe", *shlex.split(command)], lab.folder)
        return sum(int(match[1]) for match in re.finditer(r"^ *(\d+) +(?!total)\w+$", counts.read(), re.MULTILINE))


def table(results: dict[int, dict[str, Measured]]) -> str:
    """Return the Markdown table: one row per step, one group of columns per count, and the growth."""
    counts = sorted(results)
    heads = [f"{count:,}: s | CPU s | MB | MB read | looks" for count in counts]
    heads += ["growth of CPU s"] * (len(counts) > 1)
    lines = [f"| step | {' | '.join(heads)} |", "| --- |" + " ---: |" * (5 * len(counts) + (len(counts) > 1))]
    for name in (name for name in STEPS if name in results[counts[0]]):
        cells = [name]
        for measured in (results[count][name] for count in counts):
            cost = measured.cost
            cells += [f"{cost.seconds:.2f}", f"{cost.cpu_s:.2f}"]
            cells += [f"{size / 1e6:,.0f}" for size in (cost.memory_bytes, cost.read_bytes)]
            cells += ["" if measured.looks is None else f"{measured.looks:,}"]
        if len(counts) > 1:
            cells.append(f"{results[counts[-1]][name].cost.cpu_s / results[counts[0]][name].cost.cpu_s:.1f}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Measure for each count and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS)
    parser.add_argument("--folder", type=Path, help="Where to make the stores; they stay there.")
    parser.add_argument("--manifest-alone", action="store_true", help="Measure what looks at manifests alone.")
    options = parser.parse_args()
    setattr(os, "fsync", lambda handle: None)  # noqa: B010  (of this process alone, which makes what is measured)
    results = {}
    with tempfile.TemporaryDirectory(prefix="tacpipe-scale-") as temporary:
        for count in options.counts:
            lab = Lab((options.folder or Path(temporary)) / str(count), count, manifest_alone=options.manifest_alone)
            steps = (
                {name: run_step(lab, STEPS[name]) for name in OF_MANIFEST} if options.manifest_alone else measure(lab)
            )
            results[count] = steps
            print(table({count: steps}), flush=True)
    if len(results) > 1:
        print(table(results))


if __name__ == "__main__":
    main()
