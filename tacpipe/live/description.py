"""What a model predicts, read from its description alone: the recording process must not import torch."""

from __future__ import annotations

from pathlib import Path

from tacpipe.errors import UsageError
from tacpipe.live.session import Described, Grasped, Surfaces
from tacpipe.live.touch_messages import COLUMNS
from tacpipe.printable import plain

CONFIG = "config.json"
READ = ("horizon", "inputs")  # of the description of a model of future signals


def described(model: Path) -> tuple[Described | Surfaces | Grasped, str]:
    """Return what a model predicts, and the digest of its dataset. Raises `UsageError` where it does not run live."""
    import tacpipe
    from tacpipe.datasets import model_files

    found = tacpipe.open(model)
    if CONFIG not in found.files:
        raise UsageError(f"{model} is not a model; give one of `tacpipe train`.")
    config = model_files.tree(found.files, CONFIG, {"task": str})
    if config["task"] == Surfaces.kind:
        config = model_files.tree(found.files, CONFIG, {"classes": list})
        names = config.get("names") or {number: number for number in config["classes"]}
        return Surfaces(tuple(str(names[number]) for number in config["classes"])), found.digest
    if config["task"] == Grasped.kind:
        return Grasped(COLUMNS), found.digest
    if not all(key in config for key in READ):
        raise UsageError(
            f"{model} was trained for {plain(config['task'])}; models of forward, material and touch run live."
        )
    config = model_files.tree(found.files, CONFIG, {"horizon": int, "inputs.tactile": list})
    inputs = config["inputs"]
    percents = tuple(int(one) for one in config.get("quantiles", {}).get("levels", []))
    about = Described(tuple(inputs["tactile"]), config["horizon"], str(inputs.get("unit", "count")), percents)
    return about, found.digest
