"""Encode the frames of a sensor for a recurrent network: by nothing, a perceptron, or a convolution.

A header encodes each frame to features and has a mirror that decodes features to a frame. Frames are (time, slide,
channel); features (time, slide, width).
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from tacpipe.errors import TacpipeError

GRID = (6, 10)  # triangles of a RoboSkin patch and taxels of a triangle
WIDTH = 18  # features of a header: what the convolution gives, and as many of the perceptron's, so that both compare
KERNEL = (3, 5)
MAPS = 3
POOL = 2
OTHER = "other"  # key of a choice of headers: all sensors without such a grid


class Plain(nn.Module):
    """Frames are their own features."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.width = channels

    def encode(self, frames: Tensor) -> Tensor:
        """Return the frames."""
        return frames

    def decode(self, features: Tensor) -> Tensor:
        """Return the features."""
        return features


class Perceptron(nn.Module):
    """One layer of 18 tanh units, and a linear one back.

    The paper names a single-layer perceptron before BioTac's LSTM; its published code has none, so its width is ours.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.width = WIDTH
        self.encoder, self.decoder = nn.Linear(channels, WIDTH), nn.Linear(WIDTH, channels)

    def encode(self, frames: Tensor) -> Tensor:
        """Return the features."""
        return torch.tanh(self.encoder(frames))

    def decode(self, features: Tensor) -> Tensor:
        """Return the frames."""
        frames: Tensor = self.decoder(features)
        return frames


class Convolution(nn.Module):
    """A convolution over the grid of triangles and taxels, pooled; transposed and up-sampled on the way back.

    Three maps of a 3 x 5 kernel without padding, and the largest of each 2 x 2: 18 features, as in the published code
    of the joint-learning paper (IROS 2020). Its mirror up-samples to the nearest and ends in a rectifier, because counts
    above rest are not negative. ``unpool`` "last" puts each feature back where the pool of the *last* encoded frame took
    its largest from, as the published code does: right for that frame only, and a path around the latents.
    """

    def __init__(self, channels: int, unpool: str = "nearest") -> None:
        super().__init__()
        if channels != GRID[0] * GRID[1]:
            raise TacpipeError(
                f"A convolution reads a grid of {GRID[0]} x {GRID[1]} channels and this sensor has {channels}. "
                f"Give it the header none or mlp."
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
        """Return the features."""
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
        """Return the frames."""
        steps, slides, _ = features.shape
        pooled = features.reshape(-1, MAPS, 2, 3)
        if self.unpool == "last":
            assert self._indices is not None
            indices = self._indices.repeat(steps, 1, 1, 1)
            maps = nn.functional.max_unpool2d(pooled, indices, [POOL, POOL])
        else:
            maps = nn.functional.interpolate(pooled, scale_factor=float(POOL), mode="nearest")
        return torch.relu(self.decoder(maps)).reshape(steps, slides, -1)


def build(kind: str, channels: int, unpool: str = "nearest") -> Plain | Perceptron | Convolution:
    """Return the header ``kind``: none, mlp or cnn. Raises `TacpipeError` for another, and where it does not fit."""
    if kind == "none":
        return Plain(channels)
    if kind == "mlp":
        return Perceptron(channels)
    if kind == "cnn":
        return Convolution(channels, unpool)
    raise TacpipeError(f"There is no header {kind!r}; there are none, mlp and cnn.")


def chosen(assignments: str, sensors: Mapping[str, int]) -> dict[str, str]:
    """Return the header of each sensor; ``assignments`` is text like ``biotac=none,roboskin=cnn`` and may leave some out.

    ``sensors`` has the number of channels. A grid of triangles gets a convolution by default, others what ``other``
    states, or none.

    >>> chosen("biotac=mlp", {"biotac": 19, "roboskin": 60})
    {'biotac': 'mlp', 'roboskin': 'cnn'}
    >>> chosen("other=mlp", {"biotac": 19, "roboskin": 60})
    {'biotac': 'mlp', 'roboskin': 'cnn'}
    """
    headers = dict(part.strip().partition("=")[::2] for part in assignments.split(",") if part.strip())
    default = headers.pop(OTHER, "none")
    unknown = sorted(set(headers) - set(sensors))
    if unknown:
        raise TacpipeError(f"headers names the sensor {unknown[0]}; the recordings have {', '.join(sensors)}.")
    return {
        name: headers.get(name, "cnn" if channels == GRID[0] * GRID[1] else default)
        for name, channels in sensors.items()
    }
