"""Networks that classify slides: the recurrent autoencoder, the recurrent classifier, and their frame encoders.

Gao, Taunyazov, Lin and Wu, Supervised Autoencoder Joint Learning on Heterogeneous Tactile Sensory Data (IROS 2020). A
slide passes through its sensor's header frame by frame and through an LSTM. The LSTM's last state determines the 40
latents, which a linear layer classifies and a second LSTM decodes to the slide. Sizes are the paper's or, if it does
not state them, those of the published code.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tacpipe.errors import TacpipeError
from tacpipe.models.lstm import run_layer

GRID = (6, 10)  # triangles of a RoboSkin patch and taxels per triangle
WIDTH = 18  # features of a header: the output size of the convolution, also used for the perceptron
KERNEL = (3, 5)
MAPS = 3
POOL = 2
OTHER = "other"  # key for all sensors without such a grid


class Identity(nn.Module):
    """A header that uses frames as features.

    A header encodes each frame as features, and its inverse decodes features to a frame. Frames are (time, slide,
    channel); features are (time, slide, width).
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.width = channels

    def encode(self, frames: Tensor) -> Tensor:
        """Return the frames (time, slide, channel) as features."""
        return frames

    def decode(self, features: Tensor) -> Tensor:
        """Return the features (time, slide, channel) as frames."""
        return features


class Perceptron(nn.Module):
    """A header with one layer of 18 tanh units, and a linear layer as decoder.

    The paper mentions a single-layer perceptron before BioTac's LSTM; its published code has none, so the width is our
    choice.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.width = WIDTH
        self.encoder, self.decoder = nn.Linear(channels, WIDTH), nn.Linear(WIDTH, channels)

    def encode(self, frames: Tensor) -> Tensor:
        """Return the features (time, slide, width) of frames (time, slide, channel)."""
        return torch.tanh(self.encoder(frames))

    def decode(self, features: Tensor) -> Tensor:
        """Return the frames (time, slide, channel) of features (time, slide, width)."""
        frames: Tensor = self.decoder(features)
        return frames


class Convolution(nn.Module):
    """A header with a convolution over the grid of triangles and taxels, and pooling; the decoder reverses both.

    Three maps of a 3 x 5 kernel without padding, and 2 x 2 max pooling: 18 features, as in the published code of the
    joint-learning paper (IROS 2020). The decoder upsamples to the nearest and ends with a ReLU, because counts above
    rest are not negative. ``unpool`` "last" puts each feature back at the position of the maximum in the *last* encoded
    frame, as the published code does. This is correct for that frame only, and lets information bypass the latents.
    """

    def __init__(self, channels: int, unpool: str = "nearest") -> None:
        """Create the layers. Raises `TacpipeError` if the channels do not form the grid, or for an unknown ``unpool``."""
        super().__init__()
        if channels != GRID[0] * GRID[1]:
            raise TacpipeError(
                f"A convolution reads a grid of {GRID[0]} x {GRID[1]} channels and this sensor has {channels}. "
                f"Use the header none or mlp."
            )
        if unpool not in ("nearest", "last"):
            raise TacpipeError(f"unpool is {unpool!r}; it must be nearest or last.")
        self.width = WIDTH
        self.unpool = unpool
        self.encoder = nn.Conv2d(1, MAPS, KERNEL)
        self.decoder = nn.ConvTranspose2d(MAPS, 1, KERNEL)
        self.pool = nn.MaxPool2d(POOL, return_indices=unpool == "last")
        self._indices: Tensor | None = None

    def encode(self, frames: Tensor) -> Tensor:
        """Return the features (time, slide, width) of frames (time, slide, channel)."""
        steps, slides, _ = frames.shape
        maps = self.encoder(frames.reshape(-1, 1, *GRID))  # (time * slide, map, 4, 6)
        if self.unpool == "last":
            maps, indices = self.pool(maps)
            self._indices = indices[-slides:]
        else:
            maps = self.pool(maps)
        features: Tensor = maps.reshape(steps, slides, WIDTH)
        return features

    def decode(self, features: Tensor) -> Tensor:
        """Return the frames (time, slide, channel) of features (time, slide, width)."""
        steps, slides, _ = features.shape
        pooled = features.reshape(-1, MAPS, 2, 3)
        if self.unpool == "last":
            assert self._indices is not None
            indices = self._indices.repeat(steps, 1, 1, 1)
            maps = nn.functional.max_unpool2d(pooled, indices, [POOL, POOL])
        else:
            maps = nn.functional.interpolate(pooled, scale_factor=float(POOL), mode="nearest")
        return torch.relu(self.decoder(maps)).reshape(steps, slides, -1)


def build(kind: str, channels: int, unpool: str = "nearest") -> Identity | Perceptron | Convolution:
    """Return the header ``kind``: none, mlp or cnn.

    Raises `TacpipeError` if the kind is unknown or the channels do not fit.
    """
    if kind == "none":
        return Identity(channels)
    if kind == "mlp":
        return Perceptron(channels)
    if kind == "cnn":
        return Convolution(channels, unpool)
    raise TacpipeError(f"There is no header {kind!r}; there are none, mlp and cnn.")


def parse_headers(assignments: str, sensors: Mapping[str, int]) -> dict[str, str]:
    """Return the header of each sensor.

    ``assignments`` is text such as ``biotac=none,roboskin=cnn`` and may be incomplete.

    ``sensors`` has the number of channels. The default is a convolution for a grid of triangles, and otherwise the
    header assigned to ``other``, or none. Raises `TacpipeError` if ``assignments`` contains an unknown sensor.

    >>> parse_headers("biotac=mlp", {"biotac": 19, "roboskin": 60})
    {'biotac': 'mlp', 'roboskin': 'cnn'}
    >>> parse_headers("other=mlp", {"biotac": 19, "roboskin": 60})
    {'biotac': 'mlp', 'roboskin': 'cnn'}
    """
    headers = dict(part.strip().partition("=")[::2] for part in assignments.split(",") if part.strip())
    default = headers.pop(OTHER, "none")
    unknown = sorted(set(headers) - set(sensors))
    if unknown:
        raise TacpipeError(f"headers has the unknown sensor {unknown[0]}; the recordings have {', '.join(sensors)}.")
    return {
        name: headers.get(name, "cnn" if channels == GRID[0] * GRID[1] else default)
        for name, channels in sensors.items()
    }


HIDDEN = 90
LATENTS = 40
DECODERS = ("D1", "D2")


@dataclass(frozen=True)
class AutoencoderShape:
    """Sizes and layers of a sensor's network."""

    channels: int
    classes: int
    header: str = "none"  # none, mlp or cnn
    decoder: str = "D1"  # D1: the latents are the decoder's initial state; D2: they are its input at every step
    hidden: int = HIDDEN
    latents: int = LATENTS
    unpool: str = "nearest"  # how the pooling of a cnn is reversed: nearest, or last as in the published code
    dropout: float = 0.0  # dropout of the latents, or last states, before the classifier


