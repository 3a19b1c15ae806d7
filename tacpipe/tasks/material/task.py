"""The task ``material`` as a plug-in: train, evaluate, predict and load its models."""

from __future__ import annotations

from collections.abc import Mapping

from tacpipe.tasks.material.calibration import calibrate
from tacpipe.tasks.material.classifier import TASK
from tacpipe.tasks.material.evaluation import evaluate
from tacpipe.tasks.material.model import MaterialModel
from tacpipe.tasks.material.prediction import predict
from tacpipe.tasks.material.training import train
from tacpipe.tasks.opened import Chain


def load(files: Mapping[str, bytes], chain: Chain | None = None) -> MaterialModel:
    """Return the model among these files, trained behind the stages ``chain``: what `tacpipe.load` returns."""
    return MaterialModel.load(files, chain)


__all__ = ["TASK", "MaterialModel", "calibrate", "evaluate", "load", "predict", "train"]
