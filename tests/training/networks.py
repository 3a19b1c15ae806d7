"""Every network that `loop.train` trains, each in a training of seconds, with what is random in it switched on."""

import json
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from safetensors.torch import load
from torch import Tensor

from tacpipe.plugins import registry
from tests.tasks.forward import trials
from tests.tasks.material import textures
from tests.tasks.touch import handmade

Trains = Callable[..., Mapping[str, bytes]]  # functions of a workspace and params that return the files of a model
RAEC: dict[str, Any] = {"architecture": "raec", "epochs": 3, "align_from": 1, "learning_rate": 1e-3}
PATCHES: dict[str, Any] = {"architecture": "patches", "inputs": "xyz"}
POINTNET: dict[str, Any] = dict(handmade.POINTNET)
NETWORKS: dict[str, Trains] = {
    **{
        f"forward {name}": partial(trials.trained, architecture=name, epochs=3)
        for name in registry.architectures("forward")
    },
    "forward shuffled": partial(trials.trained, architecture="gru", epochs=3, actions="shuffled"),
    "material raec": partial(textures.trained, **RAEC, dropout=0.3),
    "material contrast": partial(textures.trained, **RAEC, alignment_loss="contrast"),
    "material x-lstm": partial(textures.trained, architecture="x-lstm", epochs=3),
    "touch patches": partial(handmade.trained, **PATCHES),
    "touch edges": partial(handmade.trained, **PATCHES, backbone="edges"),
    "touch pointnet": partial(handmade.trained, **POINTNET, rotation_deg=45.0),
}


def history(files: Mapping[str, bytes]) -> list[dict[str, Any]]:
    """Return the lines of a model's history."""
    return [json.loads(line) for line in files["history.jsonl"].splitlines()]


def losses(files: Mapping[str, bytes]) -> list[float]:
    """Return the training and validation loss of each epoch."""
    return [line[name] for line in history(files) for name in ("train_loss", "val_loss")]


def weights(files: Mapping[str, bytes]) -> dict[str, Tensor]:
    """Return a model's tensors by name."""
    tensors: dict[str, Tensor] = load(files["model.safetensors"])
    return tensors
