"""Test the pooling and the table of `make learning-curve`."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacpipe.scores import intervals
from tests.stages.learning_fakes import motion
from tests.tasks.forward.trials import evaluated, trained
from tests.test_docs import module


def test_draws_are_pooled_by_recording_and_intervals_are_over_recordings() -> None:
    learning_curve: Any = module("learning_curve")
    rng = np.random.default_rng(0)
    draws = [{name: rng.uniform(1, 2, (2, 4)) for name in names} for names in (("a", "b", "c"), ("b", "d"))]
    pooled_point = learning_curve.point(draws, 8.5)
    pooled = np.stack([draws[0]["a"], draws[0]["b"] + draws[1]["b"], draws[0]["c"], draws[1]["d"]])
    skill = 1 - np.exp(np.log(pooled[:, 0, 1] / pooled[:, 1, 1]).mean())  # the one definition of skill
    interval = intervals.geometric_skill_interval(pooled[:, 0, :3], pooled[:, 1, :3])
    assert (pooled_point.trained, pooled_point.tested) == (8.5, 4)
    assert pooled_point.skill[1] == pytest.approx((skill, interval.low[1], interval.high[1]))
    assert pooled_point.mae[2] == pytest.approx(pooled[:, 0, 2].sum() / pooled[:, 0, 3].sum())
    skill_of_each_draw = [learning_curve.point([draw], 8.5).skill[1][0] for draw in draws]
    assert pooled_point.spread[1] == pytest.approx(np.std(skill_of_each_draw, ddof=1))
    assert np.isnan(learning_curve.point(draws[:1], 8.5).spread).all()
    (row,) = learning_curve.rows([pooled_point])
    assert list(row)[:3] == ["trained", "tested", "skill t+1"]
    assert row["trained"] == "8.5"


def test_error_sums_of_a_result_are_those_of_its_unseen_recordings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learning_curve: Any = module("learning_curve")
    monkeypatch.setattr(learning_curve, "STEPS", (1, 3, 4))
    metrics, result = evaluated(trained(tmp_path / "model", epochs=1), motion(20), motion(21), motion(0))
    (tmp_path / "errors.parquet").write_bytes(result.files["errors.parquet"])
    sums = learning_curve.sums(tmp_path)
    assert sorted(sums) == ["trial-20", "trial-21"]
    point = learning_curve.point([sums], 3.0)
    assert point.skill[0][0] == pytest.approx(metrics["skill"]["mae_counts_geometric"]["t1"]["mean"], rel=1e-6)
    assert point.mae[1] == pytest.approx(metrics["model"]["mae_counts"]["both"]["t3"], rel=1e-6)


def test_the_commands_train_smaller_sets_for_more_epochs_on_the_same_split(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    learning_curve: Any = module("learning_curve")
    commands: list[list[str]] = []

    def run(*words: object) -> None:
        commands.append([str(word) for word in words])
        if words[0] == "split":
            count = int(str(words[words.index("--few") + 1])) if "--few" in words else 45
            Path(str(words[3])).mkdir(parents=True)
            pq.write_table(pa.table({"role": ["train"] * count + ["val"]}), Path(str(words[3])) / "split.parquet")

    monkeypatch.setattr(learning_curve, "WORK", tmp_path)
    monkeypatch.setattr(learning_curve, "run", run)
    monkeypatch.setattr(learning_curve, "sums", lambda _: {"a": np.ones((2, 4)), "b": np.ones((2, 4))})
    points = [learning_curve.measure(tmp_path / "data", size, 1, ["--hidden", "8"]) for size in (8, 0)]
    assert [point.trained for point in points] == [8, 45]
    assert [words[0] for words in commands] == ["split", "train", "evaluate"] * 2
    assert [words[words.index("--epochs") + 1] for words in commands if words[0] == "train"] == ["30", "6"]
    assert all(words[-3:] == ["--hidden", "8", "--replace"] for words in commands if words[0] == "train")
