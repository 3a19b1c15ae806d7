"""What a model predicts, read from its description alone: the recording process must not import torch."""

from __future__ import annotations

from pathlib import Path

from tacpipe.errors import UsageError
from tacpipe.live.session import Described
from tacpipe.printable import plain

CONFIG = "config.json"
READ = ("horizon", "inputs")  # of its description


def described(model: Path) -> tuple[Described, str]:
    """Return what a model predicts, and the digest of its dataset. Raises `UsageError` where it does not run live."""
    import tacpipe
    from tacpipe.datasets import model_files

    found = tacpipe.open(model)
    if CONFIG not in found.files:
        raise UsageError(f"{model} is not a model; give a trained one that predicts future tactile signals.")
    config = model_files.tree(found.files, CONFIG, {"task": str})
    if not all(key in config for key in READ):
        raise UsageError(f"{model} was trained for {plain(config['task'])}; only models of future signals run live.")
    config = model_files.tree(found.files, CONFIG, {"horizon": int, "inputs.tactile": list})
    inputs = config["inputs"]
    return Described(tuple(inputs["tactile"]), config["horizon"], str(inputs.get("unit", "count"))), found.digest
