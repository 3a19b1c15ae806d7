"""What Python users get: counts to come from windows and plans, or a sentence."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacpipe.arrays import AnyFloats
from tacpipe.codecs import tactile
from tacpipe.errors import TacpipeError
from tacpipe.plugins.registry import load as load_stage
from tacpipe.plugins.stage import Source
from tacpipe.signals import kinematics
from tacpipe.tasks.forward import tracks
from tacpipe.tasks.forward.model import ForwardModel
from tests.conftest import sample_data
from tests.fake_recordings import FakeRecording, FakeShard, dataset
from tests.stages.learning_fakes import CHANNELS, REST, motion, table
from tests.tasks.forward.trials import (
    CONTEXT,
    HORIZON,
    LENGTH,
    asked,
    compressed,
    counts,
    panda,
    poses,
    predicted_windows,
    trained,
)

TEST = motion(20)


@pytest.fixture(scope="module")
def latents() -> Mapping[str, Any]:
    """Training recordings by what their latents stand for."""
    return {of: compressed(*(motion(seed) for seed in range(3)), representation=of) for of in ("levels", "increments")}


@pytest.fixture(scope="module")
def models(latents: Mapping[str, Any], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Mapping[str, bytes]]:
    """The files of models by architecture and representation."""
    found: dict[str, Mapping[str, bytes]] = {}
    for name in ("gru raw", "taxelwise raw", "recurrent raw", "gru levels", "recurrent levels", "gru increments"):
        architecture, of = name.split()
        training = latents.get(of)
        watched = None if training is None else compressed(motion(10), files=training.files, representation=of)
        folder, fast = tmp_path_factory.mktemp("model"), {"learning_rate": 0.02, "epochs": 3}
        found[name] = trained(folder, training, watched, architecture=architecture, **fast)
    return found


@pytest.fixture(scope="module")
def forecaster(models: Mapping[str, Mapping[str, bytes]]) -> ForwardModel:
    return ForwardModel.load(models["gru raw"])


def windows(count: int = 3) -> tuple[AnyFloats, AnyFloats]:
    """Random windows and plans with poses alone."""
    rng = np.random.default_rng(0)
    arm = np.concatenate([rng.normal(0, 0.1, (count, LENGTH, 3)), rng.normal(1, 0.05, (count, LENGTH, 4))], axis=-1)
    arm[..., 3:] /= np.linalg.norm(arm[..., 3:], axis=-1, keepdims=True)
    touch = rng.normal(0, 100, (count, CONTEXT, len(CHANNELS)))
    return np.concatenate([touch, arm[:, :CONTEXT]], axis=-1), arm[:, CONTEXT:]


NAMES = ("gru raw", "taxelwise raw", "recurrent raw", "gru levels", "recurrent levels")


@pytest.mark.parametrize("name", NAMES)
def test_predict_says_what_is_judged(
    name: str, models: Mapping[str, Mapping[str, bytes]], latents: Mapping[str, Any]
) -> None:
    made = ForwardModel.load(models[name])
    shard = TEST if "raw" in name else compressed(TEST, files=latents["levels"].files).recordings[TEST.name]
    found, starts, some = predicted_windows(made, shard)
    predicted = made.predict(*asked(found, starts))
    assert predicted.shape == (72, HORIZON, len(CHANNELS))
    assert predicted.dtype == np.float64
    assert np.allclose(predicted, some.predictions["model"].count, atol=0.05)
    assert np.abs(predicted - found.tactile[some.now][:, None]).max() > 5


def test_predict_of_increments_says_what_is_judged_but_for_the_first_row_of_a_window(
    models: Mapping[str, Mapping[str, bytes]], latents: Mapping[str, Any]
) -> None:
    made = ForwardModel.load(models["gru increments"])
    shard = compressed(TEST, files=latents["increments"].files, representation="increments").recordings[TEST.name]
    found, starts, some = predicted_windows(made, shard)
    predicted, wanted = made.predict(*asked(found, starts)), some.predictions["model"].count
    # the first window begins where the recording does, so that nothing is lost
    assert np.allclose(predicted[0], wanted[0], atol=0.05)
    assert np.abs(predicted - wanted).mean() < 0.2 * np.abs(predicted - found.tactile[some.now][:, None]).mean()


def test_one_window_needs_no_axis(forecaster: ForwardModel) -> None:
    window, plan = windows()
    together = forecaster.predict(window, plan)
    assert forecaster.predict(window[1], plan[1]).shape == (HORIZON, len(CHANNELS))
    assert np.allclose(forecaster.predict(window[1], plan[1]), together[1], atol=1e-3)


def test_velocities_that_are_left_out_are_differences_of_poses(forecaster: ForwardModel) -> None:
    window, plan = windows()
    arm = np.concatenate([window[..., len(CHANNELS) :], plan], axis=1)
    t_ns = np.arange(LENGTH) * 20_000_000
    velocity = np.stack([kinematics.differences(t_ns, one[:, :3], one[:, 3:]) for one in arm])
    finger = np.zeros((3, CONTEXT, 1))
    whole = np.concatenate([window, velocity[:, :CONTEXT], finger], axis=-1)
    told = forecaster.predict(whole, np.concatenate([plan, velocity[:, CONTEXT:]], axis=-1))
    assert np.allclose(forecaster.predict(window, plan), told, atol=1e-3)


def test_the_columns_that_it_names_are_those_that_it_reads(forecaster: ForwardModel) -> None:
    assert forecaster.window_columns == (*CHANNELS, *tracks.POSE)
    assert forecaster.plan_columns == tracks.POSE
    assert set(forecaster.window_columns) < set(TEST.content.column_names)  # a dataset has each
    assert (*forecaster.plan_columns, *forecaster.derived_columns) == tracks.ARM
    assert (forecaster.context, forecaster.horizon, forecaster.actions) == (CONTEXT, HORIZON, "planned")


@pytest.mark.parametrize("name", ["gru raw", "taxelwise raw", "recurrent raw"])
def test_a_quaternion_s_sign_and_length_do_not_matter(name: str, models: Mapping[str, Mapping[str, bytes]]) -> None:
    made, (window, plan) = ForwardModel.load(models[name]), windows()
    before = made.predict(window, plan)
    turned = slice(len(CHANNELS) + 3, len(CHANNELS) + 7)
    window[:, 1::2, turned] *= -1
    plan[..., 3:] *= 2
    assert np.allclose(made.predict(window, plan), before, atol=0.02)


@pytest.mark.parametrize("name", NAMES)
def test_touch_after_now_does_not_change_what_is_predicted_now(
    name: str, models: Mapping[str, Mapping[str, bytes]], latents: Mapping[str, Any]
) -> None:
    made, now = ForwardModel.load(models[name]), 40
    felt = counts(TEST)
    felt[now + 1 :] += 500
    later = FakeShard(TEST.name, table(felt, poses(TEST)))
    shards: list[Any] = [TEST, later]
    if "levels" in name:
        shards = [compressed(one, files=latents["levels"].files).recordings[TEST.name] for one in shards]
    (_, _, before), (_, _, after) = (predicted_windows(made, one) for one in shards)
    known = now - CONTEXT + 2  # windows whose last frame of the past is not after ``now``
    for predictor, said in before.predictions.items():
        if not predictor.startswith("codec"):  # which tells what the codec loses of the truth
            changed = after.predictions[predictor].count
            assert np.allclose(changed[:known], said.count[:known], atol=1e-2), predictor
    model = before.predictions["model"].count[known]
    assert not np.allclose(after.predictions["model"].count[known], model, atol=1)


@pytest.mark.parametrize("name", NAMES)
def test_the_plan_of_a_step_changes_only_it_and_later_ones(
    name: str, models: Mapping[str, Mapping[str, bytes]]
) -> None:
    made, (window, plan) = ForwardModel.load(models[name]), windows()
    zeros = np.zeros((3, CONTEXT, 7))
    window, plan = np.concatenate([window, zeros], axis=-1), np.concatenate([plan, np.zeros((3, HORIZON, 6))], axis=-1)
    before, changed = made.predict(window, plan), plan.copy()
    changed[:, 2, [0, 7, 12]] += 1
    after = made.predict(window, changed)
    assert np.allclose(after[:, :2], before[:, :2], atol=1e-4)
    assert (np.abs(after[:, 2:] - before[:, 2:]).max(axis=(0, 2)) > 1e-3).all()


def spoiled(at: tuple[int, ...], value: float, of_plan: bool = False) -> tuple[AnyFloats, AnyFloats]:
    window, plan = windows()
    (plan if of_plan else window)[at] = value
    return window, plan


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (spoiled((1, 2, 3), np.nan), r"The window holds nan in row 2, column 3 \(counted from 0\)"),
        (spoiled((1, 2, 3), np.inf, True), "The plan holds inf in row 2, column 3"),
        ((windows()[0], windows()[1][:, :3]), r"The plan has the shape \(3, 3, 7\); this model reads 4 rows of 13"),
        ((windows()[0][:, 1:], windows()[1]), r"The window has the shape \(3, 4, 19\); this model reads 5 rows of 26"),
        ((windows()[0][..., 1:], windows()[1]), r"The window has the shape \(3, 5, 18\)"),
        ((windows()[0], windows()[1][0]), r"The plan has the shape \(4, 7\)"),
        ((windows()[0], np.zeros((3, HORIZON, 13)) + 1), "must both hold velocities, or neither"),
        ((windows()[0], windows(2)[1]), "There are 3 windows and 2 plans"),
        ((windows()[0], np.zeros((3, HORIZON, 7))), "The plan holds a quaternion of length 0"),
    ],
)
def test_what_cannot_be_read_is_one_sentence(
    given: tuple[AnyFloats, AnyFloats], said: str, forecaster: ForwardModel
) -> None:
    with pytest.raises(TacpipeError, match=said):
        forecaster.predict(*given)


@pytest.mark.parametrize("name", NAMES)
def test_raw_counts_are_refused_and_counts_above_rest_are_not(
    name: str, models: Mapping[str, Mapping[str, bytes]]
) -> None:
    made, (window, plan) = ForwardModel.load(models[name]), windows()
    made.predict(window, plan)
    window[1:, :, : len(CHANNELS)] += REST
    with pytest.raises(TacpipeError, match=r"Window 1 holds counts of 1[56]\d\d\d in the median.*level at rest"):
        made.predict(window, plan)


def test_hard_contact_that_training_had_not_is_no_raw_counts(forecaster: ForwardModel) -> None:
    window, plan = windows()
    assert forecaster.largest_level is not None
    window[..., :3] = 40 * forecaster.largest_level  # a quarter of all channels
    assert np.isfinite(forecaster.predict(window, plan)).all()
    window[..., : len(CHANNELS)] = 1.9 * forecaster.largest_level
    assert np.isfinite(forecaster.predict(window, plan)).all()


def test_a_model_that_keeps_no_level_predicts_with_a_warning(models: Mapping[str, Mapping[str, bytes]]) -> None:
    config = json.loads(models["gru raw"]["config.json"])
    del config["largest_level"]
    older = ForwardModel.load({**models["gru raw"], "config.json": json.dumps(config).encode()})
    with pytest.warns(UserWarning, match="trained before levels were kept"):
        found = older.predict(*windows())
    assert np.array_equal(found, ForwardModel.load(models["gru raw"]).predict(*windows()))


def published(files: Mapping[str, Path]) -> FakeShard:
    """A published trial after synchronize and segment contacts."""
    ingest, synchronize, contacts = (
        load_stage(name) for name in ("ingest.xela-flat", "synchronize", "segment.contacts")
    )
    recording = ingest(ingest.params(), files)
    synced = synchronize(synchronize.params(), FakeRecording(recording.streams))
    made = contacts(contacts.params(), FakeRecording(synced.streams))
    return FakeShard("-".join(sorted(map(str, files.values())))[-60:], made.streams[""], dict(synced.attributes))


@pytest.mark.data
@pytest.mark.skipif(not (sample_data() / "xela_flat_pick_move").is_dir(), reason="published recordings are not here")
def test_raw_counts_of_published_trials_are_always_refused_and_counts_above_rest_never(tmp_path: Path) -> None:
    ingest = load_stage("ingest.xela-flat")
    assert ingest.discover is not None
    found = list(ingest.discover(ingest.params(), sample_data() / "xela_flat_pick_move").values())[::4]
    training, watched, *others = (published(dict(files)) for files in found if not isinstance(files, Source))
    asked_for = {"epochs": 1, "stride": 10, "baselines": False}  # trained on one trial, where the limit is least sure
    made = ForwardModel.load(trained(tmp_path, dataset(training), dataset(watched), **asked_for))
    refused = 0
    for shard in [watched, *others]:
        channels = made.codec.channels
        given = tracks.track(shard, made.codec)  # type: ignore[arg-type]
        starts = given.starts(CONTEXT, HORIZON)
        window, plan = asked(given, starts)
        assert made.predict(window, plan).shape == (len(starts), HORIZON, len(channels))
        window[..., : len(channels)] += tactile.rest_counts(shard.content.schema, channels)
        for first in range(0, len(starts), 5):  # a refusal stops at the first window, so not all at once
            with pytest.raises(TacpipeError, match="level at rest"):
                made.predict(window[first], plan[first])
            refused += 1
    assert refused > 900


def test_a_model_of_another_task_is_refused(models: Mapping[str, Mapping[str, bytes]]) -> None:
    files = models["gru raw"]
    config = {**json.loads(files["config.json"]), "task": "material"}
    with pytest.raises(TacpipeError, match="trained for material"):
        ForwardModel.load({**files, "config.json": json.dumps(config).encode()})


def test_velocities_of_a_panda_s_joints_reach_the_model(tmp_path: Path) -> None:
    pose, joints = panda(80)
    felt = 1000 * (pose[:, :1] - pose[0, :1]) + np.random.default_rng(0).normal(0, 1, (80, len(CHANNELS)))
    shard = FakeShard("panda", table(felt, pose, extra=joints))
    made = ForwardModel.load(trained(tmp_path, dataset(shard), dataset(shard), epochs=1))
    found, starts, some = predicted_windows(made, shard)
    assert np.allclose(made.predict(*asked(found, starts)), some.predictions["model"].count, atol=0.05)
    assert found.arm[0, 7:].any()
