"""How results on materials are read, compared and reported."""

from __future__ import annotations

from tacpipe.report.material.parts import about_run, caveats, columns, folds
from tacpipe.report.material.profiles import reads
from tacpipe.report.material.reading import USUAL, called, kind, read

__all__ = ["TITLE", "USUAL", "about_run", "called", "caveats", "columns", "folds", "kind", "read", "reads"]

TITLE = "recognition of materials by touch"
