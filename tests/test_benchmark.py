"""`make benchmark` runs the commands that are declared, and its table states what part of a schedule was run."""

import csv
import importlib
import io
from pathlib import Path
from typing import Any

import pytest

from tacpipe.comparison import engine
from tacpipe.plugins import registry
from tacpipe.report.papers import read_papers
from tests.tasks.touch.report import touch_fakes

ROOT = Path(__file__).parents[1]


@pytest.fixture
def published(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module("published")


def test_every_task_has_a_set_and_every_set_has_its_paper_and_layouts(published: Any) -> None:
    assert {each.task for each in published.SETS} == set(registry.tasks())
    for each in published.SETS:
        assert not each.paper or each.paper in read_papers()
        for command in each.sources.values():
            layouts = [word for word in command.split() if word.endswith(".toml")]
            assert all((ROOT / layout).is_file() for layout in layouts)


def test_an_official_test_replaces_the_folds_and_is_kept_apart_from_training(published: Any, tmp_path: Path) -> None:
    (flat,) = [each for each in published.SETS if each.task == "forward"]
    for name in ("a", "b"):
        (tmp_path / "xela_flat_pick_move" / name).mkdir(parents=True)
    benchmark = published.Benchmark(flat, tmp_path, tmp_path / "work")
    (folds,) = benchmark.all_folds
    assert folds.count == 5 and "the official test is absent" in benchmark.tested_on(folds)
    assert benchmark._folders("xela_flat_pick_move") == {"": tmp_path / "xela_flat_pick_move"}

    (tmp_path / "xela_flat_pick_move" / "test" / "c").mkdir(parents=True)
    (folds,) = benchmark.all_folds
    assert folds.count == 1 and folds.split.startswith("--scheme authors")
    assert benchmark.tested_on(folds) == "the official test"
    folders = benchmark._folders("xela_flat_pick_move")
    assert {role: sorted(path.name for path in folder.iterdir()) for role, folder in folders.items()} == {
        "train": ["a", "b"],
        "test": ["test"],
    }


def test_folds_and_seeds_are_independent_and_quick_ones_are_fewer(
    published: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (grasps,) = [each for each in published.SETS if each.task == "touch"]
    (tmp_path / "vision2tactile").mkdir()
    commands: list[str] = []
    monkeypatch.setattr(published.Benchmark, "_run", lambda _, command: commands.append(command))
    benchmark = published.Benchmark(grasps, tmp_path)
    benchmark.measure(quick=False)
    known = [command for command in commands if command.startswith("train") and "split-known" in command]
    assert [command.split("--seed ")[1][0] for command in known] == ["0", "1", "2"] * 2
    assert all("--fold 0-4 " in command for command in known)
    assert any("--epochs 250" in command and "--points 750" in command for command in known)
    commands.clear()
    benchmark.measure(quick=True)
    known = [command for command in commands if command.startswith("train") and "split-known" in command]
    assert len(known) == 4 and all("--fold 0 " in command for command in known)
    assert any("--epochs 2" in command.split("--points 250")[-1] for command in known)


def test_all_four_targets_have_rows_and_the_papers_network_states_its_fraction(published: Any) -> None:
    (grasps,) = [each for each in published.SETS if each.task == "touch"]
    folds, pointnet = grasps.folds[0], grasps.methods[1]
    schedule = published.schedule_parts(pointnet, folds, [Path("0/0"), Path("1/0")], quick=True)
    assert schedule == ["2 of 250 epochs", "250 of 750 points", "1 of 5 folds", "2 of 3 seeds"]
    complete = [Path(f"{seed}/{fold}") for seed in range(3) for fold in range(5)]
    assert published.schedule_parts(pointnet, folds, complete, quick=False) == []

    comparisons = engine.compare([touch_fakes.result("pointnet", off=0.04)])
    rows = [published.result_cells("PointNet", each.best, each, "touch") for each in comparisons]
    assert [row[0].split(",")[0] for row in rows] == [
        "PDC thumb", "PDC middle finger", "electrodes thumb", "electrodes middle finger",
    ]  # fmt: skip
    assert rows[0][-1] == "0.05496 fraction of the range (Figure 10)" and rows[0][3] == "0.04"


def test_the_table_of_the_page_has_the_columns_that_the_script_writes(published: Any) -> None:
    text = (ROOT / "docs" / "results" / "published.csv").read_text(encoding="utf-8")
    rows = list(csv.DictReader(io.StringIO(text)))
    assert tuple(rows[0]) == published.HEADS
    assert {row["set"] for row in rows} == {each.name for each in published.SETS}
