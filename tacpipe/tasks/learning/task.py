"""Define what the tasks ``regress`` and ``classify`` share: all but their training and their messages."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar, Literal

from tacpipe.plugins.requirements import Channels, Label
from tacpipe.plugins.stage import Result
from tacpipe.tasks.task import Calibration, Files, PredictionRequest, Task

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Model
    from tacpipe.report.context import TaskReport
    from tacpipe.tasks.learning.model import LearnedModel
    from tacpipe.tasks.recordings import OpenedChain


TOUCH = Channels("tactile", (), "any number of columns, in rows at a nearly constant rate; others with --inputs")
SESSION = Label(
    "session",
    "any label, by --group and --recentre",
    "Without --group, each recording is left out by itself in cross-validation.",
)


class LearnedTask(Task):
    """A task whose models learn from windows of touch."""

    states: ClassVar[Literal["quantiles", "probabilities"]]  # what calibrated models state

    def evaluate(self, model: Model, recordings: Dataset) -> Result:
        """Return the metrics and the predictions; raises as `tacpipe.tasks.learning.evaluation`."""
        from tacpipe.tasks.learning import evaluation

        return evaluation.evaluate(model.files, recordings)

    def predict(self, model: Model, recordings: Dataset, request: PredictionRequest) -> Result:
        """Return one table of predictions per recording; raises as `tacpipe.tasks.learning.model`."""
        from tacpipe.tasks.learning.model import predict

        return predict(model.files, recordings, request.quantiles)

    def load(self, files: Files, chain: OpenedChain | None = None) -> LearnedModel:
        """Return the model in ``files``, trained on the output of the stages of ``chain``."""
        from tacpipe.tasks.learning.model import LearnedModel

        return LearnedModel.load(files, chain)

    @property
    def calibration(self) -> Calibration:
        """Calibration of the quantiles of errors, or of probabilities and of the answer unknown."""
        from tacpipe.tasks.learning.model import calibrate

        return Calibration(self.states, calibrate)

    @property
    def recentre(self) -> Callable[[Files, Dataset], Result]:
        """Measurement of the levels of a session."""
        from tacpipe.tasks.learning.model import recentre

        return recentre

    @property
    def report(self) -> TaskReport:
        """Report of estimates or confusions, taxels and the choice of the estimator."""
        from tacpipe.tasks.learning.report import LearningReport

        return LearningReport(self.name)
