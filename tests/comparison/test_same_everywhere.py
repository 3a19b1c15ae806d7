"""The same comparison has the same numbers and words in the files of a result, in `show`, `compare` and the report."""

import html
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tacpipe.cli import headline_table
from tacpipe.cli.compare import Compared
from tacpipe.comparison import engine
from tacpipe.report import page
from tacpipe.scores import headline, words
from tests.fake_recordings import FakeDataset, FakeRecording, dataset
from tests.stages.learning_fakes import motion
from tests.tasks.forward import trials
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


@pytest.mark.parametrize("evaluate", [forward, material, touch, slip])
def test_a_comparison_is_the_same_wherever_it_is_stated(evaluate: Callable[[Path], Any], tmp_path: Path) -> None:
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
    first = next(row for row in in_compare["rows"] if row["kind"] == "model")
    assert first["gain"] == pytest.approx(compared[0].best.gain.mean, rel=1e-6)  # type: ignore[union-attr]
    assert_metrics_agree(compared[0].task, metrics, wanted)


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
