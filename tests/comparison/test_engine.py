"""Methods next to their baselines, held to numpy and scipy."""

import math

import numpy as np
import pytest
from scipy import stats

from tacpipe.comparison import engine
from tacpipe.comparison.runs import TaskResults, grouped, separate
from tacpipe.scores import intervals, pairing
from tests.comparison.comparison_fakes import MEAN, QUESTION, run, sums

RNG = np.random.default_rng(5)
BASE = RNG.gamma(4.0, 1.0, 20)
GOOD = BASE * RNG.uniform(0.5, 0.9, 20)


def compare(*runs: object) -> engine.Comparison:
    return engine.compare_on(TaskResults("weighing"), grouped(runs), QUESTION)  # type: ignore[arg-type]


def test_the_rows_are_the_methods_and_baselines_with_their_errors_the_best_first() -> None:
    comparison = compare(run({"model": GOOD, "still": BASE, "far": 3 * BASE}), run({"model": 2 * GOOD}, "wide"))
    assert [(row.name, row.kind) for row in comparison.rows] == [
        ("net", "model"), ("still", "baseline"), ("wide", "model"), ("far", "baseline")
    ]  # fmt: skip
    assert [row.values[0] for row in comparison.rows] == pytest.approx(
        [GOOD.mean(), BASE.mean(), 2 * GOOD.mean(), 3 * BASE.mean()]
    )
    best = comparison.best
    assert best is not None and best.baseline == "still"
    assert best.gain.mean == pytest.approx(1 - GOOD.mean() / BASE.mean())
    assert (best.n, best.recordings, best.runs, best.seeds) == (20, 20, 1, 1)
    wide = comparison.models[1]
    assert wide.baseline == "still"  # the clusters of the other method, because its own runs state none
    assert wide.gain.mean == pytest.approx(1 - 2 * GOOD.mean() / BASE.mean())


def test_the_interval_is_about_that_of_a_plain_bootstrap_over_recordings() -> None:
    best = compare(run({"model": GOOD, "still": BASE})).best
    assert best is not None
    rng = np.random.default_rng(17)
    drawn = []
    for _ in range(4000):
        at = rng.integers(0, 20, 20)
        drawn.append(1 - GOOD[at].sum() / BASE[at].sum())
    assert (best.gain.low, best.gain.high) == pytest.approx(np.quantile(drawn, [0.025, 0.975]), abs=0.02)


def test_clusters_are_left_out_as_one() -> None:
    clusters = {f"r{place:02d}": "abcd"[place % 4] for place in range(20)}
    best = compare(run({"model": GOOD, "still": BASE}, clusters=clusters)).best
    assert best is not None and best.n == 4
    parts = [
        math.log(np.delete(GOOD.reshape(5, 4), at, 1).sum() / np.delete(BASE.reshape(5, 4), at, 1).sum())
        for at in range(4)
    ]
    error = math.sqrt(3 / 4 * np.square(np.array(parts) - np.mean(parts)).sum())
    assert math.log((1 - best.gain.low) / (1 - best.gain.high)) == pytest.approx(2 * stats.t.ppf(0.975, 3) * error)


def test_seeds_and_folds_of_a_method_are_one_row_whose_spread_is_over_runs() -> None:
    seeds = [run({"model": GOOD * scale, "still": BASE}, seed=seed) for seed, scale in enumerate((0.9, 1.0, 1.3))]
    best = compare(*seeds).best
    assert best is not None and (best.runs, best.seeds, best.n) == (3, 3, 20)
    means = [GOOD.mean() * scale for scale in (0.9, 1.0, 1.3)]
    assert best.values[0] == pytest.approx(np.mean(means))
    assert best.spread == pytest.approx(np.std(means, ddof=1))
    single = compare(seeds[1]).best
    assert single is not None and math.isnan(single.spread)
    assert best.gain.high - best.gain.low > single.gain.high - single.gain.low  # seeds are drawn too


def test_a_method_that_shows_an_effect_does_not_compete() -> None:
    comparison = compare(run({"model": GOOD, "still": BASE}), run({"model": GOOD / 2}, "cheat", control=True))
    assert comparison.best is not None and comparison.best.name == "net"
    assert [row.name for row in comparison.of("control")] == ["cheat"]


def test_settings_that_differ_name_a_method_and_are_the_columns_of_a_frame() -> None:
    runs = [run({"model": GOOD * (1 + wide), "still": BASE}, settings={"wide": wide, "deep": 3}) for wide in (0, 1)]
    comparison = compare(*runs)
    assert [row.name for row in comparison.models] == ["net · wide 0", "net · wide 1"]
    frame = comparison.frame()
    assert frame.set_index("name").loc["net · wide 1", "wide"] == 1 and "deep" not in frame
    assert frame["kind"].tolist() == ["model", "baseline", "model"]


def test_separate_runs_are_rows_that_state_seed_and_fold() -> None:
    runs = [run({"model": GOOD}, seed=seed, fold=1) for seed in (3, 4)]
    assert [(method.name, dict(method.differing)) for method in separate(runs)] == [
        ("net · seed 3 · fold 1", {"seed": 3, "fold": 1}),
        ("net · seed 4 · fold 1", {"seed": 4, "fold": 1}),
    ]


def test_the_paired_test_is_scipys_permutation_test() -> None:
    for count in (8, 20):
        first_sums, second_sums = (np.array(list(sums(part[:count]).values())) for part in (GOOD, BASE * 0.8))
        test = stats.permutation_test(
            (first_sums[:, 0], second_sums[:, 0]),
            lambda a, b, axis: np.mean(a, axis=axis) - np.mean(b, axis=axis),
            permutation_type="samples", n_resamples=20_000, rng=3, vectorized=True,
        )  # fmt: skip
        assert pairing.swap_test(MEAN, first_sums, second_sums) == pytest.approx(
            test.pvalue, abs=0.01 if count > 12 else 1e-12
        )


def test_of_right_and_wrong_answers_the_paired_test_is_mcnemars() -> None:
    first, second = np.array([[1.0] * 11, [0.0] * 2 + [1.0] * 2 + [0.0] * 7])
    first_sums, second_sums = (np.column_stack([wrong, np.ones(11)]) for wrong in (first, second))
    assert pairing.swap_test(MEAN, first_sums, second_sums) == pytest.approx(intervals.mcnemar(first == 0, second == 0))
    assert math.isnan(pairing.swap_test(MEAN, first_sums[:1], second_sums[:1]))
    assert pairing.swap_test(MEAN, first_sums, first_sums) == 1.0


def test_the_difference_of_two_methods_is_on_the_recordings_of_both() -> None:
    first, second = grouped([run({"model": GOOD[:15]}, "a"), run({"model": BASE}, "b")])
    gain = engine.difference(first, second, QUESTION)
    assert gain.mean == pytest.approx(1 - GOOD[:15].sum() / BASE[:15].sum())
    assert gain.clusters == 15 and gain.low > 0
