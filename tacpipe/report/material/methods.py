"""A result of an evaluation as a run, the runs of a method, and what that method is called."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.report import contents, provenance
from tacpipe.report.material import predictions
from tacpipe.report.material.predictions import Predictions

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

Tree = Mapping[str, Any]

PAPERS_SETS = ("biotac-slide", "roboskin")  # whose paper's tables and figures stand next to ours
SENSORS = {"biotac": "BioTac", "roboskin": "RoboSkin"}
_ARCHITECTURES = {"minirocket": "MiniRocket", "x-lstm": "X-LSTM", "raec": "RAEC", "spectra": "spatial spectra"}
_PLAIN = {
    "pairing": ("random", "fixed"),
    "labels": ("true",),
    "subsample_sensor": ("",),
    "hold_out": ("",),
    "few": ("",),
    "elsewhere": (False,),
}


@dataclass(frozen=True)
class Run:
    """One result: a model trained once and evaluated once."""

    dataset: Dataset
    config: Tree
    metrics: Tree
    history: Sequence[Tree]
    predictions: Predictions

    @classmethod
    def read(cls, dataset: Dataset) -> Run:
        """Return the run that a result holds."""
        config, metrics = (contents.tree(dataset, name) for name in ("config.json", "metrics.json"))
        found = predictions.read(dataset.recordings["predictions"].table(), config)
        return cls(dataset, config, metrics, contents.history(dataset), found)

    @cached_property
    def params(self) -> Tree:
        """What the model was trained with, as far as it counts for its architecture."""
        found: Tree = self.config.get("params", {})
        if found.get("dropout_mode") == "noop":  # of an older version, whose dropout had no effect then
            found = {**found, "dropout": 0.0}
        return params_of.counting(registry.load("train.material"), found)

    @property
    def sensors(self) -> tuple[str, ...]:
        """The sensors whose slides the model was evaluated on."""
        return ordered(set(self.predictions.sensors.tolist()))

    @property
    def trained(self) -> Mapping[str, int]:
        """The number of slides with the role train, by sensor."""
        found: Mapping[str, int] = self.config.get("counts", {}).get("train", {})
        return found

    @property
    def learned(self) -> Mapping[str, int]:
        """The number of slides that the model learned from, by sensor: a readout also learns from those of validation."""
        params = self.params
        if self.architecture == "minirocket" and params.get("use_validation") and params.get("labels") != "permuted":
            watched = self.config["counts"].get("val", {})
            return {sensor: count + watched.get(sensor, 0) for sensor, count in self.trained.items()}
        ratio = int(params.get("subsample_percent", 100))
        return {
            sensor: kept(count, int(params.get("batch", 32)), ratio)
            if sensor == params.get("subsample_sensor")
            else count
            for sensor, count in self.trained.items()
        }

    @property
    def architecture(self) -> str:
        """The kind of model."""
        return str(self.config.get("architecture", self.params.get("architecture", "")))

    @property
    def simulated(self) -> bool:
        """Whether its slides were simulated."""
        return provenance.simulated(self.dataset)

    @property
    def published(self) -> bool:
        """Whether its slides are those of the paper."""
        return provenance.published(self.dataset, PAPERS_SETS)


@dataclass(frozen=True)
class Method:
    """Runs that differ in seed or fold alone."""

    name: str
    settings: Tree  # what makes it this method, as `grouped` states
    marks: tuple[str, ...]  # what distinguishes it from others of its kind
    runs: tuple[Run, ...]

    @property
    def line(self) -> str:
        """Its name but for the number of slides: what a curve over that is called."""
        parts = [base_name({**self.settings, "few": "", "subsample_sensor": ""})]
        parts += [mark for mark in self.marks if not mark.endswith("shuffle")]
        if self.settings["joint"] and (self.settings["few_of"] or self.settings["subsample_sensor"]):
            parts.append("other sensor whole")
        if not self.settings.get("shuffle", True):
            parts.append("fixed batches")
        return " · ".join(parts)

    @property
    def kind(self) -> str:
        """What a table calls it, variants left out: ``RAEC joint``, ``MiniRocket``, ``mapping to known space`` …"""
        return base_name(self.settings, variants=False)

    @property
    def plain(self) -> bool:
        """Whether it was trained on all materials and slides, with true labels and pairs: what tables compare."""
        return self.differs_only()

    @property
    def sensors(self) -> tuple[str, ...]:
        """The sensors that any of its runs was evaluated on."""
        return ordered({sensor for run in self.runs for sensor in run.sensors})

    @property
    def simulated(self) -> bool:
        """Whether its slides were simulated."""
        return bool(self.settings["simulated"])

    @property
    def published(self) -> bool:
        """Whether all its runs were evaluated on slides of the paper."""
        return all(run.published for run in self.runs)

    def differs_only(self, *names: str) -> bool:
        """Return whether, but for these settings, it is as `plain` asks."""
        return all(name in names or self.settings[name] in usual for name, usual in _PLAIN.items())

    def of(self, sensor: str) -> list[Run]:
        """Return the runs that were evaluated on slides of ``sensor``."""
        return [run for run in self.runs if sensor in run.sensors]

    def key_without(self, *names: str) -> str:
        """Return what methods share that differ in these settings alone."""
        return json.dumps({name: value for name, value in self.settings.items() if name not in names}, sort_keys=True)


def ordered(sensors: set[str]) -> tuple[str, ...]:
    """Return sensors in the order of tables: those of the paper first."""
    known = list(SENSORS)
    return tuple(sorted(sensors, key=lambda one: (known.index(one) if one in known else len(known), one)))


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
    parts = [name]
    if settings["vibration"]:
        parts.append("with vibration")
    if settings["pairing"] == "permuted":
        parts.append("permuted pairs")
    if settings["labels"] == "permuted":
        parts.append("permuted labels")
    if settings["subsample_sensor"]:
        parts.append(f"{shown(settings['subsample_sensor'])} {settings['subsample_percent']} %")
    if settings["hold_out"]:
        for one in str(settings["hold_out"]).split(";"):
            sensor, _, materials = one.strip().partition("=")
            parts.append(f"{shown(sensor)} without {materials.replace(',', ', ')}")
    if settings["few"]:
        parts.append(f"{settings['few']} slides")
    return " · ".join(parts)
