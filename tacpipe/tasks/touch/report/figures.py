"""Draw pressures, electrodes, clouds with grasps, and losses by epoch."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.channels import biotac_sp
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.datasets.dataset import Dataset, Recording
from tacpipe.metrics import regression
from tacpipe.report import blocks, charts, context
from tacpipe.report.blocks import Chart, Charts, Fold, SmallPrint, fold
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch.headline import CONSTANT, MODEL
from tacpipe.tasks.touch.params import PAPER
from tacpipe.tasks.touch.report import methods, paper, predictions
from tacpipe.tasks.touch.report.methods import (
    Method,
    TouchResult,
    describe_training,
    one_per_architecture,
    predicted_targets,
)
from tacpipe.tasks.touch.report.predictions import GraspPredictions

PRESSURES = ("pdc_th", "pdc_mf")
MAX_GRASPS = 800  # maximum number of grasps in a figure


def pressure_folds(method: Method) -> list[Fold]:
    """Return one chart per finger for the first run; empty if the method predicts no pressure."""
    rows = method.details[0].predictions
    figures = [
        _pressure_chart(method, target) for target in PRESSURES if target in rows.targets and len(rows.recordings)
    ]
    return fold("The pressure, predicted and true", Charts(figures), about=method.name) if figures else []


def _pressure_chart(method: Method, target: str) -> Chart:
    """Return a chart of predicted against true pressures of a target, for some grasps of the first run."""
    all_rows = method.details[0].predictions
    total = len(all_rows.recordings)
    rows = all_rows.rows(np.unique(np.linspace(0, total - 1, MAX_GRASPS).astype(int)))
    values = rows.true[target][:, 0], rows.predicted[MODEL][target][:, 0]
    dots: list[charts.DataRow] = [
        {
            "name": f"{name}{'' if is_known else ' (novel)'}",
            "tip": str(recording),
            "x": float(true),
            "y": float(predicted),
        }
        for recording, name, is_known, true, predicted in zip(
            rows.recordings, rows.objects, rows.known, *values, strict=True
        )
    ]
    constant = rows.predicted.get(CONSTANT, {}).get(target)
    level = None if constant is None else ("constant", float(constant[0, 0]))
    name = headlines.TARGETS[target]
    spec = charts.scatter(dots, "true (counts)", "predicted (counts)", diagonal=True, level=level)
    counts_text = f"{len(rows.recordings):,} of {total:,}" if len(rows.recordings) < total else f"{total:,}"
    return Chart(
        name, spec, f"{counts_text} unseen grasps of the first run. Line: predicted as true; dashed: the constant."
    )


FINGERS = ("e_th", "e_mf")
PLACES = {"median": 0.5, "best decile": 0.1, "worst decile": 0.9}  # title -> quantile of the error
FINGERTIPS = (
    "Fingertips are seen from the pad, with the skin unrolled and the tip at the top. R² is relative to the mean "
    "of these grasps: 1 is perfect (blue), 0 is as good as the mean, and values below 0 are worse (orange). A "
    "contact covers few electrodes, so a mean over 24 would hide them."
)
COLOURS = (
    "Counts. Blue: lower than the constant (the mean of training grasps), which means more pressure; orange: higher."
)


@dataclass(frozen=True)
class DrawnGrasp:
    """A grasp to draw, and the reason."""

    place: str
    row: int  # row among all candidate grasps
    recording: str
    error: float  # RMSE over the electrodes of both fingers, fraction of the range


def electrode_folds(method: Method) -> list[Fold]:
    """Return charts of the electrodes' R² and of some grasps; empty if the method predicts no electrodes."""
    fingers = [target for target in FINGERS if target in predicted_targets(method)]
    if not fingers:
        return []
    figures = [part for known_objects in (True, False) if (part := _r2_chart(method, fingers, known_objects))]
    rows = method.details[0].predictions
    pairs = [_electrode_chart(rows, grasp, fingers) for grasp in choose_grasps(rows)]
    return fold(
        "Electrodes",
        Charts(figures),
        SmallPrint(FINGERTIPS),
        *pairs,
        SmallPrint(COLOURS) if pairs else None,
        about=method.name,
    )


