"""PointNet for touch (Zapata-Impata et al., Generation of tactile data from 3D vision and target robotic grasps, 2020).

Every point goes through the same layers, the largest value of each of 1,024 channels over the cloud describes the whole,
and fully connected layers make touch of it and of the grasp (Qi et al., PointNet, CVPR 2017). The trunk is that of the
group's published code: one learned transform of all input channels, and no loss that keeps it orthogonal.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from tacpipe.models.pooling import NormalisedLinear, largest

FEATURES = 1024
POINT_LAYERS = (64, 128)
TRANSFORM_LAYERS = (512, 256)
HEADS = {f"fc{depth}": (1024, 512, 256, 128, 64, 32)[:depth] for depth in range(1, 7)}  # Table I of the letter


class PointNet(nn.Module):
    """Map points (cloud, point, channel) and numbers of the grasp (cloud, number) to values of touch (cloud, value)."""

    def __init__(
        self, channels: int, grasp: int, outputs: int, *, head: Sequence[int] = HEADS["fc3"], transform: bool = True
    ) -> None:
        super().__init__()
        self.transform = PointTransform(channels) if transform else None
        self.points = PointFeatures(channels)
        self.head = _connected(FEATURES + grasp, head, outputs)

    def forward(self, points: Tensor, grasp: Tensor) -> Tensor:
        """Return the values of touch."""
        if self.transform is not None:
            points = points @ self.transform(points)
        values: Tensor = self.head(torch.cat([self.points(points), grasp], dim=1))
        return values


class PointFeatures(nn.Module):
    """The largest value of each channel over a cloud, (cloud, point, channel) to (cloud, 1024)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        sizes = (channels, *POINT_LAYERS)
        self.layers = nn.ModuleList(NormalisedLinear(*pair) for pair in pairwise(sizes))
        self.last = NormalisedLinear(sizes[-1], FEATURES)

    def forward(self, points: Tensor) -> Tensor:
        """Return the features; there is no ReLU behind the last layer."""
        for layer in self.layers:
            points = torch.relu(layer(points))
        return largest(self.last, points)


class PointTransform(nn.Module):
    """A learned map of a cloud's channels, (cloud, point, channel) to (cloud, channel, channel).

    It is the identity and what is learned beside it, which begins at random, as in the group's published code.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.channels = channels
        self.points = PointFeatures(channels)
        self.head = _connected(FEATURES, TRANSFORM_LAYERS, channels * channels)

    def forward(self, points: Tensor) -> Tensor:
        """Return the map to multiply points with from the right."""
        transform: Tensor = self.head(torch.relu(self.points(points))).view(-1, self.channels, self.channels)
        return transform + torch.eye(self.channels, device=points.device)


def _connected(inputs: int, hidden: Sequence[int], outputs: int) -> nn.Sequential:
    """Return fully connected layers with batch normalisation and ReLU, and a plain one at the end."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(inputs, width), nn.BatchNorm1d(width), nn.ReLU()]
        inputs = width
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))
