"""What will the fingertips feel over the next steps, given the planned motion of the arm?

A window is ``context`` rows t-9 … t of touch and arm, the arm of the ``horizon`` rows t+1 … t+10 as the plan, and the
touch of these rows as the answer. The recorded motion stands for the plan, so what is measured holds for an arm that
does as it was told.
"""

from __future__ import annotations

from collections.abc import Mapping

from tacpipe.tasks.forward.forecaster import TASK, Forecaster
from tacpipe.tasks.forward.judging import evaluate
from tacpipe.tasks.forward.predicting import predict
from tacpipe.tasks.forward.training import train
from tacpipe.tasks.opened import Chain


def load(files: Mapping[str, bytes], chain: Chain | None = None) -> Forecaster:
    """Return the forecaster among a model's files, trained behind the stages ``chain``: what `tacpipe.load` gives."""
    return Forecaster.load(files, chain)


__all__ = ["TASK", "Forecaster", "evaluate", "load", "predict", "train"]
