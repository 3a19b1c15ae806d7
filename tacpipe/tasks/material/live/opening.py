"""A live session's model of materials, opened for a rig."""

from __future__ import annotations

from collections.abc import Mapping

from tacpipe.datasets.dataset import Dataset
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.live.options import Options
from tacpipe.printable import listed
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.material.classifier import Classifier, NetworkReader, SpectraReader
from tacpipe.tasks.material.live.engine import MaterialEngine, finger_of
from tacpipe.tasks.material.live.messages import MaterialDescription
from tacpipe.tasks.material.live.slide import SlideSoFar, slide_params


def engine(options: Options, model: Dataset, sensors: Mapping[str, Sensor]) -> MaterialEngine:
    """Return the engine of a session.

    Raises `UsageError` where it is not stated which of the model's sensors the rig has, `TacpipeError` where the rig has not
    what the model reads, or the model was trained behind a stage that has no rule for samples as they arrive.
    """
    classifier = Classifier.load(model.files)
    params = slide_params(model.source.chain)
    known = tuple(classifier.layouts)
    if not options.sensor and len(known) > 1:
        raise UsageError(f"The model knows the sensors {listed(known)}; give --sensor {known[0]}, or what the rig has.")
    sensor = options.sensor or known[0]
    layout = classifier.layout(sensor)
    finger = finger_of(sensors)
    wanted = {quantity.encode() for quantity in classifier.quantities}
    fields = sensors[finger].fields()
    there = tuple(field.name for field in fields if (field.metadata or {}).get(b"quantity") in wanted)
    if there != layout.channels:
        odd = sorted({*there} ^ {*layout.channels})
        raise TacpipeError(
            f"The stream {finger} of this rig has other channels than the model's slides of {sensor}: {len(there)}, not "
            f"{len(layout.channels)}{f', among them {odd[0]}' if odd else ', in another order'}. Take the rig that the "
            f"model was trained on, or train one on recordings of this rig."
        )
    slide = SlideSoFar(classifier, params, sensor, options.least, sensors[finger].rate_hz)
    if options.pause_s and slide.ends_by_arm and len(sensors) == 1:
        raise UsageError(
            f"--pause-s {options.pause_s:g}: slides of this model end when the arm stops, and the rig has no stream but "
            f"{finger}. Add the arm, or train on `segment slides --trigger load`, whose slides end when nothing is touched."
        )
    stated = classifier.known or isinstance(classifier.readers[sensor], NetworkReader | SpectraReader)
    about = MaterialDescription(
        classifier.names,
        sensor,
        slide.frames,
        slide.any_length,
        "probability" if stated else "order",
        1e3 / options.every_ms,
        options.model,
    )
    every_ns, settle_ns = round(options.every_ms * 1e6), round(options.settle_ms * 1e6)
    pause_ns = round(options.pause_s * 1e9)
    return MaterialEngine(sensors, finger, slide, about, every_ns=every_ns, settle_ns=settle_ns, pause_ns=pause_ns)
