"""Read the predictions of a model and its baselines for each unseen slide."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pyarrow as pa

from tacpipe.arrays import Bools
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.tasks.material.headline import Naming
from tacpipe.tasks.material.params import MaterialConfig

MODEL, LEVEL, SWAPPED, LAST = "model", "mean_level", "swapped", "last_epoch"
SHUFFLED = "permuted_labels"
LEVEL_ONLY, LEVEL_REMOVED = "level_only", "level_removed"  # baselines of the architecture statistics
PREDICTORS = (MODEL, LEVEL, LEVEL_ONLY, LEVEL_REMOVED, SHUFFLED, SWAPPED, LAST)


def read_predictions(table: pa.Table, config: MaterialConfig) -> pd.DataFrame:
    """Return one row per unseen slide: recording, sensor, material, session if any, and each predictor's material.

    Materials are numbers or text; a predictor that names none has NA. As in the result's own metrics, three kinds of
    slides are excluded: those of materials held out of a sensor's labels, those of an incomplete last batch if
    ``config`` omits it, and those of a sensor whose network was only copied.
    """
    names = [name for name in ("recording", "sensor", "material", "session", *PREDICTORS) if name in table.column_names]
    rows: pd.DataFrame = table.to_pandas(types_mapper={pa.int32(): pd.Int32Dtype()}.get)
    return rows.loc[_counted_slides(rows, config), names].reset_index(drop=True)


def _counted_slides(rows: pd.DataFrame, config: MaterialConfig) -> Bools:
    """Return a mask (slide,) of the rows to evaluate."""
    naming = Naming.from_json(config)
    settings = params_of.used_params(registry.load("train.material"), config.get("params", {}))
    mask = ~rows["seen"].astype(bool) & (rows["sensor"] != str(settings.get("frozen_sensor", "")))
    for sensor, held_out in config.get("held_out", {}).items():
        materials = naming.names_for(np.array(held_out, np.int64)).tolist()
        mask &= ~((rows["sensor"] == sensor) & rows["material"].isin(materials))
    if settings.get("drop_last"):
        batch = settings["batch"]
        assert isinstance(batch, int)
        slides = rows.groupby("sensor")["sensor"].transform("size")
        mask &= rows.groupby("sensor").cumcount() < slides // batch * batch
    counted: Bools = mask.to_numpy(bool)
    return counted
