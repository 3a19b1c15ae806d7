"""Test predictions from windows and plans in Python, and their errors."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from tacpipe.arrays import AnyFloats
from tacpipe.codecs import tactile
from tacpipe.errors import TacpipeError
from tacpipe.models.windows import ARM, ForecastWindows
from tacpipe.plugins.registry import load as load_stage
from tacpipe.plugins.stage import Source
from tacpipe.signals import kinematics
from tacpipe.tasks.forward import tracks
from tacpipe.tasks.forward.forecaster import Forecaster, Network
from tacpipe.tasks.forward.prediction import ForwardModel
from tests.conftest import sample_data
from tests.fake_recordings import FakeRecording, FakeShard, dataset
from tests.live import rigs
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
    return {
        representation: compressed(*(motion(seed) for seed in range(3)), representation=representation)
        for representation in ("levels", "increments")
    }


@pytest.fixture(scope="module")
def models(latents: Mapping[str, Any], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Mapping[str, bytes]]:
    """The files of models by architecture and representation."""
    files_by_name: dict[str, Mapping[str, bytes]] = {}
    for name in ("gru raw", "taxelwise raw", "recurrent raw", "gru levels", "recurrent levels", "gru increments"):
        architecture, representation = name.split()
        training = latents.get(representation)
        watched = (
            None if training is None else compressed(motion(10), files=training.files, representation=representation)
        )
        folder, fast = tmp_path_factory.mktemp("model"), {"learning_rate": 0.02, "epochs": 3}
        files_by_name[name] = trained(folder, training, watched, architecture=architecture, **fast)
    return files_by_name


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
    loaded = ForwardModel.load(models[name])
    shard = TEST if "raw" in name else compressed(TEST, files=latents["levels"].files).recordings[TEST.name]
    recorded, starts, windows_predicted = predicted_windows(loaded, shard)
    predicted = loaded.predict(*asked(recorded, starts))
    assert predicted.shape == (72, HORIZON, len(CHANNELS))
    assert predicted.dtype == np.float64
    assert np.allclose(predicted, dict(windows_predicted.each_prediction())["model"].count, atol=0.05)
    assert np.abs(predicted - recorded.tactile[windows_predicted.forecast.now][:, None]).max() > 5


def test_predict_of_increments_says_what_is_judged_but_for_the_first_row_of_a_window(
    models: Mapping[str, Mapping[str, bytes]], latents: Mapping[str, Any]
) -> None:
    loaded = ForwardModel.load(models["gru increments"])
    shard = compressed(TEST, files=latents["increments"].files, representation="increments").recordings[TEST.name]
    recorded, starts, windows_predicted = predicted_windows(loaded, shard)
    predicted, expected = (
        loaded.predict(*asked(recorded, starts)),
        dict(windows_predicted.each_prediction())["model"].count,
    )
    # the first window begins where the recording does, so that nothing is lost
    assert np.allclose(predicted[0], expected[0], atol=0.05)
    assert (
        np.abs(predicted - expected).mean()
        < 0.2 * np.abs(predicted - recorded.tactile[windows_predicted.forecast.now][:, None]).mean()
    )


def test_one_window_needs_no_axis(forecaster: ForwardModel) -> None:
    window, plan = windows()
    batched = forecaster.predict(window, plan)
    assert forecaster.predict(window[1], plan[1]).shape == (HORIZON, len(CHANNELS))
    assert np.allclose(forecaster.predict(window[1], plan[1]), batched[1], atol=1e-3)


def test_velocities_that_are_left_out_are_differences_of_poses(forecaster: ForwardModel) -> None:
    window, plan = windows()
    arm = np.concatenate([window[..., len(CHANNELS) :], plan], axis=1)
    t_ns = np.arange(LENGTH) * 20_000_000
    velocity = np.stack([kinematics.difference_velocity(t_ns, pose[:, :3], pose[:, 3:]) for pose in arm])
    finger = np.zeros((3, CONTEXT, 1))
    with_velocity = np.concatenate([window, velocity[:, :CONTEXT], finger], axis=-1)
    predicted = forecaster.predict(with_velocity, np.concatenate([plan, velocity[:, CONTEXT:]], axis=-1))
    assert np.allclose(forecaster.predict(window, plan), predicted, atol=1e-3)


def test_the_columns_that_it_names_are_those_that_it_reads(forecaster: ForwardModel) -> None:
    assert forecaster.window_columns == (*CHANNELS, *tracks.POSE)
    assert forecaster.plan_columns == tracks.POSE
    assert set(forecaster.window_columns) < set(TEST.content.column_names)  # a dataset has each
    assert (*forecaster.plan_columns, *forecaster.derived_columns) == tracks.ARM
    assert (forecaster.context, forecaster.horizon, forecaster.actions) == (CONTEXT, HORIZON, "planned")


@pytest.mark.parametrize("name", ["gru raw", "taxelwise raw", "recurrent raw"])
def test_a_quaternion_s_sign_and_length_do_not_matter(name: str, models: Mapping[str, Mapping[str, bytes]]) -> None:
    loaded, (window, plan) = ForwardModel.load(models[name]), windows()
    before = loaded.predict(window, plan)
    turned = slice(len(CHANNELS) + 3, len(CHANNELS) + 7)
    window[:, 1::2, turned] *= -1
    plan[..., 3:] *= 2
    assert np.allclose(loaded.predict(window, plan), before, atol=0.02)


@pytest.mark.parametrize("name", NAMES)
def test_touch_after_now_does_not_change_what_is_predicted_now(
    name: str, models: Mapping[str, Mapping[str, bytes]], latents: Mapping[str, Any]
) -> None:
    loaded, now = ForwardModel.load(models[name]), 40
    felt = counts(TEST)
    felt[now + 1 :] += 500
    later = FakeShard(TEST.name, table(felt, poses(TEST)))
    shards: list[Any] = [TEST, later]
    if "levels" in name:
        shards = [compressed(shard, files=latents["levels"].files).recordings[TEST.name] for shard in shards]
    (_, _, before), (_, _, after) = (predicted_windows(loaded, shard) for shard in shards)
    unaffected = now - CONTEXT + 2  # windows whose last frame of the past is not after ``now``
    for predictor, prediction in before.each_prediction():
        if not predictor.startswith("codec"):  # the loss of the codec depends on the truth
            changed = dict(after.each_prediction())[predictor].count
            assert np.allclose(changed[:unaffected], prediction.count[:unaffected], atol=1e-2), predictor
    model = dict(before.each_prediction())["model"].count[unaffected]
    assert not np.allclose(dict(after.each_prediction())["model"].count[unaffected], model, atol=1)


@pytest.mark.parametrize("name", NAMES)
def test_the_plan_of_a_step_changes_only_it_and_later_ones(
    name: str, models: Mapping[str, Mapping[str, bytes]]
) -> None:
    loaded, (window, plan) = ForwardModel.load(models[name]), windows()
    zeros = np.zeros((3, CONTEXT, 7))
    window, plan = np.concatenate([window, zeros], axis=-1), np.concatenate([plan, np.zeros((3, HORIZON, 6))], axis=-1)
    before, changed = loaded.predict(window, plan), plan.copy()
    changed[:, 2, [0, 7, 12]] += 1
    after = loaded.predict(window, changed)
    assert np.allclose(after[:, :2], before[:, :2], atol=1e-4)
    assert (np.abs(after[:, 2:] - before[:, 2:]).max(axis=(0, 2)) > 1e-3).all()


def spoiled(at: tuple[int, ...], value: float, of_plan: bool = False) -> tuple[AnyFloats, AnyFloats]:
    window, plan = windows()
    (plan if of_plan else window)[at] = value
    return window, plan


@pytest.mark.parametrize(
    ("arrays", "reason"),
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
    arrays: tuple[AnyFloats, AnyFloats], reason: str, forecaster: ForwardModel
) -> None:
    with pytest.raises(TacpipeError, match=reason):
        forecaster.predict(*arrays)


@pytest.mark.parametrize("name", NAMES)
def test_raw_counts_are_refused_and_counts_above_rest_are_not(
    name: str, models: Mapping[str, Mapping[str, bytes]]
) -> None:
    loaded, (window, plan) = ForwardModel.load(models[name]), windows()
    loaded.predict(window, plan)
    window[1:, :, : len(CHANNELS)] += REST
    with pytest.raises(TacpipeError, match=r"Window 1 holds counts of 1[56]\d\d\d in the median.*level at rest"):
        loaded.predict(window, plan)


def test_hard_contact_that_training_had_not_is_no_raw_counts(forecaster: ForwardModel) -> None:
    window, plan = windows()
    window[..., :3] = 40 * forecaster.largest_level  # a quarter of all channels
    assert np.isfinite(forecaster.predict(window, plan)).all()
    window[..., : len(CHANNELS)] = 1.9 * forecaster.largest_level
    assert np.isfinite(forecaster.predict(window, plan)).all()


def publish(files: Mapping[str, Path]) -> FakeShard:
    """A published trial after synchronize and segment contacts."""
    ingest, synchronize, contacts = (
        load_stage(name) for name in ("ingest.xela-flat", "synchronize", "segment.contacts")
    )
    recording = ingest(ingest.params(), files)
    synced = synchronize(synchronize.params(), FakeRecording(recording.streams))
    segmented = contacts(contacts.params(), FakeRecording(synced.streams))
    return FakeShard("-".join(sorted(map(str, files.values())))[-60:], segmented.streams[""], dict(synced.attributes))


@pytest.mark.data
@pytest.mark.skipif(not (sample_data() / "xela_flat_pick_move").is_dir(), reason="published recordings are not here")
def test_raw_counts_of_published_trials_are_always_refused_and_counts_above_rest_never(tmp_path: Path) -> None:
    ingest = load_stage("ingest.xela-flat")
    assert ingest.source is not None
    sources = list(ingest.source.discover(ingest.params(), sample_data() / "xela_flat_pick_move").values())[::4]
    training, watched, *remaining = (publish(dict(files)) for files in sources if not isinstance(files, Source))
    asked_for = {"epochs": 1, "stride": 10, "baselines": False}  # trained on one trial, where the limit is least sure
    loaded = ForwardModel.load(trained(tmp_path, dataset(training), dataset(watched), **asked_for))
    refused = 0
    for shard in [watched, *remaining]:
        channels = loaded.codec.channels
        recorded = tracks.track(shard, loaded.codec)  # type: ignore[arg-type]
        starts = recorded.starts(CONTEXT, HORIZON)
        window, plan = asked(recorded, starts)
        assert loaded.predict(window, plan).shape == (len(starts), HORIZON, len(channels))
        window[..., : len(channels)] += tactile.rest_counts(shard.content.schema, channels)
        for first in range(0, len(starts), 5):  # a refusal stops at the first window, so not all at once
            with pytest.raises(TacpipeError, match="level at rest"):
                loaded.predict(window[first], plan[first])
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
    loaded = ForwardModel.load(trained(tmp_path, dataset(shard), dataset(shard), epochs=1))
    recorded, starts, windows_predicted = predicted_windows(loaded, shard)
    assert np.allclose(
        loaded.predict(*asked(recorded, starts)), dict(windows_predicted.each_prediction())["model"].count, atol=0.05
    )
    assert recorded.arm[0, 7:].any()


@pytest.fixture(scope="module")
def traced(tmp_path_factory: pytest.TempPathFactory) -> Forecaster:
    model_files = rigs.model(tmp_path_factory.mktemp("model"))
    return Forecaster.load(model_files[0])


def arm_windows(traced: Forecaster, seed: int) -> ForecastWindows:
    rng = np.random.default_rng(seed)
    context, rows = traced.context, traced.context + traced.horizon
    touch = rng.normal(0, 50, (context, 1, len(traced.codec.latents))).cumsum(axis=0)
    arm = rng.normal(0, 0.01, (rows, 1, ARM))
    arm[..., 6] = 1
    parts = (touch, arm, rng.normal(0.04, 0.01, (context, 1)))
    return ForecastWindows(*(torch.from_numpy(part.astype(np.float32)) for part in parts))


def test_a_recorded_network_gives_what_the_network_gives_to_the_last_bit(traced: Forecaster) -> None:
    network = Network(traced)
    assert network.is_recorded
    for seed in range(20):
        inputs = arm_windows(traced, seed)
        assert network.features(inputs).tobytes() == traced.features(inputs).tobytes()


class Moody(nn.Module):
    """Takes another way for windows that a recording of one window does not show."""

    change_only = True

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, inputs: ForecastWindows) -> Any:
        predicted = self.network(inputs)
        return predicted + 1 if float(inputs.touch.abs().max()) > 0 else predicted


class Unwilling(Moody):
    """Cannot be recorded."""

    def forward(self, inputs: ForecastWindows) -> Any:
        if torch.jit.is_tracing():  # type: ignore[attr-defined,no-untyped-call]
            raise RuntimeError("not while recorded")
        return self.network(inputs)


@pytest.mark.parametrize("kind", [Moody, Unwilling])
def test_a_network_whose_recording_gives_other_numbers_runs_as_it_is(kind: type[Moody], traced: Forecaster) -> None:
    changed = dataclasses.replace(traced, model=kind(traced.model))
    network = Network(changed)
    assert not network.is_recorded
    inputs = arm_windows(traced, 0)
    assert network.features(inputs).tobytes() == changed.features(inputs).tobytes()


def test_a_model_is_recorded_once(traced: Forecaster, tmp_path: Path) -> None:
    assert traced.single is traced.single
