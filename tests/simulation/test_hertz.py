"""Hertz' laws: cube roots, what curvature and softness do, and the sizes that were worked out by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.simulation.pinch import contact_radius_m, effective_modulus_pa, effective_radius_m, indentation_m

POSITIVE = st.floats(1e-3, 1e3)


@given(force=POSITIVE, factor=POSITIVE)
def test_the_contact_grows_with_the_cube_root_of_force_and_of_radius(force: float, factor: float) -> None:
    radius_m = contact_radius_m(force, 0.005, 1e6)
    assert contact_radius_m(factor * force, 0.005, 1e6) == pytest.approx(factor ** (1 / 3) * radius_m)
    assert contact_radius_m(force, 0.005 * factor, 1e6) == pytest.approx(factor ** (1 / 3) * radius_m)
    assert contact_radius_m(force, 0.005, 1e6 * factor) == pytest.approx(radius_m / factor ** (1 / 3))


def test_slopes_over_logarithms_are_a_third_for_the_radius_and_two_thirds_for_the_indentation() -> None:
    force = np.geomspace(0.1, 10, 50)
    contact = contact_radius_m(force, 0.004, 1e6)
    assert np.polyfit(np.log(force), np.log(contact), 1)[0] == pytest.approx(1 / 3, abs=1e-12)
    assert np.polyfit(np.log(force), np.log(indentation_m(contact, 0.004)), 1)[0] == pytest.approx(2 / 3, abs=1e-12)


def test_two_newton_give_the_contacts_worked_out_by_hand() -> None:
    flat, sharp = (effective_radius_m(0.0067, [k, k]) for k in (0.0, 160.0))
    assert 1e3 * contact_radius_m(2.0, flat, 1e6) == pytest.approx(2.16, abs=0.005)
    assert 1e3 * contact_radius_m(2.0, sharp, 1e6) == pytest.approx(1.69, abs=0.005)


def test_energy_and_indentation_agree_since_the_force_is_the_slope_of_the_energy() -> None:
    radius, modulus = 0.005, 1e6
    force = np.linspace(0.01, 3, 4000)
    deep = indentation_m(contact_radius_m(force, radius, modulus), radius)
    np.testing.assert_allclose(force, 4 / 3 * modulus * np.sqrt(radius) * deep**1.5, rtol=1e-10)  # Johnson's (4.23)
    work = ((force[1:] + force[:-1]) / 2 * np.diff(deep)).sum()
    assert work == pytest.approx(0.4 * (force[-1] * deep[-1] - force[0] * deep[0]), rel=1e-3)


def test_a_sphere_and_a_cylinder_have_the_relative_radii_of_the_book() -> None:
    assert effective_radius_m(0.0067, [20.0, 20.0]) == pytest.approx(1 / (1 / 0.0067 + 20))
    assert effective_radius_m(0.0067, [0.0, 20.0]) == pytest.approx(np.sqrt(0.0067 / (1 / 0.0067 + 20)))


def test_a_tip_does_not_reach_the_ground_of_a_narrow_hollow() -> None:
    with pytest.raises(ValueError, match="hollow of -200 1/m"):
        effective_radius_m(0.0067, [-200.0, 10.0])


def test_a_rigid_object_leaves_the_skin_its_modulus_and_foam_takes_nearly_all_of_it() -> None:
    assert effective_modulus_pa(1e6, 0.0) == pytest.approx(1e6)
    assert effective_modulus_pa(1e6, 1 / 15_000) == pytest.approx(14_778, rel=1e-3)
