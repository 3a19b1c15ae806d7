"""Report material results."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from tacpipe.comparison.runs import Kind, RecordingOutcome
from tacpipe.datasets.dataset import Dataset
from tacpipe.report.blocks import NONE, Cell, Fold
from tacpipe.report.context import Context, TaskReport
from tacpipe.tasks.material.predictions import MODEL
from tacpipe.tasks.material.report import methods, pictures
from tacpipe.tasks.material.report.methods import ComparedRun


class MaterialReport(TaskReport):
    """The report of the task ``material``."""

    title = "recognition of materials by touch"
    usual = methods.USUAL
    predictor_names = methods.PREDICTOR_NAMES

    def read(self, results: Sequence[Dataset]) -> list[ComparedRun]:
        """Return the runs of results that contain predictions for unseen slides."""
        return methods.read_runs(results)

    def kind(self, predictor: str) -> Kind:
        """Return the kind of a predictor: model, baseline or control."""
        return methods.KINDS.get(predictor, "variant")

    def uses(self, dataset: Dataset) -> bool:
        """Return whether a dataset contains slides, in the middle of which frames of cameras are shown."""
        return any(SLIDE in recording.streams for recording in dataset.recordings.values())

    def outcomes(self, run: ComparedRun) -> Sequence[RecordingOutcome]:
        """Return for each unseen slide its label, the predicted class, and whether they are equal."""
        slides = run.details.predictions
        triples = zip(slides["recording"], slides["material"], slides[MODEL], strict=True)
        return [RecordingOutcome(name, str(label), str(answer), label == answer) for name, label, answer in triples]

    def folds(self, context: Context) -> list[Fold]:
        """Return the folds that are specific to materials."""
        return [
            *pictures.confusion_folds(context),
            *pictures.zero_shot_folds(context.methods),
            *pictures.probability_folds(context),
        ]

    def caveats(self, context: Context) -> list[str]:
        """Return what the slides cannot show; empty if there is no such limit."""
        recorded = [run.details.predictions for run in context.runs if not run.simulated]
        return [SESSIONS] if recorded and all(map(has_one_session_each, recorded)) else []

    def run_columns(self, run: ComparedRun) -> dict[str, str | Cell]:
        """Return an additional column of the table of runs: training slides."""
        trained = " + ".join(f"{count}" for _, count in sorted(run.details.trained.items()))
        return {"slides trained on": trained or NONE}


SLIDE = "slide"  # stream of a slide's samples
SESSIONS = (
    "Each material was recorded in one session, so these data cannot separate texture from session: a model that "
    "recognises a session by its drift or its mean level is also correct."
)


def has_one_session_each(slides: pd.DataFrame) -> bool:
    """Return whether all slides of each material are of one session per sensor, so the two effects are inseparable."""
    if "session" not in slides or slides["session"].fillna("").eq("").any():
        return False
    return int(slides.groupby(["sensor", "material"])["session"].nunique().max()) == 1
