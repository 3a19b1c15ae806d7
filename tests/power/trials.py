"""Loss of power on real file systems: commands on a logged disk, each state that the disk may be left in, and a look at it.

    python -m tests.power.trials [--kinds ext4 xfs btrfs] [--every 1] [--seed 0]

prints how many states were tried, and what was wrong.
"""

import argparse
import shutil
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from tests.conftest import ENTRY_POINTS, write_plugin
from tests.power import block_log, machine
from tests.promises.counts import count

TOGETHER = 12  # disks of one machine
LOG_MB = 4096  # sparse
PLUGIN = Path(__file__).parents[1] / "plugin"


@dataclass
class PowerResults:
    """How many states of a disk were looked at, and what was wrong with which."""

    kind: str
    states: int = 0
    wrong: list[str] = field(default_factory=list)


def plugin(folder: Path) -> Path:
    """Return a folder with the small stages of the tests, installed."""
    shutil.copytree(PLUGIN, folder)
    write_plugin(folder, "toy", ENTRY_POINTS)
    return folder


def trial(kind: str, scratch: Path, step: int = 1, seed: int = 0) -> PowerResults:
    """Return what came of commands on a file system of this kind, whose disk loses power at any moment."""
    environment = {"PYTHONPATH": str(plugin(scratch / "plugin"))}
    base = machine.format_disk(scratch / "base.img", kind)
    disk, log = copy_disk(base, scratch / "disk.img"), machine.blank(scratch / "log.img", LOG_MB)
    (recorded,) = machine.run([disk, log], {"kind": kind, "modules": str(machine.modules())}, scratch, environment)
    assert recorded == {"recorded": kind}, recorded.get("wrong")
    disk.unlink()
    entries = block_log.read(log)
    log.unlink()
    states = [state for state in block_log.states(entries, seed) if "prepared" in state.passed][::step]
    results = PowerResults(kind)
    for first in range(0, len(states), TOGETHER):
        batch = states[first : first + TOGETHER]
        disks = [copy_disk(base, scratch / f"state{number}.img") for number in range(len(batch))]
        for state, image in zip(batch, disks, strict=True):
            block_log.write(state, image)
        answers = look(kind, batch, disks, scratch, environment)
        results.states += len(answers)
        results.wrong += [
            f"{kind}, after {answer['passed']}: {answer['wrong']}" for answer in answers if answer["wrong"]
        ]
    count("losses of power replayed on blocks", results.states)
    return results


def look(
    kind: str, batch: list[block_log.State], disks: list[Path], scratch: Path, environment: Mapping[str, str]
) -> list[dict[str, str]]:
    """Return what the guest answers of each disk; it must answer of all."""
    task = {"kind": kind, "disks": [state.passed for state in batch]}
    answers = machine.run(disks, task, scratch, environment)
    assert len(answers) == len(disks), answers
    return answers


def copy_disk(image: Path, target: Path) -> Path:
    """Return a sparse copy of a disk."""
    target.unlink(missing_ok=True)
    machine.blank(target, 0)
    with image.open("rb") as source, target.open("r+b") as copy:
        while block := source.read(1 << 20):
            if block.count(0) == len(block):
                copy.seek(len(block), 1)
            else:
                copy.write(block)
        copy.truncate(image.stat().st_size)
    return target


def main() -> None:
    """Try what the command line asks for; exit with 1 where something was wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--kinds", nargs="+", default=list(machine.MAKE), choices=list(machine.MAKE))
    parser.add_argument("--every", type=int, default=1, help="Look at one of so many states.")
    parser.add_argument("--seed", type=int, default=0, help="Of what comes onto a disk without a flush.")
    options = parser.parse_args()
    wrong: list[str] = []
    for kind in options.kinds:
        with tempfile.TemporaryDirectory() as scratch:
            results = trial(kind, Path(scratch), options.every, options.seed)
        print(f"{kind}: {results.states} states, {len(results.wrong)} wrong", flush=True)
        wrong += results.wrong
    print("\n".join(wrong))
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
