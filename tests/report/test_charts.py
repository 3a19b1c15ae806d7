"""Charts as specifications: their numbers, colours and ends."""

import json
from typing import Any

import numpy as np

from tacpipe.report import charts, context
from tacpipe.report.charts import Curve, Dot


def ranking(*dots: Dot) -> tuple[list[dict[str, Any]], list[float]]:
    spec: Any = charts.ranking(dots, "skill")
    return spec["data"]["values"], spec["layer"][2]["encoding"]["x"]["scale"]["domain"]


def test_what_is_not_defined_is_null_and_no_specification_holds_nan() -> None:
    specs = [
        charts.lines([Curve("a", [0, 1], [np.nan, 2.0], [0.0, np.nan], [1.0, 3.0])], "x", "y", level=("zero", 0.0)),
        charts.lines([Curve("a", [1, 2], [0.1, 0.2]), Curve("a", [1, 2], [0.1, 0.3], thin=True)], "x", "y", log=True),
        charts.lines([Curve("a", [0, 1], [0.2, 0.9])], "x", "y", diagonal=(0, 1)),
        charts.marked([("a", 0.5, np.nan)], "x", "y"),
        charts.ranking([Dot("a", 0.5, np.nan, np.nan), Dot("b", np.nan, np.nan, np.nan)], "x"),
        charts.scatter([{"x": 1.0, "y": 2.0, "name": "a"}], "x", "y", diagonal=True, level=("c", np.nan)),
        charts.matrix(np.array([[3, 1], [0, 4]]), ["a", "b"], "true", "named"),
        charts.bars({"1": 60.0, "2": 40.0}, "component", "%", marked=1),
        charts.grid(np.array([[2.0, -0.5], [-0.5, 0.0]]), "latent"),
        charts.plane([{"panel": "p", "x": 0.0, "y": 1.0, "strength": 0.5, "text": "1"}], ["p"], size=9),
    ]
    for spec in specs:
        assert json.loads(json.dumps(spec, allow_nan=False)) == spec
        assert "http" not in json.dumps(spec)


def test_names_keep_their_colour_from_chart_to_chart() -> None:
    scales = []
    for names in ("a", "b", "ab"):
        spec: Any = charts.lines([Curve(name, [1, 2], [0.1, 0.2]) for name in names], "x", "y", order=["a", "b"])
        scale = spec["layer"][-1]["encoding"]["color"]["scale"]
        scales.append(dict(zip(scale["domain"], scale["range"], strict=True)))
    assert {**scales[0], **scales[1]} == scales[2]
    assert len(set(scales[2].values())) == 2


def test_one_method_that_is_far_off_does_not_press_the_others_together() -> None:
    near = [Dot(f"n{place}", 0.1 * place, 0.1 * place - 0.05, 0.1 * place + 0.05) for place in range(5)]
    rows, ends = ranking(*near, Dot("far", -1000.0, -2000.0, -900.0))
    assert -5 < ends[0] < 0 < ends[1] < 1
    (far,) = [row for row in rows if row["name"] == "far"]
    assert (far["off"], far["mean"], far["x"]) == ("left", -1000.0, ends[0])
    assert all(row["off"] == "" for row in rows if row["name"] != "far")


def test_a_chart_of_skill_ends_at_its_floor() -> None:
    spec: Any = charts.lines(
        [Curve("far", [1, 2], [-1000.0, -500.0]), Curve("near", [1, 2], [0.1, 0.2])], "x", "y", floor=-1.0
    )
    assert spec["layer"][-1]["encoding"]["y"]["scale"]["domain"] == [-1.0, 0.2]


def test_a_long_line_is_thinned_and_keeps_its_extremes_and_its_gaps() -> None:
    y = np.sin(np.arange(100_000) / 700)
    y[41_234], y[70_000] = 7.0, -7.0
    y[50_000:52_000] = np.nan
    spec = charts.lines([Curve("a", np.arange(100_000.0), y)], "x", "y", points=False)
    drawn = [row["y"] for row in spec["data"]["values"]]
    assert len(drawn) <= charts.POINTS + 4
    assert (
        max(value for value in drawn if value is not None) == 7.0
        and min(value for value in drawn if value is not None) == -7.0
    )
    assert None in drawn


def test_a_covariance_shows_its_sign_by_colour_and_nothing_by_none() -> None:
    cells = charts.grid(np.array([[4.0, -1.0], [-1.0, 0.0]]), "latent")["data"]["values"]
    assert [(cell["row"], cell["column"], cell["above"], cell["strength"]) for cell in cells] == [
        (1, 1, True, 1.0), (1, 2, False, 0.5), (2, 1, False, 0.5)
    ]  # fmt: skip


def test_a_confusion_matrix_holds_its_counts() -> None:
    cells = charts.matrix(np.array([[3, 1], [0, 4]]), ["cork", "foam"], "true", "named")["data"]["values"]
    assert [(cell["row"], cell["column"], cell["count"], cell["right"]) for cell in cells] == [
        ("cork", "cork", 3, True), ("cork", "foam", 1, False), ("foam", "foam", 4, True)
    ]  # fmt: skip


def test_intervals_wider_than_the_differences_of_methods_are_drawn_whole() -> None:
    dots = [charts.Dot(f"m{place}", 0.0144 + 1e-5 * place, -0.03, 0.05) for place in range(5)]
    rows = charts.ranking(dots, "skill")["data"]["values"]
    assert {(row["low"], row["high"], row["off"]) for row in rows} == {(-0.03, 0.05, "")}


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
