"""Simulate the coverage of intervals: ``python docs/intervals.py``, about ten minutes on one core.

The script draws recordings with a given true skill and computes the interval of the gain with the code of tacpipe. It counts
how often the interval contains the true gain, and how often the best of several equal methods is called better. It prints
the tables of ``docs/benchmarks/intervals.md``. The optional argument is the number of repetitions.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import quad
from scipy.stats import beta
from scipy.stats import norm as normal
from scipy.stats import t as student

from tacpipe.arrays import AnyFloats, Floats, Int64s
from tacpipe.scores import intervals, pairing
from tacpipe.scores.headline import MIN_CLUSTERS
from tacpipe.scores.intervals import wilson
from tacpipe.scores.pairing import Measure
from tacpipe.scores.table import ScoreTable
from tacpipe.tasks.forward import headline as forward
from tacpipe.tasks.material import headline as material
from tacpipe.tasks.slip import metrics as slip
from tacpipe.tasks.slip.calibration import ScoredTrack
from tacpipe.tasks.slip.windows import BEFORE, STABLE
from tacpipe.tasks.touch import headline as touch

REPEATS, RESAMPLES = 1000, 500
SD = {"normal": 0.15, "heavy": 0.1}  # scale of the logarithm of a recording's ratio of errors
SIZES = {"normal": 0.5, "heavy": 1.2}  # standard deviation of the logarithm of a recording's error
DEGREES_OF_FREEDOM = 3  # parameter of Student's t for heavy tails
CLIP = 10  # largest absolute value of a draw
OBJECTS = (6, 6, 6, 6, 6, 6, 6, 5, 5)  # recordings per object, 52 in all
OUTLINE = {"geometric": "geometric mean of ratios (`forward`)", "pooled": "ratio of pooled RMSE (`touch`)"}


@dataclass(frozen=True)
class Case:
    """Distribution of the recordings."""

    measure: str  # a key of `OUTLINE`
    tails: str
    recordings: int
    seeds: int = 1
    folds: int = 0
    object_sd: float = -1.0  # standard deviation of objects' log ratios; negative if objects are not distinguished

    @property
    def name(self) -> str:
        """Description for the table."""
        parts = [f"{self.seeds} seeds" if self.seeds > 1 else "", f"{self.folds} folds" if self.folds else ""]
        if self.object_sd >= 0:
            parts.append(f"{len(OBJECTS)} objects {'that differ' if self.object_sd else 'that are alike'}")
        return ", ".join(filter(None, parts)) or "one seed"


@dataclass(frozen=True)
class Coverage:
    """Share of the intervals that contain the true gain."""

    case: Case
    verdicts: float  # share of repetitions with a verdict, which needs at least `MIN_CLUSTERS` effective clusters
    coverage: float  # share of the verdicts whose interval contains the true gain; NaN without verdicts
    percentile: float  # coverage of the percentile bootstrap over recordings and seeds, in all repetitions
    studentized: float  # coverage of the studentized bootstrap over the influence of clusters, in all repetitions


CASES = (
    *(Case(measure, tails, n) for measure in OUTLINE for tails in SD for n in (6, 10, 20, 39)),
    *(Case("geometric", tails, n, seeds=3) for tails in SD for n in (6, 10, 20, 39)),
    *(Case("geometric", "normal", n, folds=5) for n in (10, 20, 39)),
    *(Case("geometric", tails, 52, object_sd=sd) for tails in SD for sd in (0.0, 0.15)),
)


def log_ratios(rng: np.random.Generator, tails: str, shape: tuple[int, ...]) -> Floats:
    """Return logarithms of ratios of errors, normal or with heavy tails."""
    drawn = rng.standard_normal(shape) if tails == "normal" else rng.standard_t(DEGREES_OF_FREEDOM, shape)
    logs: Floats = SD[tails] * np.clip(drawn, -CLIP, CLIP)
    return logs


def true_gain(case: Case) -> float:
    """Return the gain in the limit of infinitely many recordings."""
    if case.measure == "geometric":
        return 0.0
    if case.tails == "normal":
        return float(1 - np.exp(SD["normal"] ** 2 / 4))
    tail = 2 * student.sf(CLIP, DEGREES_OF_FREEDOM) * np.cosh(SD["heavy"] * CLIP)
    mean = tail + quad(lambda x: np.exp(SD["heavy"] * x) * student.pdf(x, DEGREES_OF_FREEDOM), -CLIP, CLIP)[0]
    return float(1 - np.sqrt(mean))


def draw(
    rng: np.random.Generator, case: Case
) -> tuple[dict[Any, AnyFloats], dict[Any, AnyFloats], dict[str, str] | None]:
    """Return the sums of a model and of persistence by seed and recording, and the object of each recording."""
    n = case.recordings
    logs = log_ratios(rng, case.tails, (n,))[None] + np.zeros((case.seeds, 1))
    if case.seeds > 1:  # seeds differ a third as much as recordings, both overall and on each recording
        logs = logs + SD["normal"] / 3 * (rng.standard_normal((case.seeds, 1)) + rng.standard_normal((case.seeds, n)))
    clusters = None
    if case.object_sd >= 0:
        object_index = np.repeat(np.arange(len(OBJECTS)), OBJECTS)
        logs = logs + case.object_sd * rng.standard_normal(len(OBJECTS))[object_index]
        clusters = {f"r{recording:02d}": f"o{index}" for recording, index in enumerate(object_index)}
    size, ratio = np.exp(SIZES[case.tails] * rng.standard_normal(n)), np.exp(logs)
    model, persistence = dict[Any, AnyFloats](), dict[Any, AnyFloats]()
    for seed in range(case.seeds):
        for recording in range(n):
            run = recording % case.folds if case.folds else seed  # each fold has its own seed
            key = (run, f"r{recording:02d}")
            base, error = np.array([size[recording]]), np.array([size[recording] * ratio[seed, recording]])
            if case.measure == "geometric":
                model[key] = forward.sums((error**2, error), (base**2, base), 1.0)
                persistence[key] = forward.sums((base**2, base), (base**2, base), 1.0)
            else:
                model[key], persistence[key] = np.array([error[0], 1.0]), np.array([base[0], 1.0])
    return model, persistence, clusters


def task_measure(case: Case) -> Measure:
    """Return the measure of the task in a case."""
    return forward.measure((1,)) if case.measure == "geometric" else touch.measure(100.0, "grasps")


def simulate(case: Case, repeats: int = REPEATS) -> Coverage:
    """Return the coverage of the intervals in a case."""
    rng, measure, gain_truth = np.random.default_rng(case.recordings), task_measure(case), true_gain(case)
    covered = np.zeros((repeats, 3), bool)  # (repeat, method): tacpipe, percentile and studentized bootstrap
    has_verdict = np.zeros(repeats, bool)
    for repeat in range(repeats):
        model, persistence, clusters = draw(rng, case)
        pair = pairing.pair(measure, model, persistence, clusters)
        assert pair is not None
        gain = pairing.gain(measure, [pair])
        has_verdict[repeat] = min(gain.clusters, round(gain.effective, 6)) >= MIN_CLUSTERS
        ends = (gain.low, gain.high), percentile(measure, model, persistence), studentized(pair)
        covered[repeat] = [low <= gain_truth <= high for low, high in ends]
    coverage = float(covered[has_verdict, 0].mean()) if has_verdict.any() else float("nan")
    return Coverage(case, float(has_verdict.mean()), coverage, *map(float, covered[:, 1:].mean(axis=0)))


def percentile(
    measure: Measure, model: Mapping[Any, AnyFloats], persistence: Mapping[Any, AnyFloats]
) -> tuple[float, float]:
    """Return the middle 95 % of gains over resampled recordings and seeds."""
    seeds, names = sorted({seed for seed, _ in model}), sorted({name for _, name in model})
    width = len(next(iter(model.values())))
    sums = np.zeros((len(seeds), len(names), 2 * width))
    for (seed, name), errors in model.items():
        sums[seeds.index(seed), names.index(name)] = np.concatenate([errors, persistence[seed, name]])
    rng = np.random.default_rng(0)
    weights, seed_weights = (
        rng.multinomial(count, np.full(count, 1 / count), RESAMPLES) for count in (len(names), len(seeds))
    )
    totals = np.einsum("ds,sdp->dp", seed_weights.astype(float), np.stack([weights @ errors for errors in sums]))
    gains = measure.gain(measure.error(totals[:, :width]), measure.error(totals[:, width:]))
    low, high = np.nanquantile(gains, [0.025, 0.975])
    return float(low), float(high)


def studentized(pair: pairing.Pair) -> tuple[float, float]:
    """Return the interval of the studentized bootstrap for one seed, from each cluster's influence on the gain."""
    values = pair.jackknife.influence[:, 0] * (len(pair.names) - 1)
    count = len(values)
    weights = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), RESAMPLES)
    means = weights @ values / count
    spread = np.sqrt(np.maximum(weights @ values**2 / count - means**2, 1e-12) / (count - 1))
    low, high = np.quantile((means - values.mean()) / spread, [0.025, 0.975])
    error, mean = float(values.std() / np.sqrt(count - 1)), float(pair.jackknife.mean[0])
    return -float(np.expm1(high * error - mean)), -float(np.expm1(low * error - mean))


