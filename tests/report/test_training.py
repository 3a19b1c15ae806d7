"""The chart of a training's loss."""

import json
import math
from typing import Any

from tacpipe.report.training import losses_by_epoch
from tests.report import parts
from tests.tasks.touch.report.touch_fakes import result


def lines(*losses: float | None, **labels: Any) -> list[Any]:
    return [{"epoch": epoch, "train_loss": 1.0, "val_loss": loss, **labels} for epoch, loss in enumerate(losses, 1)]


def test_networks_are_averaged_by_epoch_up_to_the_end_of_the_shortest() -> None:
    history = lines(1.0, 0.5, 0.4, network=0) + lines(3.0, 1.5, network=1)
    assert losses_by_epoch(history, "val_loss") == [2.0, 1.0]
    assert losses_by_epoch(lines(1.0, target="a") + lines(2.0, target="b"), "val_loss") == [1.5]


def test_epochs_without_the_loss_are_gaps_and_a_training_without_any_has_no_curve() -> None:
    gap, value = losses_by_epoch(lines(None, 1.0), "val_loss")
    assert math.isnan(gap) and value == 1.0
    assert losses_by_epoch(lines(None, None), "val_loss") == []


def test_the_best_method_that_was_trained_in_epochs_is_drawn() -> None:
    section = parts.section("touch", result("trees", off=0.02), result("pointnet", epochs=3), result("trees"))
    (chart,) = parts.charts([parts.folds(section)["Training"]])
    assert chart.title == "Loss by epoch: PointNet"
    assert {row["name"] for row in parts.values(chart)} == {"training", "validation"}
    assert "Training" not in parts.folds(parts.section("touch", result("trees")))


def test_a_training_of_one_epoch_is_seen_as_points() -> None:
    for epochs, has_points in ((1, True), (3, False)):
        section = parts.section("touch", result("pointnet", epochs=epochs))
        (chart,) = parts.charts([parts.folds(section)["Training"]])
        assert ("circle" in json.dumps(chart.spec)) == has_points