class NetworkOutput(NamedTuple):
    """The output of a network for slides."""

    latents: Tensor  # (slide, latent)
    scores: Tensor  # (slide, class)
    frames: Tensor | None  # the reconstructed slides (time, slide, channel), or None if there is no decoder


class RecurrentAutoencoder(nn.Module):
    """A header, an LSTM encoder, latents, a classifier, and an LSTM decoder with its header."""

    ANY_LENGTH = True  # reads slides of any number of frames

    def __init__(self, shape: AutoencoderShape) -> None:
        super().__init__()
        if shape.decoder not in DECODERS:
            raise TacpipeError(f"There is no decoder {shape.decoder!r}; there are {' and '.join(DECODERS)}.")
        self.shape = shape
        self.header = build(shape.header, shape.channels, shape.unpool)
        width = self.header.width
        self.encoder = nn.LSTM(width, shape.hidden)
        self.to_latents = nn.Linear(shape.hidden, shape.latents)
        self.classifier = nn.Linear(shape.latents, shape.classes)
        self.from_latents = nn.Linear(shape.latents, shape.hidden)
        self.decoder = nn.LSTM(1 if shape.decoder == "D1" else shape.hidden, shape.hidden)
        self.to_features = nn.Linear(shape.hidden, width)

    def forward(self, frames: Tensor, *, decode: bool = True) -> NetworkOutput:
        """Return the output for slides ``frames`` (time, slide, channel); without ``decode``, its frames are None."""
        last = run_layer(self.encoder, self.header.encode(frames))[0][-1]  # (slide, hidden)
        latents = self.to_latents(last)
        return NetworkOutput(latents, self.classify(latents), self._decode(latents, len(frames)) if decode else None)

    def classify(self, latents: Tensor) -> Tensor:
        """Return the scores (slide, class) of latents (slide, latent), of this sensor or another."""
        scores: Tensor = self.classifier(nn.functional.dropout(latents, self.shape.dropout, self.training))
        return scores

    def _decode(self, latents: Tensor, steps: int) -> Tensor:
        """Return the reconstructed slides (time, slide, channel) of ``latents`` (slide, latent)."""
        initial = self.from_latents(latents)  # (slide, hidden)
        if self.shape.decoder == "D1":
            zeros = initial.new_zeros(steps, len(initial), 1)
            states, _ = run_layer(self.decoder, zeros, (initial[None], torch.zeros_like(initial)[None]))
        else:
            states, _ = run_layer(self.decoder, initial.expand(steps, *initial.shape))
        return self.header.decode(self.to_features(states))


class RecurrentClassifier(nn.Module):
    """The paper's X-LSTM: a header, an LSTM, and a linear classifier of its last state, which serves as latents."""

    ANY_LENGTH = True
    DECODES = False  # there is no reconstruction error

    def __init__(self, shape: AutoencoderShape) -> None:
        super().__init__()
        self.shape = shape
        self.header = build(shape.header, shape.channels, shape.unpool)
        self.encoder = nn.LSTM(self.header.width, shape.hidden)
        self.classifier = nn.Linear(shape.hidden, shape.classes)

    def forward(self, frames: Tensor, *, decode: bool = True) -> NetworkOutput:
        """Return the output for slides ``frames`` (time, slide, channel), without frames."""
        last = run_layer(self.encoder, self.header.encode(frames))[0][-1]
        return NetworkOutput(last, self.classify(last), None)

    def classify(self, latents: Tensor) -> Tensor:
        """Return the scores (slide, class) of last states (slide, hidden)."""
        scores: Tensor = self.classifier(nn.functional.dropout(latents, self.shape.dropout, self.training))
        return scores


class PlainClassifier(nn.Module):
    """A classifier whose scores also serve as latents, so other sensors' classifiers have no latents to read."""

    def __init__(self, network: nn.Module) -> None:
        """Wrap a network from slides (time, slide, channel) to scores (slide, class)."""
        super().__init__()
        self.network = network

    def forward(self, frames: Tensor, *, decode: bool = True) -> NetworkOutput:
        """Return the output for slides ``frames`` (time, slide, channel), without frames."""
        scores: Tensor = self.network(frames)
        return NetworkOutput(scores, scores, None)

    def classify(self, latents: Tensor) -> Tensor:
        """Return ``latents`` (slide, class), which are the scores."""
        return latents