def called_better(methods: int, recordings: int, repeats: int = REPEATS) -> tuple[float, float]:
    """Return the share of verdicts "better" for the best of several methods that equal the baseline.

    The first share uses the interval of the best method only. The second one accounts for the choice of the best method.
    """
    rng, measure = np.random.default_rng(methods), forward.measure((1,))
    better = np.zeros((repeats, 2), bool)
    for repeat in range(repeats):
        base = log_ratios(rng, "normal", (recordings,))
        pairs = []
        for _ in range(methods):
            errors = np.exp(log_ratios(rng, "normal", (recordings,)))
            sums = [{(0, f"r{n}"): forward.sums(2 * (value[n : n + 1],), 2 * (np.ones(1),), 1.0)
                     for n in range(recordings)} for value in (errors, np.exp(base))]  # fmt: skip
            pairs += [pair for pair in [pairing.pair(measure, sums[0], sums[1])] if pair]
        pairs.sort(key=lambda pair: -float(pair.jackknife.mean[0]))
        better[repeat] = [pairing.gain(measure, pairs[:1], rivals).low > 0 for rivals in ((), pairs[1:])]
    single, corrected = better.mean(axis=0)
    return float(single), float(corrected)


class RateCoverage(NamedTuple):
    """Coverage of intervals of a rate; NaN if tacpipe returns no interval."""

    same_materials: float  # Wilson over slides, for new slides of the same materials
    over_slides: float  # Wilson over slides, for new materials
    over_materials: float  # interval over materials, for new materials


