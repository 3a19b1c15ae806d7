import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from tacpipe.codecs import autoencoder_fit, codec, pca
from tacpipe.codecs.autoencoder import CHUNK, Autoencoder
from tacpipe.codecs.training_rows import TrainingRows
from tacpipe.errors import TacpipeError
from tacpipe.training.loop import Schedule
from tests.training.followers import interrupted

CHANNELS = tuple(f"c{index:02d}" for index in range(12))
LAYOUT = tuple({"stream": "xela1", "axis": "xyz"[index % 3]} for index in range(12))
SCHEDULE = Schedule(epochs=4, batch=32, learning_rate=1e-3, patience=10, gradient_clip=1.0, seed=3)


def walk(seed: int, rows: int = 60) -> np.ndarray:
    rng = np.random.default_rng(seed)
    counts: np.ndarray = (
        np.cumsum(rng.normal(size=(rows, 3)), axis=0) @ np.random.default_rng(0).normal(size=(3, 12)) * 50
    )
    return counts + rng.normal(size=counts.shape) + 20


WALKS = {f"trial-{seed}": walk(seed) for seed in range(5)}


def training(representation: str = "levels", frames: int = 1) -> TrainingRows:
    return TrainingRows(
        CHANNELS,
        LAYOUT,
        {name: codec.codec_inputs(counts, None, representation, frames) for name, counts in WALKS.items()},
    )


def fit(
    folder: Path, representation: str = "levels", frames: int = 1, hidden: str = "16,8", search: int = 0
) -> Autoencoder:
    tried = autoencoder_fit.candidate_networks(frames, hidden, search)
    return autoencoder_fit.fit(
        training(representation, frames), tried, SCHEDULE, folder, components=4, representation=representation
    )


def in_torch(layers: tuple[tuple[np.ndarray, np.ndarray], ...]) -> nn.Sequential:
    """Build the same layers of torch's own parts."""
    parts: list[nn.Module] = []
    for weight, bias in layers:
        linear = nn.Linear(weight.shape[1], weight.shape[0])
        linear.load_state_dict({"weight": torch.from_numpy(weight), "bias": torch.from_numpy(bias)})
        parts += [linear, nn.ELU()]
    return nn.Sequential(*parts[:-1])


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_encoding_and_decoding_are_what_torch_makes_of_the_same_weights(tmp_path: Path, frames: int) -> None:
    fitted = fit(tmp_path, frames=frames)
    rows = codec.codec_inputs(WALKS["trial-0"], None, "levels", frames)
    scaled = (rows.reshape(-1, frames, 12) - fitted.mean_count) / fitted.scale_count
    with torch.no_grad():
        latents = in_torch(fitted.encoder)(torch.from_numpy(scaled.reshape(len(rows), -1)).float())
        newest = in_torch(fitted.decoder)(latents)[:, -12:]
    assert np.allclose(fitted.encode(WALKS["trial-0"], CHANNELS), latents, atol=1e-5)
    counts = newest.numpy() * fitted.scale_count + fitted.mean_count
    assert np.allclose(fitted.decode(latents.numpy()), counts, atol=1e-2)
    assert np.allclose(fitted.decode(latents.numpy().reshape(6, 10, 4)), counts.reshape(6, 10, 12), atol=1e-2)


def test_widths_are_those_asked_for_and_mirrored(tmp_path: Path) -> None:
    fitted = fit(tmp_path, frames=2)
    assert [weight.shape for weight, _ in fitted.encoder] == [(16, 24), (8, 16), (4, 8)]
    assert [weight.shape for weight, _ in fitted.decoder] == [(8, 4), (16, 8), (24, 16)]
    assert fitted.latents == ("z00", "z01", "z02", "z03")


@pytest.mark.parametrize(("frames", "hidden"), [(1, (64, 32)), (2, (128, 64)), (3, (192, 96))])
def test_each_class_has_hidden_layers_of_its_own(frames: int, hidden: tuple[int, ...]) -> None:
    assert [network.hidden for network in autoencoder_fit.candidate_networks(frames, "", 0)] == [hidden]


