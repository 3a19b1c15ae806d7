"""What came out, in plain words and no more surely than the slides allow."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from tacpipe.metrics.headline import Headline, clause
from tacpipe.report import markup
from tacpipe.report.material import comparison, curves, tables, wording, zero_shot
from tacpipe.report.material.accuracy import Accuracy, accuracy, named_right
from tacpipe.report.material.comparison import Difference
from tacpipe.report.material.methods import Method, shown
from tacpipe.report.material.predictions import SWAPPED
from tacpipe.tasks.material import headline as headlines_of

ALIKE = 2.0  # latents of permuted pairs are as close as real ones up to this factor
APART = 0.2  # of accuracy: where exchanging classifiers costs more, there is no alignment to explain
LOSS = 0.05  # of accuracy, that exchanging classifiers may cost more than with real pairs
NO_CONTROL = (
    "No run with permuted materials is among the results, so whether labels alone drive the alignment was not tested."
)


def headlines(methods: Sequence[Method]) -> list[Headline]:
    """Return how the best method of each sensor compares with its baselines."""
    plain = [one for one in methods if one.plain]
    found = (_headline(plain, sensor) for sensor in tables.sensors_of(plain))
    return [one for one in found if one is not None]


def sentences(methods: Sequence[Method]) -> list[tuple[str, str]]:
    """Return the best method of each sensor with its verdict, what joint learning does, and what controls state.

    Only the first are about baselines, so the others have no verdict.
    """
    plain = [one for one in methods if one.plain]
    found = [_best(plain, sensor) for sensor in tables.sensors_of(plain)]
    described = []
    main = comparison.main(plain)
    if main:
        described += _joint(main, [one for one in plain if one.kind == "RAEC independent"])
        described.append(control(main, [one for one in methods if comparison.control(one)]))
    described += zero_shot.sentences(methods)
    return [
        *(one for one in found if one[0]),
        *((" ".join(described), "") for described in [list(filter(None, described))] if described),
    ]


def control(joint: Method, controls: Sequence[Method]) -> str:
    """Return what training on pairs of permuted materials states of the alignment of real ones, as far as there is one."""
    permuted = comparison.nearest(joint, controls)
    if permuted is None:
        return NO_CONTROL
    apart = [_last_alignment(one) for one in (joint, permuted)]
    swaps = [_swapped(one) for one in (joint, permuted)]
    if any(math.isnan(one) for one in apart) or not swaps[0] or set(swaps[0]) - set(swaps[1]):
        return "A run with permuted materials is there, but no latent difference or exchanged classifier to evaluate it by."
    costs = [
        {
            name: found.fraction - swaps[at][name].fraction
            for name in swaps[0]
            if (found := accuracy(one.of(name), name))
        }
        for at, one in enumerate((joint, permuted))
    ]
    if max(costs[0].values()) > APART:
        return (
            f"Even real pairs have not aligned: exchanged classifiers name {100 * max(costs[0].values()):.1f} points "
            f"fewer slides right than the sensors' own, so the control has nothing to be compared with."
        )
    aligns = apart[1] <= ALIKE * apart[0]
    works = all(costs[1][sensor] - costs[0][sensor] <= LOSS for sensor in costs[0])
    numbers = (
        f"latent difference {markup.number(apart[1])} against {markup.number(apart[0])}; classifiers exchanged: "
        + ", ".join(
            f"{shown(sensor)} {wording.percent(swaps[1][sensor].fraction)} % against {wording.percent(one.fraction)} %"
            for sensor, one in swaps[0].items()
        )
    )
    if aligns and works:
        return (
            f"The alignment is label-driven: pairs of permuted materials align as well, and exchanging classifiers costs "
            f"about as little ({numbers}), so neither shows that the sensors share anything but labels."
        )
    half = "align as well but do not swap as well" if aligns else "swap as well but do not align as well"
    verdict = half if aligns or works else "neither align nor swap as well"
    return f"Pairs of permuted materials {verdict} as real ones ({numbers})."


def _best(methods: Sequence[Method], sensor: str) -> tuple[str, str]:
    """Return which method names most slides of a sensor right, how that compares with the best baseline, and the verdict."""
    method = tables.leader(methods, sensor)
    if method is None:
        return "", ""
    found, compared = accuracy(method.of(sensor), sensor), _headline(methods, sensor)
    assert found is not None and compared is not None  # the leader was evaluated
    several = len([one for one in methods if one.of(sensor)]) > 1
    best = "is the best method and " if several else ""
    described = (
        f"{shown(sensor)}: {method.name} {best}names {_fraction(found)} of unseen slides right; it {clause(compared)}."
    )
    return described, compared.verdict


def _headline(methods: Sequence[Method], sensor: str) -> Headline | None:
    """Return how the best method on a sensor compares with its baselines."""
    method = tables.leader(methods, sensor)
    if method is None:
        return None
    runs = method.of(sensor)
    right: dict[str, dict[tuple[object, str], tuple[int, int]]] = {}
    for run in runs:
        for predictor in run.predictions.predicted:
            for name, one in named_right(run, sensor, predictor).items():
                key = run.params.get("seed"), name
                times, asked = right.setdefault(predictor, {}).get(key, (0, 0))
                right[predictor][key] = times + one, asked + 1
    classes = len(runs[0].config.get("classes", ()))
    return headlines_of.headline(method.name, shown(sensor), right, classes, runs=len(runs))


def _joint(joint: Method, others: Sequence[Method]) -> list[str]:
    """Return what learning jointly changes, a sentence a sensor."""
    alone = comparison.nearest(joint, others)
    if alone is None:
        return ["No independently trained RAEC is among the results, so what joint learning does was not tested."]
    described = []
    for sensor in joint.sensors:
        found = comparison.difference(joint.of(sensor), alone.of(sensor), sensor)
        if found:
            verb = {
                "better": f"helps RAEC on {shown(sensor)}",
                "worse": f"hurts RAEC on {shown(sensor)}",
                "unclear": f"makes no difference to RAEC on {shown(sensor)} that these slides could show",
            }[found.word]
            described.append(f"Joint learning {verb}: {_difference(found)}.")
    return described


def _difference(found: Difference) -> str:
    tests = [f"McNemar p = {wording.p_value(found.mcnemar)}"]
    if not math.isnan(found.paired):
        tests.append(f"paired t over {found.units} {found.unit} p = {wording.p_value(found.paired)}")
    return (
        f"{wording.points(found.mean)} points (95 % interval {wording.points(found.low)} to {wording.points(found.high)}) "
        f"on the same {found.slides} slides, {', '.join(tests)}".replace("= <", "<")
    )


def _fraction(found: Accuracy) -> str:
    runs = f" in {found.runs} runs" if found.runs > 1 else ""
    return (
        f"{wording.percent(found.fraction)} % ({found.correct} of {found.evaluated}{runs}; 95 % interval "
        f"{wording.percent(found.low)} to {wording.percent(found.high)} %)"
    )


def _last_alignment(method: Method) -> float:
    """Return the latent difference after the last epoch, the mean over runs."""
    last = [curve[-1] for run in method.runs if (curve := curves.aligned(run))]
    return float(np.mean(last)) if last else float("nan")


def _swapped(method: Method) -> dict[str, Accuracy]:
    described = {sensor: accuracy(method.of(sensor), sensor, SWAPPED) for sensor in method.sensors}
    return {sensor: found for sensor, found in described.items() if found}
