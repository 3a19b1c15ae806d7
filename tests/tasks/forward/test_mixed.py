"""The architecture ``mixed`` in the task: windows that reach further back, and what is fitted after training."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from safetensors.numpy import load as load_arrays

from tacpipe.errors import TacpipeError
from tacpipe.plugins.params import to_json
from tacpipe.tasks.forward import task as forward
from tacpipe.tasks.forward import tracks
from tacpipe.tasks.forward.rows import rows
from tests.fake_recordings import FakeShard, dataset
from tests.stages.learning_fakes import motion
from tests.tasks.forward.trials import CONTEXT, HORIZON, MIXED, evaluated, params, predicted_windows, trained

READS = 8


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return trained(tmp_path_factory.mktemp("mixed"), **MIXED, learning_rate=0.02, epochs=3)


def broken(seed: int = 5) -> FakeShard:
    """A recording with a row that is not usable."""
    one = motion(seed)
    at = one.content.column_names.index("xela1_taxel01_x")
    values = one.content.column(at).to_numpy().copy()
    values[30] = np.nan
    return dataclasses.replace(one, content=one.content.set_column(at, one.content.schema.field(at), pa.array(values)))


def track_of(shard: Any) -> tracks.Track:
    return tracks.track(shard, tracks.codec_of(shard.content, {}))


def test_windows_reach_back_to_the_first_row_without_a_gap_which_is_repeated() -> None:
    track = track_of(broken())
    starts = track.starts(CONTEXT, HORIZON)
    found = track.past(starts, CONTEXT, READS)
    for start, past in zip(starts.tolist(), found.tolist(), strict=True):
        begins = 0 if start < 30 else 31
        assert past == [max(row, begins) for row in range(start + CONTEXT - READS, start + CONTEXT)]
    assert {0, 31} <= set(starts.tolist())


def test_windows_of_training_are_those_rows_with_the_plan_after_them() -> None:
    parts = [track_of(motion(1)), track_of(broken())]
    starts = [one.starts(CONTEXT, HORIZON) for one in parts]
    found = rows(parts, starts, CONTEXT, HORIZON, reads=READS)
    windows, ahead = found.pick(found.starts)
    past = np.concatenate(
        [one.past(own, CONTEXT, READS) + 80 * at for at, (one, own) in enumerate(zip(parts, starts, strict=True))]
    )
    touch, arm, finger = (
        np.concatenate([getattr(one, name)[:] for one in parts]).astype(np.float32)
        for name in ("latent", "arm", "finger")
    )
    future = past[:, -1:] + np.arange(1, HORIZON + 1)
    np.testing.assert_array_equal(windows.touch.transpose(0, 1), touch[past])
    np.testing.assert_array_equal(windows.finger.T, finger[past])
    np.testing.assert_array_equal(windows.arm.transpose(0, 1), arm[np.hstack([past, future])])
    np.testing.assert_array_equal(ahead.transpose(0, 1), touch[future])


def test_as_many_windows_are_evaluated_as_of_other_architectures(model: dict[str, bytes], tmp_path: Path) -> None:
    other = trained(tmp_path, epochs=1)
    (found, _), (wanted, _) = (evaluated(one, broken(20)) for one in (model, other))
    assert found["counts"] == wanted["counts"]
    for name in ("persistence", "ridge", "ridge_actions", "damped_trend", "context_mean"):
        assert found[name] == wanted[name], name


def test_predict_of_arrays_is_what_is_evaluated_and_shorter_windows_repeat_their_first_row(
    model: dict[str, bytes],
) -> None:
    opened = forward.load(model)
    track, starts, some = predicted_windows(opened, broken(20))
    past, ahead = track.past(starts, CONTEXT, READS), starts[:, None] + np.arange(CONTEXT, CONTEXT + HORIZON)
    window = np.concatenate([track.tactile[past], track.arm[past], track.finger[past][..., None]], axis=-1)
    plan = track.arm[ahead]
    found = opened.predict(window, plan)
    np.testing.assert_allclose(found, some.predictions["model"].count, atol=0.05)
    assert np.abs(found - track.tactile[some.now][:, None]).max() > 5
    first = starts == 0
    np.testing.assert_allclose(opened.predict(window[first, -CONTEXT:], plan[first]), found[first], atol=1e-6)
    for count in (CONTEXT - 1, READS + 1):
        with pytest.raises(TacpipeError, match=r"reads 5 to 8 rows of 26 columns"):
            opened.predict(np.zeros((count, window.shape[2])), plan[0])


def test_touch_after_now_and_later_plans_change_no_earlier_step(model: dict[str, bytes]) -> None:
    opened = forward.load(model)
    track, starts, _ = predicted_windows(opened, motion(20))
    past, ahead = track.past(starts, CONTEXT, READS), starts[:, None] + np.arange(CONTEXT, CONTEXT + HORIZON)
    window = np.concatenate([track.tactile[past], track.arm[past], track.finger[past][..., None]], axis=-1)
    plan = track.arm[ahead].astype(np.float64)
    before = opened.predict(window, plan)
    for step in range(1, HORIZON):
        changed = plan.copy()
        changed[:, step:, :3] += 0.2
        changed[:, step:, 7:] += 1.0
        after = opened.predict(window, changed)
        np.testing.assert_allclose(after[:, :step], before[:, :step], atol=1e-6)
        assert (np.abs(after[:, step] - before[:, step]) > 1e-3).any()


def test_the_blend_is_fitted_on_validation_recordings_and_trees_are_not(tmp_path: Path) -> None:
    wild = FakeShard("wild", motion(7).content)
    one, other = (
        load_arrays(trained(tmp_path / str(len(part)), None, dataset(*part), **MIXED, epochs=1)["model.safetensors"])
        for part in ([motion(10)], [motion(10), motion(11), wild])
    )
    assert all(np.array_equal(one[name], other[name]) for name in one if name.startswith("trees_"))
    assert any(name.startswith("trees_") and values.any() for name, values in one.items())
    for values in (one["blend"], other["blend"]):
        assert values.shape == (2, HORIZON) and (values >= 0).all() and (values.sum(axis=0) < 1 + 1e-6).all()


def test_a_model_begins_with_another_of_the_same_sizes_and_others_are_refused(
    model: dict[str, bytes], tmp_path: Path
) -> None:
    given = params(**MIXED, epochs=1, learning_rate=1e-9)
    tuned = forward.train(given, dataset(motion(5)), dataset(motion(10)), tmp_path / "a", model)
    before, after = (load_arrays(one["model.safetensors"]) for one in (model, tuned))
    name = "frames.0.own.weight"
    np.testing.assert_allclose(after[name], before[name], atol=1e-6)
    for changed in ({"networks": 2}, {"trees": 9}, {"frames": 5}):
        other = params(**{**MIXED, **changed})
        with pytest.raises(TacpipeError, match=r"of the model of --init are .* and should be"):
            forward.train(other, dataset(motion(5)), dataset(motion(10)), tmp_path / "b", model)


def test_latents_are_refused_with_what_to_do(tmp_path: Path) -> None:
    from tests.tasks.forward.trials import compressed

    latents = compressed(*(motion(seed) for seed in range(3)))
    with pytest.raises(TacpipeError, match="Train it on segments without a codec"):
        trained(tmp_path, latents, latents, **MIXED)


def test_params_are_those_of_the_architecture_and_damaged_trees_are_refused(model: dict[str, bytes]) -> None:
    config = json.loads(model["config.json"])
    assert config["architecture"] == "mixed"
    assert config["params"] == to_json(params(**MIXED, learning_rate=0.02, epochs=3))
    from safetensors.numpy import save

    arrays = load_arrays(model["model.safetensors"])
    arrays["trees_children"][0, 0] = 10_000
    arrays["blend"][:] = 0.5
    with pytest.raises(TacpipeError, match="children of the model's trees are not all from 0 to 60"):
        forward.load({**model, "model.safetensors": save(arrays)})
