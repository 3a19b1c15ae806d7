"""Test that simulated handlings slip, nearly slip and release as planned, by the forces that friction can carry."""

import numpy as np
import pytest

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins.registry import load
from tacpipe.simulation import gel, handling
from tacpipe.simulation.pick_and_move import OPEN_M, PickRig, PickScene, perform, simulate_trial
from tests.fake_recordings import FakeRecording, column
from tests.stage_params import build_params

TRIALS = range(12)
DURATION_S = 8.0


def scenes(kind: str) -> list[PickScene]:
    return [perform(5, index, PickRig(duration_s=DURATION_S, handling=kind)) for index in TRIALS]


def load_n(scene: PickScene) -> np.ndarray:
    """Return the force along x and z that moves the object with the hand (time,)."""
    demand = scene.grasp.demand_n(scene.path.hand_acceleration_m_s2)
    size: np.ndarray = np.hypot(demand[:, 0], demand[:, 2])
    return size


def aloft(scene: PickScene) -> np.ndarray:
    in_air: np.ndarray = scene.path.rise_m > 0.01
    return in_air


@pytest.mark.parametrize("kind", ["jolt-held", "fade-held", "shake", "hold"])
def test_what_friction_can_carry_does_not_slip(kind: str) -> None:
    for scene in scenes(kind):
        assert not scene.contact.slip.any()
        assert (load_n(scene) < scene.grasp.limit_n)[aloft(scene)].all()


@pytest.mark.parametrize("kind", ["jolt-held", "fade-held"])
def test_a_close_call_uses_most_of_the_friction(kind: str) -> None:
    for scene in scenes(kind):
        used = (load_n(scene)[aloft(scene)] / scene.grasp.limit_n[aloft(scene)]).max()
        assert handling.HELD[0] - 0.01 <= used <= handling.HELD[1] + 0.01


def test_a_fading_grip_slips_when_friction_carries_less_than_the_load() -> None:
    for scene in scenes("fade"):
        overloaded = np.flatnonzero(aloft(scene) & (load_n(scene) > scene.grasp.limit_n))
        assert scene.contact.onset is not None
        assert abs(scene.contact.onset - overloaded[0]) <= 20  # ms; the spring of the contact lags behind the load
        assert scene.contact.dropped.any()


def test_a_jolt_slips() -> None:
    assert all(scene.contact.onset is not None for scene in scenes("jolt"))


def test_a_release_ends_the_contact_without_a_slip_in_the_air_and_on_the_table() -> None:
    dropped = []
    for index in TRIALS:
        rig = PickRig(duration_s=DURATION_S, handling="release")
        scene = perform(5, index, rig)
        assert scene.release_ns is not None
        row = int(np.searchsorted(scene.path.t_ns, scene.release_ns))
        assert scene.has_contact[row - 1] and not scene.has_contact[row:].any()
        assert not scene.contact.slip[:row].any()
        assert scene.finger_m[row] < 0.045 < scene.finger_m[-1] == pytest.approx(OPEN_M)
        assert scene.contact.normal_n[-1].max() == 0
        recording = simulate_trial(5, index, rig)
        truth = recording.streams["truth"]
        assert column(truth, "gt_slip").max() == 0
        assert (column(truth, "gt_contact") == np.where(scene.has_contact, 0, -1)).all()
        assert recording.attributes["handling"] == "release"
        assert not recording.attributes["dropped"]
        dropped.append(bool(scene.contact.dropped.any()))
    assert 0 < sum(dropped) < len(dropped)


def test_mixed_trials_show_all_handlings_of_twenty_objects() -> None:
    trials = [perform(1, index, PickRig(duration_s=DURATION_S, handling="mixed")) for index in range(120)]
    kinds = [trial.handling for trial in trials]
    assert set(kinds) == set(handling.HANDLINGS)
    assert max(map(kinds.count, set(kinds))) < 3 * min(map(kinds.count, set(kinds)))
    assert len({(trial.grasp.mass_kg, trial.grasp.friction) for trial in trials}) == 20


def test_the_markers_of_a_gel_fall_back_when_a_fading_grip_slips() -> None:
    for index in range(3):
        scene = perform(2, index, PickRig(duration_s=DURATION_S, handling="fade"))
        onset_ns = int(scene.path.t_ns[scene.contact.onset or 0])
        states = gel.gel_states(scene, 0, onset_ns + np.array([-20, -1, 15]) * 1_000_000)
        before, at, after = np.linalg.norm(states.displacement_px.mean(axis=1), axis=1)
        assert before == pytest.approx(at, rel=0.1)
        assert after < 0.9 * at  # kinetic friction carries 0.8 of the static limit


def test_labels_of_slip_are_read_from_the_truth_of_a_release() -> None:
    from tacpipe.tasks.slip.labels import read_labels

    recording = simulate_trial(5, 0, PickRig(duration_s=DURATION_S, handling="release"))
    labels = read_labels(FakeRecording({"truth": recording.streams["truth"]}))  # type: ignore[arg-type]
    assert labels is not None and labels.contact is not None
    assert len(labels.events) == 0
    assert labels.contact[1].any() and not labels.contact[1][-1]


def test_a_handling_refuses_params_that_it_replaces_and_trials_that_are_too_short() -> None:
    for name, params in {
        "simulate.forward": {"effort": 1.1},
        "simulate.gel": {"grip_loss_probability": 0.5},
    }.items():
        with pytest.raises(UsageError, match="Leave one of them out"):
            build_params(name, handling="mixed", duration_s=DURATION_S, **params).check()
    with pytest.raises(UsageError, match="still is set"):
        build_params("simulate.forward", handling="hold", still=True).check()
    with pytest.raises(TacpipeError, match="too short for a handling"):
        load("simulate.forward")(build_params("simulate.forward", handling="hold", duration_s=5.0), 0)
