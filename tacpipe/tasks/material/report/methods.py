"""A result on materials, what makes a method of such results, and what it is called."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from typing import Any

from tacpipe.comparison.naming import marks
from tacpipe.comparison.runs import Method, Run
from tacpipe.report import contents
from tacpipe.report.contents import Tree
from tacpipe.tasks.material.report import predictions
from tacpipe.tasks.material.report.predictions import Predictions

SENSORS = {"biotac": "BioTac", "roboskin": "RoboSkin"}
USUAL = (("elsewhere", False), ("elsewhere", True), ("layout", "time"))  # settings that no name states
_ARCHITECTURES = {
    "minirocket": "MiniRocket",
    "statistics": "statistics",
    "x-lstm": "X-LSTM",
    "raec": "RAEC",
    "spectra": "spatial spectra",
}
_PLAIN = {
    "pairing": ("random", "fixed"),
    "labels": ("true",),
    "subsample_sensor": ("",),
    "hold_out": ("",),
    "few": ("",),
    "elsewhere": (False,),
}
# In these, runs of one method may differ; run_label and quantities are shown as split and vibration.
_NO_METHOD = ("seed", "fold", "sensors", "baselines", "patience", "run_label", "quantities")
_CLOSED = {  # all that has an effect on what is fitted in closed form
    "minirocket": ("features", "use_validation", "labels"),
    "statistics": ("use_validation", "labels"),
    "spectra": ("speeds", "use_validation", "labels", "hold_out"),
}
_RAECS = ("decoder", "unpool", "reconstruction_weight", "latents")  # of no effect on X-LSTM
_PAIRS = ("alignment_weight", "align_from", "alignment_loss")  # of no effect where sensors learn alone
_SAME = 0.75  # training slides in this ratio are as many: folds differ in size, some learn from validation slides too


class Result(contents.Result):
    """One result on materials."""

    STAGE = "train.material"
    SETS = ("biotac-slide", "roboskin")

    @cached_property
    def predictions(self) -> Predictions:
        """What was predicted of each slide that the model has not seen."""
        return predictions.read(self.dataset.recordings["predictions"].table(), self.config)

    @property
    def given(self) -> Tree:
        """The params that are stored with the model; dropout had no effect in an older version."""
        found = super().given
        return {**found, "dropout": 0.0} if found.get("dropout_mode") == "noop" else found

    @cached_property
    def sensors(self) -> tuple[str, ...]:
        """The sensors whose slides the model was evaluated on."""
        return ordered(self.predictions.sensors.tolist())

    @property
    def trained(self) -> Mapping[str, int]:
        """The number of slides with the role train, by sensor."""
        found: Mapping[str, int] = self.config.get("counts", {}).get("train", {})
        return found

    @property
    def learned(self) -> Mapping[str, int]:
        """The number of slides that the model learned from, by sensor: a readout also learns from those of validation."""
        params = self.params
        if (
            self.architecture in ("minirocket", "statistics")
            and params.get("use_validation")
            and params.get("labels") != "permuted"
        ):
            watched = self.config["counts"].get("val", {})
            return {sensor: count + watched.get(sensor, 0) for sensor, count in self.trained.items()}
        batch, percent = int(params.get("batch", 32)), int(params.get("subsample_percent", 100))
        return {
            sensor: kept(count, batch, percent) if sensor == params.get("subsample_sensor") else count
            for sensor, count in self.trained.items()
        }

    @property
    def architecture(self) -> str:
        """The kind of model."""
        return str(self.config.get("architecture", self.params.get("architecture", "")))

    @property
    def place(self) -> tuple[str, str]:
        """The split and the layout of its slides: what is given together of results is of one of each."""
        split = self.config.get("split", "")
        layouts = {one.get("layout", "time") for one in self.config.get("sensors", {}).values()}
        described = str(split.get("scheme", "")) if isinstance(split, Mapping) else str(split)
        return described, "authors" if "authors" in layouts else "time"


def settings(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return all that makes a method of each result.

    That is architecture, joint or not, number of training slides, layout and split of the slides, and all params but the
    seed; what is of no effect is left out.
    """
    places = [one.place for one in results]
    main = max(dict.fromkeys(places), key=places.count, default=("", "time"))
    whole: dict[tuple[str, str], dict[str, int]] = {}  # the largest number of training slides, by place and sensor
    for one, place in zip(results, places, strict=True):
        for sensor, count in one.trained.items():
            most = whole.setdefault(place, {})
            most[sensor] = max(count, most.get(sensor, 0))
    few: list[float] = []
    return [
        {**_settings(one), "elsewhere": place != main, **_few(one, whole.get(place, {}), few)}
        for one, place in zip(results, places, strict=True)
    ]


def plain(settings: Tree, *but: str) -> bool:
    """Return whether a method of these settings was trained on all materials and slides, with true labels and pairs.

    This is what tables compare; the settings in ``but`` may be others.
    """
    return all(name in but or settings[name] in usual for name, usual in _PLAIN.items())


def line(method: Method) -> str:
    """Return a method's name but for the number of slides: what a curve over that is called."""
    settings = method.settings
    parts = [base_name({**settings, "few": "", "subsample_sensor": ""})]
    parts += [mark for mark in marks(method.differing) if not mark.endswith("shuffle")]
    if settings["joint"] and (settings["few_of"] or settings["subsample_sensor"]):
        parts.append("other sensor whole")
    if not settings.get("shuffle", True):
        parts.append("fixed batches")
    return " · ".join(parts)


