"""Which electrodes are predicted, and how true readings lie next to predicted ones on the fingertips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.channels import biotac_sp
from tacpipe.metrics import regression
from tacpipe.report import markup
from tacpipe.report.touch import fingertip, scores, wording
from tacpipe.report.touch.fingertip import Fingertip
from tacpipe.report.touch.methods import Method, Run
from tacpipe.report.touch.predictions import Predictions
from tacpipe.tasks.touch.result_names import CONSTANT, MODEL

FINGERS = ("e_th", "e_mf")
PLACES = {"median": 0.5, "best decile": 0.1, "worst decile": 0.9}  # by error, of the grasps that are drawn
EXPLAINED = (
    "Fingertips are seen on the pad, the skin rolled out flat, the tip up. R² is about the mean of these grasps: 1 is "
    "perfect (blue), 0 as good as that mean, below 0 worse (orange). A contact lies on a few electrodes: a mean over 24 "
    "hides them."
)


@dataclass(frozen=True)
class Chosen:
    """A grasp that is drawn, and why."""

    place: str
    row: int  # among the grasps that were chosen from
    recording: str
    error: float  # RMSE over the electrodes of both fingers, fraction of the range


def section(method: Method) -> str:
    """Return the electrodes' R² and some grasps; empty where the method predicts no electrodes."""
    fingers = [target for target in FINGERS if target in method.targets]
    if not fingers:
        return ""
    drawn = [part for known in (True, False) if (part := _explained(method, fingers, known))]
    pairs = [_pair(method.runs[0].predictions, one, fingers) for one in chosen(method.runs)]
    low = "Blue: lower than the constant, which is the mean of training grasps, so pressed more; orange: higher."
    return (
        f'<h3>Electrodes</h3><div class="pair">{"".join(drawn)}</div>{markup.note(EXPLAINED)}'
        f"{''.join(pairs)}{markup.note(f'Counts. {low}') if pairs else ''}"
    )


def chosen(runs: Sequence[Run]) -> list[Chosen]:
    """Return the grasps of the first run at the median, the best and the worst decile by the electrodes' error.

    Of grasps that err alike the first by name comes first, so the same results choose the same grasps.
    """
    rows = runs[0].predictions
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


def _explained(method: Method, fingers: Sequence[str], known: bool) -> str:
    """Return the R² of each electrode on known or on novel objects; empty where there are none."""
    tips = []
    for target in fingers:
        found = scores.by_electrode(method.runs, target, known)
        if found is not None:
            strength = np.nan_to_num(np.clip(found, -1, 1))
            tips.append(Fingertip(wording.FINGERS[target], strength, [wording.signed_short(value) for value in found]))
    if not tips:
        return ""
    title = f"R² of each electrode on {wording.OBJECTS[known]}"
    return markup.figure(fingertip.draw(tips, title), f"{title}, {method.name}.")


def _pair(rows: Predictions, one: Chosen, fingers: Sequence[str]) -> str:
    """Return true next to predicted electrodes of one grasp."""
    tips, errors = [], []
    for target in fingers:
        finger = wording.FINGERS[target]
        true, predicted = (touch[target][one.row] for touch in (rows.true, rows.predicted[MODEL]))
        constant = rows.predicted.get(CONSTANT, {}).get(target)
        usual = rows.true[target].mean(axis=0) if constant is None else constant[one.row]
        widest = float(np.abs(true - usual).max()) or 1.0
        for title, values in (("true", true), ("predicted", predicted)):
            texts = [f"{value:.0f}" for value in values]
            tips.append(Fingertip(f"{finger}, {title}", (usual - values) / widest, texts))
        errors.append(f"{finger} {regression.rmse(true[None], predicted[None]):.0f} counts")
    known = wording.OBJECTS[bool(rows.known[one.row])].removesuffix("s")
    caption = (
        f"{one.place.capitalize()} by error: {one.recording}, {rows.objects[one.row]} ({known}). RMSE {one.error:.4f} of "
        f"the range; {', '.join(errors)}."
    )
    return markup.figure(fingertip.draw(tips, f"True next to predicted electrodes of {one.recording}"), caption)
