"""Add quantiles to a trained forecaster, as an additional file computed from its errors on recordings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tacpipe.datasets import model_files
from tacpipe.datasets.dataset import Dataset
from tacpipe.errors import UsageError
from tacpipe.io import terminal
from tacpipe.scores.calibration import check_levels, highest_promised_level
from tacpipe.tasks.forward import tracks
from tacpipe.tasks.forward.evaluation import check_rate
from tacpipe.tasks.forward.forecaster import CONFIG, Forecaster
from tacpipe.tasks.forward.predictors import forecasts
from tacpipe.tasks.forward.quantiles import FILE, ForecastQuantiles, WindowErrors, fewer
from tacpipe.tasks.forward.training import check_codec
from tacpipe.tasks.recordings import add_calibration, trained_on_datasets
from tacpipe.tasks.task import CalibrationRequest

FITTED = 5000  # number of windows for fitting quantiles, evenly spread over training recordings
CORRECTED = 400  # number of windows per calibration recording


def calibrate(
    model: Mapping[str, bytes], request: CalibrationRequest, training: Dataset, calibration: Dataset
) -> dict[str, bytes]:
    """Return the files of a model with quantiles of its error, fitted on training and corrected on calibration recordings.

    Raises `UsageError` if a calibration recording was used for training or early stopping, and `TacpipeError` if the
    model cannot read the recordings, if they contain no window, or if there are too few of them.
    """
    check_levels(request.quantiles)
    forecaster = Forecaster.load(model)
    _check_unused(forecaster, calibration)
    training_errors = errors_of(forecaster, training, max(1, FITTED // max(1, len(training.recordings))))
    errors = errors_of(forecaster, calibration, CORRECTED)
    levels = np.array(request.quantiles) / 100
    quantiles = ForecastQuantiles.fit(levels, training_errors, errors, promised=request.promise, seed=request.seed)
    count = len(np.unique(errors.recordings))
    config = forecaster.config.copy()
    config["quantiles"] = {
        "levels": list(request.quantiles),
        "method": "promised" if request.promise else "pooled",
        "recordings": {"fitted": len(np.unique(training_errors.recordings)), "corrected": count},
        "most_promised": highest_promised_level(count),
    }
    config["trained_on"] = add_calibration(config["trained_on"], trained_on_datasets(training, calibration))
    return {
        **model,
        CONFIG: model_files.to_json(config),
        FILE: quantiles.to_bytes(),
    }


def _check_unused(forecaster: Forecaster, calibration: Dataset) -> None:
    """Raise `UsageError` for calibration recordings that were used for training, early stopping or shrinkage."""
    digests = set(forecaster.config["trained_on"].values())
    used = sorted(name for name, shard in calibration.recordings.items() if shard.digest in digests)
    if used:
        raise UsageError(
            f"The model was trained, stopped or calibrated with the recording {used[0]}, so its errors there are too small "
            f"to calibrate on. Make a split with `tacpipe split --calibration 0.15`; train and calibrate with it."
        )


def errors_of(forecaster: Forecaster, recordings: Dataset, limit: int) -> WindowErrors:
    """Return the model's errors on at most ``limit`` evenly spread windows of each recording.

    Raises `TacpipeError` if the recordings do not fit the model or contain no window.
    """
    check_codec(forecaster.codec_files, recordings.files)
    parts: list[tuple[Any, ...]] = []
    with terminal.progress_bar("calibrate", len(recordings.recordings)) as advance:
        for index, (name, shard) in enumerate(sorted(recordings.recordings.items())):
            track = forecaster.track(shard)
            check_rate(track, forecaster)
            starts = fewer(track.starts(forecaster.context, forecaster.horizon), limit)
            track.count_rows(starts, forecaster.context + forecaster.horizon)
            for forecast in forecasts(forecaster, track, starts):
                past, truth = track.tactile[forecast.past], track.tactile[forecast.future]
                parts.append(
                    (
                        forecaster.error_features(forecast.windows, past, forecast.count),
                        (truth - forecast.count).transpose(0, 2, 1).astype(np.float32),
                        (truth - past[:, -1:]).transpose(0, 2, 1).astype(np.float32),
                        np.full(len(past), index),
                    )
                )
            advance(note=name)
    if not parts:
        subject = f"The {len(recordings.recordings)} recordings hold"
        raise tracks.no_window(subject, recordings, forecaster.context, forecaster.horizon)
    return WindowErrors(*map(np.concatenate, zip(*parts, strict=True)))
