"""Curves over the epochs of training."""

import numpy as np

from tacpipe.report import context


def test_runs_are_thin_lines_and_their_mean_a_thick_one_as_long_as_the_shortest() -> None:
    rows = context.loss_chart({"a": [[1.0, 0.5], [1.0, 0.4, 0.3]], "b": [[1.0]]}, "loss", log=True)["data"]["values"]
    thick = [(row["name"], row["x"], row["y"]) for row in rows if not row["thin"]]
    assert thick == [("a", 1.0, 1.0), ("a", 2.0, np.mean([0.5, 0.4])), ("b", 1.0, 1.0)]
    assert [row["thin"] for row in rows].count(True) == 5


def test_a_training_of_one_epoch_is_seen_as_points() -> None:
    marks = [
        [layer["mark"]["type"] for layer in context.loss_chart({"training": [curve]}, "loss")["layer"]]
        for curve in ([0.5], [0.5, 0.4])
    ]
    assert ["circle" in layer_marks for layer_marks in marks] == [True, False]
