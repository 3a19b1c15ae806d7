"""What came out, in plain words and no more surely than grasps and objects allow."""

from __future__ import annotations

from collections.abc import Sequence

from tacpipe.metrics import headline as headline_of
from tacpipe.metrics.headline import BETTER, UNCLEAR, WORSE, Headline
from tacpipe.report.markup import listed
from tacpipe.report.touch import scores, wording
from tacpipe.report.touch.methods import DEFAULT, Group, Method

NO_EVIDENCE = "no evidence of generalisation"
VERDICTS = {
    BETTER: "is better than the best baseline on",
    UNCLEAR: "does not differ measurably from the best baseline on",
    WORSE: "is worse than the best baseline on",
    headline_of.NO_VERDICT: "was evaluated on too few {cluster} for an interval on",
}


def headlines(groups: Sequence[Group]) -> list[Headline]:
    """Return how the default method compares with its baselines on each target, of the first split that has any."""
    for group in groups:
        found = [one for known in (True, False) for one in _compared(group, known)]
        if found:
            return found
    return []


def sentences(groups: Sequence[Group]) -> list[tuple[str, str]]:
    """Return how the default method does on known objects and on novel ones, for each split, with the verdict of each."""
    described = []
    # splits on which variants of another network were compared, on one target, have their tables and no sentence
    first = [one for one in groups if one.default.architecture == DEFAULT or len(one.targets) > 1] or groups
    for group in first:
        where = f" ({wording.place(group.split, group.simulated)})" if len(groups) > 1 else ""
        described += [_known(group, where), _novel(group, where)]
    return [one for one in described if one[0]]


def beating(methods: Sequence[Method], target: str, known: bool) -> list[Method]:
    """Return the methods whose gain over their best baseline has an interval above 0."""
    return [
        one for one in methods if (described := scores.headline(one, target, known)) and described.verdict == BETTER
    ]


def _known(group: Group, where: str) -> tuple[str, str]:
    """Return how the default does on known objects, and which method is best where that is not the default."""
    found = _compared(group, True)
    if not found:
        return "", ""
    described = f"Known objects{where}: {_against(group.default, found)}."
    others = {}
    for target, name in wording.TARGETS.items():
        best = scores.best(group.methods, target, True)
        if best and best is not group.default:
            others[name] = f"{best.name} on {name}"
    if others:
        described += f" Other methods have a lower error there: {listed(list(others.values()))}."
    return described, headline_of.verdict(found)


def _novel(group: Group, where: str) -> tuple[str, str]:
    """Return how the default does on novel objects, and whether any method is better than its baselines there."""
    found = _compared(group, False)
    tried = [one for one in group.methods if any(scores.score(one.runs, target, False) for target in one.targets)]
    targets = [target for target in wording.TARGETS if scores.best(tried, target, False)]
    if not targets:
        return "", ""
    described = f"Novel objects{where}: "
    if found and group.default in tried:
        described += f"{_against(group.default, found)}. "
    evident = {target: better for target in targets if (better := beating(tried, target, False))}
    verdict = headline_of.verdict(found)
    if not evident:
        none = f"None of the {len(tried)} methods is" if len(tried) > 1 else f"{tried[0].name} is not"
        described += f"{none} better than the best baseline with an interval above zero on any target: {NO_EVIDENCE}."
        return described, verdict
    ahead = [
        f"{listed([one.name for one in better])} on {wording.TARGETS[target]}" for target, better in evident.items()
    ]
    described += f"Better than the best baseline, with an interval above zero: {'; '.join(ahead)}."
    rest = [wording.TARGETS[target] for target in targets if target not in evident]
    return (f"{described} On {listed(rest)}, none: {NO_EVIDENCE}." if rest else described), verdict


def _compared(group: Group, known: bool) -> list[Headline]:
    """Return how the default method compares with its baselines on each target."""
    method = group.default
    found = (scores.headline(method, target, known) for target in method.targets)
    return [one for one in found if one is not None]


def _against(method: Method, found: Sequence[Headline]) -> str:
    """Return on which targets a method is better than its baselines, on which it is not, and what that rests on."""
    if not any(one.best for one in found):
        return f"{method.name} was evaluated without a baseline"
    parts = []
    for verdict, words in VERDICTS.items():
        alike = [f"{one.target} ({_gain(one)})" for one in found if one.verdict == verdict]
        if alike:
            parts.append(f"{words.format(cluster=found[0].cluster)} {listed(alike)}")
    return f"{method.name} {'; '.join(parts)}; {_counted(method, found[0].part == wording.OBJECTS[True])}"


def _gain(one: Headline) -> str:
    """Return the gain on one target: "skill +0.2, 0.1 to 0.3, over constant"."""
    best = one.best
    assert best is not None  # every result that has one baseline has it on all targets
    interval = f", {headline_of.bounds(one)}" if one.verdict else ""
    return f"{headline_of.amount(one)}{interval}, over {best.name}"


def _counted(method: Method, known: bool) -> str:
    """Return on how much a comparison rests."""
    described = [one for target in method.targets if (one := scores.score(method.runs, target, known))]
    grasps, objects, runs = (max(getattr(one, name) for one in described) for name in ("grasps", "objects", "runs"))
    return (
        f"{headline_of.counted(grasps, 'grasps')} of {headline_of.counted(objects, 'objects')} in "
        f"{headline_of.counted(runs, 'runs')} (95 % intervals over {'grasps' if known else 'objects'})"
    )
