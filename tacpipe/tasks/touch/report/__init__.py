"""How results on touch are read, compared and reported."""

from __future__ import annotations

from tacpipe.tasks.touch.report.clouds import reads
from tacpipe.tasks.touch.report.methods import USUAL
from tacpipe.tasks.touch.report.parts import about_run, caveats, columns, folds, sentence
from tacpipe.tasks.touch.report.reading import called, read

__all__ = ["TITLE", "USUAL", "about_run", "called", "caveats", "columns", "folds", "read", "reads", "sentence"]

TITLE = "prediction of fingertip readings from point clouds"
