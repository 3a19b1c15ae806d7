"""The errors of several predictors of the same windows, as metrics and tables."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacpipe import metrics

Floats = NDArray[np.floating[Any]]
Masks = Mapping[str, NDArray[np.bool_]]  # name of a group of channels, (channel,)
Tree = dict[str, Any]  # names down to numbers

MODEL, BASELINE = "model", "persistence"


@dataclass(frozen=True)
class Prediction:
    """What one predictor says about some windows: latents (window, step, latent), counts (window, step, channel)."""

    latent: Floats
    count: Floats


@dataclass
class Errors:
    """Sums of one predictor's errors over the windows of a recording, each (step, latent) or (step, channel)."""

    latent_squared: Floats
    feature_squared: Floats
    count_squared: Floats
    count_absolute: Floats

    @classmethod
    def of(cls, predicted: Prediction, truth: Prediction, feature_half: Floats) -> Errors:
        """Return the errors of ``predicted``; ``feature_half`` (latent,) is what scaling divides latents by."""
        latent = metrics.squared_sums(predicted.latent, truth.latent)
        return cls(
            latent,
            latent / feature_half**2,
            metrics.squared_sums(predicted.count, truth.count),
            metrics.absolute_sums(predicted.count, truth.count),
        )

    def __add__(self, other: Errors) -> Errors:
        """Return the errors over the windows of both."""
        return Errors(*(getattr(self, name) + getattr(other, name) for name in self.__dataclass_fields__))


@dataclass
class Trial:
    """The errors on one recording by predictor; empty where it holds no window."""

    name: str
    seen: bool  # in training or validation of the model
    windows: int = 0
    errors: dict[str, Errors] = field(default_factory=dict)

    def add(self, predictions: Mapping[str, Prediction], truth: Prediction, feature_half: Floats) -> None:
        """Count some more windows of the recording."""
        self.windows += len(truth.count)
        for name, predicted in predictions.items():
            found = Errors.of(predicted, truth, feature_half)
            self.errors[name] = self.errors[name] + found if name in self.errors else found


def channel_groups(layout: Sequence[Mapping[str, str]]) -> dict[str, NDArray[np.bool_]]:
    """Return masks (channel,) for all channels, each sensor (``sensor1``… in order of columns) and each axis."""
    groups = {"all": np.ones(len(layout), dtype=bool)}
    streams = list(dict.fromkeys(one["stream"] for one in layout if "stream" in one))
    for number, stream in enumerate(streams, 1):
        groups[f"sensor{number}"] = np.array([one.get("stream") == stream for one in layout])
    for axis in sorted({one["axis"] for one in layout if "axis" in one}):
        groups[axis] = np.array([one.get("axis") == axis for one in layout])
    return groups


def summary(trials: Sequence[Trial], groups: Masks, horizon: int, seed: int = 0) -> Tree:
    """Return the metrics of ``metrics.json``: unseen recordings at the top, those the model has seen under ``seen``."""
    unseen, seen = [one for one in trials if not one.seen], [one for one in trials if one.seen]
    tree = _summary(unseen, groups, horizon, seed)
    if seen:
        tree["seen"] = _summary(seen, groups, horizon, seed)
    return tree


def horizons_csv(tree: Tree, rate_hz: float) -> bytes:
    """Return the errors by predictor and step of ``summary``'s unseen recordings."""
    rows = [
        (
            name,
            step,
            round(1000 * step / rate_hz, 3),
            *(scores["mse_latent"][f"t{step}"], scores["mse_counts"]["all"][f"t{step}"]),
            scores["mae_counts"]["all"][f"t{step}"],
        )
        for name, scores in tree.items()
        if "mse_counts" in scores and name != "skill"
        for step in range(1, len(scores["mse_latent"]))
    ]
    return _csv(("predictor", "step", "horizon_ms", "mse_latent", "mse_counts", "mae_counts"), rows)


