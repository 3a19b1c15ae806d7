"""A small grid of trainings and evaluations: `tacpipe run` one stage after another and two at a time.

``python benchmarks/grid.py`` prints seconds and processor seconds of both in interleaved rounds, on this computer as it is.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import timing
import yaml

METHODS = {
    "recurrent": "--architecture recurrent --batch 128 --hidden 200 --stride 4 --no-cycle --no-baselines",
    "gru": "--architecture gru --stride 2 --no-baselines",
    "taxelwise": "--architecture taxelwise",
}
FOLDS, EPOCHS, TRIALS, ROUNDS = (0, 1), 2, 12, 3
PREPARED = (
    f"tacpipe simulate forward --trials {TRIALS} -o data/recordings",
    "tacpipe synchronize data/recordings -o data/synced",
    "tacpipe segment contacts data/synced -o data/segments",
    "tacpipe split data/segments -o data/split --scheme kfold --folds 5 --val 0.15",
)
# processor seconds of the command, of what it started, and of what the process that forks has started
PROGRAM = """
import json, os, sys
from multiprocessing import forkserver
from pathlib import Path
from tacpipe.cli import main
code = main.answer(sys.argv[1:])
server = forkserver._forkserver._forkserver_pid
told = Path(f"/proc/{server}/stat").read_text().rpartition(")")[2].split() if server else []
print(json.dumps([code, sum(os.times()[:4]) + sum(map(int, told[11:15])) / os.sysconf("SC_CLK_TCK")]))
"""


def project(folder: Path) -> Path:
    """Return a project whose recordings are ready, and the chain that trains and evaluates."""
    folder.mkdir(parents=True)
    for command in PREPARED:
        timing.run(command, folder)
    split, stages = "--split data/split --fold {fold}", dict[str, Any]()
    for name, options in METHODS.items():
        for fold in FOLDS:
            of, place = split.format(fold=fold), f"{name}/{fold}"
            stages[f"{name}-{fold}"] = {
                "cmd": [
                    f"tacpipe train forward data/segments {of} --seed {fold} -o models/{place} {options} --epochs {EPOCHS}",
                    f"tacpipe evaluate models/{place} data/segments {of} -o results/{place}",
                ],
                "deps": ["data/segments/manifest.json", "data/split/manifest.json"],
                "outs": [f"models/{place}/manifest.json", f"results/{place}/manifest.json"],
            }
    (folder / "dvc.yaml").write_text(yaml.safe_dump({"stages": stages}, sort_keys=False))
    return folder


def measured(prepared: Path, *options: str, **environment: str) -> tuple[float, float]:
    """Return seconds and processor seconds of the chain in a copy of the project, which is then removed."""
    place = prepared.with_name("copy")
    shutil.copytree(prepared, place, symlinks=True)
    begun = time.perf_counter()
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM, "run", "dvc.yaml", "--quiet", *options],
        cwd=place,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
    )
    took = time.perf_counter() - begun
    code, spent = json.loads(ran.stdout.splitlines()[-1])
    if code:
        raise SystemExit(ran.stderr)
    shutil.rmtree(place)
    return took, spent


def main() -> None:
    """Print the medians of all rounds."""
    with tempfile.TemporaryDirectory() as folder:
        prepared = project(Path(folder) / "grid")
        found: dict[str, list[tuple[float, float]]] = {}
        for _ in range(int(sys.argv[1]) if len(sys.argv) > 1 else ROUNDS):
            found.setdefault("one at a time", []).append(measured(prepared))
            found.setdefault("one at a time, one thread", []).append(measured(prepared, OMP_NUM_THREADS="1"))
            found.setdefault("two at a time", []).append(measured(prepared, "--jobs", "2"))
    for name, times in found.items():
        took, spent = (statistics.median(one) for one in zip(*times, strict=True))
        print(f"{name}: {took:.1f} s, {spent:.1f} s of processor time")


if __name__ == "__main__":
    main()
