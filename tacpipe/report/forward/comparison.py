"""Methods and baselines next to each other: errors, skill over persistence, and how sure both are.

Runs of a method are pooled: the sums of a recording that several runs were evaluated on are added and stay together, and
intervals come from drawing whole recordings anew (`tacpipe.metrics.forecast`).
"""

from __future__ import annotations

import functools
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats, Int64s
from tacpipe.comparison.spread import Spread, spread
from tacpipe.metrics import forecast
from tacpipe.metrics.forecast import Interval
from tacpipe.metrics.headline import Headline
from tacpipe.metrics.pairing import Sums
from tacpipe.report.forward import methods as by_method
from tacpipe.report.forward.error_sums import BASELINE, MODEL
from tacpipe.report.forward.methods import Method, Run
from tacpipe.tasks.forward import headline as headlines
from tacpipe.tasks.forward import units

_draws = functools.lru_cache(maxsize=8)(forecast.draws)


@dataclass(frozen=True)
class Pool:
    """The error sums of one predictor over runs, next to those of persistence on the same windows."""

    recordings: tuple[str, ...]
    windows: Int64s  # (recording,), those of several runs added
    distinct_windows: int  # each counted once
    runs: int
    steps: tuple[int, ...]
    channels: int
    squared: AnyFloats  # (recording, step)
    absolute: AnyFloats  # (recording, step)
    baseline: AnyFloats  # (recording, step), squared errors of persistence

    @property
    def mse(self) -> AnyFloats:
        """The mean squared error of each step, (step,)."""
        found: AnyFloats = self.squared.sum(axis=0) / (self.windows.sum() * self.channels)
        return found

    @property
    def mae(self) -> AnyFloats:
        """The mean absolute error of each step, (step,)."""
        found: AnyFloats = self.absolute.sum(axis=0) / (self.windows.sum() * self.channels)
        return found

    @property
    def baseline_mse(self) -> AnyFloats:
        """The mean squared error of persistence at each step, (step,)."""
        found: AnyFloats = self.baseline.sum(axis=0) / (self.windows.sum() * self.channels)
        return found

    def at(self, values: AnyFloats, steps: Sequence[int]) -> AnyFloats:
        """Return the columns of ``values`` (…, step) that belong to ``steps``."""
        return values[..., [self.steps.index(step) for step in steps]]

    def of(self, recordings: Sequence[str]) -> Pool:
        """Return the pool of these of its recordings alone."""
        rows = [self.recordings.index(name) for name in recordings]
        parts = {name: getattr(self, name)[rows] for name in ("windows", "squared", "absolute", "baseline")}
        described = (self.distinct_windows, self.runs, self.steps, self.channels)
        windows, squared, absolute, baseline = parts.values()
        return Pool(tuple(recordings), windows, *described, squared, absolute, baseline)


@dataclass(frozen=True)
class Row:
    """How one method or baseline does."""

    name: str
    predictor: str
    method: Method  # whose runs report on it
    pool: Pool  # counts, both sensors
    standard: Pool | None  # all channels in units of their training standard deviation
    skill: Interval  # of each shown step, then of their mean
    spread: float  # standard deviation of the mean skill over runs, NaN for a single one
    standard_skill: Interval | None = None  # the same as ``skill`` of standardised channels, where shear counts too

    @property
    def score(self) -> float:
        """The mean skill over the shown steps."""
        return float(self.skill.mean[-1])


@dataclass(frozen=True)
class Represented:
    """A row of Table 1: errors in a representation's own scaled space."""

    method: Method
    validation: Spread
    test: Spread
    known: Spread | None  # test recordings of known objects alone
    persistence: Spread


def shown_steps(runs: Sequence[Run]) -> tuple[int, ...]:
    """Return the steps to report on, those that all runs predict."""
    return headlines.shown(sorted(set.intersection(*(set(run.errors.steps) for run in runs))))


