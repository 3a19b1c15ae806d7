"""Compare representations of the tactile signals, and the losses of codecs."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.codecs.measures import Reconstruction, StoredCodec
from tacpipe.comparison.runs import MODEL, Spread, spread
from tacpipe.report import blocks, charts
from tacpipe.report.blocks import NONE, Cell, Chart, Charts, Fold, SmallPrint, Table, fold, number, table
from tacpipe.report.charts import Curve
from tacpipe.report.context import Context, is_published
from tacpipe.tasks.forward.report import methods
from tacpipe.tasks.forward.report.methods import ComparedRun, Method

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


CODEC_FILE = "codec.json"


@dataclass(frozen=True)
class CodecLoss:
    """The mean reconstruction loss of codecs of one kind and width."""

    series: str  # kind and class: PCA, AE-C1, …
    latents: int
    codecs: int
    part: str  # part of the training recordings: ``val``, held out of the fit, or ``train``
    mse_standardised: float
    mae_counts: float


def read_codecs(datasets: Sequence[Dataset]) -> list[StoredCodec]:
    """Return the distinct descriptions of the codecs in the files of ``datasets``."""
    texts = dict.fromkeys(bytes(dataset.files[CODEC_FILE]) for dataset in datasets if CODEC_FILE in dataset.files)
    return [json.loads(content) for content in texts]


def codec_series(codec: StoredCodec) -> str:
    """Return the common name of codecs that differ only in width.

    >>> codec_series({"kind": "autoencoder", "frames": 2, "of": "increments"})
    'AE-C2 increments'
    """
    name = f"AE-C{codec.get('frames', 1)}" if codec["kind"] == "autoencoder" else str(codec["kind"]).upper()
    return name if codec.get("of", "levels") == "levels" else f"{name} {codec['of']}"


def codec_losses(codecs: Sequence[StoredCodec]) -> list[CodecLoss]:
    """Return the losses of codecs by series and width, on held-out recordings if all have them, otherwise on fitted ones."""
    part = (
        "val"
        if all("val" in loss_tree["reconstruction"] for loss_tree in codecs if loss_tree.get("reconstruction"))
        else "train"
    )
    by_series: dict[tuple[str, int], list[dict[str, Reconstruction]]] = {}
    for codec in codecs:
        if codec.get("reconstruction"):
            by_series.setdefault((codec_series(codec), int(codec["latents"])), []).append(codec["reconstruction"])
    mean_losses = []
    for (name, latents), described in sorted(by_series.items()):
        errors = {
            "mse_standardised": float(np.mean([losses[part]["mse_standardised"] for losses in described])),
            "mae_counts": float(np.mean([losses[part]["mae_counts"] for losses in described])),
        }
        mean_losses.append(CodecLoss(name, latents, len(described), part, **errors))
    return mean_losses


def paper_codec(codecs: Sequence[StoredCodec], series: str, latents: int) -> StoredCodec | None:
    """Return the codec of a series with a covariance whose width is nearest to ``latents``; None without one."""
    candidates = [
        candidate for candidate in codecs if codec_series(candidate) == series and candidate.get("latent_covariance")
    ]
    return min(candidates, key=lambda candidate: abs(int(candidate["latents"]) - latents), default=None)


COMPONENTS = 40  # maximum number of bars of the explained variance
PRINTED = {  # validation and test error in Table 1 of the paper
    "raw": (0.0484, 0.0552),
    "AE-C1": (0.0330, 0.0403),
    "AE-C2": (0.0351, 0.0453),
    "AE-C3": (0.0405, 0.0510),
    "PCA": (0.0298, 0.0363),
}
OWN_SPACE = (
    "Each row is in the space of its representation, scaled to ±1 on the training recordings. Rows of different "
    "spaces cannot be compared: a space without the components that are hard to predict has lower errors. "
    "Compare each row with persistence in the same space: if the ratio in the next column is below 1, the model "
    "is better."
)


@dataclasses.dataclass(frozen=True)
class Representation:
    """A row of Table 1: errors in a representation's own scaled space."""

    validation: Spread
    test: Spread
    known: Spread | None  # error on test recordings of known objects
    persistence: Spread


def representation_folds(context: Context) -> list[Fold]:
    """Return the results of the recurrent model on each representation, and codecs' variance, covariance and loss."""
    codecs = read_codecs([*(run.dataset for run in context.runs), *context.others])
    published = context.published or (
        not context.runs and all(is_published(result, methods.ForwardResult.SETS) for result in context.bare)
    )
    method_table = _representation_table(context) if context.runs else None
    note = OWN_SPACE + (
        "The recordings of the paper are not public; its numbers are quoted as printed." if context.published else ""
    )
    return fold(
        "Representations", method_table, SmallPrint(note) if method_table else None, *_codec_charts(codecs, published)
    )


def represent_method(method: Method) -> Representation | None:
    """Return a method's errors in its own scaled space, or None if the results do not contain them."""

    def error(run: ComparedRun, predictor: str, known_errors: bool | None = None) -> float | None:
        steps = run.details.errors.steps
        error_sums = list(methods.sums_by_recording(run.details, predictor, steps, known_errors, "feature").values())
        total = np.sum(error_sums, axis=0) if error_sums else None
        return None if total is None else float((total[: len(steps)] / total[-1]).mean())

    def errors_over_runs(predictor: str, known_errors: bool | None = None) -> list[float]:
        errors = [error(run, predictor, known_errors) for run in method.runs]
        return [value for value in errors if value is not None]

    test_errors, known_errors = errors_over_runs(MODEL), errors_over_runs(MODEL, True)
    if not test_errors:
        return None
    validation_errors = []
    for run in method.runs:
        validation = run.details.config.get("validation", {})
        # a recurrent model is trained with this error, so its loss is the same quantity
        loss = validation.get("loss") if methods.is_recurrent(method) else None
        validation_errors.append(validation.get("mse_feature", loss))
    return Representation(
        spread([float(value) for value in validation_errors if value is not None]),
        spread(test_errors),
        spread(known_errors) if known_errors else None,
        spread(errors_over_runs("persistence")),
    )


