"""The task ``forward`` as a plug-in: train, evaluate, predict and load its models."""

from __future__ import annotations

from collections.abc import Mapping

from tacpipe.tasks.forward.evaluation import evaluate
from tacpipe.tasks.forward.forecaster import TASK, Forecaster
from tacpipe.tasks.forward.prediction import predict
from tacpipe.tasks.forward.training import train
from tacpipe.tasks.opened import Chain


def load(files: Mapping[str, bytes], chain: Chain | None = None) -> Forecaster:
    """Return the forecaster among a model's files, trained behind the stages ``chain``: what `tacpipe.load` gives."""
    return Forecaster.load(files, chain)


__all__ = ["TASK", "Forecaster", "evaluate", "load", "predict", "train"]
