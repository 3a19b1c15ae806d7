"""Write how a model compares with its best baseline: as a sentence, as cells of tables, and as the legend of a table.

This module imports neither numpy nor any other package that slows a cache hit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from tacpipe.printable import format_count, listed
from tacpipe.scores.headline import BETTER, MIN_CLUSTERS, NO_VERDICT, UNCLEAR, WORSE, Headline, weakest

NONE = "–"
GAINS = {"skill": "less error", "points": "points more", "area": "area gained"}  # heads of columns
VERDICTS = {
    BETTER: "better",
    WORSE: "worse",
    UNCLEAR: "no measurable difference",
    NO_VERDICT: "not proven",
}
AGAINST = {  # verdicts about several targets
    BETTER: "better than the best baseline on",
    UNCLEAR: "not measurably different from the best baseline on",
    WORSE: "worse than the best baseline on",
    NO_VERDICT: "without a verdict on",
}
PROMISING = "promising, not proven, on"
CELLS = {**VERDICTS, UNCLEAR: "unclear"}  # verdicts in cells of tables
SKILL_OVER = "vs "  # column "vs X" contains 1 − error / error of X


def sentence(headline: Headline) -> str:
    """Return the comparison with the best baseline as a sentence, as certain as the interval allows."""
    return f"{capitalize(headline.where)}: {headline.method} {clause(headline)}."


def summary(headlines: Sequence[Headline]) -> list[str]:
    """Return a sentence for each headline, or for more than three how many have each verdict and the weakest of them."""
    if len(headlines) <= 3:
        return [sentence(headline) for headline in headlines]
    counts = {
        verdict: sum(headline.verdict == verdict for headline in headlines)
        for verdict in (BETTER, UNCLEAR, WORSE, NO_VERDICT)
    }
    text = ", ".join(f"{count} {VERDICTS[verdict]}" for verdict, count in counts.items() if count)
    return [f"{len(headlines)} comparisons with the best baseline: {text}. The weakest:", sentence(weakest(headlines))]


def clause(headline: Headline) -> str:
    """Return the predicate of the method in a sentence.

    For example "has 34.5 % less error than ridge, the best of 3 baselines, on 4 recordings: promising, not proven (6
    recordings are needed)".
    """
    count = format_count(headline.clusters, headline.cluster)
    best = headline.best
    if best is None:
        return f"was evaluated without a baseline, on {count}"
    name = best.name.replace("_", " ")
    among = f", the best of {len(headline.baselines)} baselines," if len(headline.baselines) > 1 else ""
    if math.isnan(headline.gain):
        return f"cannot be compared with {name}{among} on {count}"
    gain = format_amount(headline.gain, headline.measure)
    if gain.startswith(("0.0 ", "0.000 ")):
        verbs = {"skill": "has the same error as", "points": "is right as often as", "area": "has the same area as"}
    else:
        verbs = {
            "skill": f"has {gain} error than",
            "points": f"is right {gain} often than",
            "area": f"has {gain} area than",
        }
    return f"{verbs[headline.measure]} {name}{among} on {count}: {judgement(headline)}"


def clause_of_targets(headlines: Sequence[Headline]) -> str:
    """Return the predicate of the method for all targets of a part: that of `clause`, or the targets of each verdict."""
    if len(headlines) == 1:
        return clause(headlines[0])
    targets: dict[str, list[str]] = {}
    for headline in headlines:
        is_promising = headline.verdict == NO_VERDICT and headline.gain > 0
        targets.setdefault(PROMISING if is_promising else AGAINST[headline.verdict], []).append(headline.target)
    parts = []
    for verdict in (*AGAINST.values(), PROMISING):
        if verdict in targets:
            is_all = len(targets[verdict]) == len(headlines)
            parts.append(f"{verdict} {f'all {len(headlines)} targets' if is_all else listed(targets[verdict])}")
    unproven = next((headline for headline in headlines if headline.verdict == NO_VERDICT), None)
    why = f"; {_explain_no_verdict(unproven)}" if unproven else ""
    return f"is {' and '.join(parts)} ({format_count(headlines[0].clusters, headlines[0].cluster)}{why})"


def judgement(headline: Headline) -> str:
    """Return the verdict with its interval, or why there is none."""
    if headline.verdict == NO_VERDICT:
        promising = "promising, not proven" if headline.gain > 0 else "no verdict"
        return f"{promising} ({_explain_no_verdict(headline)})"
    ends = [format_amount(end, headline.measure) for end in (headline.low, headline.high)]
    if ends[0].split()[-1] == ends[1].split()[-1]:  # "5.0 to 18.1 % less", but "3.1 % more to 18.1 % less"
        ends[0] = ends[0].split()[0]
    seeds = f", {headline.seeds} seeds" if headline.seeds > 1 else ""
    methods = f", as the best of {headline.methods} methods" if headline.methods > 1 else ""
    return f"{VERDICTS[headline.verdict]} (95 % interval: {' to '.join(ends)}{seeds}{methods})"


def _explain_no_verdict(headline: Headline) -> str:
    """Return why there is no verdict, as a clause."""
    if headline.clusters < MIN_CLUSTERS:
        return f"{MIN_CLUSTERS} {headline.cluster} are needed"
    if round(headline.effective, 6) < MIN_CLUSTERS:
        count = format_count(headline.clusters, headline.cluster)
        return f"{count} count as {headline.effective:.1f} equal ones, and {MIN_CLUSTERS} are needed"
    return "there is no interval"


def format_amount(gain: float, measure: str) -> str:
    """Return a gain in words, "not defined" for NaN.

    >>> format_amount(0.345, "skill"), format_amount(-3.5, "points"), format_amount(0.119, "area")
    ('34.5 % less', '3.5 points less', '0.119 more')
    """
    if math.isnan(gain):
        return "not defined"
    amount = format_gain(abs(gain), measure).removeprefix("+")
    is_more = (gain < 0) == (measure == "skill")
    return f"{amount}{' points' if measure == 'points' else ''} {'more' if is_more else 'less'}"


def bounds(headline: Headline) -> str:
    """Return the interval of the gain as text; empty if undefined."""
    return format_interval(headline.low, headline.high, headline.measure)


def format_interval(low: float, high: float, measure: str) -> str:
    """Return an interval of a gain as text; empty if undefined."""
    if math.isnan(low):
        return ""
    return f"{format_gain(low, measure).removesuffix(' %')} to {format_gain(high, measure)}"


def format_gain(value: float, measure: str = "skill") -> str:
    """Return a gain with its sign, "not defined" for NaN; ``measure`` is skill, points or area. A skill is in percent."""
    if math.isnan(value):
        return "not defined"
    scaled = 100 * value if measure == "skill" else value
    digits = 3 if measure == "area" else 1 if abs(scaled) < 1000 else 0
    return f"{round(scaled, digits) + 0.0:+,.{digits}f}{' %' if measure == 'skill' else ''}".replace("-", "−")


def format_column(column: str) -> str:
    """Return the head of a column of errors.

    >>> format_column("vs persistence"), format_column("squared vs persistence"), format_column("RMSE")
    ('less error than persistence', 'less squared error than persistence', 'RMSE')
    """
    kind, is_skill, baseline = column.rpartition(SKILL_OVER)
    return f"less {kind}error than {baseline}" if is_skill else column


def heads(columns: Sequence[str], measure: str) -> list[str]:
    """Return the heads of columns of errors and of the gain on a terminal, where long ones have two lines."""
    return [*(format_column(column).replace(" than ", "\nthan ") for column in columns), GAINS[measure]]


def format_value(column: str, value: float) -> str:
    """Return the cell of a column of errors: a skill in percent, other values with four digits."""
    if math.isnan(value):
        return NONE
    return format_gain(value).removeprefix("+") if SKILL_OVER in column else number(value)


def number(value: float) -> str:
    """Format an error with four digits."""
    if math.isnan(value):
        return NONE
    return (f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}").replace("-", "−")


def table(headlines: Sequence[Headline]) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of a table of headlines, which must have the same columns.

    Each headline has a row for the model, one for its best baseline, and one for each other baseline of the table.
    """
    if not headlines:
        return [], []
    first = headlines[0]
    heads = ["", "", *map(format_column, first.columns), GAINS[first.measure], "95 % interval", "n"]
    rows = []
    for headline in headlines:
        best = headline.best
        gain_cells = [format_gain(headline.gain, headline.measure) if best else NONE, bounds(headline) or NONE]
        n = format_count(headline.clusters, headline.cluster) + (
            f", {headline.seeds} seeds" if headline.seeds > 1 else ""
        )
        rows.append([headline.where, headline.method, *cells(first.columns, headline.model.values), *gain_cells, n])
        if best:
            verdict = CELLS[headline.verdict]
            rows.append(
                ["", f"than the best baseline: {best.name}", *cells(first.columns, best.values), "", verdict, ""]
            )
            rows += [
                ["", row.name, *cells(first.columns, row.values), "", "", ""]
                for row in headline.table_baselines
                if row is not best
            ]
    return heads, rows


