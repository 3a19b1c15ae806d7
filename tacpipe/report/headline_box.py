"""What came out, first on the page: sentences whose colour states no more than their intervals, and the table behind
them."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from tacpipe.metrics import headline
from tacpipe.metrics.headline import Headline
from tacpipe.report import markup


def box(sentences: Sequence[tuple[str, str]]) -> str:
    """Return sentences with their verdicts (`tacpipe.metrics.headline.verdict`), green only where it is ``better``."""
    return "\n".join(
        f'<p class="{f"headline {verdict}".strip()}">{escape(_unbroken(described))}</p>'
        for described, verdict in sentences
        if described
    )


def table(headlines: Sequence[Headline]) -> str:
    """Return the model next to its best baseline, a pair of rows a headline; empty without any."""
    if not headlines:
        return ""
    heads, rows = headline.table(headlines)
    kinds = {number: "quiet" for number, row in enumerate(rows) if not row[0]}
    title = "The model next to its best baseline"
    return (
        f'<div class="names">{markup.table(title, heads, rows, kinds)}</div>{markup.note(headline.caption(headlines))}'
    )


def _unbroken(described: str) -> str:
    return described.replace(" %", "\N{NO-BREAK SPACE}%")