def rate_coverage(materials: int, slides: int = 16, repeats: int = REPEATS) -> RateCoverage:
    """Return the coverage of intervals over slides (Wilson) and over materials if the materials differ."""
    rng, mean_rate = np.random.default_rng(materials), 0.2
    covered = np.zeros((repeats, 3), bool)
    totals = np.full((materials, 1), float(slides))
    for repeat in range(repeats):
        material_rates = rng.beta(1.0, 4.0, materials)
        accepted = rng.binomial(slides, material_rates)
        low, high = wilson(int(accepted.sum()), materials * slides)
        estimate = intervals.share_interval(accepted[:, None].astype(float), totals).first
        covered[repeat] = (
            low <= material_rates.mean() <= high,
            low <= mean_rate <= high,
            estimate.low <= mean_rate <= estimate.high,
        )
    same, over_slides, over_materials = (float(share) for share in covered.mean(axis=0))
    return RateCoverage(same, over_slides, over_materials if materials >= MIN_CLUSTERS else float("nan"))


class AreaCoverage(NamedTuple):
    """Coverage of intervals over objects, of an area under the ROC curve and of the margin over a baseline."""

    area: float
    margin: float


@dataclass(frozen=True)
class ScoreModel:
    """Normal scores of windows: the sum of parts that objects, recordings and windows have, and the effect of a slip."""

    area: float  # in the limit of infinitely many objects
    object_sd: float = 1.0
    recording_sd: float = 0.5
    window_sd: float = 0.7
    effect_sd: float = 0.5  # standard deviation of the effect of a slip over objects

    @property
    def effect(self) -> float:
        """Mean effect of a slip: the difference of two scores of different objects is normal."""
        spread = 2 * (self.object_sd**2 + self.recording_sd**2 + self.window_sd**2) + self.effect_sd**2
        return float(normal.ppf(self.area) * np.sqrt(spread))