def _representation_table(context: Context) -> Table | None:
    """Return a table of the recurrent model's results on each representation; None if there are no such results.

    If the data are the paper's, the table also contains the paper's numbers.
    """
    published, order = context.published, list(PRINTED)
    recurrent_methods = [represented for represented in context.methods if methods.is_recurrent(represented)]

    def paper_order(method: Method) -> tuple[int, str, int, str]:
        codec = methods.codec_of(method)
        row = methods.paper_row(codec)
        return order.index(row) if row else len(order), str(codec["kind"]), int(codec["latents"]), method.name

    has_objects = any(run.details.errors.named for method in recurrent_methods for run in method.runs)
    rows: list[list[str | Cell]] = []
    for method in sorted(recurrent_methods, key=paper_order):
        represented = represent_method(method)
        if represented is None:
            continue
        paper = methods.paper_row(methods.codec_of(method)) or ""
        cells: list[str | Cell] = [
            blocks.with_sd(part.mean, part.sd) for part in (represented.validation, represented.test)
        ]
        if has_objects:
            cells.append(blocks.with_sd(represented.known.mean, represented.known.sd) if represented.known else NONE)
        cells.append(blocks.with_sd(represented.persistence.mean, represented.persistence.sd))
        cells.append(
            number(represented.test.mean / represented.persistence.mean, 3) if represented.persistence.mean else NONE
        )
        if published:
            cells += [f"{value:.4f}" for value in PRINTED[paper]] if paper in PRINTED else [NONE, NONE]
        rows.append([method.name.split(" · ", 1)[-1], *cells, str(len(method.runs))])
    if not rows:
        return None
    heads = ["representation", "validation", "test", *(["test, known objects"] if has_objects else [])]
    heads += [
        "persistence, test",
        "test ÷ persistence",
        *(["paper: validation", "paper: test"] if published else []),
        "runs",
    ]
    if published:
        present = {methods.paper_row(methods.codec_of(represented)) for represented in recurrent_methods}
        blank = [NONE] * (len(heads) - 4)
        rows += [
            [name, *blank, *(f"{value:.4f}" for value in PRINTED[name]), "0"] for name in order if name not in present
        ]
    title = (
        "Table 1 in the paper's form: mean squared error"
        if published
        else "Mean squared error in the space of each representation"
    )
    return table(f"{title}, mean ± sd over runs", heads, rows)


def _codec_charts(codecs: Sequence[StoredCodec], published: bool) -> list[Charts | Table]:
    """Return charts of the codecs' variance, covariance and loss, and a table of their losses; empty without codecs."""
    if not codecs:
        return []
    drawn = []
    pca, autoencoder = paper_codec(codecs, "PCA", 20), paper_codec(codecs, "AE-C1", 8)
    if pca and pca.get("explained_ratio"):
        kept_latents, ratio = int(pca["latents"]), pca["explained_ratio"]
        printed = "; in the paper, 20 explain 82 %" if published else ""
        caption = f"The {kept_latents} latents explain {100 * sum(ratio[:kept_latents]):.1f} %{printed}."
        values = {str(index): 100 * float(fraction) for index, fraction in enumerate(ratio[:COMPONENTS], 1)}
        title = f"Variance by principal component{', Figure 4 of the paper' if published else ''}"
        drawn.append(
            Chart(title, charts.bars(values, "principal component", "variance (%)", marked=kept_latents), caption)
        )
    for name, codec in (("PCA", pca), ("AE-C1", autoencoder)):
        if codec:
            spec = charts.grid(np.array(codec["latent_covariance"]), "latent")
            spec["usermeta"] = {"most": 360}
            caption = "Training rows; blue above 0, orange below; strength is the square root of the size."
            drawn.append(Chart(f"Covariance between the {codec['latents']} latents of {name}", spec, caption))
    losses = codec_losses(codecs)
    series: dict[str, dict[int, float]] = {}
    for loss in losses:
        series.setdefault(loss.series, {})[loss.latents] = loss.mse_standardised
    if any(len(widths) > 1 for widths in series.values()):
        lines = [
            Curve(name, sorted(by_width), [by_width[width] for width in sorted(by_width)])
            for name, by_width in sorted(series.items())
        ]
        caption = "Error of encoding and decoding, relative to a codec without latents (1). Lower is better."
        spec = charts.lines(lines, "latents", "mean squared error (standardised)")
        drawn.append(Chart("Reconstruction error by number of latents", spec, caption))
    rows = [
        [
            loss.series,
            str(loss.latents),
            f"{loss.mse_standardised:.4f}",
            number(loss.mae_counts),
            "held out" if loss.part == "val" else "of the fit",
            str(loss.codecs),
        ]
        for loss in losses
    ]
    heads = ["", "latents", "MSE (standardised)", "MAE (channels' unit)", "training recordings", "codecs"]
    lost = [table("Reconstruction errors of the representations", heads, rows)] if rows else []
    return [*([Charts(drawn)] if drawn else []), *lost]
