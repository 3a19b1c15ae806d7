"""Report touch results."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from tacpipe.comparison.engine import Comparison, ComparisonRow
from tacpipe.datasets.dataset import Dataset
from tacpipe.report.blocks import NONE, Cell, Fold, number
from tacpipe.report.context import Context, TaskReport
from tacpipe.report.coverage import coverage_folds
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch.report import methods, pictures
from tacpipe.tasks.touch.report.methods import ComparedRun


class TouchReport(TaskReport):
    """The report of the task ``touch``."""

    title = "prediction of fingertip readings from point clouds"
    usual = methods.USUAL
    predictor_names = headlines.BASELINES

    def read(self, results: Sequence[Dataset]) -> list[ComparedRun]:
        """Return the runs of results that contain predictions for unseen grasps."""
        return methods.read_runs(results)

    def columns(
        self, context: Context, comparison: Comparison
    ) -> Sequence[tuple[str, Callable[[ComparisonRow], Cell]]]:
        """Return R² as a further column: its heading and a function that returns the cell of a row."""
        return [("R²", lambda row: number(pictures.r2_of(comparison, row), 2))]

    def folds(self, context: Context) -> list[Fold]:
        """Return the parts of the page that only touch has."""
        constant = headlines.CONSTANT
        return [
            *pictures.scatter_folds(context),
            *pictures.object_folds(context),
            *coverage_folds(context, "target", headlines.TARGETS, constant, "counts", headlines.PARTS),
        ]

    def caveats(self, context: Context) -> list[str]:
        """Return the caveats of these numbers."""
        recorded = [run.details.predictions.in_a_row for run in context.runs if not run.simulated]
        follow_same, follow_any = (sum(column) for column in zip(*recorded, strict=True)) if recorded else (0, 0)
        is_in_blocks = follow_any and follow_same / follow_any >= MAX_IN_A_ROW
        note = RECORDED.format(same=f"{follow_same:,}", all=f"{follow_any:,}") if is_in_blocks else ""
        return [POOLED, note] if context.methods else []

    def run_columns(self, run: ComparedRun) -> dict[str, str | Cell]:
        """Return further columns of the table of runs: split and training grasps."""
        trained = run.details.config.get("counts", {}).get("train")
        return {
            "split": methods.describe_split(*run.details.split),
            "trained on": NONE if trained is None else f"{trained:,}",
        }


POOLED = (
    "PDC is the fluid pressure in a fingertip. RMSE is pooled over all grasps, electrodes and runs of a method, "
    "as a fraction of the fixed range of the target and in device counts. R² is relative to the mean of the evaluated "
    "grasps, so it is at most 0 for a constant. A novel object has no object mean; the constant replaces it."
)
RECORDED = (
    "{same} of {all} evaluated grasps follow a grasp of the same object in time, so errors on known objects also "
    "depend on the time of recording. The mean of the grasps nearest in time, of any object, shows the extent."
)
MAX_IN_A_ROW = 0.75  # fraction of successive grasps of the same object above which objects were not interleaved
