"""Report the bands of calibrated models: how often a measurement lies between the outer quantiles, and their width."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tacpipe.comparison.runs import MODEL, ComparedRun
from tacpipe.io.parquet import from_parquet
from tacpipe.report import charts
from tacpipe.report.blocks import NONE, Block, Cell, Chart, Charts, Fold, Table, estimate, fold, notes, number, table
from tacpipe.report.charts import Dot
from tacpipe.report.context import Context, read_json
from tacpipe.scores import calibration
from tacpipe.scores.calibration import COVERAGE_FILE

HEADS = ("", "values", "coverage (%)", "width", "pinball loss", "pinball loss below the baseline's (%)")
NOTE = (
    "Blue: the model; grey: baselines. A band has its nominal coverage if it is on the dashed line. Bars are 95 % "
    "intervals over recordings of known objects, or over unknown objects. The narrowest band with the correct coverage "
    "is best, as measured by the pinball loss (lower is better)."
)


def coverage_folds(
    context: Context,
    column: str,
    titles: Mapping[Any, str],
    baseline: str,
    unit: str,
    parts: Mapping[bool | None, str],
    *examples: Block,
) -> list[Fold]:
    """Return the coverage of calibrated models' bands and ``examples``; empty if no model is calibrated.

    ``titles`` names the values of ``column`` in `COVERAGE_FILE` that are shown, in ``unit``. The pinball loss is
    compared with that of ``baseline``. ``parts`` names known and unknown objects.
    """
    import pandas as pd

    drawn: list[Chart] = []
    tables: list[Table] = []
    for method in context.methods:
        runs = [run for run in method.runs if COVERAGE_FILE in run.dataset.files]
        if not runs:
            continue
        coverage = pd.concat([from_parquet(run.dataset.files[COVERAGE_FILE]).to_pandas() for run in runs])
        if "seen" in coverage:
            coverage = coverage[~coverage["seen"]]
        is_single = coverage["known"] | coverage["object"].isna()  # the recording is a cluster of its own
        coverage["cluster"] = coverage["recording"].where(is_single, coverage["object"])
        levels = _outer_levels(runs)
        for known_objects in (True, False):
            rows_of_part = coverage[coverage["known"] == known_objects]
            if not len(rows_of_part):
                continue
            bands = calibration.measure_bands(rows_of_part, column, "cluster", baseline)
            dots: list[Dot] = []
            rows: list[Sequence[str | Cell]] = []
            for key, title in titles.items():
                for predictor in dict.fromkeys([MODEL, *(name for at, name in bands if at == key)]):
                    if (key, predictor) not in bands:
                        continue
                    band, name = bands[key, predictor], context.task.predictor_name(predictor)
                    kind = "model" if predictor == MODEL else "baseline"
                    mean, low, high = (100 * end for end in band.coverage)
                    dots.append(Dot(name, mean, low, high, kind, title))
                    rows.append(
                        [
                            f"{title}: {name}",
                            f"{band.values:,}",
                            estimate(band.coverage, 0, factor=100),
                            number(band.width, 3),
                            number(band.pinball, 3),
                            NONE if predictor == baseline else estimate(band.gain, 0, factor=100),
                        ]
                    )
            level = {title: float(levels[1] - levels[0]) for title in titles.values()}
            spec = charts.ranking(dots, "coverage (% of values)", level=level, row=18)
            where = f"{method.name}, {parts[known_objects]}"
            drawn.append(Chart(f"Coverage of the {levels[0]} to {levels[1]} % band: {where}", spec))
            tables.append(table(f"{where}; width and pinball loss in {unit}", HEADS, rows))
    return fold("Uncertainty", Charts(drawn), notes(NOTE), *tables, *examples) if tables else []


def _outer_levels(runs: Sequence[ComparedRun]) -> tuple[int, int]:
    """Return the lowest and the highest level in percent of the first run's quantiles."""
    levels = read_json(runs[0].dataset, "config.json")["quantiles"]["levels"]
    return levels[0], levels[-1]
