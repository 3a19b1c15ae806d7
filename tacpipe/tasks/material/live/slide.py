"""Predict the material during a slide: apply `tacpipe segment slides` and the model to the samples so far.

The prediction at any time equals that for a recording that ends there, so it uses no future samples, and at the end of
the recording it equals that of `tacpipe predict`. Only slides that are still shorter than those of training are treated
differently: models that accept slides of any length read the available rows, once there are enough.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from tacpipe.arrays import Float32s
from tacpipe.channels.streams import finger_stream
from tacpipe.errors import TacpipeError
from tacpipe.live.stages import RecordingInMemory, stage_params
from tacpipe.plugins import registry
from tacpipe.store.records import Step
from tacpipe.tasks.material import slides as slides_of
from tacpipe.tasks.material.classifier import Classifier
from tacpipe.tasks.material.slides import STREAM, describe_difference

if TYPE_CHECKING:
    Tables = Mapping[str, pa.Table]

SLIDES = "segment.slides"
ENDED_NS = 200_000_000  # time without a row of the slide after which it has ended
UNLIKE = "the slide is like none of the materials that the model knows"


def slide_params(steps: Sequence[Step]) -> Any:
    """Return the params of the stage `segment slides` of a material model.

    Raises `UsageError` if that stage now has another version, `TacpipeError` if the model has other preprocessing
    stages.
    """
    names = [step["stage"] for step in steps]
    if names != [SLIDES]:
        commands = ", ".join(f"`tacpipe {name.replace('.', ' ')}`" for name in names) or "no stage"
        raise TacpipeError(
            f"The model was trained on the output of {commands}, but a session cuts slides with `tacpipe segment "
            "slides` only. Train it on recordings that went through that stage."
        )
    params_found = stage_params(steps[0])
    if params_found.trigger == "load" and params_found.rest != "start":
        raise TacpipeError(
            f"The model was trained with `segment slides --rest {params_found.rest}`, which searches the complete recording "
            f"for the rest level. A session takes it from the start. Train it with --rest start."
        )
    return params_found


class RecordingSoFar(RecordingInMemory):
    """Streams of a recording so far, which are decoded already."""

    def columns(self, stream: str = "") -> Any:
        """Return a stream."""
        return self.tables[stream]


@dataclass(frozen=True)
class Answer:
    """A model's prediction for a slide so far."""

    scores: Float32s | None  # (class,); None if no material is predicted, with the reason in ``cause``
    rows: int = 0  # number of rows of the slide so far
    fraction: float = 0.0  # fraction of the rows that the model reads
    is_over: bool = False  # whether the slide had no new row for `ENDED_NS`
    cause: str = ""
    probabilities: Float32s | None = field(default=None)  # (class,)


class SlideSoFar:
    """Predicts the material of the slide in the samples so far."""

    def __init__(
        self, classifier: Classifier, params: Any, sensor: str, least_fraction: float, rate_hz: float | None = None
    ) -> None:
        """Store the params of `segment slides` and the minimum fraction of a slide. Raises an error for an unknown sensor.

        ``rate_hz`` is the rig's nominal rate. If None, the rate is that of the arrival times, which are bursty on a
        busy computer.
        """
        self._classifier, self._params, self._sensor = classifier, params, sensor
        self._attributes = {"sensor": sensor} | ({"rate_hz": rate_hz} if rate_hz else {})
        self._layout, self._reader = classifier.layout(sensor), classifier.readers[sensor]
        self._stage = registry.load(SLIDES)
        self._least_fraction = least_fraction

    @property
    def frames(self) -> int:
        """Number of rows that the model reads of a slide."""
        return self._layout.frames

    @property
    def any_length(self) -> bool:
        """Whether the model accepts fewer rows."""
        return self._reader.any_length

    def answer(self, streams: Mapping[str, pa.Table]) -> Answer:
        """Return the prediction for a recording of these streams that ends now, or why there is none."""
        recording = RecordingSoFar("so far", streams, self._attributes)
        try:
            segmented = self._stage(replace(self._params, crop="none"), recording)
        except TacpipeError:
            return Answer(None, cause="no slide has begun")
        table = segmented.streams[STREAM]
        rows = table.num_rows
        newest_ns = finger_stream("so far", streams).column("t_ns")[-1].as_py()
        is_over = rows > 0 and newest_ns - table.column("t_ns")[-1].as_py() > ENDED_NS
        try:
            slide, is_incomplete = self._slide_rows(recording, table)
            layout, frames = slides_of.frames(slide, self._sensor, self._classifier.quantities)
        except TacpipeError as error:
            return Answer(None, rows, 0.0, is_over, str(error))
        answer = Answer(None, rows, min(1.0, len(frames) / self.frames), is_over)
        differs = f"the slide {describe_difference(self._layout, layout)} as the model was trained on"
        if layout.channels != self._layout.channels or len(frames) > self.frames:
            return replace(answer, cause=differs)
        if len(frames) < self.frames and not (self.any_length and answer.fraction >= self._least_fraction):
            enough = f"{self._least_fraction:.0%} of {self.frames}" if self.any_length else str(self.frames)
            return replace(answer, cause=f"{len(frames)} rows of the slide have come, and {enough} are needed")
        if not is_incomplete and not self._layout.is_compatible(layout):
            return replace(answer, cause=differs)
        scores = self._reader.read(frames[None]).scores
        if self._classifier.is_unknown(scores, frames[None], self._sensor)[0]:
            return replace(answer, scores=scores[0], cause=UNLIKE)
        return replace(
            answer, scores=scores[0], probabilities=self._classifier.probabilities_of(scores, self._sensor)[0]
        )

    def is_over(self, streams: Mapping[str, pa.Table], finger_stream: str, pause_ns: int) -> bool:
        """Return whether the slide in these streams has ended and been followed by a pause.

        With the trigger ``load``, a pause is a time without contact, whatever the arm does; the samples after it start
        without contact, as in a recording. With ``pressure``, it is a time in which the arm has stopped.
        """
        is_by_load = self._params.trigger == "load"
        tables = {name: table for name, table in streams.items() if not is_by_load or name == finger_stream}
        if finger_stream not in tables:
            return False
        try:
            recording = RecordingSoFar("so far", tables, self._attributes)
            slide = self._stage(replace(self._params, crop="none"), recording).streams[STREAM]
        except TacpipeError:  # no slide has started
            return False
        newest_ns, last_ns = (table.column("t_ns")[-1].as_py() for table in (tables[finger_stream], slide))
        return bool(newest_ns - last_ns >= pause_ns)

    @property
    def ends_by_arm(self) -> bool:
        """Whether a slide ends only when the arm stops."""
        return bool(self._params.trigger != "load")

    def _slide_rows(self, recording: RecordingSoFar, table: pa.Table) -> tuple[Any, bool]:
        """Return the slide's rows, selected by the stage or as far as available, and whether there are too few."""
        params = self._params
        first = params.offset_frames if params.crop == "offset" else 0
        if params.crop == "none" or table.num_rows - first >= params.frames:
            slide = self._stage(params, recording)
            return RecordingSoFar("so far", slide.streams, {**recording.attributes, **slide.attributes}), False
        remaining = table.slice(min(first, table.num_rows))
        return RecordingSoFar("so far", {STREAM: remaining}, recording.attributes), remaining.num_rows < self.frames
