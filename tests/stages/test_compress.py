import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.codecs import codec
from tacpipe.errors import TacpipeError
from tacpipe.plugins import registry
from tests.fake_recordings import FakeShard, dataset
from tests.stages.learning_fakes import CHANNELS, motion, table

PCA = registry.load("compress.pca")
assert PCA.fit is not None
FIT = PCA.fit
AUTOENCODER = registry.load("compress.autoencoder")
assert AUTOENCODER.fit is not None
FIT_AUTOENCODER = AUTOENCODER.fit
RECORDINGS = [motion(seed) for seed in range(4)]


def fitted(*shards: FakeShard, **options: float | str) -> dict[str, bytes]:
    return dict(FIT(PCA.params(**({"components": 3} | options)), dataset(*shards)).files)


def compress(shard: FakeShard, files: dict[str, bytes]) -> pa.Table:
    return PCA(PCA.params(), shard, files)


def learn(folder: Path, *shards: FakeShard, **options: Any) -> dict[str, bytes]:
    params = AUTOENCODER.params(**({"components": 3, "hidden": "8", "epochs": 2} | options))
    return dict(FIT_AUTOENCODER(params, dataset(*shards), folder).files)


def test_latents_are_added_and_everything_else_stays() -> None:
    shard = RECORDINGS[0]
    encoded = compress(shard, fitted(*RECORDINGS))
    assert encoded.column_names == [*shard.content.column_names, "z00", "z01", "z02"]
    assert encoded.select(shard.content.column_names).equals(shard.content, check_metadata=True)
    assert encoded.schema.field("z01").metadata == {b"quantity": b"latent", b"unit": b"1"}
    assert encoded.schema.field("z01").type == pa.float32()


def test_the_rest_level_of_each_recording_is_taken_off() -> None:
    files = fitted(*RECORDINGS)
    counts = np.column_stack([RECORDINGS[0].content[name].to_numpy() for name in CHANNELS]) - 16000
    drifted = compress(FakeShard("drifted", table(counts - 700, rest=16000.0 - 700)), files)
    for name in ("z00", "z01", "z02"):
        assert np.allclose(drifted[name].to_numpy(), compress(RECORDINGS[0], files)[name].to_numpy(), atol=1e-4)


def test_decoding_gives_back_counts_above_rest() -> None:
    files = fitted(*RECORDINGS, components=len(CHANNELS))
    encoded = compress(RECORDINGS[0], files)
    latents = np.column_stack([encoded[name].to_numpy() for name in codec.load(files).latents])
    counts = np.column_stack([RECORDINGS[0].content[name].to_numpy() for name in CHANNELS]) - 16000
    assert np.allclose(codec.load(files).decode(latents), counts, atol=0.01)


def test_the_codec_does_not_depend_on_the_order_of_recordings_nor_on_rows_in_gaps() -> None:
    gap = np.zeros(80, dtype=bool)
    gap[-5:] = True
    tactile = np.random.default_rng(0).normal(size=(80, len(CHANNELS)))
    wild = tactile.copy()
    wild[-5:] = 1e5
    tame, torn = (fitted(FakeShard("a", table(samples, gap=gap))) for samples in (tactile, wild))
    assert tame == torn
    assert fitted(*RECORDINGS) == fitted(*reversed(RECORDINGS))


def test_a_recording_without_rows_is_compressed_to_none() -> None:
    encoded = compress(FakeShard("empty", table(np.zeros((0, len(CHANNELS))))), fitted(*RECORDINGS))
    assert (encoded.num_rows, encoded.column_names[-1]) == (0, "z02")


def test_a_rig_with_other_channels_is_refused_with_the_recordings_name() -> None:
    small = FakeShard("small", table(np.zeros((9, 6))))
    with pytest.raises(TacpipeError, match="small: The codec does not fit this table"):
        compress(small, fitted(*RECORDINGS))
    with pytest.raises(TacpipeError, match="trial-00: The codec does not fit this table"):
        fitted(FakeShard("a", table(np.zeros((9, 6)))), RECORDINGS[0])


def test_no_recording_and_no_tactile_channel_are_refused() -> None:
    with pytest.raises(TacpipeError, match="no training recording"):
        fitted()
    with pytest.raises(TacpipeError, match="no tactile channel"):
        fitted(FakeShard("a", table(np.zeros((9, 0)))))


