"""Which electrodes are predicted, and how true readings lie next to predicted ones on the fingertips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.channels import biotac_sp
from tacpipe.comparison.runs import Method
from tacpipe.metrics import regression
from tacpipe.report import charts
from tacpipe.report.blocks import Chart, Charts, Fold, Note, fold
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch.report import scores, tables, wording
from tacpipe.tasks.touch.report.methods import targets
from tacpipe.tasks.touch.report.predictions import Predictions
from tacpipe.tasks.touch.result_names import CONSTANT, MODEL

FINGERS = ("e_th", "e_mf")
PLACES = {"median": 0.5, "best decile": 0.1, "worst decile": 0.9}  # by error, of the grasps that are drawn
EXPLAINED = (
    "Fingertips are seen on the pad, the skin rolled out flat, the tip up. R² is about the mean of these grasps: 1 is "
    "perfect (blue), 0 as good as that mean, below 0 worse (orange). A contact lies on a few electrodes: a mean over 24 "
    "hides them."
)
LOW = "Counts. Blue: lower than the constant, which is the mean of training grasps, so pressed more; orange: higher."


@dataclass(frozen=True)
class Chosen:
    """A grasp that is drawn, and why."""

    place: str
    row: int  # among the grasps that were chosen from
    recording: str
    error: float  # RMSE over the electrodes of both fingers, fraction of the range


def folds(method: Method) -> list[Fold]:
    """Return the electrodes' R² and some grasps; nothing where the method predicts no electrodes."""
    fingers = [target for target in FINGERS if target in targets(method)]
    if not fingers:
        return []
    drawn = [part for known in (True, False) if (part := _explained(method, fingers, known))]
    rows = method.details[0].predictions
    pairs = [_pair(rows, one, fingers) for one in chosen(rows)]
    return fold("Electrodes", Charts(drawn), Note(EXPLAINED), *pairs, Note(LOW) if pairs else None, about=method.name)


def chosen(rows: Predictions) -> list[Chosen]:
    """Return the grasps of a run at the median, the best and the worst decile by the electrodes' error.

    Of grasps that err alike the first by name comes first, so the same results choose the same grasps.
    """
    fingers = [target for target in FINGERS if target in rows.targets]
    if not fingers or not len(rows.recordings):
        return []
    squared = [
        np.square(biotac_sp.normalised(one, rows.predicted[MODEL][one]) - biotac_sp.normalised(one, rows.true[one]))
        for one in fingers
    ]
    error = np.sqrt(np.hstack(squared).mean(axis=1))
    order = np.lexsort((rows.recordings, error))
    found = [(place, int(order[round(place_fraction * (len(order) - 1))])) for place, place_fraction in PLACES.items()]
    return [Chosen(place, row, str(rows.recordings[row]), float(error[row])) for place, row in found]


def _explained(method: Method, fingers: Sequence[str], known: bool) -> Chart | None:
    """Return the R² of each electrode on known or on novel objects; None where there are none."""
    rows: list[dict[str, object]] = []
    for target in fingers:
        found = scores.by_electrode(tables.predictions(method), target, known)
        if found is not None:
            strength = np.nan_to_num(np.clip(found, -1, 1))
            rows += tip(wording.FINGERS[target], strength, [wording.signed_short(value) for value in found], "R²")
    if not rows:
        return None
    return Chart(f"R² of each electrode, {headlines.PARTS[known]}", plane(rows))


def _pair(rows: Predictions, one: Chosen, fingers: Sequence[str]) -> Chart:
    """Return true next to predicted electrodes of one grasp."""
    tips: list[dict[str, object]] = []
    errors = []
    for target in fingers:
        finger = wording.FINGERS[target]
        true, predicted = (touch[target][one.row] for touch in (rows.true, rows.predicted[MODEL]))
        constant = rows.predicted.get(CONSTANT, {}).get(target)
        usual = rows.true[target].mean(axis=0) if constant is None else constant[one.row]
        widest = float(np.abs(true - usual).max()) or 1.0
        for title, values in (("true", true), ("predicted", predicted)):
            tips += tip(f"{finger}, {title}", (usual - values) / widest, [f"{value:.0f}" for value in values], "Counts")
        errors.append(f"{finger} {regression.rmse(true[None], predicted[None]):.0f} counts")
    known = headlines.PARTS[bool(rows.known[one.row])].removesuffix("s")
    caption = f"{rows.objects[one.row]} ({known}). RMSE {one.error:.4f} of the range; {', '.join(errors)}."
    return Chart(f"True next to predicted: {one.place} by error, {one.recording}", plane(tips), caption, wide=True)


def tip(panel: str, strength: AnyFloats, texts: Sequence[str], quantity: str) -> list[dict[str, object]]:
    """Return the electrodes of one fingertip, its skin rolled out flat, the tip up, coloured from -1 to 1."""
    places = 1000 * biotac_sp.unrolled_m()[:, ::-1]  # (electrode, across and along), mm
    return [
        {"panel": panel, "x": float(x), "y": float(y), "strength": round(float(np.clip(part, -1, 1)), 2), "text": text,
         "Electrode": number, quantity: text}
        for number, ((x, y), part, text) in enumerate(zip(places, strength, texts, strict=True), 1)
    ]  # fmt: skip


def plane(rows: Sequence[dict[str, object]]) -> charts.Spec:
    """Return fingertips next to each other, of rows that `tip` gave."""
    spec = charts.plane(rows, list(dict.fromkeys(str(row["panel"]) for row in rows)), size=520, columns=4)
    spec["usermeta"] |= {"panel": 200, "least": 170}
    return spec
