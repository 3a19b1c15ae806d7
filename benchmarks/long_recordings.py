"""Measure processor time and memory of commands on one long recording: two skins of 48 channels and an arm at 1 kHz.

    python benchmarks/long_recordings.py [--minutes 2 10 60] [--only segment-contacts ...] [--folder FOLDER]

A simulated recording of two minutes is repeated on one time axis. Each command runs in a process by itself with one job.
The memory is the peak of its largest process less what the same Python takes to import the command's libraries. Stages
whose recordings are slides or single grasps read recordings of their own simulations and do not depend on the minutes.
"""

from __future__ import annotations

import argparse
import re
import shlex
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import timing

MINUTES = 2  # length of the recording that is repeated
ENTRY_POINTS = "[tacpipe.stages]\nsegment.repeat = bench_stages:repeat\n"
LIBRARIES = {
    "arrow": "import typer, numpy, pyarrow.parquet",
    "scipy": "import typer, numpy, pyarrow.parquet, scipy.signal, scipy.ndimage",
    "torch": "import typer, numpy, pyarrow.parquet, torch, torch.nn",
    "pictures": "import typer, numpy, pyarrow.parquet, matplotlib.figure, matplotlib.backends.backend_agg",
    "h5py": "import typer, numpy, pyarrow.parquet, h5py",
    "zarr": "import typer, numpy, pyarrow.parquet, zarr",
    "mcap": "import typer, numpy, pyarrow.parquet, mcap.writer",
}
STEPS = {  # name: libraries, and what runs; M is the folder of the recording of so many minutes
    "synchronize": ("arrow", "tacpipe synchronize M/rec -o M/synced-default"),
    "synchronize-1khz": ("arrow", "tacpipe synchronize M/rec --rate-hz 1000 -o M/synced"),
    "synchronize-interpolate": (
        "arrow",
        "tacpipe synchronize M/rec --rate-hz 1000 --values interpolate -o M/interpolated",
    ),
    "segment-contacts": ("arrow", "tacpipe segment contacts M/synced -o M/segments"),
    "segment-contacts-noise": ("arrow", "tacpipe segment contacts M/synced --thresholds noise -o M/noise"),
    "segment-slips": ("scipy", "tacpipe segment slips M/segments -o M/slips"),
    "segment-slides": ("scipy", "tacpipe segment slides M/rec --streams xela1,robot --trigger load -o M/slides"),
    "compress-pca": ("arrow", "tacpipe compress pca M/segments --split M/split -o M/latents"),
    "evaluate": ("torch", "tacpipe evaluate short/model M/rec -o M/results"),
    "predict": ("torch", "tacpipe predict short/model M/rec -o M/predictions"),
    "show": ("arrow", "tacpipe show M/rec trial-000"),
    "show-plot": ("pictures", "tacpipe show M/rec trial-000 --plot M/plot.png"),
    "show-plot-synced": ("pictures", "tacpipe show M/segments trial-000 --plot M/plot.png"),
    "one-column": ("arrow", ""),
    "export-csv": ("arrow", "tacpipe export csv M/synced -o M/csv"),
    "export-hdf5": ("h5py", "tacpipe export hdf5 M/rec -o M/hdf5"),
    "export-zarr": ("zarr", "tacpipe export zarr M/synced -o M/zarr"),
    "export-mcap": ("mcap", "tacpipe export mcap M/rec -o M/mcap"),
    "export-lerobot": ("arrow", "tacpipe export lerobot M/synced -o M/lerobot"),
    "simulate": ("arrow", "tacpipe simulate forward --trials 1 --duration-s SECONDS --tactile-rate-hz 1000 -o M/sim"),
}
COLUMN = "taxel04_x"
KEPT = ("rec", "synced", "segments", "split")
OUTSIDE = re.compile("tacpipe (show|export) ")  # commands that never answer from the store


def main() -> None:
    """Make the recordings, run the commands and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--minutes", type=int, nargs="+", default=[2, 10, 60])
    parser.add_argument("--only", nargs="+", choices=STEPS, default=list(STEPS))
    parser.add_argument("--folder", type=Path, help="where recordings are made, and kept for the next run")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="tacpipe-long-") as name:
        folder = options.folder or Path(name)
        prepare(folder, options.minutes)
        print("| command | " + " | ".join(f"{minutes} min" for minutes in options.minutes) + " |", flush=True)
        print("| --- |" + " ---: |" * len(options.minutes), flush=True)
        imports = {name: timing.cost([timing.PYTHON, "-c", code], folder) for name, code in LIBRARIES.items()}
        for step in options.only:
            print(f"| {step} |", end="", flush=True)
            for minutes in options.minutes:
                library, command = STEPS[step]
                cost = timing.cost(words(command, minutes), folder)
                beyond = (cost.memory_bytes - imports[library].memory_bytes) / 1e6
                print(f" {cost.cpu_s:.1f} s, {beyond:,.0f} MB |", end="", flush=True)
                clean(folder, minutes)
            print(flush=True)


def prepare(folder: Path, minutes: Sequence[int]) -> None:
    """Make the recordings that do not exist yet, their synchronized and segmented forms, a split and a model."""
    folder.mkdir(parents=True, exist_ok=True)
    place = folder / "plugin-bench_stages"
    plugin = place if place.exists() else timing.plugin(folder, "bench_stages", ENTRY_POINTS)
    if not (folder / "short" / "model").exists():
        for command in (
            f"tacpipe simulate forward --trials 3 --duration-s {MINUTES * 60} --tactile-rate-hz 1000 -o short/rec --jobs 1",
            f"tacpipe simulate forward --trials 1 --duration-s {MINUTES * 60} --tactile-rate-hz 1000 -o short/one --jobs 1",
            "tacpipe synchronize short/rec --rate-hz 1000 -o short/synced --jobs 1",
            "tacpipe segment contacts short/synced -o short/segments --jobs 1",
            "tacpipe split short/segments -o short/split --test 0.34 --val 0.34",
            "tacpipe train forward short/segments --split short/split -o short/model --preset quick --epochs 1 --stride 50",
        ):
            timing.run(command, folder)
    for length in minutes:
        if (folder / f"{length}m" / "split").exists():
            continue
        for command in (
            f"tacpipe segment repeat short/one --times {length // MINUTES} -o M/rec --jobs 1",
            "tacpipe synchronize M/rec --rate-hz 1000 -o M/synced --jobs 1",
            "tacpipe segment contacts M/synced -o M/segments --jobs 1",
            "tacpipe split M/segments --val 0 --test 0 -o M/split",
        ):
            timing.run(command.replace("M/", f"{length}m/"), folder, PYTHONPATH=str(plugin))


def words(command: str, minutes: int) -> list[str]:
    """Return the words of a step: those of a command with one job, or Python that reads one column."""
    if not command:
        read = f"tacpipe.open('{minutes}m/synced')['trial-000'].table('xela1', ['{COLUMN}'])"
        return [timing.PYTHON, "-c", f"import tacpipe; {read}"]
    text = command.replace("M/", f"{minutes}m/").replace("SECONDS", str(minutes * 60))
    return (
        shlex.split(text) + ([] if " show " in text else ["--jobs", "1"]) + ([] if OUTSIDE.match(text) else ["--rerun"])
    )


def clean(folder: Path, minutes: int) -> None:
    """Remove what a step wrote, so that the disk holds one result at a time."""
    for path in (folder / f"{minutes}m").iterdir():
        if path.name not in KEPT:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    timing.run("tacpipe store gc --grace-days 0 --recordings", folder)


if __name__ == "__main__":
    main()
