"""Figures 10 and 11 of the paper: errors on known objects next to those on novel ones, of each target."""

from __future__ import annotations

from collections.abc import Sequence

from tacpipe.comparison.runs import Method
from tacpipe.report import blocks
from tacpipe.report.blocks import NONE, Block, Cell, Note
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch.report import printed, scores, tables, wording
from tacpipe.tasks.touch.report.methods import DEFAULT, PAPERS, targets
from tacpipe.tasks.touch.report.scores import Score

TITLE = "Figures 10 and 11", "known objects (test) next to novel ones"
PARTS = ("RMSE over runs", "R²", "skill")


def parts(methods: Sequence[Method]) -> list[Block]:
    """Return the table of the paper's network and that of the default method, where they predicted two targets or more."""
    described = []
    for architecture in (PAPERS, DEFAULT):
        pairs = _pairs([one for one in methods if one.settings["architecture"] == architecture])
        described.append(max(pairs, key=_weight, default=None))
    return [one for pair in described if pair for one in _table(*pair)]


def _pairs(methods: Sequence[Method]) -> list[tuple[Method, Method]]:
    """Return pairs of methods, one evaluated on known objects and one on novel ones, that are the same or differ in split.

    The paper trains anew, on all grasps of known objects, for novel ones.
    """
    known, novel = ([one for one in methods if len(_targets(one, of)) > 1] for of in (True, False))
    return [(one, other) for one in known for other in novel if one.key_without("split") == other.key_without("split")]


def _weight(pair: tuple[Method, Method]) -> tuple[int, int, bool]:
    """Return how much a pair states: targets, then runs; of two that state as much, one method on both."""
    known, novel = pair
    common = set(_targets(known, True)) & set(_targets(novel, False))
    return len(common), len(known.runs) + len(novel.runs), known is novel


def _targets(method: Method, known: bool) -> list[str]:
    return [target for target in targets(method) if scores.score(tables.predictions(method), target, known)]


def _table(known: Method, novel: Method) -> list[Block]:
    published = known.published and novel.published
    rows: list[list[str | Cell]] = []
    pairs: list[tuple[Score | None, Score | None]] = []
    kinds: dict[int, str] = {}
    for target, name in headlines.TARGETS.items():
        test, other = (scores.score(tables.predictions(one), target, of) for one, of in ((known, True), (novel, False)))
        if test is None and other is None:
            continue
        pairs.append((test, other))
        rows.append([name, *_cells(test, other), *(_printed(target) if published else [])])
        baselines = zip(
            *(tables.baseline_rows([one], target, of) for one, of in ((known, True), (novel, False))), strict=False
        )
        for (called, first), (_, second) in baselines:
            kinds[len(rows)] = "quiet"
            rows.append([f"· {called.partition(':')[0]}", *_cells(first, second), *([NONE] * 3 if published else [])])
    heads = ["", *(f"test: {part}" for part in PARTS), *(f"novel: {part}" for part in PARTS), "change (%)"]
    heads += ["paper: test", "paper: novel", "change (%)"] if published else []
    simulated = known.simulated or novel.simulated
    chosen = [known] if known is novel else [known, novel]
    counted = [max(one.grasps for one in described if one) for described in zip(*pairs, strict=True)]
    evaluated = f"Evaluated on {counted[0]:,} grasps of known and {counted[1]:,} of novel objects."
    note = f"{wording.basis(chosen)} {evaluated} {printed.FOUND_ON if published else ''} {wording.caution(chosen)}"
    title = f"{blocks.form(*TITLE, published)}{' (simulated)' if simulated else ''}; {known.name}"
    return [blocks.table(title, heads, rows, kinds), Note(note)]


def _cells(test: Score | None, novel: Score | None) -> list[str | Cell]:
    change = NONE
    if test and novel and test.each.mean > 0:
        change = f"{round(100 * (novel.each.mean / test.each.mean - 1)):+d}".replace("-", "−")
    return [*_part(test), *_part(novel), change]


def _part(found: Score | None) -> list[str | Cell]:
    """Return what `PARTS` name."""
    error, counts, *rest = tables.cells(found)[: len(PARTS) + 1]
    return [_above_counts(error, str(counts)) if found else NONE, *rest]


def _printed(target: str) -> list[str | Cell]:
    one = printed.FINAL[target]
    pairs = ((one.test, one.test_counts), (one.novel, one.novel_counts))
    return [*(_above_counts(f"{percentage:.5f}", str(counts)) for percentage, counts in pairs), f"+{one.change}"]


def _above_counts(error: str | Cell, counts: str) -> Cell:
    text, value = (error, None) if isinstance(error, str) else (error.text, error.value)
    return Cell(text, f"{counts} counts", value)
