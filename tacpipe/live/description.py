"""What a model predicts live, read from its description alone: the recording process must not import torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from tacpipe.errors import UsageError
from tacpipe.printable import plain
from tacpipe.tasks.forward.live.alarms import NAMES
from tacpipe.tasks.forward.live.stages import refuse_look_ahead
from tacpipe.tasks.touch.live.messages import COLUMNS

CONFIG = "config.json"
READ = ("horizon", "inputs")  # of the description of a model of future signals


@dataclass(frozen=True)
class Described:
    """What the model predicts, which the session's own streams must state before it runs."""

    channels: tuple[str, ...]
    horizon: int
    unit: str
    percents: tuple[int, ...] = ()  # levels of the quantiles that it has
    quantiles: tuple[int, ...] = ()  # those of them that are asked for
    kind: ClassVar[str] = "forecast"  # of its messages

    def own(self, steps: Sequence[int]) -> dict[str, Mapping[str, Any]]:
        """Return the session's own streams, with the options of the sensor ``live``."""
        forecast = {"output": "forecast", "channels": list(self.channels), "steps": list(steps), "unit": self.unit}
        levels = {"quantiles": list(self.quantiles)} if self.quantiles else {}
        return {
            "forecast": {**forecast, **levels},
            "alarm": {"output": "alarm", "alarms": list(NAMES)},
            "latency": {"output": "latency"},
        }


@dataclass(frozen=True)
class Surfaces:
    """The materials that the model names."""

    names: tuple[str, ...]
    kind: ClassVar[str] = "material"

    def own(self, steps: Sequence[int]) -> dict[str, Mapping[str, Any]]:
        """Return the session's own streams, with the options of the sensor ``live``."""
        return {"material": {"output": "material", "channels": list(self.names)}, "latency": {"output": "latency"}}


@dataclass(frozen=True)
class Grasped:
    """What the model predicts of a grasp."""

    columns: tuple[str, ...]
    kind: ClassVar[str] = "touch"

    def own(self, steps: Sequence[int]) -> dict[str, Mapping[str, Any]]:
        """Return the session's own streams, with the options of the sensor ``live``."""
        return {"touch": {"output": "touch", "channels": list(self.columns)}, "latency": {"output": "latency"}}


def described(model: Path, *, allow_look_ahead: bool = False) -> tuple[Described | Surfaces | Grasped, str]:
    """Return what a model predicts, and the digest of its dataset.

    Raises `UsageError` where it does not run live, `TacpipeError` where it was trained on rows that look ahead, unless
    ``allow_look_ahead``.
    """
    from tacpipe.datasets import model_files
    from tacpipe.engine.pipeline import open_dataset

    found = open_dataset(model)
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
    if not allow_look_ahead:
        refuse_look_ahead(config, found.source.chain)
    inputs = config["inputs"]
    percents = tuple(int(one) for one in config.get("quantiles", {}).get("levels", []))
    about = Described(tuple(inputs["tactile"]), config["horizon"], str(inputs.get("unit", "count")), percents)
    return about, found.digest
