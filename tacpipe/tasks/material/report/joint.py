"""What joint learning changes, in plain words and no more surely than the slides allow."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from tacpipe.comparison.runs import Method
from tacpipe.report.blocks import number, p_value, signed
from tacpipe.tasks.material.report import comparison, curves, wording
from tacpipe.tasks.material.report.accuracy import Accuracy, accuracy
from tacpipe.tasks.material.report.comparison import Difference
from tacpipe.tasks.material.report.methods import of, sensors_of, shown
from tacpipe.tasks.material.report.predictions import SWAPPED

ALIKE = 2.0  # latents of permuted pairs are as close as real ones up to this factor
APART = 0.2  # of accuracy: where exchanging classifiers costs more, there is no alignment to explain
LOSS = 0.05  # of accuracy, that exchanging classifiers may cost more than with real pairs
NO_CONTROL = (
    "No run with permuted materials is among the results, so whether labels alone drive the alignment was not tested."
)


def effects(methods: Sequence[Method]) -> list[str]:
    """Return what joint learning does, and what controls state of it."""
    main = comparison.main(methods)
    return (
        [*_joint(main, comparison.alone(methods, main)), control(main, comparison.permuted(methods, main))]
        if main
        else []
    )


def control(joint: Method, permuted: Method | None) -> str:
    """Return what training on pairs of permuted materials states of the alignment of real ones, as far as there is one."""
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
            if (found := accuracy(of(one, name), name))
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
        f"latent difference {number(apart[1]).text} against {number(apart[0]).text}; classifiers exchanged: "
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


def _joint(joint: Method, alone: Method | None) -> list[str]:
    """Return what learning jointly changes, a sentence a sensor."""
    if alone is None:
        return ["No independently trained RAEC is among the results, so what joint learning does was not tested."]
    described = []
    for sensor in sensors_of([joint]):
        found = comparison.difference(joint, alone, sensor)
        if found:
            verb = {
                "better": f"helps RAEC on {shown(sensor)}",
                "worse": f"hurts RAEC on {shown(sensor)}",
                "unclear": f"makes no difference to RAEC on {shown(sensor)} that these slides could show",
            }[found.word]
            described.append(f"Joint learning {verb}: {_difference(found)}.")
    return described


def _difference(found: Difference) -> str:
    tests = [f"McNemar p = {p_value(found.mcnemar).text}"]
    if not math.isnan(found.runs.p):
        tests.append(f"paired t over {found.runs.units} {found.runs.unit} p = {p_value(found.runs.p).text}")
    mean, low, high = (signed(one, 1) for one in (found.gain.mean, found.gain.low, found.gain.high))
    return (
        f"{mean} points (95 % interval {low} to {high}) on the same {found.slides} slides, {', '.join(tests)}"
    ).replace("= <", "<")


def _last_alignment(method: Method) -> float:
    """Return the latent difference after the last epoch, the mean over runs."""
    last = [curve[-1] for one in method.details if (curve := curves.aligned(one))]
    return float(np.mean(last)) if last else float("nan")


def _swapped(method: Method) -> dict[str, Accuracy]:
    described = {sensor: accuracy(of(method, sensor), sensor, SWAPPED) for sensor in sensors_of([method])}
    return {sensor: found for sensor, found in described.items() if found}
