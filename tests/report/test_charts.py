"""Charts as specifications: their numbers, colours and ends."""

import itertools
import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from tacpipe.report import charts
from tacpipe.report.charts import Curve, Dot


def ranking(*dots: Dot) -> tuple[list[dict[str, Any]], list[float]]:
    spec: Any = charts.ranking(dots, "skill")
    return spec["data"]["values"], spec["layer"][2]["encoding"]["x"]["scale"]["domain"]


def test_what_is_not_defined_is_null_and_no_specification_holds_nan() -> None:
    specs = [
        charts.lines([Curve("a", [0, 1], [np.nan, 2.0], [0.0, np.nan], [1.0, 3.0])], "x", "y", level=("zero", 0.0)),
        charts.lines([Curve("a", [1, 2], [0.1, 0.2]), Curve("b", [1, 2], [0.1, 0.3])], "x", "y", log=True),
        charts.lines([Curve("a", [1, 2], [np.nan, -5.0], [np.nan, -6.0], [np.nan, 0.5])], "x", "y", floor=-1.0),
        charts.lines([Curve("a", [0, 1], [0.2, 0.9])], "x", "y", diagonal=(0, 1)),
        charts.ranking([Dot("a", 0.5, np.nan, np.nan), Dot("b", np.nan, np.nan, np.nan)], "x"),
        charts.scatter([{"x": 1.0, "y": 2.0, "name": "a"}], "x", "y", diagonal=True, level=("c", np.nan)),
        charts.matrix(np.array([[3, 1], [0, 4]]), ["a", "b"], "true", "named"),
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


def test_a_confusion_matrix_holds_its_counts() -> None:
    cells = charts.matrix(np.array([[3, 1], [0, 4]]), ["cork", "foam"], "true", "named")["data"]["values"]
    assert [(cell["row"], cell["column"], cell["count"], cell["right"]) for cell in cells] == [
        ("cork", "cork", 3, True), ("cork", "foam", 1, False), ("foam", "foam", 4, True)
    ]  # fmt: skip


def test_intervals_wider_than_the_differences_of_methods_are_drawn_whole() -> None:
    dots = [charts.Dot(f"m{place}", 0.0144 + 1e-5 * place, -0.03, 0.05) for place in range(5)]
    rows = charts.ranking(dots, "skill")["data"]["values"]
    assert {(row["low"], row["high"], row["off"]) for row in rows} == {(-0.03, 0.05, "")}


def test_what_goes_on_below_the_floor_of_a_chart_has_an_arrow() -> None:
    curves = [
        Curve("far", [1, 2], [-1000.0, -500.0]),
        Curve("wide", [1, 2], [0.1, 0.2], [-3.0, 0.1], [0.3, 0.3]),
    ]
    spec: Any = charts.lines(curves, "x", "y", floor=-1.0)
    assert spec["layer"][-1]["encoding"]["y"]["scale"]["domain"] == [-1.0, 0.3]
    assert spec["layer"][-1]["mark"]["shape"] == "triangle-down"
    arrows = [(row["name"], row["x"], row["y"], row["below"]) for row in spec["data"]["values"] if "floor" in row]
    assert arrows == [("far", 1, None, "−1000"), ("far", 2, None, "−500"), ("wide", 1, 0.1, "0.1 (−3 to 0.3)")]
    without: Any = charts.lines([Curve("near", [1, 2], [0.1, 0.2])], "x", "y", floor=-1.0)
    assert without["layer"][-1]["mark"]["type"] == "circle"


def test_an_interval_is_whole_or_has_an_arrow_where_it_goes_on() -> None:
    near = [Dot(f"n{place}", 0.1 * place, 0.1 * place - 0.05, 0.1 * place + 0.05) for place in range(5)]
    rows, ends = ranking(*near, Dot("wide", 0.2, -900.0, 0.3), Dot("short", 0.2, -0.4, 0.3))
    by_name = {row["name"]: row for row in rows}
    assert (by_name["wide"]["on_left"], by_name["wide"]["on_right"], by_name["wide"]["low"]) == (True, False, ends[0])
    assert (by_name["short"]["on_left"], by_name["short"]["low"]) == (False, -0.4)
    spec: Any = charts.ranking([*near, Dot("wide", 0.2, -900.0, 0.3)], "skill")
    assert [layer["mark"]["shape"] for layer in spec["layer"][4:]] == ["triangle-left"]


# Machado, Oliveira and Fernandes, 2009: deuteranopia in linear RGB
DEUTERANOPIA = np.array([[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]])
TO_XYZ = np.array([[0.4339, 0.3762, 0.1899], [0.2127, 0.7152, 0.0722], [0.0178, 0.1095, 0.8727]])  # D65 is 1, 1, 1


def lab(rgb: np.ndarray) -> np.ndarray:
    """CIELAB of linear RGB."""
    x, y, z = np.cbrt(np.clip(TO_XYZ @ rgb, 0.009, 1))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def test_a_reader_without_green_cones_tells_the_colours_of_a_chart_apart() -> None:
    css = (Path(charts.__file__).parents[1] / "templates" / "page.css").read_text()
    colours = re.findall(r"--c\d: #(\w{6})", css)
    assert len(colours) == 2 * 8
    for palette in (colours[:8], colours[8:]):  # light and dark
        linear = [(np.array([int(code[at : at + 2], 16) for at in (0, 2, 4)]) / 255) ** 2.2 for code in palette]
        for sight in (np.eye(3), DEUTERANOPIA):
            seen = [lab(sight @ colour) for colour in linear]
            assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(seen, 2)) > 18
