"""What came out, in plain words and no more surely than grasps and objects allow."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tacpipe.report import markup
from tacpipe.report.markup import listed
from tacpipe.report.touch import scores, wording
from tacpipe.report.touch.methods import DEFAULT, Group, Method
from tacpipe.touch_results import OBJECT_MEAN

NO_EVIDENCE = "no evidence of generalisation"


def sentences(groups: Sequence[Group]) -> list[str]:
    """Return what the default method does on known objects and on novel ones, and which is best, for each split."""
    told = []
    # splits on which variants of another network were compared, on one target, have their tables and no sentence
    first = [one for one in groups if one.default.architecture == DEFAULT or len(one.targets) > 1] or groups
    for group in first:
        where = f" ({wording.place(group.split, group.simulated)})" if len(groups) > 1 else ""
        told += [_known(group, where), _novel(group, where)]
    return [one.replace(" %", "\N{NO-BREAK SPACE}%") for one in told if one]


def beating(methods: Sequence[Method], target: str, known: bool) -> list[Method]:
    """Return the methods whose skill over the constant has an interval above 0."""
    found = [(one, scores.score(one.runs, target, known)) for one in methods]
    return [one for one, told in found if told and told.skill.low > 0]


def _known(group: Group, where: str) -> str:
    """Return skill on known objects, and which method is best where that is not the default."""
    skills = _skills(group.default, True)
    if not skills:
        return ""
    grasps = _counted(group.default, True)
    told = f"Known objects{where}: {group.default.name} has a skill over the constant of {skills}, judged on {grasps}."
    others = {}
    for target, name in wording.TARGETS.items():
        best = scores.best(group.methods, target, True)
        found = scores.score(best.runs, target, True) if best else None
        if best and found and best is not group.default:
            others[name] = f"{best.name} on {name} with {wording.skill_within(found)}"
    told += f" {_object_means(group)}"
    return (f"{told} Better there: {listed(list(others.values()))}." if others else told).rstrip()


def _novel(group: Group, where: str) -> str:
    """Return skill on novel objects, and whether there is evidence of any."""
    skills = _skills(group.default, False)
    tried = [one for one in group.methods if any(scores.score(one.runs, target, False) for target in one.targets)]
    judged = [target for target in wording.TARGETS if scores.best(tried, target, False)]
    if not judged:
        return ""
    told = f"Novel objects{where}: "
    if skills:
        told += f"{group.default.name} has a skill of {skills}, judged on {_counted(group.default, False)}. "
    evident = {target: found for target in judged if (found := beating(tried, target, False))}
    if not evident:
        alone = "It" if skills else tried[0].name
        none = f"None of {len(tried)} methods beats" if len(tried) > 1 else f"{alone} does not beat"
        return f"{told}{none} the constant with an interval above zero on any target: {NO_EVIDENCE}."
    ahead = [f"{listed([one.name for one in found])} on {wording.TARGETS[target]}" for target, found in evident.items()]
    told += f"With an interval above zero, the constant is beaten by {'; by '.join(ahead)}."
    rest = [wording.TARGETS[target] for target in judged if target not in evident]
    return f"{told} On {listed(rest)} nothing does: {NO_EVIDENCE}." if rest else told


def _object_means(group: Group) -> str:
    """Return the skill of the mean of each known object, which knows nothing of a grasp; empty where none tells it."""
    found = {}
    for target, name in wording.TARGETS.items():
        source = scores.reference(group.methods, target, OBJECT_MEAN)
        score = scores.score(source.runs, target, True, OBJECT_MEAN) if source else None
        if score and not math.isnan(score.skill.mean):
            found[name] = markup.decimals(score.skill.mean)
    means = listed([f"{skill} on {name}" for name, skill in found.items()])
    return f"The mean of the object alone, whatever the grasp, has {means}." if means else ""


def _skills(method: Method, known: bool) -> str:
    """Return a method's skill on each target with its interval."""
    found = {target: scores.score(method.runs, target, known) for target in method.targets}
    return listed([f"{wording.skill_within(one)} on {wording.TARGETS[name]}" for name, one in found.items() if one])


def _counted(method: Method, known: bool) -> str:
    """Return on how much a skill rests."""
    told = [one for target in method.targets if (one := scores.score(method.runs, target, known))]
    grasps, objects, runs = (max(getattr(one, name) for one in told) for name in ("grasps", "objects", "runs"))
    return (
        f"{grasps:,} grasps of {objects} object{'s' if objects > 1 else ''} in {runs} run{'s' if runs > 1 else ''} "
        f"(95 % intervals over {'grasps' if known else 'objects'})"
    )
