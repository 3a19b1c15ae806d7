import itertools
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn import decomposition

from tacpipe.codecs import codec, pca
from tacpipe.codecs.measures import Moments
from tacpipe.codecs.training_rows import TrainingRows
from tacpipe.errors import TacpipeError

CHANNELS = [f"c{index}" for index in range(6)]
LAYOUT = [{"stream": "xela1", "axis": axis} for axis in "xyzxyz"]


def values(seed: int = 0, rows: int = 60) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(rows, 3)) @ rng.normal(size=(3, 6)) * 100 + rng.normal(size=(rows, 6)) + 20


def fit(content: np.ndarray, **options: float | str) -> pca.PCA:
    return pca.fit(Moments.from_pieces([content], len(CHANNELS)), CHANNELS, LAYOUT, **options)  # type: ignore[arg-type]


def standardise(content: np.ndarray) -> np.ndarray:
    scaled: np.ndarray = (content - content.mean(axis=0)) / content.std(axis=0)
    return scaled


def test_latents_are_those_of_sklearn_on_standardised_channels_up_to_sign() -> None:
    content = values()
    oracle = decomposition.PCA(4).fit(standardise(content))
    fitted = fit(content, components=4)
    signs = np.sign((fitted.components * oracle.components_).sum(axis=1))
    assert np.allclose(fitted.encode(content, CHANNELS), oracle.transform(standardise(content)) * signs, atol=1e-4)
    assert np.allclose(fitted.explained_ratio[:4], oracle.explained_variance_ratio_)


def test_the_largest_weight_of_each_component_is_positive() -> None:
    components = fit(values(3), components=6).components
    assert (np.take_along_axis(components, np.abs(components).argmax(axis=1)[:, None], axis=1) > 0).all()


def test_a_share_of_variance_keeps_as_few_latents_as_hold_it() -> None:
    content = values()
    ratios = fit(content, components=6).explained_ratio.cumsum()
    fitted = fit(content, variance=0.9)
    count = len(fitted.components)
    assert (
        count == int(np.searchsorted(ratios, 0.9)) + 1 == decomposition.PCA(0.9).fit(standardise(content)).n_components_
    )
    assert fitted.explained_ratio[:count].sum() >= 0.9


def test_the_ratios_are_those_of_all_components_and_not_only_of_those_kept() -> None:
    content = values()
    oracle = decomposition.PCA().fit(standardise(content)).explained_variance_ratio_
    fitted = fit(content, components=2)
    assert np.allclose(fitted.explained_ratio, oracle)
    assert np.allclose(json.loads(fitted.to_files()["codec.json"])["explained_ratio"], oracle, atol=1e-9)
    assert len(fit(values(rows=4), components=2).explained_ratio) == 3


def test_components_of_increments_are_the_right_singular_vectors_of_increments_whose_mean_stays() -> None:
    steps = values() + 50
    scale = steps.std(axis=0)
    oracle = np.linalg.svd(steps / scale, full_matrices=False)[2][:3]
    fitted = fit(steps, components=3, representation="increments")
    signs = np.sign((fitted.components * oracle).sum(axis=1))
    assert np.allclose(fitted.components, oracle * signs[:, None])
    assert np.array_equal(fitted.mean_count, np.zeros(6))


def test_a_codec_of_increments_encodes_what_a_row_adds_and_decodes_to_that() -> None:
    walk = np.cumsum(values(rows=40), axis=0)
    steps = np.diff(walk, axis=0)
    fitted = fit(steps, components=6, representation="increments")
    latents = fitted.encode(walk, CHANNELS)
    assert np.array_equal(latents[0], np.zeros(6))
    assert np.allclose(fitted.decode(latents)[1:], steps, atol=1e-2)
    begins = np.arange(40) == 17
    assert np.array_equal(fitted.encode(walk, CHANNELS, begins)[17], np.zeros(6))


def test_rows_that_are_not_finite_have_no_latents() -> None:
    content = values()
    content[4, 1], content[9, 0] = np.nan, np.inf
    levels = fit(values(), components=3).encode(content, CHANNELS)
    assert np.flatnonzero(np.isnan(levels).all(axis=1)).tolist() == [4, 9]
    increments = fit(values(), components=3, representation="increments").encode(content, CHANNELS)
    assert np.flatnonzero(np.isnan(increments).all(axis=1)).tolist() == [4, 5, 9, 10]
    assert np.isfinite(np.delete(increments, [4, 5, 9, 10], axis=0)).all()


def test_channels_that_all_stand_still_are_refused() -> None:
    with pytest.raises(TacpipeError, match="None of the 6 tactile channels changes in 30 training rows"):
        fit(np.full((30, 6), 0.1), components=2)


