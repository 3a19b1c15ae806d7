"""Figures, and the numbers that go into them."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from tacpipe.report.material import confusion, curves, figures, grouping, latents, profiles
from tacpipe.report.material.figures import Band, Cloud
from tacpipe.report.material.methods import Method, Run
from tests.report.material import material_fakes
from tests.report.material.material_fakes import result

BOTH = {"biotac": 1, "roboskin": 2}
PARTNERS = {1: 2, 2: 3, 3: 4, 4: 1}


def grouped(*results: Any) -> list[Method]:
    return grouping.grouped([Run.read(one) for one in results])


def test_figures_are_drawn_in_the_pages_colours_and_carry_nothing_from_outside() -> None:
    points = np.arange(12.0).reshape(6, 2)
    materials = np.array([1, 1, 2, 2, 3, 3])
    drawn = [
        figures.by_slides({"a": Band([64, 576], [0.5, 0.9], [0.4, 0.8], [0.6, 0.95])}, 0.05, "t"),
        figures.confusion(np.array([[3, 1], [0, 4]]), [1, 2], "t"),
        figures.latents([Cloud("BioTac", points, materials), Cloud("RoboSkin", points + 1, materials)], {}, "t"),
        figures.profile(
            np.arange(3.0), {"raw": np.arange(3.0), "median": np.ones(3)}, np.array([False, True, True]), "q", "t"
        ),
    ]
    for one in drawn:
        assert one.startswith("<svg role=")
        assert not re.search(r"#01020\d|#01030\d", one)
        assert "http" not in re.sub(r'xmlns(:xlink)?="[^"]+"', "", one)


def test_confusions_are_counted_over_runs_and_told_in_words() -> None:
    (method,) = grouped(result(wrong={"biotac": 2}, fold=0), result(wrong={"biotac": 1}, fold=1))
    counts, materials = confusion.counted(method, "biotac")
    assert materials == [1, 2, 3, 4]
    # the fakes take the first slide of material 1 for 2 in both runs, and that of 2 for 3 in one
    assert counts.tolist() == [[8, 2, 0, 0], [0, 9, 1, 0], [0, 0, 10, 0], [0, 0, 0, 10]]
    assert confusion.worst(counts, materials) == "Most often it takes 1 for 2 (2 of 10) and 2 for 3 (1 of 10)."
    assert confusion.worst(np.diag([3, 3]), [1, 2]) == "It takes none for another."


def test_confusions_are_shown_of_the_best_method_and_of_the_joint_one() -> None:
    html = confusion.section(grouped(result("minirocket", wrong={"biotac": 1}), result(wrong=BOTH, joint=True)))
    assert re.findall(r"<figcaption>(\w+, [^:]+):", html) == [
        "BioTac, MiniRocket",
        "BioTac, RAEC joint",
        "RoboSkin, RAEC joint",
    ]


def test_projections_keep_what_lies_in_a_plane() -> None:
    rng = np.random.default_rng(0)
    plane = rng.normal(size=(2, 5))
    parts = [rng.normal(size=(count, 2)) @ plane for count in (4, 7)]
    flat = latents.projected(parts)
    assert [one.shape for one in flat] == [(4, 2), (7, 2)]
    together = np.vstack(parts), np.vstack(flat)
    apart = [np.linalg.norm(one[:, None] - one[None], axis=2) for one in together]
    assert np.allclose(*apart)


def test_a_projection_does_not_depend_on_the_sign_that_a_decomposition_takes() -> None:
    points = np.random.default_rng(1).normal(size=(9, 4)) * [5, 2, 1, 1]
    first, second = latents.projected([points])[0], latents.projected([points[::-1]])[0][::-1]
    assert np.allclose(first, second)


def test_materials_lie_together_with_those_that_they_were_paired_with() -> None:
    same, other = (
        Run.read(result(wrong=BOTH, joint=True, epochs=2, partners=partners, pairing="permuted")).predictions
        for partners in (None, PARTNERS)
    )
    assert latents.together(same.of("biotac"), same.of("roboskin"), {}) == (4, 4)
    assert latents.together(other.of("biotac"), other.of("roboskin"), {}) == (0, 4)
    assert latents.together(other.of("biotac"), other.of("roboskin"), PARTNERS) == (4, 4)


def test_latents_of_a_joint_run_stand_beside_the_control_and_two_that_learned_alone() -> None:
    html = latents.section(
        grouped(
            result(wrong=BOTH, joint=True, epochs=2),
            result(wrong=BOTH, joint=True, epochs=2, partners=PARTNERS, pairing="permuted"),
            result(wrong={"biotac": 1}, epochs=2),
            result(wrong={"roboskin": 1}, epochs=2),
        )
    )
    captions = re.findall(r"<figcaption>([^<]+)</figcaption>", html)
    assert [one.split(":")[0] for one in captions] == ["RAEC joint", "RAEC joint · permuted pairs", "RAEC independent"]
    assert (
        "4 of 4 materials, the other sensor&#x27;s nearest mean is the material that it was paired with" in captions[1]
    )
    assert latents.section(grouped(result("minirocket", wrong=BOTH))) == ""


def test_convergence_is_drawn_for_each_sensor_and_the_alignment_with_its_control() -> None:
    given = grouped(
        result(wrong=BOTH, joint=True, epochs=4, fold=0),
        result(wrong=BOTH, joint=True, epochs=5, fold=1),
        result(wrong=BOTH, joint=True, epochs=4, pairing="permuted"),
        result(wrong={"roboskin": 1}, epochs=4),
    )
    html = curves.convergence(given)
    assert re.findall(r"validation accuracy on (\w+) by epoch", html) == ["BioTac", "RoboSkin"]
    assert html.count("RAEC joint (2 runs)") == 2 and html.count("RAEC independent (1 run)") == 1
    assert "RAEC joint · permuted pairs (1 run)" in curves.alignment(given)
    assert curves.convergence(grouped(result("minirocket", wrong=BOTH))) == ""
    assert curves.alignment(grouped(result(wrong=BOTH, epochs=3))) == ""


def test_curves_over_slides_are_those_of_methods_with_several_numbers() -> None:
    html = curves.few_slides(
        grouped(
            *(result("minirocket", wrong=BOTH, train=dict.fromkeys(BOTH, count)) for count in (64, 576)),
            *(result(wrong=BOTH, joint=True, reduce="biotac", ratio=ratio, shuffle=False) for ratio in (11, 50)),
            *(result(wrong=BOTH, joint=True, train={"biotac": 576, "roboskin": count}) for count in (96, 576)),
            result("x-lstm", wrong=BOTH),
        )
    )
    joint = "RAEC joint · other sensor whole"
    names = ("MiniRocket", joint, f"{joint} · fixed batches", "X-LSTM")
    biotac, roboskin = ([name for name in names if f">{name}<" in part] for part in html.split("</figure>")[:2])
    assert biotac == ["MiniRocket", f"{joint} · fixed batches"]
    assert roboskin == ["MiniRocket", joint]
    assert ">64<" in html and ">576<" in html
    assert "recorded in one session" in html
    assert curves.few_slides(grouped(result("minirocket", wrong=BOTH))) == ""


def test_slides_are_counted_and_the_one_of_median_force_is_drawn() -> None:
    html = profiles.section([material_fakes.recorded(5, outside=2)])
    assert "5 slides of BioTac, 2 of them outside the protocol (2 moved at 12 mm/s)." in html
    assert "1 slide of RoboSkin, 0 of them outside the protocol." in html
    assert "force on BioTac in biotac-m01-t003" in html  # forces of 3, 4 and 5 N kept to the protocol
    assert "as measured and median of 3" in html
    assert html.count("<svg") == 2


@pytest.mark.parametrize("lacking", ["force_n", "speed_m_s"])
def test_what_was_not_measured_is_not_drawn(lacking: str) -> None:
    given = material_fakes.recorded(1, outside=0)
    shard = given.recordings["biotac-m01-t000"]
    short = shard.tables["profile"].drop_columns([lacking] if lacking == "force_n" else [lacking, "speed_raw_m_s"])
    shard.tables = {**shard.tables, "profile": short}
    assert profiles.section([given]).count("<svg") == 1