def choose_grasps(rows: GraspPredictions) -> list[DrawnGrasp]:
    """Return the grasps of a run with the median, best-decile and worst-decile error of the electrodes.

    Ties are resolved by name, so the choice is reproducible.
    """
    fingers = [target for target in FINGERS if target in rows.targets]
    if not fingers or not len(rows.recordings):
        return []
    squared = [
        np.square(
            biotac_sp.normalise(finger, rows.predicted[MODEL][finger]) - biotac_sp.normalise(finger, rows.true[finger])
        )
        for finger in fingers
    ]
    error = np.sqrt(np.hstack(squared).mean(axis=1))
    order = np.lexsort((rows.recordings, error))
    rows_by_title = [
        (title, int(order[round(place_fraction * (len(order) - 1))])) for title, place_fraction in PLACES.items()
    ]
    return [DrawnGrasp(title, row, str(rows.recordings[row]), float(error[row])) for title, row in rows_by_title]


def _r2_chart(method: Method, fingers: Sequence[str], known_objects: bool) -> Chart | None:
    """Return the R² of each electrode on known or on novel objects; None if there are no such objects."""
    rows: list[charts.DataRow] = []
    for target in fingers:
        scores_by_electrode = predictions.r2_by_electrode(paper.predictions_of_runs(method), target, known_objects)
        if scores_by_electrode is not None:
            strength = np.nan_to_num(np.clip(scores_by_electrode, -1, 1))
            rows += fingertip(
                methods.FINGER_NAMES[target], strength, [methods.short_r2(value) for value in scores_by_electrode], "R²"
            )
    if not rows:
        return None
    return Chart(f"R² of each electrode, {headlines.PARTS[known_objects]}", draw_fingertips(rows))


def _electrode_chart(rows: GraspPredictions, grasp: DrawnGrasp, fingers: Sequence[str]) -> Chart:
    """Return a chart of the true and predicted electrodes of one grasp."""
    tips: list[charts.DataRow] = []
    errors = []
    for target in fingers:
        finger = methods.FINGER_NAMES[target]
        true, predicted = (touch[target][grasp.row] for touch in (rows.true, rows.predicted[MODEL]))
        constant = rows.predicted.get(CONSTANT, {}).get(target)
        reference = rows.true[target].mean(axis=0) if constant is None else constant[grasp.row]
        widest = float(np.abs(true - reference).max()) or 1.0
        for title, values in (("true", true), ("predicted", predicted)):
            tips += fingertip(
                f"{finger}, {title}", (reference - values) / widest, [f"{value:.0f}" for value in values], "Counts"
            )
        errors.append(f"{finger} {regression.rmse(true[None], predicted[None]):.0f} counts")
    part = headlines.PARTS[bool(rows.known[grasp.row])].removesuffix("s")
    caption = f"{rows.objects[grasp.row]} ({part}). RMSE {grasp.error:.4f} of the range; {', '.join(errors)}."
    return Chart(
        f"True next to predicted: {grasp.place} by error, {grasp.recording}", draw_fingertips(tips), caption, wide=True
    )


def fingertip(panel: str, strength: AnyFloats, texts: Sequence[str], quantity: str) -> list[charts.DataRow]:
    """Return a data row per electrode: its position on the unrolled skin of a fingertip, and its ``strength`` in [-1, 1]."""
    positions_mm = 1000 * biotac_sp.unrolled_positions_m()[:, ::-1]  # (electrode, across and along), mm
    return [
        {"panel": panel, "x": float(x), "y": float(y), "strength": round(float(np.clip(value, -1, 1)), 2), "text": text,
         "Electrode": number, quantity: text}
        for number, ((x, y), value, text) in enumerate(zip(positions_mm, strength, texts, strict=True), 1)
    ]  # fmt: skip


