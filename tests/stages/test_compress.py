from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from tacpipe import registry
from tacpipe.codecs import codec as codecs
from tacpipe.errors import TacpipeError
from tests.stages.learning_fakes import CHANNELS, FakeShard, dataset, motion, table

PCA = registry.load("compress.pca")
assert PCA.fit is not None
FIT = PCA.fit
RECORDINGS = [motion(seed) for seed in range(4)]


def fitted(*shards: FakeShard, **how: float) -> dict[str, bytes]:
    return dict(FIT(PCA.params(**({"components": 3} | how)), dataset(*shards)).files)


def compressed(shard: FakeShard, files: dict[str, bytes]) -> pa.Table:
    return PCA(PCA.params(), shard, files)


def test_latents_are_added_and_everything_else_stays() -> None:
    shard = RECORDINGS[0]
    found = compressed(shard, fitted(*RECORDINGS))
    assert found.column_names == [*shard.content.column_names, "z00", "z01", "z02"]
    assert found.select(shard.content.column_names).equals(shard.content, check_metadata=True)
    assert found.schema.field("z01").metadata == {b"quantity": b"latent", b"unit": b"1"}
    assert found.schema.field("z01").type == pa.float32()


def test_the_rest_level_of_each_recording_is_taken_off() -> None:
    files = fitted(*RECORDINGS)
    counts = np.column_stack([RECORDINGS[0].content[name].to_numpy() for name in CHANNELS]) - 16000
    drifted = compressed(FakeShard("drifted", table(counts - 700, rest=16000.0 - 700)), files)
    for name in ("z00", "z01", "z02"):
        assert np.allclose(drifted[name].to_numpy(), compressed(RECORDINGS[0], files)[name].to_numpy(), atol=1e-4)


def test_decoding_gives_back_counts_above_rest() -> None:
    files = fitted(*RECORDINGS, components=len(CHANNELS))
    found = compressed(RECORDINGS[0], files)
    latents = np.column_stack([found[name].to_numpy() for name in codecs.load(files).latents])
    counts = np.column_stack([RECORDINGS[0].content[name].to_numpy() for name in CHANNELS]) - 16000
    assert np.allclose(codecs.load(files).decode(latents), counts, atol=0.01)


def test_the_codec_does_not_depend_on_the_order_of_recordings_nor_on_rows_in_gaps() -> None:
    gap = np.zeros(80, dtype=bool)
    gap[-5:] = True
    tactile = np.random.default_rng(0).normal(size=(80, len(CHANNELS)))
    wild = tactile.copy()
    wild[-5:] = 1e5
    tame, torn = (fitted(FakeShard("a", table(one, gap=gap))) for one in (tactile, wild))
    assert tame == torn
    assert fitted(*RECORDINGS) == fitted(*reversed(RECORDINGS))


def test_a_recording_without_rows_is_compressed_to_none() -> None:
    found = compressed(FakeShard("empty", table(np.zeros((0, len(CHANNELS))))), fitted(*RECORDINGS))
    assert (found.num_rows, found.column_names[-1]) == (0, "z02")


def test_a_rig_with_other_channels_is_refused_with_the_recordings_name() -> None:
    small = FakeShard("small", table(np.zeros((9, 6))))
    with pytest.raises(TacpipeError, match="small: The codec does not fit this table"):
        compressed(small, fitted(*RECORDINGS))
    with pytest.raises(TacpipeError, match="trial-00: The codec does not fit this table"):
        fitted(FakeShard("a", table(np.zeros((9, 6)))), RECORDINGS[0])


def test_no_recording_and_no_tactile_channel_are_refused() -> None:
    with pytest.raises(TacpipeError, match="no training recording"):
        fitted()
    with pytest.raises(TacpipeError, match="no tactile channel"):
        fitted(FakeShard("a", table(np.zeros((9, 0)))))
