"""The wheel and the sdist, installed into clean environments and used there: `make test-install`.

    python -m tests.packaging.environments [--only core learn]

builds both below ``--place``, and makes an environment of each extra from the wheel, and one of the core from the sdist.
In each it imports every module, runs commands, and prints how much the environment weighs. Ends with 1 if one fails.
"""

import argparse
import shlex
import shutil
import subprocess
import sys
import tempfile
import venv
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
NOT_FOR_USERS = ("dev", "docs", "fuzz")
CORE = (
    "--help",
    "sensors list",
    "simulate forward --trials 3 --duration-s 4 -o data/recordings",
    "synchronize data/recordings -o data/synced",
    "segment contacts data/synced -o data/segments",
    "split data/segments -o data/split --scheme random --val 0.34 --test 0.33",
    "show data/segments",
    "store verify",
    "simulate touch --trials 1 -o data/grasps",
)
LEARN = (
    "train forward data/segments --split data/split -o model --epochs 1",
    "evaluate model data/segments --split data/split -o results",
    "report results -o report.html",
)
CLOUDS = ("candidates box.pcd",)
DEVICES = ("sensors probe",)
SILENT = 5  # Exit code where the computer has a serial port and nothing answers there.
HDF5 = ("export hdf5 data/recordings -o hdf5", "ingest hdf5 hdf5 --guess")
VIEW = ("view data/segments --limit 1 --save one.rrd",)
ROS = ("export mcap data/recordings -o mcap", "ingest mcap mcap -o data/from-mcap")
ZARR = ("export zarr data/synced -o zarr", "ingest zarr zarr --guess")
EXTRAS: dict[str, tuple[str, ...]] = {  # Commands that work with each extra and not without it.
    "learn": LEARN,
    "bucket": (),
    "clouds": CLOUDS,
    "dask": (),
    "devices": DEVICES,
    "frames": (),
    "hdf5": HDF5,
    "live": (),
    "lsl": (),
    "mlflow": (),
    "view": VIEW,
    "ros": ROS,
    "slurm": (),
    "tensorboard": (),
    "track": (),
    "video": (),
    "wandb": (),
    "xlsx": (),
    "zarr": ZARR,
    "all": (*LEARN, *CLOUDS, *DEVICES, *HDF5, *ROS, *ZARR),
}
IMPORT_ALL = """
import importlib, pkgutil, sys
import tacpipe, tacpipe_stages
from tacpipe.plugins import extras

lacking = {}
for package in (tacpipe, tacpipe_stages):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if module.name == "tacpipe.__main__":
            continue
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as error:
            if extras.extra_for(error.name) is None:
                raise
            lacking.setdefault(extras.extra_for(error.name), []).append(module.name)
for extra, modules in lacking.items():
    print(f"  {len(modules)} modules need the extra {extra}")
assert not lacking or sys.argv[1] != "all", lacking
"""


@dataclass(frozen=True)
class Built:
    """Wheel and sdist that are uploaded for a release."""

    wheel: Path
    sdist: Path


class FailedError(Exception):
    """A command in an environment failed."""


def build(place: Path) -> Built:
    """Return the sdist, and the wheel that is built from the sdist."""
    run([sys.executable, "-m", "build", "--outdir", str(place), str(ROOT)], place)
    (wheel,), (sdist,) = place.glob("*.whl"), place.glob("*.tar.gz")
    return Built(wheel, sdist)


def try_environment(folder: Path, package: Path, extra: str) -> float:
    """Install a wheel or an sdist with an extra ("" for none), and use it; return the megabytes that were installed.

    Raises `FailedError` with the output of the first command that fails.
    """
    environment, project = folder / "environment", folder / "project"
    venv.create(environment, with_pip=True)
    python, bare_mb = environment / "bin" / "python", size_mb(environment)
    requirement = f"{package}[{extra}]" if extra else str(package)
    pip = [str(python), "-m", "pip", "install", "-q", "--no-compile"]  # bytecode is no part of what is measured
    run([*pip, "-c", str(ROOT / "constraints.txt"), requirement], folder)
    installed_mb = size_mb(environment) - bare_mb
    project.mkdir()
    write_box(project / "box.pcd")
    print(run([str(python), "-c", IMPORT_ALL, extra], project), end="")
    for command in (*CORE, *EXTRAS.get(extra, ())):
        allowed = (0, SILENT) if command in DEVICES else (0,)
        run([str(environment / "bin" / "tacpipe"), *shlex.split(command)], project, allowed)
    return installed_mb


def write_box(path: Path) -> None:
    """Write the cloud of a box of 6 cm on a table, as a PCD file of text."""
    steps = [number * 0.004 - 0.03 for number in range(16)]
    top = [(x, y, 0.06) for x in steps for y in steps]
    side = [(x, y, z + 0.03) for x in steps for y in (-0.03, 0.03) for z in steps]
    rows = [" ".join(f"{value:.4f}" for value in point) for point in (*top, *side)]
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    path.write_text(f"{head}WIDTH {len(rows)}\nHEIGHT 1\nPOINTS {len(rows)}\nDATA ascii\n" + "\n".join(rows) + "\n")


def size_mb(folder: Path) -> float:
    """Return how many megabytes the files below a folder have."""
    return sum(path.lstat().st_size for path in folder.rglob("*") if not path.is_dir()) / 1e6


def run(words: list[str], folder: Path, allowed: tuple[int, ...] = (0,)) -> str:
    """Return what a command prints; raises `FailedError` where it ends with a code that is not allowed."""
    process = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    if process.returncode not in allowed:
        raise FailedError(f"{shlex.join(words)} ended with {process.returncode}:\n{process.stdout}{process.stderr}")
    return process.stdout


def main() -> int:
    """Try the environments and print a line on each; return 1 if one failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only", nargs="*", default=["core", "sdist", *EXTRAS], help="environments: core, sdist, an extra"
    )
    environments = parser.parse_args().only
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "dist").mkdir()
        built = build(place / "dist")
        for path in (built.wheel, built.sdist):
            print(f"{path.name}: {path.stat().st_size / 1e6:.1f} MB", flush=True)
        for name in environments:
            package = built.sdist if name == "sdist" else built.wheel
            (place / name).mkdir()
            try:
                installed_mb = try_environment(place / name, package, name if name in EXTRAS else "")
            except FailedError as failure:
                failed += 1
                print(f"{name}: {failure}", flush=True)
            else:
                print(f"{name}: works, {installed_mb:,.0f} MB installed", flush=True)
            shutil.rmtree(place / name)  # together they would be 15 GB
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
