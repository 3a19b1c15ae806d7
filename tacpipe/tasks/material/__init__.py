"""Which material is under the finger? Told from one slide of a tactile sensor, and learned jointly across unlike ones.

A slide is the table of frames that ``tacpipe segment slides`` keeps of a recording. Each sensor has its own reader;
networks may be trained so that slides of the same material get the same latents, whichever sensor felt them.
"""

from __future__ import annotations

from collections.abc import Mapping

from tacpipe.tasks.material.classifier import TASK, Classifier
from tacpipe.tasks.material.judging import evaluate
from tacpipe.tasks.material.predicting import predict
from tacpipe.tasks.material.training import train
from tacpipe.tasks.opened import Chain


def load(files: Mapping[str, bytes], chain: Chain | None = None) -> Classifier:
    """Return the classifier among a model's files, trained behind the stages ``chain``: what `tacpipe.load` gives."""
    return Classifier.load(files, chain)


__all__ = ["TASK", "Classifier", "evaluate", "load", "predict", "train"]
