"""What results state of predictors under one name of ``metrics.json``: each method's model, and the baselines."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from tacpipe.comparison.runs import MODEL, Method
from tacpipe.tasks.forward.report import single_run

Figures = Mapping[str, float]


def described(
    methods: Sequence[Method], key: str, of: Callable[[Method, str], Figures | None]
) -> list[tuple[str, Figures]]:
    """Return names and what ``of`` a method and a predictor gives, for all that state it.

    A baseline is the same for all methods, so it is taken from the method whose most runs state it under ``key``.
    """
    found = [(one.name, of(one, MODEL)) for one in methods]
    names = {name for one in methods for run in one.runs for name in run.details.metrics.get(key, {})} - {MODEL}
    for name in sorted(names):
        source = max(methods, key=lambda one: sum(name in run.details.metrics.get(key, {}) for run in one.runs))
        found.append((single_run.spelled(name), of(source, name)))
    return [(name, figures) for name, figures in found if figures]
