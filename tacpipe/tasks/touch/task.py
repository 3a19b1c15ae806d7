"""The task ``touch`` as a plug-in: train, evaluate, predict and load its models."""

from __future__ import annotations

from collections.abc import Mapping

from tacpipe.tasks.opened import Chain
from tacpipe.tasks.touch.evaluation import evaluate
from tacpipe.tasks.touch.prediction import predict
from tacpipe.tasks.touch.predictor import TASK, Predictor, Touch
from tacpipe.tasks.touch.training import train


def load(files: Mapping[str, bytes], chain: Chain | None = None) -> Predictor:
    """Return the predictor among a model's files, trained behind the stages ``chain``: what `tacpipe.load` gives."""
    return Predictor.load(files, chain)


__all__ = ["TASK", "Predictor", "Touch", "evaluate", "load", "predict", "train"]