def test_a_row_depends_on_the_before_it_and_not_across_a_break(tmp_path: Path) -> None:
    fitted = fit(tmp_path, frames=3)
    values = WALKS["trial-1"]
    begins = np.arange(60) == 30
    changed = values.copy()
    changed[29] += 500
    first_latents, second_latents = (fitted.encode(counts, CHANNELS) for counts in (values, changed))
    assert np.flatnonzero((first_latents != second_latents).any(axis=1)).tolist() == [29, 30, 31]
    first_latents, second_latents = (fitted.encode(counts, CHANNELS, begins) for counts in (values, changed))
    assert np.flatnonzero((first_latents != second_latents).any(axis=1)).tolist() == [29]
    assert np.allclose(second_latents[30:], fitted.encode(changed[30:], CHANNELS), atol=1e-5)


def test_rows_that_are_not_finite_have_no_latents_and_long_ones_are_done_in_pieces(tmp_path: Path) -> None:
    fitted = fit(tmp_path, frames=2)
    walk = WALKS["trial-2"]
    rows = 2 * CHUNK + 10
    values, begins = np.resize(walk, (rows, walk.shape[1])), np.arange(rows) % len(walk) == 0
    expected = np.resize(fitted.encode(walk, CHANNELS), (rows, 4))
    values[CHUNK - 1, 2] = np.nan
    torn = fitted.encode(values, CHANNELS, begins)
    assert np.flatnonzero(np.isnan(torn).all(axis=1)).tolist() == [CHUNK - 1, CHUNK]
    intact = [row for row in range(rows) if row not in (CHUNK - 1, CHUNK)]
    assert np.allclose(torn[intact], expected[intact], atol=1e-5)
    assert fitted.encode(values[:0], CHANNELS).shape == (0, 4)


def test_of_increments_a_row_that_does_not_move_has_latents_0_and_comes_back_as_0(tmp_path: Path) -> None:
    fitted = fit(tmp_path, "increments")
    latents = fitted.encode(np.full((5, 12), 700.0), CHANNELS)
    assert np.array_equal(latents, np.zeros((5, 4)))
    assert np.array_equal(fitted.decode(latents), np.zeros((5, 12)))


def test_a_codec_read_back_gives_the_same_bytes_and_latents(tmp_path: Path) -> None:
    fitted = fit(tmp_path / "a", frames=2)
    files = fitted.to_files()
    read = codec.load(files)
    assert isinstance(read, Autoencoder)
    assert read.to_files() == files == fit(tmp_path / "b", frames=2).to_files()
    assert np.array_equal(read.encode(WALKS["trial-0"], CHANNELS), fitted.encode(WALKS["trial-0"], CHANNELS))
    description = json.loads(files["codec.json"])
    assert (description["kind"], description["of"], description["frames"], description["latents"]) == (
        "autoencoder",
        "levels",
        2,
        4,
    )


def test_errors_told_are_those_of_encoding_and_decoding_the_newest_frame(tmp_path: Path) -> None:
    fitted, rows = fit(tmp_path, frames=2), training(frames=2)
    for name, is_validation in (("train", False), ("val", True)):
        back, true = [], []
        for recording, values in WALKS.items():
            if (recording in rows.held_out) == is_validation:
                back.append(fitted.decode(fitted.encode(values, CHANNELS)))
                true.append(values)
        error = np.concatenate(back) - np.concatenate(true)
        measured = fitted.measured["reconstruction"][name]
        assert measured["rows"] == len(error)
        assert measured["mae_counts"] == pytest.approx(np.abs(error).mean(), rel=1e-4)
        assert measured["mse_standardised"] == pytest.approx(np.square(error / fitted.scale_count).mean(), rel=1e-4)
    learned = np.concatenate([fitted.encode(WALKS[name], CHANNELS) for name in sorted(set(WALKS) - rows.held_out)])
    assert np.allclose(fitted.measured["latent_covariance"], np.cov(learned, rowvar=False), atol=1e-4)


def test_a_search_tries_twelve_networks_and_keeps_the_best(tmp_path: Path) -> None:
    tried = autoencoder_fit.candidate_networks(3, "", 12)
    assert len(set(tried)) == 12
    assert {network.hidden for network in tried} == {(192, 96), (384, 192, 96), (384, 192)}
    fitted = fit(tmp_path, hidden="", search=6)
    records = fitted.measured["search"]
    assert [network["hidden"] for network in records] == [[64, 32], [128, 64, 32], [128, 64]] * 2
    assert [network["learning_rate"] for network in records] == [0.001] * 3 + [0.003] * 3
    (best,) = (network for network in records if network["kept"])
    assert best["val_loss"] == min(network["val_loss"] for network in records)
    assert [len(weight) for weight, _ in fitted.encoder[:-1]] == best["hidden"]
    weights = sum(weight.size + bias.size for weight, bias in fitted.encoder + fitted.decoder)
    assert best["parameters"] == weights


