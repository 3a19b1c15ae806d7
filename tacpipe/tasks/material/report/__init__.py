"""How results on materials are read, compared and reported."""

from __future__ import annotations

from tacpipe.tasks.material.report.methods import USUAL
from tacpipe.tasks.material.report.parts import caveats, columns, folds
from tacpipe.tasks.material.report.profiles import reads
from tacpipe.tasks.material.report.reading import called, kind, read
from tacpipe.tasks.material.report.tables import about_run

__all__ = ["TITLE", "USUAL", "about_run", "called", "caveats", "columns", "folds", "kind", "read", "reads"]

TITLE = "recognition of materials by touch"
