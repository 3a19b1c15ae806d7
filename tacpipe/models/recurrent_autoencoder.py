"""The recurrent autoencoder with a classifier, and the recurrent classifier that it is measured against.

Gao, Taunyazov, Lin and Wu, Supervised Autoencoder Joint Learning on Heterogeneous Tactile Sensory Data (IROS 2020).
A slide goes through its sensor's header frame by frame and through an LSTM; its last state gives the latents, 40
numbers, which a linear layer classifies and a second LSTM turns into the slide again. Sizes are the paper's; where the
paper is silent, those of the published code.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tacpipe.errors import TacpipeError
from tacpipe.models import headers
from tacpipe.models.lstm import lstm

HIDDEN = 90
LATENTS = 40
DECODERS = ("D1", "D2")


@dataclass(frozen=True)
class Shape:
    """Sizes and layers of a sensor's network."""

    channels: int
    classes: int
    header: str = "none"  # none, mlp or cnn
    decoder: str = "D1"  # D1: the latents are the decoder's first state; D2: they are its input at every step
    hidden: int = HIDDEN
    latents: int = LATENTS
    unpool: str = "nearest"  # undoes the pooling of a cnn: nearest, or last as in the published code
    dropout: float = (
        0.0  # fraction of the latents, or last states, left out before the classifier in each training step
    )


class NetworkOutput(NamedTuple):
    """The output of a network for slides."""

    latents: Tensor  # (slide, latent)
    scores: Tensor  # (slide, class)
    frames: Tensor | None  # the reconstructed slides (time, slide, channel); None where there is no decoder


class RecurrentAutoencoder(nn.Module):
    """Header, LSTM, latents, classifier, and the decoder's LSTM and header."""

    ANY_LENGTH = True  # reads slides of any number of frames

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        if shape.decoder not in DECODERS:
            raise TacpipeError(f"There is no decoder {shape.decoder!r}; there are {' and '.join(DECODERS)}.")
        self.shape = shape
        self.header = headers.build(shape.header, shape.channels, shape.unpool)
        width = self.header.width
        self.encoder = nn.LSTM(width, shape.hidden)
        self.to_latents = nn.Linear(shape.hidden, shape.latents)
        self.classifier = nn.Linear(shape.latents, shape.classes)
        self.from_latents = nn.Linear(shape.latents, shape.hidden)
        self.decoder = nn.LSTM(1 if shape.decoder == "D1" else shape.hidden, shape.hidden)
        self.to_features = nn.Linear(shape.hidden, width)

    def forward(self, frames: Tensor, *, decode: bool = True) -> NetworkOutput:
        """Return the output for slides ``frames`` (time, slide, channel); without ``decode`` no frames."""
        last = _through(self.encoder, self.header.encode(frames))[-1]  # (slide, hidden)
        latents = self.to_latents(last)
        return NetworkOutput(latents, self.classify(latents), self._decoded(latents, len(frames)) if decode else None)

    def classify(self, latents: Tensor) -> Tensor:
        """Return the scores (slide, class) of latents (slide, latent), of this sensor or of another."""
        scores: Tensor = self.classifier(nn.functional.dropout(latents, self.shape.dropout, self.training))
        return scores

    def _decoded(self, latents: Tensor, steps: int) -> Tensor:
        initial = self.from_latents(latents)  # (slide, hidden)
        if self.shape.decoder == "D1":
            zeros = initial.new_zeros(steps, len(initial), 1)
            states = _through(self.decoder, zeros, initial)
        else:
            states = _through(self.decoder, initial.expand(steps, *initial.shape))
        return self.header.decode(self.to_features(states))


class RecurrentClassifier(nn.Module):
    """The paper's X-LSTM: header, LSTM, and a linear layer that classifies its last state, which are its latents."""

    ANY_LENGTH = True

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.shape = shape
        self.header = headers.build(shape.header, shape.channels, shape.unpool)
        self.encoder = nn.LSTM(self.header.width, shape.hidden)
        self.classifier = nn.Linear(shape.hidden, shape.classes)

    def forward(self, frames: Tensor, *, decode: bool = True) -> NetworkOutput:
        """Return the output for slides ``frames`` (time, slide, channel), which has no frames."""
        last = _through(self.encoder, self.header.encode(frames))[-1]
        return NetworkOutput(last, self.classify(last), None)

    def classify(self, latents: Tensor) -> Tensor:
        """Return the scores (slide, class) of last states (slide, hidden)."""
        scores: Tensor = self.classifier(nn.functional.dropout(latents, self.shape.dropout, self.training))
        return scores


def parameters(network: nn.Module) -> int:
    """Return how many weights a network has."""
    return sum(weight.numel() for weight in network.parameters())


def _through(layer: nn.LSTM, inputs: Tensor, hidden: Tensor | None = None) -> Tensor:
    """Return the states (time, slide, hidden) of a layer whose cell begins at zero, and so does h if none is given."""
    from_input, from_state, *biases = layer.parameters()  # torch keeps two biases, and adds them
    state = None if hidden is None else (hidden, torch.zeros_like(hidden))
    states, _ = lstm(inputs, state, (from_input, from_state, biases[0] + biases[1]))
    return states