def trials_csv(trials: Sequence[Trial]) -> bytes:
    """Return one line a recording: windows, mean squared error of model and persistence in counts, and skill."""
    rows = []
    for one in trials:
        errors: list[float | str] = ["", "", ""]
        if one.windows:
            model, baseline = (float(one.errors[name].count_squared.mean()) for name in (MODEL, BASELINE))
            gain = float(metrics.skill(np.array([model]), np.array([baseline]))[0])
            told = (model / one.windows, baseline / one.windows, gain)
            errors = [_rounded(value) if math.isfinite(value) else "" for value in told]
        rows.append((one.name, str(one.seen).lower(), one.windows, *errors))
    return _csv(("recording", "seen", "windows", "mse_counts_model", "mse_counts_persistence", "skill"), rows)


def _summary(trials: Sequence[Trial], groups: Masks, horizon: int, seed: int) -> Tree:
    """Return errors of each predictor, skill and counts over the recordings that hold windows."""
    held = [one for one in trials if one.windows]
    windows = np.array([one.windows for one in held], dtype=np.int64)
    counts = {
        "windows": int(windows.sum()),
        "recordings": len(held),
        "recordings_without_window": len(trials) - len(held),
        "effective_windows": int(windows.sum()) // horizon,  # as many would fit without overlap of their horizons
    }
    tree: Tree = {"counts": counts}
    for name in held[0].errors if held else ():
        errors = [one.errors[name] for one in held]
        tree[name] = {
            "mse_latent": _steps(np.stack([one.latent_squared for one in errors]), windows),
            "mse_feature": _steps(np.stack([one.feature_squared for one in errors]), windows),
            "mse_counts": _grouped(np.stack([one.count_squared for one in errors]), windows, groups),
            "mae_counts": _grouped(np.stack([one.count_absolute for one in errors]), windows, groups),
        }
    if held:
        tree["skill"] = {
            told: _intervals(_by_step(held, MODEL, kept), _by_step(held, BASELINE, kept), seed)
            for told, kept in (("mse_counts", "count_squared"), ("mse_latent", "latent_squared"))
        }
    return tree


def _steps(sums: Floats, windows: NDArray[np.int64]) -> Tree:
    """Return the mean error by step and over all steps; ``sums`` is (recording, step, channel)."""
    error = metrics.mean_error(sums, windows)
    return {f"t{step}": _rounded(value) for step, value in enumerate(error, 1)} | {"mean": _rounded(error.mean())}


def _grouped(sums: Floats, windows: NDArray[np.int64], groups: Masks) -> Tree:
    """Return the mean error by group of channels and step."""
    return {name: _steps(sums[:, :, mask], windows) for name, mask in groups.items()}


def _by_step(trials: Sequence[Trial], predictor: str, kept: str) -> Floats:
    """Return one kind of a predictor's error sums over all channels, shape (recording, step)."""
    return np.stack([getattr(one.errors[predictor], kept).sum(axis=1) for one in trials])


def _intervals(model: Floats, baseline: Floats, seed: int) -> Tree:
    """Return skill with its interval by step and over all; what is not defined is left out. Sums (recording, step)."""
    wide = [np.hstack([sums, sums.sum(axis=1, keepdims=True)]) for sums in (model, baseline)]  # (recording, step + 1)
    found = metrics.skill_interval(wide[0], wide[1], seed=seed)
    names = [f"t{step}" for step in range(1, model.shape[1] + 1)] + ["mean"]
    tree: Tree = {}
    for index, name in enumerate(names):
        told = {part: float(getattr(found, part)[index]) for part in ("mean", "low", "high")}
        tree[name] = {part: _rounded(value) for part, value in told.items() if math.isfinite(value)}
    return {name: one for name, one in tree.items() if one}


def _rounded(value: float) -> float:
    """Return ``value`` to 9 digits: more would differ between machines."""
    return float(f"{value:.9g}")


def _csv(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> bytes:
    """Return a CSV file with ``header``."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue().encode()
