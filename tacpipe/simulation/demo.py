"""List the commands of `tacpipe demo`, as a lab would type them, on simulated recordings or on an emulated rig."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.plugins import registry

if TYPE_CHECKING:
    from tacpipe.tasks.task import Demo

LIVE_S, LIVE_TRIALS = 30, 6  # length and trials of the emulated rig
EMULATED = "emulated"  # the folder of the emulated rig's own rig file


def commands(output: Path) -> list[list[str]]:
    """Return the commands of each task's demo without the leading ``tacpipe``, and the page of all results."""
    demos = parts(output)
    datasets = [*(name for demo in demos for name in demo.results), *(name for demo in demos for name in demo.datasets)]
    return [*(words for demo in demos for words in demo.commands), ["report", *datasets, "-o", str(page(output))]]


def rig(output: Path) -> list[list[str]]:
    """Return the commands after the emulated rig is up: 30 s recorded live, then the chain to a forecast."""
    recordings = str(output / "recordings")
    live = ["--trials", str(LIVE_TRIALS), "--duration-s", str(LIVE_S / LIVE_TRIALS)]
    return [
        ["acquire", str(output / EMULATED / "rig.toml"), "-o", recordings, *live],
        ["show", recordings],
        *(words for demo in parts(output) for words in demo.recorded),
        ["report", str(output / "results"), "-o", str(page(output))],
    ]


def parts(output: Path) -> list[Demo]:
    """Return the parts of all tasks that have one."""
    return [demo for name in registry.tasks() if (demo := registry.load_task(name).demo(output)) is not None]


def page(output: Path) -> Path:
    """Return the path of the page of results."""
    return output / "report.html"
