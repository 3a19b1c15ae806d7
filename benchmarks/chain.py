"""The forward chain, small: what DVC and tacpipe take to find out that there is nothing to do."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import timing
import yaml

ROOT = Path(__file__).parents[1]


def project(folder: Path) -> Path:
    """Return a repository in which the whole forward chain was run by DVC, on a few short recordings."""
    place = folder / "forward"
    if place.exists():
        return place
    (place / "docs" / "tasks").mkdir(parents=True)
    for name in ("dvc.yaml", "docs/tasks/horizons.json"):
        shutil.copy(ROOT / name, place / name)
    params: dict[str, Any] = yaml.safe_load((ROOT / "params.yaml").read_text())
    params["forward"]["recordings"] = "simulate forward --trials 8 --duration-s 4"
    params["forward"]["train"] |= {"epochs": 1, "hidden": 8}
    (place / "params.yaml").write_text(yaml.safe_dump(params))
    for command in ("git init --quiet", "dvc init --quiet", "dvc repro"):
        timing.run(command, place, DVC_NO_ANALYTICS="1", GIT_CONFIG_GLOBAL=os.devnull)
    return place


def commands(place: Path) -> list[str]:
    """Return the commands of the chain, as DVC runs them."""
    params = yaml.safe_load((place / "params.yaml").read_text())
    chain = yaml.safe_load((place / "dvc.yaml").read_text())
    recordings = params["forward"]["recordings"]
    return [stage["cmd"].replace("${forward.recordings}", recordings) for stage in chain["stages"].values()]


def measure(folder: Path, rounds: int) -> list[timing.Line]:
    """Return what both take on a chain in which nothing changed."""
    place = project(folder)

    def tacpipe() -> None:
        for command in commands(place):
            timing.run(command, place)

    def dvc() -> None:
        timing.run("dvc repro", place, DVC_NO_ANALYTICS="1", GIT_CONFIG_GLOBAL=os.devnull)

    times = timing.interleaved({"tacpipe": tacpipe, "dvc repro": dvc}, max(5, rounds // 2))
    count = len(commands(place))
    return [timing.at_most(f"nothing to do in a chain of {count} commands", times, "tacpipe", "dvc repro")]