def test_rows_outside_of_contact_are_encoded_and_not_learned() -> None:
    values = np.random.default_rng(0).normal(size=(80, len(CHANNELS)))
    wild = values.copy()
    wild[:30] *= 1e4
    contact = np.where(np.arange(80) < 30, -1, 0)
    inside, marked = FakeShard("a", table(values[30:])), FakeShard("a", table(wild, contact=contact))
    assert fitted(marked) == fitted(inside)
    assert np.isfinite(compress(marked, fitted(marked))["z00"].to_numpy()).all()


def test_rows_that_are_not_finite_get_latents_that_are_not() -> None:
    values = np.random.default_rng(0).normal(size=(80, len(CHANNELS)))
    values[9, 4] = np.nan
    shard = FakeShard("a", table(values))
    encoded = compress(shard, fitted(shard))
    assert np.isnan(encoded["z01"].to_numpy()).nonzero()[0].tolist() == [9]


def test_increments_do_not_reach_across_a_gap_in_time() -> None:
    files = fitted(*RECORDINGS, representation="increments")
    content = RECORDINGS[0].content
    cut = FakeShard("cut", content.take([*range(20), *range(30, 80)]))
    latents = compress(cut, files)["z00"].to_numpy()
    uncut = compress(RECORDINGS[0], files)["z00"].to_numpy()
    assert latents[0] == latents[20] == 0
    assert np.allclose(latents[1:20], uncut[1:20])
    assert np.allclose(latents[21:], uncut[31:])


def test_codec_json_says_what_latents_stand_for_and_what_is_lost() -> None:
    info = json.loads(fitted(*RECORDINGS, representation="increments")["codec.json"])
    assert (info["kind"], info["of"], info["latents"], len(info["explained_ratio"])) == ("pca", "increments", 3, 12)
    assert info["reconstruction"]["val"].keys() == {"rows", "mse_standardised", "mae_counts"}
    assert np.shape(info["latent_covariance"]) == (3, 3)


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_an_autoencoder_adds_its_latents_and_everything_else_stays(tmp_path: Path, frames: int) -> None:
    files = learn(tmp_path, *RECORDINGS, frames=frames)
    encoded = AUTOENCODER(AUTOENCODER.params(), RECORDINGS[0], files)
    assert encoded.column_names == [*RECORDINGS[0].content.column_names, "z00", "z01", "z02"]
    counts = np.column_stack([RECORDINGS[0].content[name].to_numpy() for name in CHANNELS]) - 16000
    expected = codec.load(files).encode(counts, CHANNELS)
    assert np.allclose(
        np.column_stack([encoded[name].to_numpy() for name in ("z00", "z01", "z02")]), expected, atol=1e-5
    )
    info = json.loads(files["codec.json"])
    assert (info["kind"], info["frames"], len(info["search"])) == ("autoencoder", frames, 1)


def test_an_autoencoder_is_the_same_for_the_same_seed_and_another_for_another(tmp_path: Path) -> None:
    first, second = learn(tmp_path / "a", *RECORDINGS), learn(tmp_path / "b", *reversed(RECORDINGS))
    assert first == second
    assert learn(tmp_path / "c", *RECORDINGS, seed=1) != first


def test_a_rig_with_other_channels_is_refused_by_an_autoencoder_too(tmp_path: Path) -> None:
    files = learn(tmp_path, *RECORDINGS)
    with pytest.raises(TacpipeError, match="small: The codec does not fit this table"):
        AUTOENCODER(AUTOENCODER.params(), FakeShard("small", table(np.zeros((9, 6)))), files)


@pytest.mark.parametrize("how", [{"representation": "speed"}, {"representation": ""}])
def test_another_kind_of_value_is_refused_before_anything_is_fitted(tmp_path: Path, how: dict[str, str]) -> None:
    with pytest.raises(TacpipeError, match=r"^representation is .*levels.*increments"):
        fitted(*RECORDINGS, **how)
    with pytest.raises(TacpipeError, match=r"^representation is .*levels.*increments"):
        learn(tmp_path, *RECORDINGS, **how)


def test_an_array_with_fewer_channels_than_latents_keeps_as_many_as_it_has_and_a_note_says_so() -> None:
    stage = registry.load("compress.pca")
    assert stage.fit is not None
    shards = dataset(*(motion(seed) for seed in range(3)))
    too_many = stage.fit(stage.params(components=len(CHANNELS) + 1), shards)
    all_channels = stage.fit(stage.params(components=len(CHANNELS)), shards)
    assert too_many.files == all_channels.files
    assert len(too_many.notes) == 1 and str(len(CHANNELS)) in too_many.notes[0]
    assert not all_channels.notes