def pool(runs: Sequence[Run], predictor: str, group: str = "both", known: bool | None = None) -> Pool | None:
    """Return the pooled sums of a predictor; None where no run has any.

    ``known`` takes the recordings of known objects alone, or of unseen ones; None takes both.
    """
    parts = [found for run in runs if (found := _part(run, predictor, group, known)) is not None]
    if not parts:
        return None
    names = sorted({name for part in parts for name in part.recordings})
    steps = tuple(step for step in parts[0].steps if all(step in part.steps for part in parts))
    place = {name: index for index, name in enumerate(names)}
    windows, most = np.zeros((2, len(names)), dtype=np.int64)
    sums = np.zeros((3, len(names), len(steps)))
    for part in parts:
        rows = [place[name] for name in part.recordings]
        windows[rows] += part.windows
        most[rows] = np.maximum(most[rows], part.windows)
        for index, values in enumerate((part.squared, part.absolute, part.baseline)):
            sums[index][rows] += part.at(values, steps)
    return Pool(tuple(names), windows, int(most.sum()), len(parts), steps, parts[0].channels, *sums)


def skill(pooled: Pool, steps: Sequence[int]) -> Interval:
    """Return the skill over persistence at ``steps``, then its mean over these, with intervals by recording."""
    count = len(pooled.recordings)
    mean = _skills(np.ones((1, count)), pooled, steps)[0]
    if count < 2:
        return Interval(mean, np.full_like(mean, np.nan), np.full_like(mean, np.nan))
    return Interval(mean, *forecast.bounds(_skills(_draws(count), pooled, steps)))


def difference(one: Pool, other: Pool, steps: Sequence[int]) -> Interval | None:
    """Return by how much the skill of ``one`` exceeds that of ``other``, each resample drawing the same recordings.

    Only recordings that both were evaluated on count; None where there is none.
    """
    common = [name for name in one.recordings if name in set(other.recordings)]
    if not common:
        return None
    pair = one.of(common), other.of(common)
    even = np.ones((1, len(common)))
    mean = (_skills(even, pair[0], steps) - _skills(even, pair[1], steps))[0]
    if len(common) < 2:
        return Interval(mean, np.full_like(mean, np.nan), np.full_like(mean, np.nan))
    drawn = _draws(len(common))
    return Interval(mean, *forecast.bounds(_skills(drawn, pair[0], steps) - _skills(drawn, pair[1], steps)))


def headline(method: Method, others: Sequence[Method], steps: Sequence[int], known: bool | None) -> Headline | None:
    """Return how a method compares with its baselines on known objects, unseen ones or all; None where it has no errors.

    Baselines that its own runs do not hold are those of ``others``, as in `rows`.
    """
    source = by_method.reference([method, *others])
    names = dict.fromkeys([*_predictors(method), *_predictors(source)])
    baselines = {}
    for name in filter(headlines.legitimate, names):
        held = method if name in _predictors(method) else source
        baselines[name] = _sums(held.runs, name, steps, known)
    return headlines.headline(
        method.name,
        steps,
        _sums(method.runs, MODEL, steps, known),
        baselines,
        known,
        len(method.runs),
        units.of_model(method.config),
    )


def _sums(runs: Sequence[Run], predictor: str, steps: Sequence[int], known: bool | None) -> Sums:
    """Return what a headline is computed from, by seed and recording."""
    found: dict[tuple[Hashable, str], AnyFloats] = {}
    for run in runs:
        one = _part(run, predictor, "both", known)
        if one is None:
            continue
        squared, absolute, still = (one.at(values, steps) for values in (one.squared, one.absolute, one.baseline))
        for at, name in enumerate(one.recordings):
            values = float(one.windows[at]) * one.channels
            described = headlines.sums(squared[at], absolute[at], still[at], values)
            key = run.config["params"].get("seed"), name
            found[key] = found[key] + described if key in found else described
    return found


def rows(methods: Sequence[Method], steps: Sequence[int], known: bool | None) -> list[Row]:
    """Return every method and every baseline, the highest mean skill first.

    Baselines are those of the runs of one method (`tacpipe.report.forward.methods.reference`), because a split has the
    same for all; those that go through a codec are given for each codec.
    """
    found = [_row(one.name, MODEL, one, steps, known) for one in methods]
    source = by_method.reference(methods)
    found += [_row(name, name, source, steps, known) for name in _predictors(source) if not own(name)]
    for one in methods:  # what else was made of the model's own forecast
        others = [name for name in _predictors(one) if name.startswith(f"{MODEL}_")]
        found += [_row(f"{one.name} · {name[len(MODEL) + 1 :]}", name, one, steps, known) for name in others]
    for codec in sorted({str(one.codec["name"]) for one in methods}):
        source = by_method.reference([one for one in methods if one.codec["name"] == codec])
        through = [name for name in _predictors(source) if name.startswith("codec")]
        found += [_row(f"{name} {codec}", name, source, steps, known) for name in through]
    held = [row for row in found if row is not None]
    return sorted(held, key=lambda row: (np.isnan(row.score), -row.score, row.name))


