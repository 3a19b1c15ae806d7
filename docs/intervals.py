"""Simulate how often intervals hold the truth: ``python docs/intervals.py``, about five minutes on one core.

Draws recordings whose true skill is set, computes the interval of the gain with the program's own code, and counts how often
it holds the true gain, and how often the best of several equal methods is called better. Prints the tables of
``docs/explanation/intervals.md``. An argument is the number of repetitions.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import quad
from scipy.stats import t as student

from tacpipe.arrays import AnyFloats, Floats
from tacpipe.metrics import intervals, pairing
from tacpipe.metrics.headline import MIN_CLUSTERS
from tacpipe.metrics.intervals import wilson
from tacpipe.metrics.pairing import Measure
from tacpipe.tasks.forward import headline as forward
from tacpipe.tasks.touch import headline as touch

REPEATS, RESAMPLES = 1000, 500
SD = {"normal": 0.15, "heavy": 0.1}  # scale of the logarithm of a recording's ratio of errors
SIZES = {"normal": 0.5, "heavy": 1.2}  # standard deviation of the logarithm of a recording's error
FREEDOM, MOST = 3, 10  # degrees of freedom of Student's t that draws heavy tails, and the largest value
OBJECTS = (6, 6, 6, 6, 6, 6, 6, 5, 5)  # recordings of each: 52
OUTLINE = {"geometric": "geometric mean of ratios (`forward`)", "pooled": "ratio of pooled RMSE (`touch`)"}


@dataclass(frozen=True)
class Case:
    """How recordings are drawn."""

    measure: str  # of `OUTLINE`
    tails: str
    recordings: int
    seeds: int = 1
    folds: int = 0
    object_sd: float = -1.0  # of the logarithm of the ratio of an object; negative where objects are not distinguished

    @property
    def name(self) -> str:
        """The case in words."""
        parts = [f"{self.seeds} seeds" if self.seeds > 1 else "", f"{self.folds} folds" if self.folds else ""]
        if self.object_sd >= 0:
            parts.append(f"{len(OBJECTS)} objects {'that differ' if self.object_sd else 'that are alike'}")
        return ", ".join(filter(None, parts)) or "one seed"


@dataclass(frozen=True)
class Coverage:
    """How often intervals hold the truth."""

    case: Case
    verdicts: float  # share of repetitions with `MIN_CLUSTERS` effective clusters or more, which have a verdict
    coverage: float  # share of these whose interval holds the truth; NaN without any
    percentile: float  # the same of all repetitions by the percentile bootstrap over recordings, seeds drawn too
    studentized: float  # the same by the studentized bootstrap of the influence of clusters


CASES = (
    *(Case(measure, tails, n) for measure in OUTLINE for tails in SD for n in (6, 10, 20, 39)),
    *(Case("geometric", tails, n, seeds=3) for tails in SD for n in (6, 10, 20, 39)),
    *(Case("geometric", "normal", n, folds=5) for n in (10, 20, 39)),
    *(Case("geometric", tails, 52, object_sd=sd) for tails in SD for sd in (0.0, 0.15)),
)


def log_ratios(rng: np.random.Generator, tails: str, shape: tuple[int, ...]) -> Floats:
    """Return logarithms of ratios of errors, normal or with heavy tails."""
    drawn = rng.standard_normal(shape) if tails == "normal" else rng.standard_t(FREEDOM, shape)
    logs: Floats = SD[tails] * np.clip(drawn, -MOST, MOST)
    return logs


def true_gain(case: Case) -> float:
    """Return the gain of an endless number of recordings."""
    if case.measure == "geometric":
        return 0.0
    if case.tails == "normal":
        return float(1 - np.exp(SD["normal"] ** 2 / 4))
    tail = 2 * student.sf(MOST, FREEDOM) * np.cosh(SD["heavy"] * MOST)
    mean = tail + quad(lambda x: np.exp(SD["heavy"] * x) * student.pdf(x, FREEDOM), -MOST, MOST)[0]
    return float(1 - np.sqrt(mean))


def draw(
    rng: np.random.Generator, case: Case
) -> tuple[dict[Any, AnyFloats], dict[Any, AnyFloats], dict[str, str] | None]:
    """Return the sums of a model and of persistence by seed and recording, and the object of each recording."""
    n = case.recordings
    logs = log_ratios(rng, case.tails, (n,))[None] + np.zeros((case.seeds, 1))
    if case.seeds > 1:  # which differ by a third as much as recordings do, and as much on each recording
        logs = logs + SD["normal"] / 3 * (rng.standard_normal((case.seeds, 1)) + rng.standard_normal((case.seeds, n)))
    clusters = None
    if case.object_sd >= 0:
        which = np.repeat(np.arange(len(OBJECTS)), OBJECTS)
        logs = logs + case.object_sd * rng.standard_normal(len(OBJECTS))[which]
        clusters = {f"r{at:02d}": f"o{kind}" for at, kind in enumerate(which)}
    size, ratio = np.exp(SIZES[case.tails] * rng.standard_normal(n)), np.exp(logs)
    model, still = dict[Any, AnyFloats](), dict[Any, AnyFloats]()
    for seed in range(case.seeds):
        for at in range(n):
            key = (at % case.folds if case.folds else seed, f"r{at:02d}")  # each fold has a seed of its own
            base, error = np.array([size[at]]), np.array([size[at] * ratio[seed, at]])
            if case.measure == "geometric":
                model[key] = forward.sums((error**2, error), (base**2, base), 1.0)
                still[key] = forward.sums((base**2, base), (base**2, base), 1.0)
            else:
                model[key], still[key] = np.array([error[0], 1.0]), np.array([base[0], 1.0])
    return model, still, clusters


def measure_of(case: Case) -> Measure:
    """Return the measure of a task."""
    return forward.measure((1,)) if case.measure == "geometric" else touch.measure(100.0, "grasps")


def simulate(case: Case, repeats: int = REPEATS) -> Coverage:
    """Return how often the interval of a case holds the truth."""
    rng, measure, truth = np.random.default_rng(case.recordings), measure_of(case), true_gain(case)
    holds = np.zeros((repeats, 3), bool)  # the interval of the program, percentile and studentized bootstrap
    enough = np.zeros(repeats, bool)
    for repeat in range(repeats):
        model, still, clusters = draw(rng, case)
        pair = pairing.pair(measure, model, still, clusters)
        assert pair is not None
        gain = pairing.gain(measure, [pair])
        enough[repeat] = min(gain.clusters, round(gain.effective, 6)) >= MIN_CLUSTERS
        ends = (gain.low, gain.high), percentile(measure, model, still), studentized(pair)
        holds[repeat] = [low <= truth <= high for low, high in ends]
    coverage = float(holds[enough, 0].mean()) if enough.any() else float("nan")
    return Coverage(case, float(enough.mean()), coverage, *(float(share) for share in holds[:, 1:].mean(axis=0)))


def percentile(measure: Measure, model: Mapping[Any, AnyFloats], still: Mapping[Any, AnyFloats]) -> tuple[float, float]:
    """Return the middle 95 % of gains over resampled recordings and seeds."""
    seeds, names = sorted({seed for seed, _ in model}), sorted({name for _, name in model})
    width = len(next(iter(model.values())))
    sums = np.zeros((len(seeds), len(names), 2 * width))
    for (seed, name), one in model.items():
        sums[seeds.index(seed), names.index(name)] = np.concatenate([one, still[seed, name]])
    rng = np.random.default_rng(0)
    weights, drawn = (
        rng.multinomial(count, np.full(count, 1 / count), RESAMPLES) for count in (len(names), len(seeds))
    )
    totals = np.einsum("ds,sdp->dp", drawn.astype(float), np.stack([weights @ one for one in sums]))
    gains = measure.gain(measure.error(totals[:, :width]), measure.error(totals[:, width:]))
    low, high = np.nanquantile(gains, [0.025, 0.975])
    return float(low), float(high)


def studentized(pair: pairing.Pair) -> tuple[float, float]:
    """Return the ends of the studentized bootstrap of one seed, from how much each cluster moves the gain."""
    values = pair.jackknife.influence[:, 0] * (len(pair.names) - 1)
    count = len(values)
    weights = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), RESAMPLES)
    means = weights @ values / count
    spread = np.sqrt(np.maximum(weights @ values**2 / count - means**2, 1e-12) / (count - 1))
    low, high = np.quantile((means - values.mean()) / spread, [0.025, 0.975])
    error, mean = float(values.std() / np.sqrt(count - 1)), float(pair.jackknife.mean[0])
    return -float(np.expm1(high * error - mean)), -float(np.expm1(low * error - mean))


def called_better(methods: int, recordings: int, repeats: int = REPEATS) -> tuple[float, float]:
    """Return how often the best of equal methods is called better than a baseline that is equal too.

    The first share is by the interval of the best method alone, the second by the one that accounts for the choice.
    """
    rng, measure = np.random.default_rng(methods), forward.measure((1,))
    better = np.zeros((repeats, 2), bool)
    for repeat in range(repeats):
        base = log_ratios(rng, "normal", (recordings,))
        pairs = []
        for _ in range(methods):
            errors = np.exp(log_ratios(rng, "normal", (recordings,)))
            sums = [{(0, f"r{at}"): forward.sums(2 * (value[at : at + 1],), 2 * (np.ones(1),), 1.0)
                     for at in range(recordings)} for value in (errors, np.exp(base))]  # fmt: skip
            pairs += [one for one in [pairing.pair(measure, sums[0], sums[1])] if one]
        pairs.sort(key=lambda one: -float(one.jackknife.mean[0]))
        better[repeat] = [pairing.gain(measure, pairs[:1], rivals).low > 0 for rivals in ((), pairs[1:])]
    alone, chosen = better.mean(axis=0)
    return float(alone), float(chosen)


class HeldRates(NamedTuple):
    """How often intervals of a rate hold the truth; NaN where the program gives no interval."""

    same_materials: float  # Wilson over slides, of the rate on new slides of the same materials
    over_slides: float  # Wilson over slides, of the rate on new materials
    over_materials: float  # the interval over materials, of the rate on new materials


def rates(materials: int, slides: int = 16, repeats: int = REPEATS) -> HeldRates:
    """Return how often intervals over slides (Wilson) and over materials hold the rate where materials differ."""
    rng, truth = np.random.default_rng(materials), 0.2
    holds = np.zeros((repeats, 3), bool)
    whole = np.full((materials, 1), float(slides))
    for repeat in range(repeats):
        of_material = rng.beta(1.0, 4.0, materials)
        accepted = rng.binomial(slides, of_material)
        low, high = wilson(int(accepted.sum()), materials * slides)
        found = intervals.share_interval(accepted[:, None].astype(float), whole).first
        holds[repeat] = low <= of_material.mean() <= high, low <= truth <= high, found.low <= truth <= found.high
    same, over_slides, over_materials = (float(share) for share in holds.mean(axis=0))
    return HeldRates(same, over_slides, over_materials if materials >= MIN_CLUSTERS else float("nan"))


def lines(repeats: int = REPEATS) -> Iterator[str]:
    """Yield the lines of the tables."""
    yield "| measure | recordings | n | with a verdict | coverage | percentile bootstrap | studentized bootstrap |"
    yield "| --- | --- | --- | --- | --- | --- | --- |"
    for case in CASES:
        found = simulate(case, repeats)
        student_t = f"{found.studentized:.3f}" if case.seeds == 1 else ""
        yield (
            f"| {OUTLINE[case.measure]} | {case.tails} tails, {case.name} | {case.recordings} "
            f"| {100 * found.verdicts:.0f} % | "
            f"{'no verdict' if np.isnan(found.coverage) else f'{found.coverage:.3f}'} | "
            f"{found.percentile:.3f} | {student_t} |"
        )
    yield ""
    yield "| equal methods | n | best called better: its interval alone | with the choice |"
    yield "| --- | --- | --- | --- |"
    for methods in (1, 3, 6, 12):
        alone, chosen = called_better(methods, 20, repeats)
        yield f"| {methods} | 20 | {100 * alone:.1f} % | {100 * chosen:.1f} % |"
    yield ""
    yield "| materials, 16 slides each | same materials: Wilson over slides | new materials: Wilson | over materials |"
    yield "| --- | --- | --- | --- |"
    for materials in (4, 10, 20, 40):
        same, slides, by_material = rates(materials, repeats=repeats)
        shown = "no interval" if np.isnan(by_material) else f"{by_material:.3f}"
        yield f"| {materials} | {same:.3f} | {slides:.3f} | {shown} |"


if __name__ == "__main__":
    for line in lines(*map(int, sys.argv[1:2])):
        print(line, flush=True)