RECORDINGS, SLIP_SHARE, STABLE_ROWS, SLIP_ROWS = 5, 0.35, 10, 20  # per object, of the recordings, and per recording
BASELINE_AREA = 0.6


def draw_scores(rng: np.random.Generator, objects: int, models: Sequence[ScoreModel]) -> list[list[ScoredTrack]]:
    """Return the windows of each object with the scores of each model. The models share a part of each object's score."""
    tracks: list[list[ScoredTrack]] = [[] for _ in models]
    for number in range(objects):
        shared = rng.standard_normal()
        own = rng.standard_normal((len(models), 2))
        states: list[Int64s] = []
        scores: list[list[Floats]] = [[] for _ in models]
        for _ in range(1 + rng.poisson(RECORDINGS - 1)):
            state = BEFORE if rng.random() < SLIP_SHARE else STABLE
            states.append(np.array([STABLE] * STABLE_ROWS + [state] * SLIP_ROWS))
            for part, model, (level, effect) in zip(scores, models, own, strict=True):
                values = model.object_sd * (shared + level) / np.sqrt(2) + model.recording_sd * rng.standard_normal()
                values = values + model.window_sd * rng.standard_normal(len(states[-1]))
                part.append(values + (states[-1] == BEFORE) * (model.effect + model.effect_sd * effect))
        all_states = np.concatenate(states)
        t_ns, no_event = np.arange(len(all_states)) * 100_000_000, np.zeros((0, 2), np.int64)
        for tracks_of_model, values_of_object in zip(tracks, scores, strict=True):
            joined, weights = np.concatenate(values_of_object), np.ones(len(all_states))
            tracks_of_model.append(
                ScoredTrack(str(number), str(number), t_ns, all_states, joined, no_event, weights, t_ns / 1e9)
            )
    return tracks


def area_coverage(objects: int, area: float, repeats: int = REPEATS) -> AreaCoverage:
    """Return the coverage of intervals of areas and margins with some objects."""
    rng, models = np.random.default_rng(objects), (ScoreModel(area), ScoreModel(BASELINE_AREA))
    layout = slip.AreaLayout(map(str, range(objects)))
    measure, truths = layout.measure(), (area, area - BASELINE_AREA)
    covered = np.full((repeats, 2), np.nan)
    for repeat in range(repeats):
        model, baseline = (
            windows.sums("before", layout, np.zeros(len(windows.scores)))
            for windows in map(slip.WindowScores, draw_scores(rng, objects, models))
        )
        table = ScoreTable(measure, {"model": model, "baseline": baseline})
        estimates = table.score("model"), table.gain_over("baseline")
        for column, (estimate, truth) in enumerate(zip(estimates, truths, strict=True)):
            if np.isfinite(estimate.low):
                covered[repeat, column] = estimate.low <= truth <= estimate.high
    return AreaCoverage(*(float(share) for share in np.nanmean(covered, axis=0)))


class ShareCoverage(NamedTuple):
    """Coverage and mean width of intervals of a difference of two shares, in percentage points."""

    coverage: float
    width: float
    jackknife: float  # coverage of the jackknife alone


# probabilities that the model and the baseline are right, and the number of answers per cluster
SHARES = ((0.6, 0.5), (0.8, 0.6), (0.95, 0.9), (0.99, 0.98), (0.97, 0.97), (0.98, 0.2))
ANSWERS = (1, 16)