def represented(method: Method) -> Represented | None:
    """Return a method's errors in its own scaled space; None where the results do not state them."""
    pooled = [found for run in method.runs if (found := pool([run], MODEL, "feature")) is not None]
    if not pooled:
        return None
    known = [found for run in method.runs if (found := pool([run], MODEL, "feature", known=True)) is not None]
    # the recurrent model is trained by this very error, so its loss states it too
    validation = [run.config.get("validation", {}) for run in method.runs]
    described = [one.get("mse_feature", one.get("loss") if method.recurrent else None) for one in validation]
    return Represented(
        method,
        spread([float(one) for one in described if one is not None]),
        spread([float(one.mse.mean()) for one in pooled]),
        spread([float(one.mse.mean()) for one in known]) if known else None,
        spread([float(one.baseline_mse.mean()) for one in pooled]),
    )


def anticipation(method: Method, predictor: str) -> dict[str, float] | None:
    """Return recall, leads and false alarms of a predictor, averaged over runs by their numbers of events."""
    described = [run.metrics.get("anticipation", {}).get(predictor) for run in method.runs]
    held = [one for one in described if one and one.get("events")]
    if not held:
        return None
    found: dict[str, float] = {"events": sum(float(one["events"]) for one in held)}
    for name in ("recall", "median_lead_rows", "median_lead_frames", "false_alarms_per_minute"):
        pairs = [(float(one[name]), float(one["events"])) for one in held if one.get(name) is not None]
        values, weights = zip(*pairs, strict=True) if pairs else ((float("nan"),), (1.0,))
        found[name] = float(np.average(values, weights=weights))
    return found


def _part(run: Run, predictor: str, group: str, known: bool | None) -> Pool | None:
    """Return the sums of one run."""
    errors = run.errors
    sums, baseline = errors.of(predictor, group), errors.of(BASELINE, group)
    held = (errors.windows > 0) & (True if known is None else errors.known == known)
    if sums is None or baseline is None or not held.any():
        return None
    names = tuple(name for name, kept in zip(errors.recordings, held, strict=True) if kept)
    windows = errors.windows[held]
    described = (int(windows.sum()), 1, errors.steps, errors.channels[group])
    return Pool(names, windows, *described, sums[0][held], sums[1][held], baseline[0][held])


def _skills(weights: AnyArray, pooled: Pool, steps: Sequence[int]) -> AnyFloats:
    """Return skill at ``steps`` and its mean, (draw, step + 1), each recording counted as ``weights`` (draw, it) state."""
    found = forecast.skill(
        weights @ pooled.at(pooled.squared, steps), weights @ pooled.at(pooled.baseline, steps)
    )  # (draw, step)
    return np.hstack([found, found.mean(axis=1, keepdims=True)])


def _predictors(method: Method) -> list[str]:
    """Return the baselines of a method's runs, in the order in which they come."""
    return list(dict.fromkeys(name for run in method.runs for name in run.errors.predictors if name != MODEL))


def _row(name: str, predictor: str, method: Method, steps: Sequence[int], known: bool | None) -> Row | None:
    """Return how a predictor does in the runs of a method; None where it has no errors in counts."""
    pooled = pool(method.runs, predictor, known=known)
    if pooled is None:
        return None
    each = [found for run in method.runs if (found := pool([run], predictor, known=known)) is not None]
    scores = [float(_skills(np.ones((1, len(one.recordings))), one, steps)[0, -1]) for one in each]
    standard = pool(method.runs, predictor, "standard", known)
    described = skill(standard, steps) if standard else None
    return Row(name, predictor, method, pooled, standard, skill(pooled, steps), spread(scores).sd, described)


def own(predictor: str) -> bool:
    """Return whether a predictor is a model's or a codec's own, and not a baseline that is the same for all of a split."""
    return not headlines.legitimate(predictor)


def best(found: Sequence[Row]) -> Row | None:
    """Return the best method among rows, those that were shown a wrong plan left out."""
    return next((row for row in found if row.predictor == MODEL and row.method.actions != "shuffled"), None)
