"""The tables in which methods are next to each other."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from tacpipe.metrics.forecast import Interval
from tacpipe.report import markup
from tacpipe.report.forward import comparison
from tacpipe.report.forward import methods as by_method
from tacpipe.report.forward.comparison import Pool, Row
from tacpipe.report.forward.error_sums import BASELINE, MODEL
from tacpipe.report.forward.methods import Method
from tacpipe.report.forward.sweep import Loss
from tacpipe.report.markup import NONE
from tacpipe.tasks.forward import units

PRINTED = {  # validation and test error in Table 1 of the paper
    "raw": (0.0484, 0.0552),
    "AE-C1": (0.0330, 0.0403),
    "AE-C2": (0.0351, 0.0453),
    "AE-C3": (0.0405, 0.0510),
    "PCA": (0.0298, 0.0363),
}
KNOWN = "test, known objects"
HEADS = ("representation", "validation", "test", KNOWN, "persistence, test", "test ÷ persistence")
OBJECTS = {None: "all recordings", True: "known objects", False: "unseen objects"}


def representations(methods: Sequence[Method], published: bool) -> str:
    """Return the recurrent model on each representation: Table 1 in the paper's form where the data are ``published``.

    Empty where no recurrent model was run and there is nothing printed to hold against.
    """
    found = [one for one in methods if one.recurrent and one.actions == "planned"]
    order = list(PRINTED)

    def place(method: Method) -> tuple[int, str, int, str]:
        row = by_method.paper_row(method.codec)
        rank = order.index(row) if row else len(order)
        return rank, str(method.codec["kind"]), int(method.codec["latents"]), method.name

    named = any(run.errors.named for method in found for run in method.runs)
    heads = [head for head in HEADS if named or head != KNOWN]
    rows = []
    for method in sorted(found, key=place):
        described = comparison.represented(method)
        if described is None:
            continue
        printed = PRINTED.get(by_method.paper_row(method.codec) or "") if published else None
        rows.append(
            [
                method.name.split(" · ", 1)[1],
                markup.with_sd(described.validation.mean, described.validation.sd),
                markup.with_sd(described.test.mean, described.test.sd),
                *(
                    [markup.with_sd(described.known.mean, described.known.sd) if described.known else NONE]
                    if named
                    else []
                ),
                markup.with_sd(described.persistence.mean, described.persistence.sd),
                f"{described.test.mean / described.persistence.mean:.3g}" if described.persistence.mean else NONE,
                *([f"{value:.4f}" for value in printed] if printed else [NONE, NONE] if published else []),
                str(len(method.runs)),
            ]
        )
    if not published:
        title = "Mean squared error in each representation's own space, mean ± sd over runs"
        return markup.table(title, [*heads, "runs"], rows) if rows else ""
    present = {by_method.paper_row(one.codec) for one in found}
    rows += [
        [name, *[NONE] * (len(heads) - 1), *(f"{value:.4f}" for value in PRINTED[name]), "0"]
        for name in order
        if name not in present
    ]
    heads += ["paper: validation", "paper: test", "runs"]
    return markup.table("Table 1 in the paper's form: mean squared error, mean ± sd over runs", heads, rows)


def comparable(found: Sequence[Row], steps: Sequence[int], known: bool | None) -> str:
    """Return every method and baseline with its errors and its skill, in the order of `comparison.rows`."""
    first, unit = comparison.best(found), units.common(row.method.config for row in found)
    rows, kinds = [], {}
    for index, row in enumerate(found):
        if row is first:
            kinds[index] = "best"
        elif not row.predictor.startswith(MODEL):
            kinds[index] = "quiet"
        rows.append(
            [
                row.name,
                _skills(row.skill)[-1],
                NONE if math.isnan(row.spread) else f"{row.spread:.3f}",
                _skills(row.standard_skill)[-1] if row.standard_skill else NONE,
                *(markup.number(value) for value in row.pool.at(row.pool.mae, steps)),
                markup.number(float(row.pool.mse.mean())),
                markup.number(float(row.standard.mse.mean())) if row.standard else NONE,
                *_skills(row.skill)[:-1],
                str(row.pool.runs),
                f"{len(row.pool.recordings):,}",
                f"{row.pool.distinct_windows:,}",
            ]
        )
    ahead = [f"t+{step}" for step in steps]
    heads = [
        "",
        "mean skill",
        "sd over runs",
        "mean skill (standardised)",
        *(f"MAE {step} ({unit})" for step in ahead),
        f"MSE ({unit}²)",
        "MSE (standardised)",
        *(f"skill {step}" for step in ahead),
        "runs",
        "recordings",
        "windows",
    ]
    return markup.table(f"Methods and baselines on {OBJECTS[known]}, the best first", heads, rows, kinds)


def channel_groups(chosen: Sequence[Row], steps: Sequence[int], known: bool | None) -> str:
    """Return errors and skill by sensor and axis of the chosen rows, and of persistence on the first one's windows."""
    groups = [
        name for name in chosen[0].method.runs[0].errors.groups if name not in ("both", "standard", "feature", "latent")
    ]
    rows = []
    for group in groups:
        for row in chosen:
            pooled = comparison.pool(row.method.runs, row.predictor, group, known)
            if pooled:
                described = _skills(comparison.skill(pooled, steps))
                rows.append([f"{group}, {row.name}", described[-1], *_mae(pooled, steps), *described[:-1]])
        still = comparison.pool(chosen[0].method.runs, BASELINE, group, known)
        if still:
            rows.append([f"{group}, {BASELINE}", NONE, *_mae(still, steps), *[NONE] * len(steps)])
    ahead = [f"t+{step}" for step in steps]
    unit = units.common(row.method.config for row in chosen)
    heads = ["", "mean skill", *(f"MAE {step} ({unit})" for step in ahead), *(f"skill {step}" for step in ahead)]
    return markup.table(f"By sensor and axis, {OBJECTS[known]}", heads, rows) if rows else ""


