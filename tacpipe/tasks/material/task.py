"""The task ``material`` as a plug-in: train, evaluate, predict and load its models."""

from __future__ import annotations

from collections.abc import Mapping

from tacpipe.tasks.material.classifier import TASK, Classifier
from tacpipe.tasks.material.evaluation import evaluate
from tacpipe.tasks.material.prediction import predict
from tacpipe.tasks.material.training import train
from tacpipe.tasks.opened import Chain


def load(files: Mapping[str, bytes], chain: Chain | None = None) -> Classifier:
    """Return the classifier among a model's files, trained behind the stages ``chain``: what `tacpipe.load` gives."""
    return Classifier.load(files, chain)


__all__ = ["TASK", "Classifier", "evaluate", "load", "predict", "train"]
