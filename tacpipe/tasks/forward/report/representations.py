"""Errors of representations in their own spaces, Table 1 of the paper, and what codecs hold and lose."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from tacpipe.comparison.runs import MODEL, Method, Run
from tacpipe.comparison.spread import Spread, spread
from tacpipe.report import blocks, charts, provenance
from tacpipe.report.blocks import NONE, Cell, Chart, Charts, Fold, Note, Table, fold, number, table
from tacpipe.report.charts import Line
from tacpipe.report.context import Context
from tacpipe.tasks.forward.report import methods as by_method
from tacpipe.tasks.forward.report import reading, sweep

COMPONENTS = 40  # bars of the explained variance
PRINTED = {  # validation and test error in Table 1 of the paper
    "raw": (0.0484, 0.0552),
    "AE-C1": (0.0330, 0.0403),
    "AE-C2": (0.0351, 0.0453),
    "AE-C3": (0.0405, 0.0510),
    "PCA": (0.0298, 0.0363),
}
OWN_SPACE = (
    "Each row is in its own representation's space, scaled to ±1 on the training recordings. Rows of different spaces "
    "cannot be compared: a space that leaves out what is hard to predict has the lower error. Persistence in the same space "
    "shows what a row is worth: below 1 in the column next to it, the model is better."
)


@dataclasses.dataclass(frozen=True)
class Represented:
    """A row of Table 1: errors in a representation's own scaled space."""

    validation: Spread
    test: Spread
    known: Spread | None  # test recordings of known objects alone
    persistence: Spread


def folds(context: Context) -> list[Fold]:
    """Return the recurrent model on each representation, and codecs' variance, covariance and loss."""
    codecs = sweep.read([*(run.dataset for run in context.runs), *context.others])
    published = context.published or (
        not context.runs and all(provenance.published(one, by_method.Result.SETS) for one in context.bare)
    )
    own = _table(context) if context.runs else None
    note = OWN_SPACE + (
        " The paper's own recordings are not public; its numbers are as printed." if context.published else ""
    )
    return fold("Representations", own, Note(note) if own else None, *_codecs(codecs, published))


def represented(method: Method) -> Represented | None:
    """Return a method's errors in its own scaled space; None where the results do not state them."""

    def error(run: Run, predictor: str, known: bool | None = None) -> float | None:
        steps = run.details.errors.steps
        found = list(reading.sums(run.details, predictor, steps, known, "feature").values())
        total = np.sum(found, axis=0) if found else None
        return None if total is None else float((total[: len(steps)] / total[-1]).mean())

    def over(predictor: str, known: bool | None = None) -> list[float]:
        return [value for run in method.runs if (value := error(run, predictor, known)) is not None]

    tested, known = over(MODEL), over(MODEL, True)
    if not tested:
        return None
    # the recurrent model is trained by this very error, so its loss states it too
    validation = [run.details.config.get("validation", {}) for run in method.runs]
    described = [one.get("mse_feature", one.get("loss") if by_method.recurrent(method) else None) for one in validation]
    return Represented(
        spread([float(one) for one in described if one is not None]),
        spread(tested),
        spread(known) if known else None,
        spread(over("persistence")),
    )


def _table(context: Context) -> Table | None:
    """Return the recurrent model on each representation: Table 1 in the paper's form where the data are the paper's."""
    published, order = context.published, list(PRINTED)
    found = [one for one in context.methods if by_method.recurrent(one)]

    def place(method: Method) -> tuple[int, str, int, str]:
        codec = by_method.codec(method)
        row = by_method.paper_row(codec)
        return order.index(row) if row else len(order), str(codec["kind"]), int(codec["latents"]), method.name

    named = any(run.details.errors.named for method in found for run in method.runs)
    rows: list[list[str | Cell]] = []
    for method in sorted(found, key=place):
        one = represented(method)
        if one is None:
            continue
        paper = by_method.paper_row(by_method.codec(method)) or ""
        cells: list[str | Cell] = [blocks.with_sd(part.mean, part.sd) for part in (one.validation, one.test)]
        cells += [blocks.with_sd(one.known.mean, one.known.sd) if one.known else NONE] if named else []
        cells.append(blocks.with_sd(one.persistence.mean, one.persistence.sd))
        cells.append(number(one.test.mean / one.persistence.mean, 3) if one.persistence.mean else NONE)
        if published:
            cells += [f"{value:.4f}" for value in PRINTED[paper]] if paper in PRINTED else [NONE, NONE]
        rows.append([method.name.split(" · ", 1)[-1], *cells, str(len(method.runs))])
    if not rows:
        return None
    heads = ["representation", "validation", "test", *(["test, known objects"] if named else [])]
    heads += [
        "persistence, test",
        "test ÷ persistence",
        *(["paper: validation", "paper: test"] if published else []),
        "runs",
    ]
    if published:
        present = {by_method.paper_row(by_method.codec(one)) for one in found}
        blank = [NONE] * (len(heads) - 4)
        rows += [
            [name, *blank, *(f"{value:.4f}" for value in PRINTED[name]), "0"] for name in order if name not in present
        ]
    title = (
        "Table 1 in the paper's form: mean squared error"
        if published
        else "Mean squared error in each representation's own space"
    )
    return table(f"{title}, mean ± sd over runs", heads, rows)


def _codecs(codecs: Sequence[sweep.Tree], published: bool) -> list[Charts | Table]:
    if not codecs:
        return []
    drawn = []
    pca, autoencoder = sweep.papers(codecs, "PCA", 20), sweep.papers(codecs, "AE-C1", 8)
    if pca and pca.get("explained_ratio"):
        kept, ratio = int(pca["latents"]), pca["explained_ratio"]
        printed = "; in the paper 20 hold 82 %" if published else ""
        caption = f"The {kept} that are kept hold {100 * sum(ratio[:kept]):.1f} %{printed}."
        values = {str(place): 100 * float(one) for place, one in enumerate(ratio[:COMPONENTS], 1)}
        title = f"Variance by principal component{', Figure 4 of the paper' if published else ''}"
        drawn.append(Chart(title, charts.bars(values, "principal component", "variance (%)", marked=kept), caption))
    for name, codec in (("PCA", pca), ("AE-C1", autoencoder)):
        if codec:
            spec = {**charts.grid(np.array(codec["latent_covariance"]), "latent"), "usermeta": {"most": 360}}
            caption = "Training rows; blue above 0, orange below; strength is the square root of the size."
            drawn.append(Chart(f"Covariance between the {codec['latents']} latents of {name}", spec, caption))
    losses = sweep.losses(codecs)
    series: dict[str, dict[int, float]] = {}
    for one in losses:
        series.setdefault(one.series, {})[one.latents] = one.mse_standardised
    if any(len(widths) > 1 for widths in series.values()):
        several = [
            Line(name, sorted(found), [found[width] for width in sorted(found)])
            for name, found in sorted(series.items())
        ]
        caption = "Error of encoding and decoding, where 1 is what no latent at all would give. Lower is better."
        spec = charts.lines(several, "latents", "mean squared error (standardised)")
        drawn.append(Chart("Reconstruction error by number of latents", spec, caption))
    rows = [
        [
            one.series,
            str(one.latents),
            f"{one.mse_standardised:.4f}",
            number(one.mae_counts),
            "held out" if one.part == "val" else "of the fit",
            str(one.codecs),
        ]
        for one in losses
    ]
    heads = ["", "latents", "MSE (standardised)", "MAE (channels' unit)", "training recordings", "codecs"]
    lost = [table("What representations lose on the way to latents and back", heads, rows)] if rows else []
    return [*([Charts(drawn)] if drawn else []), *lost]
