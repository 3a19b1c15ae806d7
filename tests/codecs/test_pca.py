from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn import decomposition

from tacpipe.codecs import codec, pca
from tacpipe.errors import TacpipeError

CHANNELS = [f"c{index}" for index in range(6)]
LAYOUT = [{"stream": "xela1", "axis": axis} for axis in "xyzxyz"]


def values(seed: int = 0, rows: int = 60) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(rows, 3)) @ rng.normal(size=(3, 6)) * 100 + rng.normal(size=(rows, 6)) + 20


def fit(content: np.ndarray, **how: float) -> pca.PCA:
    return pca.fit(content, CHANNELS, LAYOUT, **how)  # type: ignore[arg-type]


def test_latents_are_those_of_sklearn_on_standardised_channels_up_to_sign() -> None:
    content = values()
    standardised = (content - content.mean(axis=0)) / content.std(axis=0)
    oracle = decomposition.PCA(4).fit(standardised)
    fitted = fit(content, components=4)
    signs = np.sign((fitted.components * oracle.components_).sum(axis=1))
    assert np.allclose(fitted.encode(content, CHANNELS), oracle.transform(standardised) * signs, atol=1e-4)
    assert np.allclose(fitted.explained_ratio, oracle.explained_variance_ratio_)


def test_the_largest_weight_of_each_component_is_positive() -> None:
    components = fit(values(3), components=6).components
    assert (np.take_along_axis(components, np.abs(components).argmax(axis=1)[:, None], axis=1) > 0).all()


def test_a_share_of_variance_keeps_as_few_latents_as_hold_it() -> None:
    content = values()
    ratios = fit(content, components=6).explained_ratio.cumsum()
    fitted = fit(content, variance=0.9)
    assert len(fitted.components) == int(np.searchsorted(ratios, 0.9)) + 1
    assert fitted.explained_ratio.sum() >= 0.9


@given(st.integers(0, 2**16), st.integers(1, 6))
@settings(max_examples=25, deadline=None)
def test_decoding_is_a_projection(seed: int, components: int) -> None:
    content = values(seed)
    fitted = fit(content, components=components)
    once = fitted.decode(fitted.encode(content, CHANNELS))
    assert np.allclose(fitted.decode(fitted.encode(once, CHANNELS)), once, atol=1e-2)
    if components == 6:
        assert np.allclose(once, content, atol=1e-2)


def test_a_channel_that_never_moves_comes_back_as_it_was() -> None:
    content = values()
    content[:, 2] = 7.0
    fitted = fit(content, components=5)
    assert np.allclose(fitted.decode(fitted.encode(content, CHANNELS))[:, 2], 7.0)


def test_a_codec_read_back_gives_the_same_bytes_and_latents() -> None:
    fitted = fit(values(), components=3)
    files = fitted.to_files()
    read = codec.load(files)
    assert isinstance(read, pca.PCA)
    assert read.to_files() == files == fit(values(), components=3).to_files()
    assert np.array_equal(read.encode(values(1), CHANNELS), fitted.encode(values(1), CHANNELS))
    assert (read.channels, read.layout, read.latents) == (tuple(CHANNELS), tuple(LAYOUT), ("z00", "z01", "z02"))
    assert json.loads(files["codec.json"])["kind"] == "pca"


def test_latents_are_float32_and_no_rows_give_no_latents() -> None:
    found = fit(values(), components=3).encode(np.zeros((0, 6)), CHANNELS)
    assert found.shape == (0, 3)
    assert found.dtype.name == "float32"


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ([*CHANNELS[:5], "other"], "channel 6 is other where it was fitted on c5"),
        (CHANNELS[:4], "fitted on 6 channels and is given 4"),
        ([CHANNELS[1], CHANNELS[0], *CHANNELS[2:]], "channel 1 is c1 where it was fitted on c0"),
    ],
)
def test_other_channels_are_refused_by_name(given: list[str], told: str) -> None:
    with pytest.raises(TacpipeError, match=told):
        fit(values(), components=3).encode(np.zeros((2, len(given))), given)


@pytest.mark.parametrize(
    ("rows", "how", "told"),
    [
        (60, {"components": 7}, "components is 7; 60 rows of 6 channels give 1 to 6"),
        (60, {"components": 0}, "components is 0"),
        (60, {"variance": 1.5}, "variance is 1.5"),
        (1, {"components": 1}, "cannot be fitted on 1 rows"),
    ],
)
def test_what_the_data_cannot_give_is_refused(rows: int, how: dict[str, float], told: str) -> None:
    with pytest.raises(TacpipeError, match=told):
        fit(values(rows=rows), **how)


def test_an_unknown_kind_and_missing_files_are_refused() -> None:
    with pytest.raises(TacpipeError, match=r"no codec\.safetensors"):
        codec.load({"codec.json": b"{}"})
    with pytest.raises(TacpipeError, match="kind 'magic' is unknown"):
        codec.load({"codec.json": b'{"kind": "magic"}', "codec.safetensors": b""})
