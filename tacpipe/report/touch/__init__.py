"""How results on touch are read, compared and reported."""

from __future__ import annotations

from tacpipe.report.touch.clouds import reads
from tacpipe.report.touch.methods import USUAL
from tacpipe.report.touch.parts import about_run, caveats, columns, folds, sentence
from tacpipe.report.touch.reading import called, read

__all__ = ["TITLE", "USUAL", "about_run", "called", "caveats", "columns", "folds", "read", "reads", "sentence"]

TITLE = "prediction of fingertip readings from point clouds"
