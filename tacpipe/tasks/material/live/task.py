"""Run material models live: settings, session plan and engine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.live.settings import LiveTask, SessionPlan, Settings, TaskSettings
from tacpipe.plugins.constraints import Range
from tacpipe.plugins.stage import Result
from tacpipe.printable import listed
from tacpipe.sensors.live import Declaration
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.material.live.messages import DECLARATION, MATERIAL, MIN_SEEN, MaterialDescription

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Model
    from tacpipe.recording.rig import Rig
    from tacpipe.tasks.material.classifier import Classifier
    from tacpipe.tasks.material.live.engine import MaterialEngine
    from tacpipe.tasks.task import PredictionRequest


@dataclass(frozen=True)
class MaterialSettings(TaskSettings):
    """Settings of a session with a material model."""

    sensor: str = ""  # Sensor of the rig; by default the only sensor of the model
    every_ms: Annotated[float, Range(10, 10_000)] = 100.0  # Time between two answers, ms [100]
    # Fraction of a slide that must arrive before its material is named [0.25]
    least: Annotated[float, Range(above=0, maximum=1)] = MIN_SEEN
    # Pause that ends a slide, s; 0: one slide per recording [0]
    pause_s: Annotated[float, Range(0, 60)] = 0.0


class MaterialLive(LiveTask):
    """Prediction of the material during a slide."""

    settings: ClassVar[type[TaskSettings]] = MaterialSettings
    declaration: ClassVar[Declaration] = DECLARATION

    def plan(self, model: Dataset, rig: Rig, settings: Settings) -> SessionPlan:
        """Return the streams of materials and latencies, and the settings that `predict` needs as attributes."""
        own_settings = _material_settings(settings)
        config = model_files.tree(model.files, model_files.CONFIG, {"classes": list})
        names = config.get("names") or {number: number for number in config["classes"]}
        materials = [str(names[number]) for number in config["classes"]]
        attributes = (
            {"live_pause_s": own_settings.pause_s, "live_least": own_settings.least} if own_settings.pause_s else {}
        )
        return SessionPlan(rig, own_settings, {MATERIAL: {"channels": materials}, "latency": {}}, attributes)

    def engine(self, model: Dataset, rig: Rig, sensors: Mapping[str, Sensor], settings: Settings) -> MaterialEngine:
        """Return the engine of a session.

        Raises `UsageError` if the rig's sensor is ambiguous, and `TacpipeError` if the rig lacks channels of the model, or
        one of the model's stages has no causal version.
        """
        from tacpipe.tasks.material.classifier import Classifier
        from tacpipe.tasks.material.live.engine import MaterialEngine, find_finger
        from tacpipe.tasks.material.live.slide import SlideSoFar, slide_params

        material_settings = _material_settings(settings)
        classifier = Classifier.load(model.files)
        params = slide_params(model.source.chain)
        trained = tuple(classifier.layouts)
        if not material_settings.sensor and len(trained) > 1:
            raise UsageError(
                f"The model knows the sensors {listed(trained)}; give --sensor {trained[0]}, or the sensor of the rig."
            )
        sensor = material_settings.sensor or trained[0]
        finger = find_finger(sensors)
        _check_channels(classifier, sensor, finger, sensors[finger])
        slide = SlideSoFar(classifier, params, sensor, material_settings.least, sensors[finger].rate_hz)
        if material_settings.pause_s and slide.ends_by_arm and len(sensors) == 1:
            raise UsageError(
                f"--pause-s {material_settings.pause_s:g}: slides of this model end when the arm stops, and the rig has no "
                f"stream but {finger}. Add the arm, or train on `segment slides --trigger load`, whose slides end when "
                f"nothing is touched."
            )
        has_probabilities = classifier.calibrations or classifier.readers[sensor].GIVES_LIKELIHOODS
        description = MaterialDescription(
            classifier.names,
            sensor,
            slide.frames,
            slide.any_length,
            "probability" if has_probabilities else "order",
            1e3 / material_settings.every_ms,
            settings.model,
        )
        return MaterialEngine(
            sensors,
            finger,
            slide,
            description,
            every_ns=round(material_settings.every_ms * 1e6),
            settle_ns=round(settings.settle_ms * 1e6),
            pause_ns=round(material_settings.pause_s * 1e9),
        )

    def predict(self, model: Model, recordings: Dataset, request: PredictionRequest) -> Result:
        """Return the final prediction for each slide."""
        from tacpipe.tasks.material.live.slides import predict

        return predict(model, recordings)


def _material_settings(settings: Settings) -> MaterialSettings:
    assert isinstance(settings.task, MaterialSettings)
    return settings.task


def _check_channels(classifier: Classifier, sensor: str, stream: str, finger: Sensor) -> None:
    """Raise `TacpipeError` if the finger's stream and the training slides differ in channels."""
    layout = classifier.layout(sensor)
    quantities = {quantity.encode() for quantity in classifier.quantities}
    channels = tuple(field.name for field in finger.fields() if (field.metadata or {}).get(b"quantity") in quantities)
    if channels != layout.channels:
        odd = sorted({*channels} ^ {*layout.channels})
        raise TacpipeError(
            f"The stream {stream} of this rig has other channels than the model's slides of {sensor}: {len(channels)}, not "
            f"{len(layout.channels)}{f', among them {odd[0]}' if odd else ', in another order'}. Take the rig that the "
            f"model was trained on, or train one on recordings of this rig."
        )
