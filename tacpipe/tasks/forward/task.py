"""The task ``forward`` as a plug-in: train, evaluate, predict and load its models."""

from __future__ import annotations

from collections.abc import Mapping

from tacpipe.tasks.forward.calibration import calibrate
from tacpipe.tasks.forward.evaluation import evaluate
from tacpipe.tasks.forward.forecaster import TASK
from tacpipe.tasks.forward.model import ForwardModel
from tacpipe.tasks.forward.prediction import predict
from tacpipe.tasks.forward.training import notes, train
from tacpipe.tasks.opened import Chain

SHORT_NAMES = {"known objects": "known", "unseen objects": "unseen"}  # of parts, in summary.json


def load(files: Mapping[str, bytes], chain: Chain | None = None) -> ForwardModel:
    """Return the model among these files, trained behind the stages ``chain``: what `tacpipe.load` returns."""
    return ForwardModel.load(files, chain)


__all__ = ["SHORT_NAMES", "TASK", "ForwardModel", "calibrate", "evaluate", "load", "notes", "predict", "train"]