def sensors_of(methods: Sequence[Method]) -> tuple[str, ...]:
    """Return the sensors that any of some methods was evaluated on."""
    return ordered([sensor for method in methods for one in method.details for sensor in one.sensors])


def of(method: Method, sensor: str) -> list[Run]:
    """Return the runs of a method that were evaluated on slides of ``sensor``."""
    return [run for run in method.runs if sensor in run.details.sensors]


def ordered(sensors: Collection[str]) -> tuple[str, ...]:
    """Return sensors, each once, in the order of tables: those of the paper first."""
    known = list(SENSORS)
    return tuple(sorted(set(sensors), key=lambda one: (known.index(one) if one in known else len(known), one)))


def shown(sensor: str) -> str:
    """Return a sensor's name as texts have it.

    >>> shown("biotac"), shown("xela1")
    ('BioTac', 'xela1')
    """
    return SENSORS.get(sensor, sensor)


def kept(slides: int, batch: int, ratio: int) -> int:
    """Return how many slides a sensor learns from that keeps ``ratio`` % of the full batches.

    90 % leaves out each tenth batch, the others keep each second, fourth, sixth and ninth.

    >>> [kept(600, 32, ratio) for ratio in (100, 90, 50, 25, 17, 11)]
    [600, 512, 288, 160, 96, 64]
    """
    every = {50: 2, 25: 4, 17: 6, 11: 9}
    batches = range(slides // batch)
    if ratio == 100:
        return slides
    return batch * sum(number % 10 != 0 if ratio == 90 else number % every[ratio] == 0 for number in batches)


def base_name(settings: Tree, variants: bool = True) -> str:
    """Return the name that a method has before it is derived from others like it."""
    architecture = str(settings["architecture"])
    name = _ARCHITECTURES.get(architecture, architecture)
    if settings["frozen_sensor"]:
        name = "mapping to known space"
    elif settings["joint"]:
        name += " joint"
    elif architecture == "raec":
        name += " independent"
    if not variants:
        return name
    held_out = (one.strip().partition("=") for one in str(settings["hold_out"]).split(";") if settings["hold_out"])
    parts = [
        name,
        "with vibration" if settings["vibration"] else "",
        "permuted pairs" if settings["pairing"] == "permuted" else "",
        "permuted labels" if settings["labels"] == "permuted" else "",
        f"{shown(settings['subsample_sensor'])} {settings['subsample_percent']} %"
        if settings["subsample_sensor"]
        else "",
        *(f"{shown(sensor)} without {materials.replace(',', ', ')}" for sensor, _, materials in held_out),
        f"{settings['few']} slides" if settings["few"] else "",
    ]
    return " · ".join(filter(None, parts))


def _settings(run: Result) -> dict[str, Any]:
    """Return all that makes a method but the number of its slides; what is of no effect is left out."""
    config, params, architecture = run.config, run.params, run.architecture
    frozen = str(params.get("frozen_sensor", ""))
    joint = bool(config.get("joint", architecture == "raec" and params.get("joint", False)))
    closed = _CLOSED.get(architecture)
    ratio = 100 if closed else int(params.get("subsample_percent", 100))
    idle = {
        *_NO_METHOD,
        "features",
        "use_validation",
        "speeds",
        *((_RAECS + _PAIRS) if architecture == "x-lstm" else () if joint or frozen else _PAIRS),
    }
    split, layout = run.place
    return {
        **{name: value for name, value in params.items() if (name in closed if closed else name not in idle)},
        "architecture": architecture,
        "joint": joint,
        "frozen_sensor": bool(frozen),  # each run reports on the sensor that was mapped, so both are one method
        "pairing": str(params.get("pairing", "random")) if joint or frozen else "random",
        "labels": str(params.get("labels", "true")),
        "subsample_sensor": str(params.get("subsample_sensor", "")) if ratio < 100 else "",
        "subsample_percent": ratio if params.get("subsample_sensor") else 100,
        "hold_out": "" if architecture in ("minirocket", "statistics") else str(params.get("hold_out", "")),
        "vibration": "vibration" in config.get("quantities", str(params.get("quantities", "")).split(","))
        and "vibration" not in config.get("absent", ()),
        "layout": layout,
        "split": split,
        "simulated": run.simulated,
    }


def _few(run: Result, whole: Mapping[str, int], described: list[float]) -> dict[str, str]:
    """Return the number of training slides of a run where it has not all, and the sensor that this is so for if not all.

    Numbers are rounded to those of other runs that have about as many; ``described`` has the fractions of before. A
    sensor that learns from some batches alone has all slides: that is a setting.
    """
    fewer = {}
    for sensor in ordered(run.trained):
        fraction = run.trained[sensor] / max(whole[sensor], 1)
        if fraction > _SAME:
            continue
        same = [one for one in described if _SAME < one / fraction < 1 / _SAME]
        if not same:
            described.append(fraction)
        fewer[sensor] = str(round((same or [fraction])[0] * whole[sensor]))
    if set(fewer) == set(run.trained) and len(set(fewer.values())) == 1:
        return {"few": next(iter(fewer.values())), "few_of": ""}
    few = ", ".join(f"{shown(sensor)} {count}" for sensor, count in fewer.items())
    return {"few": few, "few_of": ",".join(fewer)}
