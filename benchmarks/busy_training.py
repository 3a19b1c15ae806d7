"""How long a training takes on a computer whose cores are busy with other programs, by the policy of waiting threads.

    python -m benchmarks.busy_training [--busy 2] [--rounds 3]

Trains `forward` with default params for one epoch on simulated recordings, while ``--busy`` processes compute in a loop.
Threads of OpenMP spin for a while before they sleep; on a busy core, they spin instead of the thread for which they wait.
The cases are interleaved, wall and CPU seconds are medians, and the models must have the same bytes.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

import tacpipe

CASES: Mapping[str, Mapping[str, str]] = {
    "spinning (GNU OpenMP's default)": {"GOMP_SPINCOUNT": "300000"},
    "tacpipe's default": {},
    "one thread": {"OMP_NUM_THREADS": "1"},
}
VARIABLES = ("OMP_NUM_THREADS", "OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "MKL_NUM_THREADS")
PREPARATION = (
    "store init",
    "simulate forward --trials 4 --duration-s 4 -o data/recordings",
    "synchronize data/recordings -o data/rows",
    "segment contacts data/rows -o data/contacts",
    "split data/contacts -o data/split --scheme random --val 0.25 --test 0",
)
TRAINING = "train forward data/contacts --split data/split -o models/forward --epochs 1 --rerun --quiet"
BUSY = "while True: pass"


def run(command: str, folder: Path, variables: Mapping[str, str]) -> tuple[float, float]:
    """Run a command; return its wall and CPU seconds."""
    environment = {name: value for name, value in os.environ.items() if name not in VARIABLES} | dict(variables)
    before, began_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, "-m", "tacpipe", *command.split()], cwd=folder, env=environment, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - began_s, cpu_s


def main() -> None:
    """Run the trainings and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--busy", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=3)
    chosen = parser.parse_args()
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in CASES}
    digests: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for command in PREPARATION:
            run(command, folder, {})
        others = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(chosen.busy)]
        try:
            for _ in range(chosen.rounds):
                for case, variables in CASES.items():
                    times[case].append(run(TRAINING, folder, variables))
                    digests[case] = tacpipe.open(folder / "models/forward").digest
        finally:
            for process in others:
                process.kill()
    print(f"| {chosen.busy} busy processes, {os.cpu_count()} cores | wall s | largest | CPU s | model |")
    print("| --- | --- | --- | --- | --- |")
    for case, rows in times.items():
        wall_s, cpu_s = np.median(rows, axis=0)
        print(f"| {case} | {wall_s:.1f} | {max(rows)[0]:.1f} | {cpu_s:.1f} | {digests[case][:8]} |", flush=True)


if __name__ == "__main__":
    main()
