"""Test that simulated markers follow the contact forces, and that `extract markers` measures them."""

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.arrays import Floats
from tacpipe.plugins.registry import load
from tacpipe.plugins.stage import RecordingOutput
from tacpipe.simulation import gel, pick_and_move
from tests.fake_recordings import FakeRecording
from tests.stage_params import build_params
from tests.video.gels import ERROR_PX

simulate = load("simulate.gel")
SECONDS = 5.0


@pytest.fixture(scope="module")
def trial() -> dict[str, pa.Table]:
    """Return the streams of a trial whose plan makes the object slip and drop."""
    return tables(simulate(build_params("simulate.gel", duration_s=SECONDS, effort=1.1, seed=4), 0))


def tables(output: RecordingOutput) -> dict[str, pa.Table]:
    return {
        name: stream if isinstance(stream, pa.Table) else stream.read_all() for name, stream in output.streams.items()
    }


def true_px(trial: dict[str, pa.Table], name: str) -> Floats:
    """Return the true displacements (time, marker, xy) of the stream ``name``."""
    truth = trial[f"{name}_truth"]
    columns = [truth.column(field).to_numpy() for field in truth.column_names if "_marker" in field]
    return np.column_stack(columns).reshape(truth.num_rows, -1, 2)


def track(frames: pa.Table) -> pa.Table:
    """Return what `extract markers` measures of all markers."""
    output = load("extract.markers").function(
        build_params("extract.markers", rows=gel.ROWS, columns=gel.COLUMNS), FakeRecording({"gel": frames})
    )
    return tables(output)["gel"]


def measured_px(channels: pa.Table) -> Floats:
    """Return displacements (time, marker, xy), NaN where a marker is missing."""
    columns = [channels.column(name).to_numpy() for name in channels.column_names if name.startswith("taxel")]
    return np.column_stack(columns).reshape(channels.num_rows, -1, 2)


def test_the_same_seed_gives_the_same_frames_and_another_trial_others(trial: dict[str, pa.Table]) -> None:
    params = build_params("simulate.gel", duration_s=SECONDS, effort=1.1, seed=4)
    repeated, other = tables(simulate(params, 0)), tables(simulate(params, 1))
    assert set(trial) == {"gel1", "gel2", "gel1_truth", "gel2_truth", "robot", "truth"}
    assert all(trial[name].equals(repeated[name]) for name in trial)
    assert not trial["gel1"].equals(other["gel1"])


def test_the_markers_of_both_fingers_carry_the_load_of_the_object(trial: dict[str, pa.Table]) -> None:
    rig = pick_and_move.PickRig(duration_s=SECONDS, effort=1.1)
    scene = pick_and_move.perform(4, 0, rig)
    true_ns = np.arange(0, int(scene.path.t_ns[-1]), 50_000_000)
    states = [gel.gel_states(scene, finger, true_ns) for finger in (0, 1)]
    stiffness_n_px = gel.STIFFNESS_N_M / (gel.ROWS * gel.COLUMNS) / gel.PX_M
    carried = sum(state.displacement_px.sum(axis=1) for state in states) * stiffness_n_px  # (time, xy)
    load = pick_and_move.interpolation(scene, true_ns)(scene.contact.force_n[:, ::2]) * [1, -1]
    assert np.abs(carried - load).max() < 0.05 * np.abs(load).max()
    assert np.abs(load).max() > 2


@pytest.mark.parametrize("name", gel.FINGERS)
def test_markers_are_measured_to_a_fifth_of_a_pixel_up_to_half_their_distance(
    trial: dict[str, pa.Table], name: str
) -> None:
    true, measured = true_px(trial, name), measured_px(track(trial[name]))
    assert measured.shape == true.shape
    length = np.linalg.norm(true, axis=2)
    inside = length <= gel.PITCH_PX / 2
    assert length.max() > 0.3 * gel.PITCH_PX
    assert np.nanmax(np.abs(measured - true)[inside]) < ERROR_PX
    assert np.isnan(measured).mean() < 0.01


def test_covered_markers_are_null_and_never_invented(trial: dict[str, pa.Table]) -> None:
    from tacpipe.video.encoding import encode_images
    from tacpipe.video.stream import read_format
    from tests.video import videos

    frames = trial["gel1"]
    video_format = read_format(frames)
    assert video_format is not None
    images = list(videos.sound_images(video_format, [frames]).values())
    for image in images[40:]:
        image[80:150, 100:200] = [110, 120, 135]  # a patch without markers
    column = pa.array(list(encode_images(video_format, images)), pa.binary())
    covered = frames.set_column(frames.column_names.index("packet"), frames.field("packet"), column)
    channels = track(covered)
    measured, true = measured_px(channels), true_px(trial, "gel1")
    places = gel.rest_places_px() + true
    hidden = np.all((places > [100 + 8, 80 + 8]) & (places < [200 - 8, 150 - 8]), axis=2)  # (time, marker)
    hidden[:46] = False  # a marker is tracked for five frames without being seen
    assert hidden.sum() > 200
    assert np.isnan(measured[hidden]).all()
    around = 25  # markers are darker than the mean of a square of 41 pixels around them
    seen = ~((places > [100 - around, 80 - around]) & (places < [200 + around, 150 + around])).all(axis=2)
    seen &= np.linalg.norm(true, axis=2) <= gel.PITCH_PX / 2
    assert np.nanmax(np.abs(measured - true)[seen]) < ERROR_PX
    assert channels.column("detected_ratio")[-1].as_py() < 1


def test_a_row_is_the_same_bit_for_bit_whatever_follows_it(trial: dict[str, pa.Table]) -> None:
    whole = track(trial["gel2"])
    for count in (1, 2, 37):
        assert track(trial["gel2"].slice(0, count)).equals(whole.slice(0, count))