def actions(methods: Sequence[Method], steps: Sequence[int], parts: Sequence[bool | None]) -> str:
    """Return what the plan is worth: models that were given it, none, and a wrong one; empty where none was left out."""
    rows = []
    for family in _families(methods, "actions"):
        planned = next((one for one in family if one.actions == "planned"), None)
        for method in sorted(family, key=lambda one: by_method.ACTIONS.index(one.actions)):
            row = [method.name if method is planned else f"… {method.actions}" if planned else method.name]
            for known in parts:
                pooled = comparison.pool(method.runs, MODEL, known=known)
                row.append(_skills(comparison.skill(pooled, steps))[-1] if pooled else NONE)
                row += _lost(planned, method, steps, known)
            rows.append([*row, str(len(method.runs))])
    if not rows:
        return ""
    heads = [""]
    for known in parts:
        gained = f"{OBJECTS[known]}: the plan's gain"
        heads += [f"{OBJECTS[known]}: mean skill", f"{gained} in mean skill", f"{gained} at t+{steps[-1]}"]
    return markup.table("What the planned motion is worth", [*heads, "runs"], rows)


def timelines(methods: Sequence[Method], steps: Sequence[int], parts: Sequence[bool | None]) -> str:
    """Return the same methods on other timelines; empty where there is one alone."""
    rows = []
    for family in _families(methods, "timeline"):
        for method in sorted(family, key=lambda one: one.timeline):
            rate_hz = float(method.config.get("rate_hz") or 0)
            row = [method.name, f"{1000 / rate_hz:.0f}" if rate_hz else NONE]
            for known in parts:
                pooled = comparison.pool(method.runs, MODEL, known=known)
                row += [_skills(comparison.skill(pooled, steps))[-1], _mae(pooled, steps)[-1]] if pooled else [NONE] * 2
            rows.append([*row, str(len(method.runs))])
    if not rows:
        return ""
    heads, unit = ["", "a step (ms)"], units.common(one.config for one in methods)
    for known in parts:
        heads += [f"{OBJECTS[known]}: mean skill", f"{OBJECTS[known]}: MAE t+{steps[-1]} ({unit})"]
    return markup.table("Timelines: a step lasts differently, so rows cannot be compared", [*heads, "runs"], rows)


def anticipation(methods: Sequence[Method]) -> str:
    """Return how often and how early a method sees a change come; empty where no result states."""
    source = by_method.reference(methods)
    described = [(one.name, comparison.anticipation(one, MODEL)) for one in methods]
    names = sorted({name for run in source.runs for name in run.metrics.get("anticipation", {}) if name != MODEL})
    described += [(name, comparison.anticipation(source, name)) for name in names]
    measures = ("median_lead_rows", "median_lead_frames", "false_alarms_per_minute")
    rows = [
        [name, f"{found['events']:,.0f}", _plain(100 * found["recall"]), *(_plain(found[key]) for key in measures)]
        for name, found in sorted(described, key=lambda one: -one[1]["recall"] if one[1] else 0.0)
        if found
    ]
    if not rows:
        return ""
    heads = ["", "events", "seen coming (%)", "median lead (rows)", "median lead (frames)", "false alarms a minute"]
    return markup.table("Anticipation: changes that a forecast announces before they come", heads, rows)


def losses(found: Sequence[Loss]) -> str:
    """Return what each codec loses, by kind and width."""
    rows = [
        [
            one.series,
            str(one.latents),
            f"{one.mse_standardised:.4f}",
            markup.number(one.mae_counts),
            "held out" if one.part == "val" else "of the fit",
            str(one.codecs),
        ]
        for one in found
    ]
    heads = ["", "latents", "MSE (standardised)", "MAE (channels' unit)", "training recordings", "codecs"]
    return markup.table("What representations lose on the way to latents and back", heads, rows)


def _skills(found: Interval) -> list[str]:
    """Return the skill at each step, and its mean, with intervals."""
    return [
        markup.sure(float(mean), float(low), float(high))
        for mean, low, high in zip(found.mean, found.low, found.high, strict=True)
    ]


def _mae(pooled: Pool, steps: Sequence[int]) -> list[str]:
    return [markup.number(float(value)) for value in pooled.at(pooled.mae, steps)]


def _lost(planned: Method | None, other: Method, steps: Sequence[int], known: bool | None) -> list[str]:
    """Return by how much the plan raises the mean skill and that of the last step, over a model without it."""
    if planned is None or planned is other:
        return [NONE, NONE]
    one, two = (comparison.pool(method.runs, MODEL, known=known) for method in (planned, other))
    found = comparison.difference(one, two, steps) if one and two else None
    if found is None:
        return [NONE, NONE]
    described = _skills(found)
    return [described[-1], described[-2]]


def _families(methods: Sequence[Method], what: str) -> list[list[Method]]:
    """Return the methods that differ in ``what`` alone, where there are several such, in the order of names."""
    found: dict[str, list[Method]] = {}
    for method in methods:
        found.setdefault(method.key_without(what), []).append(method)
    return [family for family in found.values() if len(family) > 1]


def _plain(value: float) -> str:
    return NONE if math.isnan(value) else markup.number(value)


def settings(methods: Sequence[Method]) -> Mapping[str, str]:
    """Return the values that params of the schedule have among all results, in words."""
    found = {}
    for name in ("preset", "epochs", "stride", "hidden", "batch", "seed"):
        values = {run.config["params"].get(name) for method in methods for run in method.runs} - {None}
        if values:
            found[name] = ", ".join(str(value) for value in sorted(values, key=lambda value: (str(type(value)), value)))
    return found