def test_measures_are_those_of_a_fit_without_the_recordings_held_out() -> None:
    parts = {f"trial-{index}": values(index) for index in range(8)}
    rows = TrainingRows(tuple(CHANNELS), tuple(LAYOUT), parts)
    fitted = pca.fit_and_measure(rows, components=3)
    all_rows = np.concatenate([parts[name] for name in sorted(parts)])
    assert np.allclose(fitted.components, fit(all_rows, components=3).components, rtol=1e-9)
    train, val = rows.parts
    scale = train.std(axis=0)
    oracle = decomposition.PCA(3).fit((train - train.mean(axis=0)) / scale)
    for name, part in (("train", train), ("val", val)):
        scaled = (part - train.mean(axis=0)) / scale
        error = oracle.inverse_transform(oracle.transform(scaled)) - scaled
        measured = fitted.measured["reconstruction"][name]
        assert measured["rows"] == len(part)
        assert measured["mse_standardised"] == pytest.approx(np.square(error).mean(), rel=1e-4)
        assert measured["mae_counts"] == pytest.approx(np.abs(error * scale).mean(), rel=1e-4)
    covariance = np.array(fitted.measured["latent_covariance"])
    latents = fitted.encode(all_rows, CHANNELS)
    assert np.allclose(covariance, np.cov(latents, rowvar=False), atol=1e-4)
    assert codec.load(fitted.to_files()).to_files() == fitted.to_files()


def test_a_single_recording_is_measured_on_itself_alone() -> None:
    rows = TrainingRows(tuple(CHANNELS), tuple(LAYOUT), {"only": values()})
    assert list(pca.fit_and_measure(rows, components=2).measured["reconstruction"]) == ["train"]


def test_six_components_hold_data_of_rank_six_and_the_error_falls_with_their_number() -> None:
    rng = np.random.default_rng(5)
    content = rng.normal(size=(2000, 6)) @ rng.normal(size=(6, 96)) * 300
    channels = [f"c{index}" for index in range(96)]
    fitted = [pca.fit(Moments.from_pieces([content], 96), channels, [], components=count) for count in range(1, 7)]
    errors = [float(np.square(codec.decode(codec.encode(content, channels)) - content).mean()) for codec in fitted]
    assert fitted[-1].explained_ratio[:6].sum() >= 0.99
    assert all(before > after for before, after in itertools.pairwise(errors))
    assert errors[-1] < 1e-6 * content.var()


@given(st.integers(0, 2**16), st.integers(1, 6))
@settings(max_examples=25, deadline=None)
def test_decoding_is_a_projection(seed: int, components: int) -> None:
    content = values(seed)
    fitted = fit(content, components=components)
    projected = fitted.decode(fitted.encode(content, CHANNELS))
    assert np.allclose(fitted.decode(fitted.encode(projected, CHANNELS)), projected, atol=1e-2)
    if components == 6:
        assert np.allclose(projected, content, atol=1e-2)


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
    latents = fit(values(), components=3).encode(np.zeros((0, 6)), CHANNELS)
    assert latents.shape == (0, 3)
    assert latents.dtype.name == "float32"


@pytest.mark.parametrize(
    ("channels", "reason"),
    [
        ([*CHANNELS[:5], "other"], "channel 6 is other where it was fitted on c5"),
        (CHANNELS[:4], "fitted on 6 channels and is given 4"),
        ([CHANNELS[1], CHANNELS[0], *CHANNELS[2:]], "channel 1 is c1 where it was fitted on c0"),
    ],
)
def test_other_channels_are_refused_by_name(channels: list[str], reason: str) -> None:
    with pytest.raises(TacpipeError, match=reason):
        fit(values(), components=3).encode(np.zeros((2, len(channels))), channels)


@pytest.mark.parametrize(
    ("rows", "options", "reason"),
    [
        (60, {"components": 7}, "components is 7; 60 rows of 6 channels give 1 to 6"),
        (60, {"components": 0}, "components is 0"),
        (60, {"variance": 1.5}, "variance is 1.5"),
        (1, {"components": 1}, "cannot be fitted on 1 rows"),
    ],
)
def test_what_the_data_cannot_give_is_refused(rows: int, options: dict[str, float], reason: str) -> None:
    with pytest.raises(TacpipeError, match=reason):
        fit(values(rows=rows), **options)


def test_an_unknown_kind_and_missing_files_are_refused() -> None:
    with pytest.raises(TacpipeError, match=r"codec\.safetensors does not exist"):
        codec.load({"codec.json": b"{}"})
    with pytest.raises(TacpipeError, match=r"kind 'magic' is not installed.*autoencoder, pca"):
        codec.load({"codec.json": b'{"kind": "magic"}', "codec.safetensors": b""})
