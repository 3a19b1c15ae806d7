"""Choose an estimator by cross-validation within the training recordings: the simplest within one standard error.

Groups of recordings are left out as a whole. Baselines take part: if no estimator is better than the best of them, it is
chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypedDict

import numpy as np

from tacpipe.arrays import Floats, Indices
from tacpipe.errors import TacpipeError
from tacpipe.io import terminal
from tacpipe.printable import round_to
from tacpipe.tasks.learning.answers import ModelAnswers
from tacpipe.tasks.learning.estimators import OutputEstimator
from tacpipe.tasks.learning.examples import Examples
from tacpipe.tasks.learning.features import Kind

FOLDS = 5
FRACTIONS = (0.125, 0.25, 0.5, 1.0)  # fractions of the training groups of a learning curve
# examples, their outputs, and the name of the part of the examples -> a fitted estimator
Fit = Callable[[Examples, Floats, str], OutputEstimator]
# outputs (example, output), their examples and the fold of each (example,) -> loss of each fold that has one (fold,)
FoldLosses = Callable[[Floats, Examples, Indices], Floats]


class CandidateLoss(TypedDict):
    """The cross-validated loss of a candidate, and how much larger than the smallest it is, with its standard error."""

    name: str
    baseline: bool
    loss: float
    excess: float
    error: float  # standard error of ``excess`` over the folds


class CurvePoint(TypedDict):
    """The cross-validated loss with a part of the training groups."""

    groups: float  # mean number of groups that were learned from
    loss: float


@dataclass(frozen=True)
class Selection:
    """The chosen candidate, with its outputs for examples that it did not learn from."""

    name: str
    table: list[CandidateLoss]  # in the order of simplicity
    predicted: Mapping[str, Floats]  # outputs (example, output) of each candidate

    @property
    def outputs(self) -> Floats:
        """The outputs of the chosen candidate (example, output)."""
        return self.predicted[self.name]


def fit_with(estimator: Any, kind: Kind, **options: Any) -> Fit:
    """Return a function that fits an estimator, a class of `estimators`, with these options."""
    return lambda examples, outputs, part: estimator.fit(examples, outputs, kind, **options)


def assign_folds(examples: Examples, seed: int) -> Indices:
    """Return the fold of each example (example,): each group is in one fold, and folds have about equally many examples.

    The examples of a single group are divided in their order into blocks. Raises `TacpipeError` for fewer than two
    examples.
    """
    if len(examples) < 2:
        raise TacpipeError(f"There are {len(examples)} examples to learn from, too few to compare estimators.")
    names, numbers, counts = np.unique(np.array(examples.example_groups), return_inverse=True, return_counts=True)
    if len(names) == 1:
        return np.arange(len(examples)) * min(FOLDS, len(examples)) // len(examples)
    folds, sizes = np.zeros(len(names), np.intp), np.zeros(min(FOLDS, len(names)))
    order = np.random.default_rng(seed).permutation(len(names))
    for group in order[np.argsort(-counts[order], kind="stable")].tolist():
        folds[group] = sizes.argmin()
        sizes[folds[group]] += counts[group]
    return np.asarray(folds[numbers])


def out_of_fold(fit: Fit, examples: Examples, outputs: Floats, folds: Indices, name: str) -> Floats:
    """Return the outputs (example, output) for each fold by an estimator that learned from the other folds."""
    predicted = np.empty_like(outputs)
    for fold in np.unique(folds).tolist():
        held_out = folds == fold
        estimator = fit(examples.select(~held_out), outputs[~held_out], f"{name}-{fold}")
        predicted[held_out] = estimator.outputs(examples.select(held_out))
    return predicted


def select(
    baselines: Mapping[str, Fit],
    candidates: Mapping[str, Fit],
    outputs: Floats,
    examples: Examples,
    losses_of: FoldLosses,
    seed: int,
) -> Selection:
    """Return the first candidate within one standard error of the smallest loss that is better than every baseline.

    The error is that of the difference of losses over folds. The best baseline is chosen if it is better than every
    candidate. A single candidate is chosen whatever its loss.
    """
    folds = assign_folds(examples, seed)
    fits = {**baselines, **candidates}
    predicted = {}
    with terminal.progress_bar("cross-validate", len(fits)) as advance:
        for name, fit in fits.items():
            predicted[name] = out_of_fold(fit, examples, outputs, folds, name)
            advance(note=name)
    losses = {name: losses_of(values, examples, folds) for name, values in predicted.items()}
    best = min(losses, key=lambda name: float(losses[name].mean()))
    table: list[CandidateLoss] = []
    for name, by_fold in losses.items():
        excess = by_fold - losses[best]
        error = float(excess.std(ddof=1) / np.sqrt(len(excess))) if len(excess) > 1 else 0.0
        table.append(
            {
                "name": name,
                "baseline": name in baselines,
                "loss": round_to(by_fold.mean(), 6),
                "excess": round_to(excess.mean(), 6),
                "error": round_to(error, 6),
            }
        )
    return Selection(_chosen(table, list(candidates)), table, predicted)


def _chosen(table: Sequence[CandidateLoss], candidates: Sequence[str]) -> str:
    """Return the name of the candidate or baseline to use."""
    if len(candidates) == 1:
        return candidates[0]
    baseline = min((row for row in table if row["baseline"]), key=lambda row: row["loss"], default=None)
    better = [row for row in table if not row["baseline"] and (baseline is None or row["loss"] < baseline["loss"])]
    if not better:
        assert baseline is not None
        return baseline["name"]
    return next((row["name"] for row in better if row["excess"] <= row["error"]), better[0]["name"])


def mean_losses(answers: ModelAnswers) -> FoldLosses:
    """Return a function that returns the mean loss of each fold (fold,)."""

    def measure(outputs: Floats, examples: Examples, folds: Indices) -> Floats:
        losses = answers.losses(outputs, examples.values)
        return np.array([losses[folds == fold].mean() for fold in np.unique(folds).tolist()])

    return measure


def notes(chosen: Selection, baselines: Mapping[str, Fit], groups: int) -> list[str]:
    """Return a note if the chosen candidate is a baseline."""
    if chosen.name not in baselines:
        return []
    return [
        f"No estimator is better than the baseline {chosen.name.replace('_', ' ')} in cross-validation over {groups} "
        f"groups, so the model is that baseline."
    ]


def learning_curve(fit: Fit, answers: ModelAnswers, examples: Examples, seed: int) -> list[CurvePoint]:
    """Return the cross-validated loss of a candidate that learns from `FRACTIONS` of the groups of the other folds."""
    folds, outputs = assign_folds(examples, seed), answers.encode(examples.values)
    groups = np.array(examples.example_groups)
    rng = np.random.default_rng(seed)
    points: list[CurvePoint] = []
    for fraction in FRACTIONS:
        predicted, used = np.empty_like(outputs), []
        for fold in np.unique(folds).tolist():
            names = rng.permutation(np.unique(groups[folds != fold]))
            kept = names[: max(1, round(fraction * len(names)))]
            chosen = (folds != fold) & np.isin(groups, kept)
            estimator = fit(examples.select(chosen), outputs[chosen], f"curve-{fraction:g}-{fold}")
            predicted[folds == fold] = estimator.outputs(examples.select(folds == fold))
            used.append(len(kept))
        loss = mean_losses(answers)(predicted, examples, folds).mean()
        points.append({"groups": float(np.mean(used)), "loss": round_to(loss, 6)})
    return points