def test_weights_that_decay_are_smaller(tmp_path: Path) -> None:
    sizes = []
    for decay in (0.0, 0.3):
        tried = autoencoder_fit.candidate_networks(1, "16", 0, weight_decay=decay)
        fitted = autoencoder_fit.fit(training(), tried, SCHEDULE, tmp_path / str(decay), components=4)
        sizes.append(sum(float(np.square(weight).sum()) for weight, _ in fitted.encoder + fitted.decoder))
    assert sizes[1] < sizes[0]


def test_a_search_that_was_interrupted_goes_on_to_the_same_codec(tmp_path: Path) -> None:
    uninterrupted = fit(tmp_path / "whole", hidden="", search=3)
    with interrupted(tmp_path / "torn", networks=3):
        fit(tmp_path / "torn", hidden="", search=3)
    assert fit(tmp_path / "torn", hidden="", search=3).to_files() == uninterrupted.to_files()


@pytest.mark.long
def test_as_many_latents_as_the_data_have_dimensions_lose_no_more_than_principal_components(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    mixing = rng.normal(size=(6, 96)) * 200
    channels = tuple(f"c{index}" for index in range(96))
    recordings = {
        f"t{index}": rng.normal(size=(700, 6)) @ mixing + rng.normal(size=(700, 96)) * 150 for index in range(7)
    }
    rows = TrainingRows(channels, (), recordings)
    schedule = Schedule(epochs=60, batch=64, learning_rate=2e-3, patience=10, gradient_clip=1.0, seed=0)
    tried = autoencoder_fit.candidate_networks(1, "", 0, learning_rate=2e-3)
    network = autoencoder_fit.fit(rows, tried, schedule, tmp_path, components=8)
    linear = pca.fit_and_measure(rows, components=6)
    mse = {
        name: fitted.measured["reconstruction"]["val"]["mse_standardised"]
        for name, fitted in (("network", network), ("linear", linear))
    }
    assert mse["network"] <= 1.1 * mse["linear"]


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"frames": 4}, "frames is 4; an autoencoder reads 1, 2 or 3 frames"),
        ({"frames": 0}, "frames is 0"),
        ({"search": 13}, "search is 13; it must be the number of networks to try, 1 to 12"),
        ({"search": 3, "hidden": "64"}, "Give only one of them"),
        ({"hidden": "64,a"}, "hidden is '64,a'"),
        ({"hidden": "64,,32"}, "Leave it empty"),
        ({"hidden": "64,0"}, "positive integers"),
        ({"weight_decay": -1.0}, "weight_decay is -1.0"),
        ({"weight_decay": float("nan")}, "weight_decay is nan"),
    ],
)
def test_what_makes_no_network_is_refused(options: dict[str, object], reason: str) -> None:
    with pytest.raises(TacpipeError, match=reason):
        autoencoder_fit.candidate_networks(**({"frames": 1, "hidden": "", "search": 0} | options))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("recordings", "components", "reason"),
    [
        ({"a": 60, "b": 60}, 13, "components is 13; 12 channels give 1 to 12"),
        ({"a": 60, "b": 60}, 0, "components is 0"),
        ({"a": 60}, 4, "at least 2 training recordings, .* there is 1"),
        ({"a": 1, "b": 1}, 4, "cannot be fitted to 1 rows and stopped by 1"),
        ({"a": 0, "b": 0}, 4, "cannot be fitted to 0 rows"),
    ],
)
def test_what_the_recordings_cannot_give_is_refused(
    tmp_path: Path, recordings: dict[str, int], components: int, reason: str
) -> None:
    rows = TrainingRows(CHANNELS, LAYOUT, {name: walk(1, count) for name, count in recordings.items()})
    with pytest.raises(TacpipeError, match=reason):
        autoencoder_fit.fit(
            rows, autoencoder_fit.candidate_networks(1, "", 0), SCHEDULE, tmp_path, components=components
        )