def share_coverage(clusters: int, shares: tuple[float, float], answers: int, repeats: int = REPEATS) -> ShareCoverage:
    """Return the coverage of the interval of a gain in points over slides, or over clusters of answers that differ.

    Whether the two are right is correlated (0.5). With several answers, the probabilities of a cluster are drawn from beta
    distributions.
    """
    rng, truth, measure = np.random.default_rng(clusters), 100 * (shares[0] - shares[1]), material.MEASURE
    found = np.zeros((repeats, 3))
    for repeat in range(repeats):
        first = rng.standard_normal(clusters)
        second = 0.5 * first + np.sqrt(0.75) * rng.standard_normal(clusters)
        ranks = normal.cdf(np.stack([first, second]))
        if answers == 1:
            right = (ranks < np.array(shares)[:, None]).astype(np.float64)
        else:
            right = rng.binomial(
                answers, [beta.ppf(rank, 5 * share, 5 * (1 - share)) for rank, share in zip(ranks, shares, strict=True)]
            )
        sums = [{(0, f"s{n}"): np.array([count, answers]) for n, count in enumerate(counts)} for counts in right]
        pair = pairing.pair(measure, sums[0], sums[1])
        assert pair is not None
        gain = pairing.gain(measure, [pair])
        differences = 100 * (right[0] - right[1]) / answers
        half_width = student.ppf(0.975, clusters - 1) * differences.std(ddof=1) / np.sqrt(clusters)
        found[repeat] = (
            gain.low <= truth <= gain.high,
            gain.high - gain.low,
            abs(differences.mean() - truth) <= half_width,
        )
    return ShareCoverage(*(float(mean) for mean in found.mean(axis=0)))


def lines(repeats: int = REPEATS) -> Iterator[str]:
    """Yield the lines of the tables."""
    yield "| measure | recordings | n | with a verdict | coverage | percentile bootstrap | studentized bootstrap |"
    yield "| --- | --- | --- | --- | --- | --- | --- |"
    for case in CASES:
        result = simulate(case, repeats)
        student_t = f"{result.studentized:.3f}" if case.seeds == 1 else ""
        yield (
            f"| {OUTLINE[case.measure]} | {case.tails} tails, {case.name} | {case.recordings} "
            f"| {100 * result.verdicts:.0f} % | "
            f"{'no verdict' if np.isnan(result.coverage) else f'{result.coverage:.3f}'} | "
            f"{result.percentile:.3f} | {student_t} |"
        )
    yield ""
    yield "| equal methods | n | best called better, from its own interval | with correction for the choice |"
    yield "| --- | --- | --- | --- |"
    for methods in (1, 3, 6, 12):
        single, corrected = called_better(methods, 20, repeats)
        yield f"| {methods} | 20 | {100 * single:.1f} % | {100 * corrected:.1f} % |"
    yield ""
    yield "| materials, 16 slides each | same materials: Wilson over slides | new materials: Wilson | over materials |"
    yield "| --- | --- | --- | --- |"
    for materials in (4, 10, 20, 40):
        same, slides, by_material = rate_coverage(materials, repeats=repeats)
        cell = "no interval" if np.isnan(by_material) else f"{by_material:.3f}"
        yield f"| {materials} | {same:.3f} | {slides:.3f} | {cell} |"
    yield ""
    yield "| clusters | answers each | right: model, baseline | coverage | mean width (points) | jackknife alone |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for answers in ANSWERS:
        for clusters in (6, 10, 18, 40, 100):
            for pair in SHARES:
                coverage, width, jackknife = share_coverage(clusters, pair, answers, repeats)
                shares_text = f"{pair[0]:g}, {pair[1]:g}"
                yield f"| {clusters} | {answers} | {shares_text} | {coverage:.3f} | {width:.1f} | {jackknife:.3f} |"
    yield ""
    yield "| objects | area under the curve | coverage | of the margin over a baseline |"
    yield "| --- | --- | --- | --- |"
    for objects in (6, 10, 26, 41):
        for area in (0.55, 0.72, 0.86, 0.97):
            shares = area_coverage(objects, area, repeats)
            yield f"| {objects} | {area:.2f} | " + " | ".join(f"{share:.3f}" for share in shares) + " |"


if __name__ == "__main__":
    for line in lines(*map(int, sys.argv[1:2])):
        print(line, flush=True)
