from __future__ import annotations

import numpy as np
import pytest

from tacpipe.codecs import codec as codecs
from tacpipe.errors import TacpipeError
from tacpipe.tasks import tracks
from tests.stages.learning_fakes import CHANNELS, FakeShard, table

RNG = np.random.default_rng(0)
TACTILE = RNG.normal(size=(30, len(CHANNELS)))


def track(content: object, name: str = "trial") -> tracks.Track:
    shard = FakeShard(name, content)
    return tracks.track(shard, tracks.codec_of(content, {}))  # type: ignore[arg-type]


def test_a_dataset_without_codec_gives_counts_above_rest() -> None:
    found = track(table(TACTILE))
    assert np.allclose(found.tactile, TACTILE, atol=2e-3)
    assert np.allclose(found.latent, found.tactile)


def test_windows_cross_neither_contacts_nor_gaps_nor_missing_rows() -> None:
    contact, gap = np.repeat([0, 1, 1], 10), np.zeros(30, dtype=bool)
    gap[15] = True
    found = track(table(TACTILE, contact=contact, gap=gap))
    assert found.starts(3, 2).tolist() == [*range(6), 10, *range(16, 26)]
    content = table(TACTILE)
    t_ns = np.arange(30) * 20_000_000
    t_ns[12:] += 60_000_000
    torn = content.set_column(0, content.schema.field(0), [t_ns])
    assert track(torn).starts(5, 5).tolist() == [0, 1, 2, *range(12, 21)]


def test_rows_that_are_not_finite_or_not_in_contact_are_unusable() -> None:
    pose = np.tile([0.5, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0], (30, 1))
    pose[4, 0], pose[6, 3:] = np.nan, 0.0
    contact = np.zeros(30)
    contact[20:] = -1
    usable = track(table(TACTILE, pose, contact=contact)).usable
    assert np.flatnonzero(~usable).tolist() == [4, 6, *range(20, 30)]


def test_a_recording_without_rows_has_no_windows() -> None:
    found = track(table(TACTILE[:0]))
    assert found.starts(2, 2).tolist() == []
    assert tracks.rate_hz([found]) == 0.0


def test_quaternions_that_flip_their_sign_are_one_pose() -> None:
    angle = np.linspace(0, 3, 30)
    pose = np.zeros((30, 7))
    pose[:, 3], pose[:, 6] = np.sin(angle / 2), np.cos(angle / 2)
    flipped = pose.copy()
    flipped[::3, 3:] *= -1
    states = [track(table(TACTILE, one)).state for one in (pose, flipped)]
    aligned = [tracks.aligned(state, pose[0, 3:]) for state in states]
    assert np.allclose(aligned[0], aligned[1])
    assert np.allclose(aligned[0], pose, atol=1e-6)


def test_ground_truth_is_never_read() -> None:
    content = table(TACTILE, extra={"gt_slip": np.zeros(30)})
    with pytest.raises(TacpipeError, match="ground truth"):
        tracks.inputs(content, ["gt_slip"])


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (table(TACTILE, rest=None), "trial: Channel xela1_taxel01_x has no rest level"),
        (table(TACTILE).drop_columns(["contact"]), "trial: There is no column contact"),
        (table(TACTILE).drop_columns(["robot_position_x_m"]), "trial: There is no column robot_position_x_m"),
    ],
)
def test_what_is_absent_is_named_with_its_recording(content: object, told: str) -> None:
    with pytest.raises(TacpipeError, match=told):
        track(content)


def test_tables_and_codecs_that_do_not_belong_together_are_refused() -> None:
    bare = table(TACTILE)
    latent = bare.append_column(bare.schema.field(0).with_name("z00").with_metadata({"quantity": "latent"}), bare[0])
    with pytest.raises(TacpipeError, match="1 latent columns but its dataset no codec"):
        tracks.codec_of(latent, {})
    with pytest.raises(TacpipeError, match="no tactile channel"):
        tracks.codec_of(bare.select(["t_ns"]), {})
    other = codecs.Raw(tuple(reversed(CHANNELS)), ())
    with pytest.raises(TacpipeError, match="trial: The codec does not fit"):
        tracks.track(FakeShard("trial", bare), other)  # type: ignore[arg-type]


def test_recordings_of_different_rates_are_refused() -> None:
    slow, content = track(table(TACTILE), "slow"), table(TACTILE)
    fast = track(content.set_column(0, content.schema.field(0), [np.arange(30) * 10_000_000]), "fast")
    assert tracks.rate_hz([slow, slow]) == 50.0
    with pytest.raises(TacpipeError, match=r"slow runs at 50\.00 Hz and fast at 100\.00 Hz"):
        tracks.rate_hz([slow, fast])