def draw_fingertips(rows: Sequence[charts.DataRow]) -> charts.Spec:
    """Return a chart of fingertips next to each other, from the rows of `fingertip`."""
    spec = charts.plane(rows, list(dict.fromkeys(str(row["panel"]) for row in rows)), size=520, columns=4)
    spec["usermeta"] |= {"panel": 200, "least": 170}
    return spec


CLOUD, GRASP = "cloud", "grasp"
MAX_CLOUDS = 3
NEAR_MM = 10.0  # distance to a contact point that is highlighted; a fingertip has a radius of 6.7 mm
POINTS = 700  # number of drawn points per cloud
VIEWS = {"from the camera": 0, "from the side": 2}  # view -> index of the horizontal axis; y is vertical
CLOUD_COLOURS = (
    "Blue points are near the first contact, orange points near the second. The cloud contains only the visible "
    "side, although a finger may touch other parts."
)


def holds_grasps(dataset: Dataset) -> bool:
    """Return whether a dataset contains clouds with grasps."""
    return any(_has_grasp(shard) for shard in dataset.recordings.values())


def cloud_folds(datasets: Sequence[Dataset], chosen: Mapping[str, str]) -> list[Fold]:
    """Return a fold with charts of the clouds of ``chosen`` grasps (name -> description), or of the first grasps.

    The first grasps are drawn if none of the chosen ones is in the datasets. Without grasps, the list is empty.
    """
    shards = {name: shard for dataset in datasets for name, shard in dataset.recordings.items() if _has_grasp(shard)}
    if not shards:
        return []
    first_grasps = dict.fromkeys(sorted(shards)[:MAX_CLOUDS], "")
    descriptions = {name: description for name, description in chosen.items() if name in shards} or first_grasps
    figures = [_cloud_chart(shards[name], description) for name, description in descriptions.items()]
    return fold("Clouds and their grasps", Charts(figures), SmallPrint(CLOUD_COLOURS))


def _has_grasp(shard: Recording) -> bool:
    return {CLOUD, GRASP} <= set(getattr(shard, "streams", ()))


def _cloud_chart(shard: Recording, words: str) -> Chart:
    """Return a chart of a cloud from two views, with the points near both contacts highlighted.

    ``words`` describe the grasp.
    """
    cloud, grasp = Cloud.from_table(shard.table(CLOUD)), Grasp.from_table(shard.table(GRASP))
    contacts_m = np.array([grasp.g1_m, grasp.g2_m])
    middle = contacts_m.mean(axis=0)
    indices = np.unique(np.linspace(0, len(cloud) - 1, POINTS).astype(int))
    points = 1000 * (cloud.points_m[indices].astype(np.float64) - middle)  # (point, xyz), mm
    contacts = 1000 * (contacts_m - middle)
    distance = np.linalg.norm(points[:, None] - contacts[None], axis=2)  # (point, finger)
    near = np.where(distance.min(axis=1) <= NEAR_MM, np.array([1, -1])[distance.argmin(axis=1)], 0)
    rows: list[charts.DataRow] = []
    for view, across in VIEWS.items():
        for point, side in zip(points, near, strict=True):
            x, y = float(round(point[across], 1)), float(round(-point[1], 1))
            rows.append({"panel": view, "x": x, "y": y, "strength": 0.6 * int(side)})
    for view, across in VIEWS.items():
        for point, strength in zip(contacts, (1.0, -1.0), strict=True):
            rows.append({"panel": view, "x": float(point[across]), "y": float(-point[1]), "strength": strength})
    about = f"{shard.name}{f' ({words})' if words else ''}: {shard.attributes.get('object', 'an object')}"
    caption = f"{len(cloud):,} points, the fingers {1000 * grasp.opening_m:.0f} mm apart."
    return Chart(about, charts.plane(rows, list(VIEWS), size=9), caption)


