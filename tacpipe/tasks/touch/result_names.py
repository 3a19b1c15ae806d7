"""Names of the parts of a result of the task ``touch``: written by its evaluation, read by a report without torch."""

from __future__ import annotations

COVERAGE = "coverage.parquet"  # each value of each grasp, with the band that a calibrated model predicted
PREDICTIONS = "predictions"  # the recording; each name below is a stream of it, with the same grasps as rows
GRASPS, TRUE, MODEL = "grasps", "true", "model"
CONSTANT, OBJECT_MEAN, NEAREST_IN_TIME = "constant", "object_mean", "nearest_in_time"  # the baselines
