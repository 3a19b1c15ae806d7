"""What would a grasp feel like? Told from a point cloud of the object and the two points where fingers are to close.

A grasp is a recording with a ``cloud``, a ``grasp`` and a ``reading`` of two BioTac SP. Four targets are foretold: the
pressure of the fluid and 24 electrodes of thumb and middle finger each.
"""

from __future__ import annotations

from collections.abc import Mapping

from tacpipe.tasks.opened import Chain
from tacpipe.tasks.touch.judging import evaluate
from tacpipe.tasks.touch.predicting import predict
from tacpipe.tasks.touch.predictor import TASK, Predictor, Touch
from tacpipe.tasks.touch.training import train


def load(files: Mapping[str, bytes], chain: Chain | None = None) -> Predictor:
    """Return the predictor among a model's files, trained behind the stages ``chain``: what `tacpipe.load` gives."""
    return Predictor.load(files, chain)


__all__ = ["TASK", "Predictor", "Touch", "evaluate", "load", "predict", "train"]
