"""Test that the simulate stage hands its params to the rig."""

from tacpipe.plugins.registry import load

simulate = load("simulate.forward")


def test_a_trial_has_the_streams_of_the_rig_and_follows_from_seed_and_number() -> None:
    params = simulate.params(duration_s=5.0)
    first, repeated, next_trial = simulate(params, 3), simulate(params, 3), simulate(params, 4)
    assert set(first.streams) == {"xela1", "xela2", "robot", "proximity", "truth"}
    assert all(first.streams[name].equals(repeated.streams[name]) for name in first.streams)
    assert first.attributes == repeated.attributes
    assert not first.streams["xela1"].equals(next_trial.streams["xela1"])


def test_the_number_of_trials_does_not_change_a_trial() -> None:
    from_1_trial, from_100_trials = (simulate(simulate.params(duration_s=5.0, trials=trials), 0) for trials in (1, 100))
    assert from_1_trial.streams["xela2"].equals(from_100_trials.streams["xela2"])
