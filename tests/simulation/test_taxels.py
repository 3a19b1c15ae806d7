"""Test that the forces on taxels add up, and can be computed from counts."""

import numpy as np
import pytest

from tacpipe.simulation import taxels

RNG = np.random.default_rng(8)


def skin() -> taxels.Skin:
    return taxels.draw_skin(np.random.default_rng(4))


def test_the_shares_of_the_pressure_add_up_to_one_wherever_the_object_is() -> None:
    displacement = RNG.uniform(-0.3, 0.3, (50, 2))
    share = taxels.fractions(skin(), displacement, RNG.uniform(-1, 1, 50))
    np.testing.assert_allclose(share.sum(axis=1), 1.0)
    assert (share >= 0).all()


def test_an_object_that_slips_down_takes_the_pressure_with_it() -> None:
    displacement = np.column_stack([np.zeros(3), [0.0, -0.002, -0.020]])
    centre = taxels.fractions(skin(), displacement, np.zeros(3)) @ taxels.PLACES_M
    assert (np.diff(centre[:, 1]) < -0.0005).all()
    np.testing.assert_allclose(centre[:, 0], centre[0, 0], atol=1e-9)


def test_shear_carries_the_load_and_no_taxel_bears_more_than_friction_allows() -> None:
    cap = RNG.uniform(0.0, 1.0, (200, 32))
    load = RNG.normal(size=(200, 2))
    load *= (RNG.uniform(0, 1, 200) * cap.sum(axis=1) / np.linalg.norm(load, axis=1))[:, None]
    shear_force = taxels.shear(cap, load)
    size = np.linalg.norm(shear_force, axis=2)
    np.testing.assert_allclose(shear_force.sum(axis=1), load, atol=1e-12)
    assert (size <= cap + 1e-12).all()
    free = size < cap - 1e-9
    assert all(np.ptp(row[sticking]) < 1e-12 for row, sticking in zip(size, free, strict=True) if sticking.any())


def test_the_taxels_of_least_pressure_slip_first_and_all_slip_in_the_end() -> None:
    cap = np.tile(np.arange(1.0, 5.0), (3, 1))
    load = np.array([[2.0, 0.0], [6.0, 0.0], [10.0, 0.0]])
    shear_force = taxels.shear(cap, load)[:, :, 0]
    np.testing.assert_allclose(shear_force, [[0.5, 0.5, 0.5, 0.5], [1.0, 5 / 3, 5 / 3, 5 / 3], [1.0, 2.0, 3.0, 4.0]])
    np.testing.assert_allclose(taxels.shear(cap[:1], np.array([[11.0, 0.0]]))[0, :, 0], [1.1, 2.2, 3.3, 4.4])


def test_a_bulge_pushes_outwards_and_adds_up_to_nothing() -> None:
    pressed = RNG.uniform(0, 1, (20, 16))
    push = taxels.bulge(pressed)
    np.testing.assert_allclose(push.sum(axis=1), 0.0, atol=1e-12)
    even = taxels.bulge(np.full((1, 16), 0.5))[0]
    assert (even * taxels.PLACES_M > 0).all()


def test_counts_give_back_the_force_on_each_taxel() -> None:
    force = RNG.normal(size=(40, 16, 3))
    counts = skin().base_count + taxels.signal(skin(), force)
    np.testing.assert_allclose(taxels.forces(skin(), counts), force, atol=1e-9)
    rounded = taxels.digitise(counts)
    assert rounded.dtype == np.uint16
    assert np.abs(taxels.forces(skin(), rounded.astype(float)) - force).max() < 0.001


def test_a_force_on_one_taxel_shows_on_its_neighbours_by_the_cross_talk() -> None:
    force = np.zeros((1, 16, 3))
    force[0, 5, 2] = 0.5
    counts = taxels.signal(skin(), force)[0, :, 2]
    assert np.flatnonzero(counts).tolist() == [1, 4, 5, 6, 9]
    np.testing.assert_allclose(counts[[1, 4, 6, 9]] / counts[5], 0.08)


def test_what_creeps_follows_by_a_first_order_lag() -> None:
    step = np.where(np.arange(4000) < 1000, 2.0, 3.0)
    lagged_force = taxels.lag(step, 1000.0)
    np.testing.assert_allclose(lagged_force[:1000], 2.0, atol=1e-12)
    assert lagged_force[1500] == pytest.approx(3 - np.exp(-1), abs=0.002)
    assert lagged_force[-1] == pytest.approx(3 - np.exp(-6), abs=0.002)


def test_noise_is_white_and_drift_a_random_walk() -> None:
    at_s = np.arange(0, 400, 0.02)
    noise = taxels.draw_errors(at_s, 1.0, 0.0, np.random.default_rng(1))
    np.testing.assert_allclose(noise.std(axis=(0, 1)), taxels.NOISE_COUNT, rtol=0.01)
    assert abs(np.corrcoef(noise[1:, 0, 0], noise[:-1, 0, 0])[0, 1]) < 0.02
    drift = taxels.draw_errors(at_s, 0.0, 1.0, np.random.default_rng(1))
    assert (drift[50:] - drift[:-50]).std() == pytest.approx(taxels.DRIFT_COUNT, rel=0.05)
