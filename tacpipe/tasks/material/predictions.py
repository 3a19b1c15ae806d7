"""Read the predictions for each slide in a result, and compute the tables of scores that metrics and reports are made of."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pandas as pd
import pyarrow as pa

from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.scores.table import ScoreTable
from tacpipe.tasks.material import headline
from tacpipe.tasks.material.headline import UNKNOWN, Naming
from tacpipe.tasks.material.params import MaterialConfig

PREDICTIONS = "predictions"  # the recording of a result
MODEL, LEVEL, SWAPPED, LAST = "model", "mean_level", "swapped", "last_epoch"
SHUFFLED = "permuted_labels"
LEVEL_ONLY, LEVEL_REMOVED = "level_only", "level_removed"  # baselines of the architecture statistics
PREDICTORS = (MODEL, LEVEL, LEVEL_ONLY, LEVEL_REMOVED, SHUFFLED, SWAPPED, LAST)
ABOUT = ("recording", "sensor", "material", "seen", "session")  # other columns


def read_slides(table: pa.Table, config: MaterialConfig, predictors: Sequence[str] = PREDICTORS) -> pd.DataFrame:
    """Return one row per counted slide: recording, sensor, material, session if any, and each predictor's material.

    Materials are numbers or text; a predictor that names none has NA. Two further columns state whether the model was
    trained on the slide (``seen``), and whether its material is held out of its sensor's labels (``held_out``). Slides of
    an incomplete last batch do not count if ``config`` omits it, unless a sensor has fewer slides than a batch.
    """
    rows: pd.DataFrame = table.to_pandas(types_mapper={pa.int32(): pd.Int32Dtype()}.get)
    naming = Naming.from_json(config)
    rows = rows[[name for name in (*ABOUT, *predictors) if name in rows]]
    for name in set(predictors) & set(rows):
        rows[name] = rows[name].mask(rows[name] == UNKNOWN)
    rows["held_out"] = False
    for sensor, held_out in config.get("held_out", {}).items():
        materials = naming.names_for(np.array(held_out, np.int64)).tolist()
        rows["held_out"] |= (rows["sensor"] == sensor) & rows["material"].isin(materials)
    settings = params_of.used_params(registry.load("train.material"), config.get("params", {}))
    if settings.get("drop_last"):
        batch = settings["batch"]
        assert isinstance(batch, int)
        slides = rows.groupby("sensor")["sensor"].transform("size")
        rows = rows[rows.groupby("sensor").cumcount() < (slides // batch * batch).where(slides >= batch, slides)]
    return rows


def read_predictions(table: pa.Table, config: MaterialConfig) -> pd.DataFrame:
    """Return the rows of `read_slides` that a report compares: unseen slides of materials that are not held out.

    Slides of a sensor whose network was only copied are excluded.
    """
    rows = read_slides(table, config)
    frozen = params_of.used_params(registry.load("train.material"), config.get("params", {})).get("frozen_sensor", "")
    return rows[~rows["seen"] & ~rows["held_out"] & (rows["sensor"] != frozen)].reset_index(drop=True)


def score_tables(slides: pd.DataFrame, sensors: Iterable[str], classes: int) -> dict[str, ScoreTable]:
    """Return the table of scores of each sensor's slides, which are rows of `read_slides`, among ``classes``."""
    predictors = [str(name) for name in slides if name not in (*ABOUT, "held_out")]
    tables = {}
    for sensor in sensors:
        right: dict[str, Mapping[str, bool]] = {}
        for name in predictors:
            rows = slides[(slides["sensor"] == sensor) & slides[name].notna()]
            right[name] = dict(zip(rows["recording"], rows[name] == rows["material"], strict=True))
        tables[sensor] = headline.score_table(right, classes)
    return tables
