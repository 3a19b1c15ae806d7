from typing import Any

import pytest
import torch
from torch import nn

from tacpipe.errors import TacpipeError
from tacpipe.models import recurrent_autoencoder
from tacpipe.models.recurrent_autoencoder import (
    AutoencoderShape,
    RecurrentAutoencoder,
    RecurrentClassifier,
)

BIOTAC, ROBOSKIN = AutoencoderShape(19, 20), AutoencoderShape(60, 20, header="cnn")


def count_weights(network: nn.Module) -> int:
    return sum(weight.numel() for weight in network.parameters())


def test_the_networks_have_as_many_weights_as_the_published_ones() -> None:
    biotac, roboskin = RecurrentAutoencoder(BIOTAC), RecurrentAutoencoder(ROBOSKIN)
    assert count_weights(biotac) == 83_319
    assert count_weights(roboskin) == 82_962
    assert count_weights(biotac.encoder) == 39_960
    assert count_weights(roboskin.encoder) == 39_600
    assert count_weights(biotac.to_latents) == 3_640
    assert count_weights(biotac.classifier) == 820
    assert count_weights(biotac.from_latents) == 3_690
    assert count_weights(biotac.decoder) == 33_480
    assert count_weights(biotac.to_features) == 1_729
    assert count_weights(roboskin.to_features) == 1_638
    assert count_weights(roboskin.header) == 48 + 46


class Plainly(nn.Module):
    """The same network written with torch's layers only."""

    def __init__(self, ours: RecurrentAutoencoder) -> None:
        super().__init__()
        self.ours = ours

    def forward(self, frames: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        ours, shape = self.ours, self.ours.shape
        header: Any = ours.header
        steps, slides, _ = frames.shape
        if shape.header == "cnn":
            maps = [nn.functional.max_pool2d(header.encoder(part.view(slides, 1, 6, 10)), 2) for part in frames]
            features = torch.stack([part.flatten(1) for part in maps])
        elif shape.header == "mlp":
            features = torch.stack([torch.tanh(header.encoder(part)) for part in frames])
        else:
            features = frames
        _, (last, _) = ours.encoder(features)
        z = ours.to_latents(last[0])
        initial = ours.from_latents(z)
        if shape.decoder == "D1":
            state = initial[None], torch.zeros_like(initial)[None]
            states, _ = ours.decoder(torch.zeros(steps, slides, 1), state)
        else:
            states, _ = ours.decoder(torch.stack([initial] * steps))
        out = ours.to_features(states)
        if shape.header == "cnn":
            ups = [part.view(slides, 3, 2, 3).repeat_interleave(2, 2).repeat_interleave(2, 3) for part in out]
            out = torch.stack([torch.relu(header.decoder(part)).flatten(1) for part in ups])
        elif shape.header == "mlp":
            out = header.decoder(out)
        return z, ours.classifier(z), out


@pytest.mark.parametrize("header, channels", [("none", 19), ("mlp", 19), ("cnn", 60)])
@pytest.mark.parametrize("decoder", ["D1", "D2"])
def test_a_network_says_what_the_same_one_of_plain_layers_says(header: str, channels: int, decoder: str) -> None:
    torch.manual_seed(3)
    ours = RecurrentAutoencoder(AutoencoderShape(channels, 5, header=header, decoder=decoder))
    frames = torch.rand(7, 4, channels)
    expected = Plainly(ours)(frames)
    for ours_part, plain_part in zip(ours(frames), expected, strict=True):
        torch.testing.assert_close(ours_part, plain_part, atol=1e-5, rtol=1e-4)
    grown = torch.autograd.grad(
        sum(plain_part.square().mean() for plain_part in expected), list(ours.parameters()), allow_unused=True
    )
    output = ours(frames)
    ours.zero_grad()
    sum(plain_part.square().mean() for plain_part in output).backward()
    for weight, gradient in zip(ours.parameters(), grown, strict=True):
        wanted_gradient = torch.zeros_like(weight) if gradient is None else gradient
        found_gradient = torch.zeros_like(weight) if weight.grad is None else weight.grad
        torch.testing.assert_close(found_gradient, wanted_gradient, atol=1e-5, rtol=1e-3)


def test_unpooling_as_published_uses_the_places_of_the_last_frame() -> None:
    header = recurrent_autoencoder.Convolution(60, "last")
    frames = torch.rand(5, 2, 60)
    features = header.encode(frames)
    _, indices = nn.functional.max_pool2d(header.encoder(frames[-1].view(2, 1, 6, 10)), 2, return_indices=True)
    maps = nn.functional.max_unpool2d(features[0].view(2, 3, 2, 3), indices, [2, 2])
    expected = torch.relu(header.decoder(maps)).flatten(1)
    torch.testing.assert_close(header.decode(features)[0], expected)


def test_reconstructed_counts_of_the_convolution_are_never_negative() -> None:
    output = RecurrentAutoencoder(ROBOSKIN)(torch.randn(6, 3, 60))
    assert (output.frames >= 0).all()


def test_the_classifier_alone_has_its_last_state_for_latents_and_makes_no_frames() -> None:
    network = RecurrentClassifier(BIOTAC)
    output = network(torch.rand(6, 3, 19))
    assert output.frames is None
    torch.testing.assert_close(network.classifier(output.latents), output.scores)
    assert count_weights(network) == 39_960 + 90 * 20 + 20


@pytest.mark.parametrize("kind", [RecurrentAutoencoder, RecurrentClassifier])
def test_dropout_leaves_out_latents_in_training_only(kind: type[RecurrentAutoencoder | RecurrentClassifier]) -> None:
    network = kind(AutoencoderShape(19, 20, dropout=0.5))
    frames = torch.rand(4, 64, 19)
    network.eval()
    assert torch.equal(network(frames).scores, network(frames).scores)
    network.train()
    assert not torch.equal(network(frames).scores, network(frames).scores)


def test_what_cannot_be_built_is_refused_with_what_can() -> None:
    with pytest.raises(TacpipeError, match="no decoder 'D3'; there are D1 and D2"):
        RecurrentAutoencoder(AutoencoderShape(19, 20, decoder="D3"))
    with pytest.raises(TacpipeError, match="a grid of 6 x 10 channels and this sensor has 19"):
        RecurrentAutoencoder(AutoencoderShape(19, 20, header="cnn"))
    with pytest.raises(TacpipeError, match="no header 'fft'"):
        RecurrentAutoencoder(AutoencoderShape(19, 20, header="fft"))
    with pytest.raises(TacpipeError, match="the unknown sensor digit; the recordings have biotac"):
        recurrent_autoencoder.parse_headers("digit=mlp", {"biotac": 19})