ALL = "all"  # name of a network that predicts all targets
UNWATCHED = "If there are no validation grasps, it is the loss on the training grasps after each epoch."


def loss_charts(methods: Sequence[Method]) -> list[Chart]:
    """Return validation losses of one method per architecture, one chart per target; empty if no run has epochs."""
    figures, shown_methods = [], one_per_architecture(methods)
    for target in (*biotac_sp.TARGETS, ALL):
        curves = context.curves_of_methods(
            shown_methods, functools.partial(losses_by_epoch, target=target, name="val_loss")
        )
        if curves:
            name = headlines.TARGETS.get(target, "one network for all targets")
            spec = context.loss_chart(curves, "validation loss", log=True)
            caption = "Each method's own loss. Thick: mean over runs; thin: single runs."
            figures.append(
                Chart(f"Validation loss by epoch, {name}", spec, f"{caption}{_unwatched_note(shown_methods)}")
            )
    return figures


def figure_8(methods: Sequence[Method]) -> list[Chart]:
    """Return Figure 8 of the paper: both losses of its network with the most epochs; empty if it was not run."""
    paper_methods = [method for method in methods if method.settings["architecture"] == PAPER]
    candidates = [
        (method, target)
        for method, target in itertools.product(paper_methods, (paper.TARGET, ALL))
        if _loss_curves(method, target, "train_loss")
    ]
    if not candidates:
        return []

    def epochs_and_runs(candidate: tuple[Method, str]) -> tuple[int, int]:
        method, target = candidate
        return len(_loss_curves(method, target, "train_loss")[0]), len(method.runs)

    method, target = max(candidates, key=epochs_and_runs)
    loss_names = {"training": "train_loss", "validation": "val_loss"}
    all_curves = {name: _loss_curves(method, target, loss) for name, loss in loss_names.items()}
    curves = {name: losses for name, losses in all_curves.items() if losses}
    quantity = "loss (RMSE, fraction of the range)" if method.settings.get("loss", "rmse") == "rmse" else "loss"
    text = f"training and validation loss by epoch, {method.name}, {headlines.TARGETS.get(target, 'all targets')}"
    note = " The paper's figure has 1,000 epochs." if method.published else ""
    caption = (
        f"{describe_training([method])}{note}{_unwatched_note([method])}{' Simulated.' if method.simulated else ''}"
    )
    return [
        Chart(blocks.form("Figure 8", text, method.published), context.loss_chart(curves, quantity, log=True), caption)
    ]


def losses_by_epoch(result: TouchResult, target: str, name: str) -> list[float]:
    """Return a loss by epoch of one target's network, averaged over several networks; empty if it was not logged.

    The mean ends with the shortest network. Epochs without the loss are NaN.
    """
    networks: dict[object, list[float]] = {}
    for line in result.history:
        if line.get("target", ALL) == target:
            epoch_loss = line.get("val_loss") if name == "val_loss" else line.get("train_loss")
            networks.setdefault(line.get("network"), []).append(
                float("nan") if epoch_loss is None else float(epoch_loss)
            )
    length = min(map(len, networks.values()), default=0)
    mean = [
        sum(values) / len(values)
        for values in zip(*(network_losses[:length] for network_losses in networks.values()), strict=True)
    ]
    return mean if any(not math.isnan(value) for value in mean) else []


def _loss_curves(method: Method, target: str, name: str) -> list[list[float]]:
    return [curve for result in method.details if (curve := losses_by_epoch(result, target, name))]


def _unwatched_note(methods: Sequence[Method]) -> str:
    """Return a note on runs without validation grasps."""
    runs = [run for method in methods for run in method.details if run.history]
    return UNWATCHED if any(run.config.get("counts", {}).get("val") == 0 for run in runs) else ""
