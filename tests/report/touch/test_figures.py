"""Figures, and the numbers that go into them."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from tacpipe.channels import biotac_sp
from tacpipe.comparison.spread import Spread
from tacpipe.report.touch import clouds, curves, electrodes, figures, fingertip, pressure
from tacpipe.report.touch.figures import Scattered
from tacpipe.report.touch.fingertip import Fingertip
from tacpipe.report.touch.methods import Method, Run, grouped, groups
from tests.report.touch.touch_fakes import NOVEL, recorded, result


def methods(*results: Any) -> list[Method]:
    return grouped([Run.read(one) for one in results])


def test_figures_are_drawn_in_the_pages_colours_and_carry_nothing_from_outside() -> None:
    rng = np.random.default_rng(0)
    drawn = [
        figures.scatter([Scattered("a", True, np.arange(3.0), np.arange(3.0))], 1.5, "(counts)", "t"),
        figures.settings({"XYZ": Spread(0.1, 0.01), "RGB": Spread(0.2, float("nan"))}, {"constant": 0.15}, "t"),
        figures.cloud(rng.normal(size=(50, 3)) / 100, np.array([[0.01, 0, 0], [-0.01, 0, 0]]), "t"),
        fingertip.draw([Fingertip("thumb", np.linspace(-1, 1, 24), ["1"] * 24)], "t"),
    ]
    for one in drawn:
        assert one.startswith("<svg role=")
        assert not re.search(r"#01020\d|#01030\d", one)
        assert "http" not in re.sub(r'xmlns(:xlink)?="[^"]+"', "", one)


def test_electrodes_do_not_cover_each_other() -> None:
    places = 1000 * biotac_sp.unrolled_m()
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)[~np.eye(24, dtype=bool)]
    assert apart.min() > 2 * fingertip.DOT_MM


def test_a_fingertip_lies_with_its_tip_up_and_its_electrodes_across_as_around_it() -> None:
    drawn = fingertip.draw([Fingertip("thumb", np.zeros(24), [f"n{n}" for n in range(1, 25)])], "t")
    pattern = r'x="(\S+)" y="(\S+)"[^>]*>(n\d+)</text>'
    at = {name: (float(x), -float(y)) for x, y, name in re.findall(pattern, drawn)}
    # 1 and 11 mirror each other, 10 lies nearer the palm than 1, 21 nearer the tip than 24 on the midline
    assert at["n1"][0] > at["n11"][0] and at["n1"][1] == at["n11"][1]
    assert at["n1"][1] > at["n10"][1] and at["n21"][1] > at["n24"][1]


def test_grasps_are_chosen_by_their_error_whatever_the_order_of_rows() -> None:
    names = [f"object{number:02d}" for number in range(11)]
    off = {name: 0.01 * (11 - number) for number, name in enumerate(names)}
    given = result(off=off, known=names, per_object=1)
    chosen = electrodes.chosen([Run.read(given)])
    assert [(one.place, one.recording) for one in chosen] == [
        ("median", "object05-000"),
        ("best decile", "object09-000"),
        ("worst decile", "object01-000"),
    ]
    assert [one.error for one in chosen] == pytest.approx([0.06, 0.02, 0.10], abs=1e-5)
    shard = given.recordings["predictions"]
    back = list(range(len(names)))[::-1]
    shard.tables = {name: table.take(back) for name, table in shard.tables.items()}
    assert [one.recording for one in electrodes.chosen([Run.read(given)])] == [one.recording for one in chosen]


def test_chosen_grasps_are_named_with_their_error_in_counts() -> None:
    (method,) = methods(result(off=0.05, novel=NOVEL))
    html = electrodes.section(method)
    assert html.count("<svg") == 5  # R² on known and novel objects, three grasps
    assert re.search(r"Median by error: \w+-00\d, \w+ \((known|novel) object\)\. RMSE 0\.0500 of the range", html)
    assert "thumb 175 counts, middle finger 165 counts" in html
    assert electrodes.section(methods(result(targets=("pdc_th",)))[0]) == ""


def test_pressures_are_drawn_for_the_fingers_that_are_foretold() -> None:
    (method,) = methods(result(novel=NOVEL, targets=("pdc_mf", "e_mf")))
    html = pressure.section(method)
    assert html.count("<svg") == 1
    assert "PDC middle finger, tree-ensemble: 40 unseen grasps" in html
    assert "drill (novel)" in html


def test_a_cloud_is_drawn_with_its_grasp_and_the_chosen_ones_first() -> None:
    html = clouds.section([recorded()], {"drill-002": "median by error", "elsewhere": "best"})
    assert html.count("<svg") == 1
    assert "drill-002 (median by error): drill, 2,000 points, the fingers 70 mm apart." in html
    assert clouds.section([recorded()], {}).count("<svg") == 2
    assert clouds.section([], {"drill-002": "median"}) == ""


def test_a_dataset_without_clouds_or_grasps_is_not_read() -> None:
    given = recorded(["a"])
    assert clouds.reads(given)
    shard = given.recordings["a"]
    shard.tables = {name: table for name, table in shard.tables.items() if name != "grasp"}
    assert not clouds.reads(given)


def test_losses_are_of_one_target_and_the_mean_of_its_networks() -> None:
    run = Run.read(result("pointnet", targets=("pdc_th", "e_th"), epochs=4))
    lines = [
        {"epoch": epoch, "train_loss": loss, "val_loss": None, "target": "all", "network": network}
        for network, losses in enumerate(([4.0, 2.0, 1.0], [2.0, 1.0]))
        for epoch, loss in enumerate(losses, 1)
    ]
    several = Run(run.dataset, run.config, [*run.history, *lines], run.predictions)
    assert curves.losses(several, "all", "train_loss") == [3.0, 1.5]
    assert curves.losses(several, "all", "val_loss") == []
    assert len(curves.losses(several, "e_th", "train_loss")) == 4
    assert curves.losses(several, "pdc_mf", "train_loss") == []


def test_figure_8_is_of_the_papers_network_trained_longest() -> None:
    given = methods(
        *(
            result("pointnet", head=head, epochs=epochs, targets=("pdc_th",))
            for head, epochs in (("fc3", 3), ("fc1", 8))
        ),
        result(epochs=20),
    )
    html = curves.figure_8(given)
    assert "PointNet · head fc1" in html and "paper schedule" in html
    assert curves.figure_8(methods(result(epochs=20))) == ""


def test_losses_without_validation_grasps_are_told_as_such() -> None:
    watched, unwatched = result(epochs=3), result(epochs=3)
    unwatched.files["config.json"] = unwatched.files["config.json"].replace(b'"val": 10', b'"val": 0')
    texts = [curves.section(groups(methods(one))[0]) for one in (watched, unwatched)]
    assert ["no grasps were kept" in one for one in texts] == [False, True]
    assert curves.section(groups(methods(result()))[0]) == ""
