"""A comparison has the same numbers and words in a result's files, `show`, `compare`, the report and the result page."""

import html
import importlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tacpipe.cli import headline_table
from tacpipe.cli.compare import Compared
from tacpipe.comparison import engine
from tacpipe.plugins import registry
from tacpipe.report import page
from tacpipe.scores import headline, words
from tacpipe.tasks.classify.params import ClassifyLinear
from tacpipe.tasks.regress.params import RegressLinear
from tests.fake_recordings import FakeDataset, FakeRecording, dataset
from tests.stages.learning_fakes import motion
from tests.tasks.forward import trials
from tests.tasks.learning.presses import presses
from tests.tasks.material import textures
from tests.tasks.slip.slip_recordings import trained
from tests.tasks.slip.slip_recordings import trials as slips
from tests.tasks.touch import handmade


def forward(folder: Path) -> Any:
    _, result = trials.evaluated(trials.trained(folder), *(motion(seed) for seed in range(20, 27)))
    return result


def material(folder: Path) -> Any:
    model = textures.trained(folder, textures.slides(0, 4), textures.slides(4, 1), architecture="minirocket")
    return textures.evaluated(model, textures.slides(5, 2))[1]


def touch(folder: Path) -> Any:
    return handmade.evaluated(handmade.trained(folder, architecture="trees"), handmade.recordings(6, 8))[1]


def slip(folder: Path) -> Any:
    from tacpipe.tasks.slip import evaluation
    from tacpipe.tasks.slip.params import SlipBoosting

    params = SlipBoosting(trees=10, leaves=4, leaf=10, learning_rate=0.3)
    model = trained(params, dataset(*slips(12)), None, folder)
    return evaluation.evaluate(model, dataset(*slips(8, 100)))


def learned(params: Any, folder: Path) -> Any:
    from tacpipe.tasks.learning import evaluation

    train = registry.load_task("regress" if params.KIND == "quantity" else "classify").train.function
    files = train(params, dataset(*presses(range(12))), None, folder).files
    return evaluation.evaluate(files, dataset(*presses(range(20, 28))))


def regress(folder: Path) -> Any:
    return learned(RegressLinear(target="ft_force", context_s=0.2), folder)


def classify(folder: Path) -> Any:
    return learned(ClassifyLinear(label="shape"), folder)


EVALUATIONS = (forward, material, touch, slip, regress, classify)


def test_every_task_is_compared() -> None:
    assert {evaluate.__name__ for evaluate in EVALUATIONS} == set(registry.tasks())


@pytest.fixture
def published(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module that writes the table of published sets."""
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    return importlib.import_module("published")


@pytest.mark.parametrize("evaluate", EVALUATIONS)
def test_a_comparison_is_the_same_wherever_it_is_stated(
    evaluate: Callable[[Path], Any], published: Any, tmp_path: Path
) -> None:
    evaluated = evaluate(tmp_path)
    recordings = {
        name: FakeRecording(output.streams, name, output.attributes) for name, output in evaluated.recordings.items()
    }
    result: Any = FakeDataset(recordings, evaluated.files)
    compared = engine.compare([result])
    wanted = {(entry.part, entry.target): entry for entry in headline.read(result.files[headline.FILE])}
    assert wanted and {(one.question.part, one.question.target) for one in compared} == wanted.keys()

    shown = headline_table.text(headline_table.read(result.files[headline.FILE]), 200)
    (in_compare,) = Compared({"r": result}, compared, True).to_json()["comparisons"][:1]
    report = html.unescape(re.sub(r"<[^>]+>", " ", page.render([result]).decode()))
    metrics = json.loads(result.files["metrics.json"])
    for comparison in compared:
        entry, row = wanted[comparison.question.part, comparison.question.target], comparison.best
        assert row is not None and comparison.headline is not None
        ours = [entry.gain, entry.low, entry.high, *entry.model.values]
        assert [row.gain.mean, row.gain.low, row.gain.high, *row.values] == pytest.approx(
            ours, rel=1e-4, nan_ok=True
        )  # float32
        assert comparison.headline.verdict == entry.verdict == row.gain.verdict
        assert words.clause(comparison.headline).replace("_", " ") == words.clause(entry).replace("_", " ")
        gained, interval = words.format_gain(entry.gain, entry.measure), words.bounds(entry)
        assert gained in shown and interval in shown and gained in report and interval in report
        *_, stated, _ = published.result_cells("method", row, comparison, paper="")
        assert stated.startswith(words.format_amount(entry.gain, entry.measure))
        assert stated.endswith(f": {words.CELLS[entry.verdict]}")
    first = next(row for row in in_compare["rows"] if row["kind"] == "model")
    assert first["gain"] == pytest.approx(compared[0].best.gain.mean, rel=1e-6)  # type: ignore[union-attr]
    assert_metrics_agree(compared[0].task, metrics, wanted)
    weakest = headline.weakest(list(wanted.values()))
    summary = json.loads(headline.write_summary(list(wanted.values())))
    assert summary["gain"] == pytest.approx(weakest.gain, rel=1e-5) and summary["n"] == weakest.clusters


def assert_metrics_agree(task: str, metrics: dict[str, Any], wanted: dict[tuple[str, str], headline.Headline]) -> None:
    """Expect the values of headlines in ``metrics.json``."""
    for (part, target), entry in wanted.items():
        values = entry.model.values
        if task == "material":
            sensor = next(name for name in metrics["model"]["accuracy"] if name.lower() == part.lower())
            assert values[0] == pytest.approx(100 * metrics["model"]["accuracy"][sensor], rel=1e-6)
        elif task == "slip":
            part_of = {"risk of a slip": "before", "detection of a slip": "during", "moment of a slip": "within"}
            assert values[0] == pytest.approx(metrics["model"]["auc"][part_of[target]]["value"], rel=1e-5)
        elif task == "forward" and not part:
            assert values[-1] == pytest.approx(metrics["skill"]["mae_counts_geometric"]["mean"]["mean"], rel=1e-5)
        elif task in ("regress", "classify"):
            stored = metrics[target or "classes"]["model"]
            assert list(values) == pytest.approx([stored[column] for column in entry.columns], rel=1e-5)
