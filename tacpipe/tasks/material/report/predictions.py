"""Read the predictions of a model and its baselines for each unseen slide."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tacpipe.arrays import AnyFloats, Bools, Int64s
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.tasks.material.headline import NUMBERS, Naming
from tacpipe.tasks.material.params import MaterialConfig

MODEL, LEVEL, SWAPPED, LAST = "model", "mean_level", "swapped", "last_epoch"
SHUFFLED = "permuted_labels"
LEVEL_ONLY, LEVEL_REMOVED = "level_only", "level_removed"  # baselines of the architecture statistics
PREDICTORS = (MODEL, LEVEL, LEVEL_ONLY, LEVEL_REMOVED, SHUFFLED, SWAPPED, LAST)
NOTHING = -1  # number of a missing prediction


@dataclass(frozen=True)
class SlidePredictions:
    """Predictions with one row per slide; training slides are excluded."""

    recordings: NDArray[np.str_]  # (slide,)
    sensors: NDArray[np.str_]  # (slide,)
    materials: Int64s  # (slide,), true material
    predicted: Mapping[str, Int64s]  # predictor -> (slide,)
    latents: AnyFloats | None  # (slide, latent); None if the model has no latents
    naming: Naming = NUMBERS  # names of the materials
    sessions: NDArray[np.str_] | None = None  # (slide,), empty string if unnamed; None in results without sessions

    def of(self, sensor: str) -> SlidePredictions:
        """Return the rows of one sensor."""
        rows = self.sensors == sensor
        predicted = {name: values[rows] for name, values in self.predicted.items()}
        latents = None if self.latents is None else self.latents[rows]
        sessions = None if self.sessions is None else self.sessions[rows]
        return SlidePredictions(
            self.recordings[rows], self.sensors[rows], self.materials[rows], predicted, latents, self.naming, sessions
        )

    def named(self, materials: Int64s) -> NDArray[Any]:
        """Return the names of materials (slide,): text, or numbers if the materials have no names."""
        return self.naming.names_for(materials)

    @property
    def one_session_each(self) -> bool:
        """Whether all slides of each material are of one session per sensor, so that the two effects cannot be separated."""
        if self.sessions is None or not len(self.sessions) or (self.sessions == "").any():
            return False
        sessions: dict[tuple[str, int], set[str]] = {}
        for sensor, material, session in zip(self.sensors, self.materials, self.sessions, strict=True):
            sessions.setdefault((str(sensor), int(material)), set()).add(str(session))
        return all(len(names) == 1 for names in sessions.values())


def read_predictions(table: pa.Table, config: MaterialConfig) -> SlidePredictions:
    """Return the predictions for unseen slides in the table ``predictions`` of a result.

    As in the result's own metrics, three kinds of slides are excluded: those of materials held out of a sensor's
    labels, those of an incomplete last batch if ``config`` omits it, and those of a sensor whose network was only
    copied.
    """
    naming = Naming.from_json(config)
    counted = table.filter(_counted_slides(table, config, naming))
    names = [name for name in counted.column_names if name.startswith("z") and name[1:].isdigit()]
    latents = np.column_stack([counted[name].to_numpy() for name in names]).astype(np.float64) if names else None
    sessions = None
    if "session" in counted.column_names:
        sessions = np.array([session or "" for session in counted["session"].to_pylist()], dtype=np.str_)
    return SlidePredictions(
        np.array(counted["recording"].to_pylist(), dtype=np.str_),
        np.array(counted["sensor"].to_pylist(), dtype=np.str_),
        _numbers(counted, "material", naming),
        {name: _numbers(counted, name, naming) for name in PREDICTORS if name in counted.column_names},
        latents if latents is not None and np.isfinite(latents).all() else None,
        naming,
        sessions,
    )


def _numbers(table: pa.Table, name: str, naming: Naming) -> Int64s:
    """Return a column of materials as numbers (slide,), with `NOTHING` for null."""
    if not naming.names:
        return table[name].fill_null(NOTHING).to_numpy().astype(np.int64)  # type: ignore[no-any-return]
    numbers = {material: number for number, material in enumerate(naming.names)}
    return np.array([numbers.get(label, NOTHING) for label in table[name].to_pylist()], np.int64)


def _counted_slides(table: pa.Table, config: MaterialConfig, naming: Naming) -> Bools:
    """Return a mask (slide,) of the rows to evaluate."""
    sensors = np.array(table["sensor"].to_pylist(), dtype=np.str_)
    materials = _numbers(table, "material", naming)
    settings = params_of.used_params(registry.load("train.material"), config.get("params", {}))
    mask: Bools = ~table["seen"].to_numpy(zero_copy_only=False).astype(bool)
    mask &= sensors != str(settings.get("frozen_sensor", ""))
    for sensor, held_out in config.get("held_out", {}).items():
        mask &= ~((sensors == sensor) & np.isin(materials, held_out))
    if settings.get("drop_last"):
        batch = settings["batch"]
        assert isinstance(batch, int)
        for sensor in np.unique(sensors):
            rows = np.flatnonzero(sensors == sensor)
            mask[rows[len(rows) // batch * batch :]] = False
    return mask
