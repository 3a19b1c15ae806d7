"""Read material results as runs of methods; each sensor's slides are a question."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import pandas as pd

from tacpipe.comparison import runs
from tacpipe.comparison.runs import Kind, Question, Settings
from tacpipe.datasets.dataset import Dataset
from tacpipe.plugins import architectures
from tacpipe.report import context
from tacpipe.report.context import SHORTENED, drop_duplicates
from tacpipe.tasks.material import headline, predictions
from tacpipe.tasks.material.headline import MaterialMetrics, sensor_title
from tacpipe.tasks.material.params import MaterialConfig, Params

USUAL = (("elsewhere", False), ("elsewhere", True), ("layout", "time"), SHORTENED)  # settings that names do not mark
_COMPETING = {  # settings of methods that compete: trained on all materials and slides, with true labels and pairs
    "pairing": ("random", "fixed"),
    "labels": ("true",),
    "subsample_sensor": ("",),
    "hold_out": ("",),
    "few": ("",),
}
# Runs of one method may differ in these; run_label and quantities are shown as split and vibration.
_NO_METHOD = ("seed", "fold", "sensors", "baselines", "patience", "run_label", "quantities")
_PAIRS = ("alignment_weight", "align_from", "alignment_loss")  # params without effect if sensors are trained separately
_SAME = 0.75  # ratio above which numbers of training slides count as equal: folds differ, and some use validation slides too


class MaterialResult(context.ReportResult[MaterialConfig]):
    """A material result."""

    STAGE = "train.material"
    SETS = ("biotac-slide", "roboskin")

    @cached_property
    def metrics(self) -> MaterialMetrics:
        """Metrics that are reported without further computation."""
        metrics: MaterialMetrics = context.read_json(self.dataset, "metrics.json")
        return metrics

    @cached_property
    def predictions(self) -> pd.DataFrame:
        """Predictions for each unseen slide, as `predictions.read_predictions` returns them."""
        return predictions.read_predictions(self.dataset.recordings["predictions"].table(), self.config)

    @cached_property
    def sensors(self) -> tuple[str, ...]:
        """Sensors whose slides the model was evaluated on."""
        return tuple(sorted(set(self.predictions["sensor"])))

    @property
    def trained(self) -> Mapping[str, int]:
        """Number of slides with the role train, by sensor."""
        return self.config.get("counts", {}).get("train", {})

    @property
    def architecture(self) -> str:
        """Architecture of the model."""
        return str(self.config.get("architecture", self.params.get("architecture", "")))

    @property
    def place(self) -> tuple[str, str]:
        """The split and the layout of its slides, authors or time; results are only pooled if both are equal."""
        layouts = {sensor_config.get("layout", "time") for sensor_config in self.config.get("sensors", {}).values()}
        return str(self.config.get("split", "")), ("authors" if "authors" in layouts else "time")


Method = runs.Method[MaterialResult]
ComparedRun = runs.ComparedRun[MaterialResult]


def settings(results: Sequence[MaterialResult]) -> list[Settings]:
    """Return the settings that define the method of each result.

    These are architecture, joint or not, number of training slides, layout and split of the slides, and all params
    except the seed. Params without effect are removed.
    """
    places = [result.place for result in results]
    main = max(dict.fromkeys(places), key=places.count, default=("", "time"))
    all_slides: dict[tuple[str, str], dict[str, int]] = {}  # split and layout -> sensor -> maximum
    for result, place in zip(results, places, strict=True):
        for sensor, count in result.trained.items():
            most_slides = all_slides.setdefault(place, {})
            most_slides[sensor] = max(count, most_slides.get(sensor, 0))
    fractions: list[float] = []
    return [
        {
            **_settings(result),
            "elsewhere": place != main,
            **_reduced_counts(result, all_slides.get(place, {}), fractions),
        }
        for result, place in zip(results, places, strict=True)
    ]


def sensors_of(methods: Sequence[Method]) -> tuple[str, ...]:
    """Return the sensors that any of the methods was evaluated on."""
    return tuple(sorted({sensor for method in methods for result in method.details for sensor in result.sensors}))


def runs_on(method: Method, sensor: str) -> list[ComparedRun]:
    """Return the runs of a method that were evaluated on slides of ``sensor``."""
    return [run for run in method.runs if sensor in run.details.sensors]


def base_name(settings: Settings, variants: bool = True) -> str:
    """Return the base name of a method, without suffixes that distinguish it from similar ones."""
    architecture = str(settings["architecture"])
    kind = architectures.find_or(Params, architecture)
    name = kind.TITLE or architecture
    if settings["frozen_sensor"]:
        name = "mapping to known space"
    elif settings["joint"]:
        name += " joint"
    elif kind.ALIGNS_SENSORS:
        name += " independent"
    if not variants:
        return name
    held_out = (text.strip().partition("=") for text in str(settings["hold_out"]).split(";") if settings["hold_out"])
    parts = [
        f"{name} ({settings[SHORTENED]})" if SHORTENED in settings else name,
        "with vibration" if settings["vibration"] else "",
        "permuted pairs" if settings["pairing"] == "permuted" else "",
        "permuted labels" if settings["labels"] == "permuted" else "",
        f"{sensor_title(str(settings['subsample_sensor']))} {settings['subsample_percent']} %"
        if settings["subsample_sensor"]
        else "",
        *(f"{sensor_title(sensor)} without {materials.replace(',', ', ')}" for sensor, _, materials in held_out),
        f"{settings['few']} slides" if settings["few"] else "",
    ]
    return " · ".join(filter(None, parts))


def _settings(run: MaterialResult) -> Settings:
    """Return the settings that define a method without the number of slides; params without effect are removed."""
    config, params, architecture = run.config, run.params, run.architecture
    frozen = str(params.get("frozen_sensor", ""))
    joint = bool(config.get("joint", params.get("joint", False)))
    ratio = int(params.get("subsample_percent", 100))
    shortened = run.epochs_of_paper
    omitted = {*_NO_METHOD, *(["epochs"] if shortened else []), *(() if joint or frozen else _PAIRS)}
    split, layout = run.place
    return {
        **{name: value for name, value in params.items() if name not in omitted},
        "architecture": architecture,
        "joint": joint,
        "frozen_sensor": bool(frozen),  # each run reports on the mapped sensor, so both directions are one method
        "pairing": str(params.get("pairing", "random")) if joint or frozen else "random",
        "labels": str(params.get("labels", "true")),
        "subsample_sensor": str(params.get("subsample_sensor", "")) if ratio < 100 else "",
        "subsample_percent": ratio if params.get("subsample_sensor") else 100,
        "hold_out": str(params.get("hold_out", "")),
        "vibration": "vibration" in config.get("quantities", str(params.get("quantities", "")).split(","))
        and "vibration" not in config.get("absent", ()),
        "layout": layout,
        "split": split,
        "simulated": run.simulated,
        **({SHORTENED: shortened} if shortened else {}),
    }


def _reduced_counts(run: MaterialResult, all_slides: Mapping[str, int], known_fractions: list[float]) -> dict[str, str]:
    """Return how many training slides a run used if fewer than all (``few``), of which sensors if not of all.

    A number is that of an earlier run with about as many slides, if there is one; ``known_fractions`` collects the
    fractions of the other runs.
    """
    fewer = {}
    for sensor in sorted(run.trained):
        fraction = run.trained[sensor] / max(all_slides[sensor], 1)
        if fraction > _SAME:
            continue
        similar = [earlier for earlier in known_fractions if _SAME < earlier / fraction < 1 / _SAME]
        if not similar:
            known_fractions.append(fraction)
        fewer[sensor] = str(round((similar or [fraction])[0] * all_slides[sensor]))
    if set(fewer) == set(run.trained) and len(set(fewer.values())) == 1:
        return {"few": next(iter(fewer.values()))}
    return {"few": ", ".join(f"{sensor_title(sensor)} {count}" for sensor, count in fewer.items())}


PREDICTOR_NAMES = {
    predictions.LEVEL: headline.BASELINES[predictions.LEVEL],
    predictions.LEVEL_ONLY: headline.BASELINES[predictions.LEVEL_ONLY],
    predictions.LEVEL_REMOVED: "same readout, level removed",
    predictions.SHUFFLED: "trained on shuffled labels",
    predictions.SWAPPED: "classifiers exchanged",
    predictions.LAST: "last epoch",
}
KINDS: dict[str, Kind] = {
    predictions.MODEL: "model",
    **dict.fromkeys((predictions.LEVEL, predictions.LEVEL_ONLY, headline.CHANCE), "baseline"),
    **dict.fromkeys((predictions.SHUFFLED, predictions.LEVEL_REMOVED), "control"),
}


def read_runs(results: Sequence[Dataset]) -> list[ComparedRun]:
    """Return the runs of results that contain predictions for unseen slides."""
    all_results = [MaterialResult(result) for result in drop_duplicates(results) if "predictions" in result.recordings]
    with_sensors = [result for result in all_results if result.sensors]
    return [_run(*pair) for pair in zip(with_sensors, settings(with_sensors), strict=True)]


def question_on(run: ComparedRun, sensor: str) -> Question | None:
    """Return the question that a run answers for slides of a sensor, or None."""
    return next((question for question in run.questions if question.part.split(", ")[0] == sensor_title(sensor)), None)


def _run(result: MaterialResult, settings: Settings) -> ComparedRun:
    """Return the run of a result: per sensor, the numbers of correct slides of each predictor."""
    place = " · ".join(str(settings[name]) for name in ("split", "layout")) if settings["elsewhere"] else ""
    classes = len(result.config.get("classes", ()))
    questions = {}
    for sensor, scored in predictions.score_tables(result.predictions, result.sensors, classes).items():
        part = ", ".join(filter(None, (sensor_title(sensor), place)))
        questions[Question(part, place=int(settings["elsewhere"]))] = scored
    return ComparedRun(
        result.dataset,
        headline.TASK,
        base_name(settings),
        settings,
        questions,
        family=base_name(settings, variants=False),
        seed=result.params.get("seed"),
        fold=result.config.get("fold"),
        published=result.published,
        control=any(settings[name] not in usual for name, usual in _COMPETING.items()),
        details=result,
    )
