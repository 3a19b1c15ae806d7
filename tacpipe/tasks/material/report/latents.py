"""Where two sensors' latents of the same material lie: together where they were aligned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.comparison.runs import Method
from tacpipe.report import charts
from tacpipe.report.blocks import Chart, Charts, Fold, Note, fold
from tacpipe.tasks.material.report import comparison
from tacpipe.tasks.material.report.methods import Result, ordered, shown
from tacpipe.tasks.material.report.predictions import Predictions

NOTE = (
    "Latents of unseen slides on their first two principal components, both sensors together: a colour is a material, whose "
    "name is at the mean of the first sensor's slides. A line leads from there to the mean of the other sensor's "
    "slides of the material that it was paired with, so short lines are what alignment makes. Where permuted pairs have "
    "lines as short, that sensors lie together is not evidence that they measure the same."
)


def folds(methods: Sequence[Method]) -> list[Fold]:
    """Return a chart each of a joint run, of the control and of two independent ones; nothing without joint latents."""
    main = comparison.main(methods)
    if main is None:
        return []
    chosen = main, comparison.permuted(methods, main), comparison.alone(methods, main)
    drawn = [found for one in chosen if one and (found := _chart(one))]
    return fold("Latents", Charts(drawn), Note(NOTE)) if drawn else []


def projected(parts: Sequence[AnyFloats]) -> list[AnyFloats]:
    """Return points of several sets, each (slide, latent), on the first two principal components of all, (slide, 2).

    Of the two directions of a component the one is taken in which its largest weight is positive.
    """
    stacked = np.vstack(parts)
    centre = stacked.mean(axis=0)
    axes = np.linalg.svd(stacked - centre, full_matrices=False)[2][:2]  # (component, latent)
    axes *= np.sign(axes[np.arange(len(axes)), np.abs(axes).argmax(axis=1)])[:, None]
    return [(part - centre) @ axes.T for part in parts]


def together(one: Predictions, other: Predictions, partners: Mapping[int, int]) -> tuple[int, int]:
    """Return of how many materials the nearest mean among the other's is that of its partner, and of how many.

    All latents count. ``partners`` has the other sensor's material of each; one that is not in it is its own.
    """
    own, others = np.unique(one.materials), np.unique(other.materials)
    means = [
        np.array([_latents(part)[part.materials == name].mean(axis=0) for name in names])
        for part, names in ((one, own), (other, others))
    ]
    apart = np.linalg.norm(means[0][:, None] - means[1][None], axis=2)  # (material, material of the other)
    wanted = [partners.get(int(name), int(name)) for name in own]
    found = [near == name for near, name in zip(others[apart.argmin(axis=1)], wanted, strict=True) if name in others]
    return int(sum(found)), len(found)


def _chart(method: Method) -> Chart | None:
    """Return the latents of one run of a method, or of one a sensor where each has its own model."""
    rows = _rows(method.details)
    if rows is None:
        return None
    sensors, parts = rows
    points = projected([_latents(part) for part in parts])
    partners = {int(one): int(other) for one, other in method.details[0].config.get("partners", {}).items()}
    same, of = together(parts[0], parts[1], partners)
    dots = [
        {"name": str(name), "x": float(x), "y": float(y), "shape": shown(sensor), "tip": str(recording)}
        for sensor, part, at in zip(sensors, parts, points, strict=True)
        for name, recording, (x, y) in zip(part.named(part.materials), part.recordings, at, strict=True)
    ]
    spec = charts.scatter(
        dots,
        "first principal component",
        "second principal component",
        shapes=[shown(sensor) for sensor in sensors],
        legend=False,
    )
    spec["layer"].append(charts.joined(_lines(points, parts, partners)))
    what = "the material that it was paired with" if partners else "the same material"
    caption = f"For {same} of {of} materials, the other sensor's nearest mean is {what}."
    return Chart(f"{method.name}: latents of both sensors", spec, caption)


def _lines(
    points: Sequence[AnyFloats], parts: Sequence[Predictions], partners: Mapping[int, int]
) -> list[tuple[str, AnyFloats, AnyFloats]]:
    """Return the name of each material, the mean of the first sensor's slides and of its partner's by the other."""
    means = [
        {int(one): at[part.materials == one].mean(axis=0) for one in np.unique(part.materials)}
        for at, part in zip(points, parts, strict=True)
    ]
    names = dict(zip(parts[0].materials.tolist(), parts[0].named(parts[0].materials).tolist(), strict=True))
    return [
        (str(names[one]), middle, means[1][partners.get(one, one)])
        for one, middle in means[0].items()
        if partners.get(one, one) in means[1]
    ]


def _rows(runs: Sequence[Result]) -> tuple[tuple[str, str], list[Predictions]] | None:
    """Return two sensors and the rows of each, of the first run that holds both, or else of the first of each."""
    held = [run for run in runs if run.predictions.latents is not None]
    sensors = ordered([sensor for run in held for sensor in run.sensors])[:2]
    if len(sensors) < 2:
        return None
    both = next((run for run in held if set(sensors) <= set(run.sensors)), None)
    chosen = [both or next(run for run in held if sensor in run.sensors) for sensor in sensors]
    parts = [run.predictions.of(sensor) for run, sensor in zip(chosen, sensors, strict=True)]
    if len({_latents(part).shape[1] for part in parts}) > 1:
        return None
    return (sensors[0], sensors[1]), parts


def _latents(part: Predictions) -> AnyFloats:
    assert part.latents is not None
    return part.latents