def cells(columns: Sequence[str], values: Sequence[float]) -> list[str]:
    """Return the cells of a row of errors."""
    return [format_value(column, value) for column, value in zip(columns, values, strict=True)]


def legend(headlines: Sequence[Headline]) -> str:
    """Return an explanation of the columns of `table`."""
    first = headlines[0]
    over = {f"{headline.cluster}{' and seeds' if headline.seeds > 1 else ''}" for headline in headlines}
    return (
        f"Units: {first.unit}. {explain_gain(first.measure, first.ranked_by)} Intervals: jackknife over "
        f"{' or '.join(sorted(over))}, model and baseline on the same ones.{_omission_note(headlines)}"
    )


def explain_gain(measure: str, ranked_by: str) -> str:
    """Return a sentence on the column of gains."""
    explanations = {
        "skill": f"Less error: 1 − error / error of the best baseline; the error is {ranked_by}.",
        "points": f"Points more: percentage points of {ranked_by} above the best baseline.",
        "area": f"Area gained: {ranked_by}, minus that of the best baseline.",
    }
    return explanations[measure]


def _omission_note(headlines: Sequence[Headline]) -> str:
    count = sum(headline.left_out for headline in headlines if headline.measure == "skill")
    return (
        f" Left out: {format_count(count, 'recordings')} without an error of {headlines[0].reference}." if count else ""
    )


def capitalize(words: str) -> str:
    """Return words with a capital first letter; the name of a column stays as it is."""
    return words if "_" in words.split()[0] else words[:1].upper() + words[1:]
