"""Two methods on the same slides: by how much one names more of them right, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tacpipe.comparison import engine
from tacpipe.comparison.observations import PairedRuns, paired_runs
from tacpipe.comparison.runs import Method
from tacpipe.metrics.pairing import Gain
from tacpipe.metrics.proportions import mcnemar
from tacpipe.tasks.material.report import accuracy, reading
from tacpipe.tasks.material.report.methods import of, plain
from tacpipe.tasks.material.report.predictions import MODEL


@dataclass(frozen=True)
class Difference:
    """What the first method has over the second on the slides that both were evaluated on."""

    slides: int
    gain: Gain  # percentage points
    first_only: int  # slides that the first alone names right
    second_only: int
    mcnemar: float  # p
    runs: PairedRuns

    @property
    def word(self) -> str:
        """Whether the first is ``better`` or ``worse``, or that is ``unclear``."""
        return "better" if self.gain.low > 0 else "worse" if self.gain.high < 0 else "unclear"


@dataclass(frozen=True)
class Pair:
    """Two methods that a table compares."""

    name: str
    first: Method
    second: Method


def difference(
    first: Method, second: Method, sensor: str, predictors: tuple[str, str] = (MODEL, MODEL)
) -> Difference | None:
    """Return what ``first`` has over ``second`` on slides of a sensor; None where they share none.

    McNemar's test takes a slide for right where at least half of a method's runs name it right.
    """
    held = [of(one, sensor) for one in (first, second)]
    if not all(held) or (question := reading.question(held[0][0], sensor)) is None:
        return None
    gain = engine.difference(first, second, question, predictors)
    if not gain.clusters:
        return None
    one, other = (
        accuracy.right(runs, sensor, name).groupby("recording").mean() >= 0.5
        for runs, name in zip(held, predictors, strict=True)
    )
    one, other = one.align(other, join="inner")
    p = mcnemar(one.to_numpy(), other.to_numpy())
    only = int((one & ~other).sum()), int((other & ~one).sum())
    return Difference(gain.clusters, gain, *only, p, paired_runs(held[0], held[1], question, predictors))


def pairs(methods: Sequence[Method]) -> list[Pair]:
    """Return which methods a table compares: what is asked to help, against the same without it."""
    held = [one for one in methods if plain(one.settings)]
    found = []
    for joint in (one for one in held if one.family == "RAEC joint"):
        others = alone(methods, joint), permuted(methods, joint)
        found += [Pair(f"{joint.name} − {one.name}", joint, one) for one in others if one]
        found += [Pair(f"{one.name} − {joint.name}", one, joint) for one in held if one.family == "MiniRocket"]
    return found


def control(method: Method) -> bool:
    """Return whether a method is the negative control: trained jointly like others, its pairs of permuted materials."""
    settings = method.settings
    return method.family == "RAEC joint" and settings["pairing"] == "permuted" and plain(settings, "pairing")


def main(methods: Sequence[Method], family: str = "RAEC joint") -> Method | None:
    """Return the plain method of a family that represents it where one is given: that with most runs."""
    held = [one for one in methods if plain(one.settings) and one.family == family]
    return max(held, key=lambda one: len(one.runs), default=None)


def alone(methods: Sequence[Method], joint: Method) -> Method | None:
    """Return the network most like a joint one that learned from one sensor alone."""
    return nearest(joint, [one for one in methods if plain(one.settings) and one.family == "RAEC independent"])


def permuted(methods: Sequence[Method], joint: Method) -> Method | None:
    """Return the control that is most like a joint method."""
    return nearest(joint, [one for one in methods if control(one)])


def nearest(method: Method, others: Sequence[Method]) -> Method | None:
    """Return that of ``others`` that shares most settings with a method; of several the one with most runs."""

    def shared(other: Method) -> int:
        return sum(other.settings.get(name) == value for name, value in method.settings.items())

    return max(others, key=lambda other: (shared(other), len(other.runs), other.name), default=None)
