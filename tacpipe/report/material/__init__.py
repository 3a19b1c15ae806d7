"""How results on materials are read, compared and reported."""

from __future__ import annotations

from tacpipe.report.material.methods import USUAL
from tacpipe.report.material.parts import caveats, columns, folds
from tacpipe.report.material.profiles import reads
from tacpipe.report.material.reading import called, kind, read
from tacpipe.report.material.tables import about_run

__all__ = ["TITLE", "USUAL", "about_run", "called", "caveats", "columns", "folds", "kind", "read", "reads"]

TITLE = "recognition of materials by touch"
