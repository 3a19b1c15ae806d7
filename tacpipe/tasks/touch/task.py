"""The task ``touch`` as a plug-in: train, evaluate, predict and load its models."""

from __future__ import annotations

from collections.abc import Mapping

from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.tasks.opened import Chain
from tacpipe.tasks.touch.calibration import calibrate
from tacpipe.tasks.touch.evaluation import evaluate
from tacpipe.tasks.touch.headline import PARTS, TARGETS
from tacpipe.tasks.touch.model import TouchModel
from tacpipe.tasks.touch.prediction import predict
from tacpipe.tasks.touch.predictor import TASK, Touch
from tacpipe.tasks.touch.training import train

SHORT_NAMES = {  # of parts and targets, in summary.json
    **{text: name for name, text in TARGETS.items()},
    **{text: text.partition(" ")[0] for text in PARTS.values()},
}


def load(files: Mapping[str, bytes], chain: Chain | None = None) -> TouchModel:
    """Return the model among these files, trained behind the stages ``chain``: what `tacpipe.load` returns."""
    return TouchModel.load(files, chain)


def predict_grasp(model: TouchModel, cloud: Cloud, grasp: Grasp) -> dict[str, float]:
    """Return the 50 predicted values of a grasp on a cloud, device counts by column: `tacpipe candidates` asks for them."""
    touch = model.predict(cloud, grasp)
    values: dict[str, float] = {}
    for finger in ("th", "mf"):
        values[f"pdc_{finger}_counts"] = round(float(getattr(touch, f"pdc_{finger}")), 1)
        electrodes = enumerate(getattr(touch, f"e_{finger}"), 1)
        values |= {f"e_{finger}_{n:02d}_counts": round(float(value), 1) for n, value in electrodes}
    return values


__all__ = [
    "SHORT_NAMES",
    "TASK",
    "Touch",
    "TouchModel",
    "calibrate",
    "evaluate",
    "load",
    "predict",
    "predict_grasp",
    "train",
]
