"""Touch from what lies under the fingertips: patches about both contacts and a coarse view of the object, in metres.

Contact depends on the surface about the contact, its curvature, slope and edges, and on sizes in metres. So points are
read in the axes of the grasp, those about each contact through layers of their own, and the grasp's own sizes beside
them. Moving object, hand and wrist together changes nothing of what is read. Two backbones describe a patch:

- ``points``: every point alone, as in PointNet;
- ``edges``: every point with its nearest neighbours (EdgeConv; Wang et al., Dynamic graph CNN, 2019).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

BACKBONES = ("points", "edges")
NEIGHBOURS = 12
WIDTHS = (64, 128, 256)


@dataclass(frozen=True)
class Shape:
    """Sizes of what a network of touch reads and predicts."""

    channels: int  # numbers per point
    numbers: int  # numbers that describe the grasp
    values: int  # predicted values, those of all targets side by side


class PatchNetwork(nn.Module):
    """Map patches (cloud, patch, point, channel) and the grasp's numbers (cloud, number) to touch (cloud, value)."""

    def __init__(
        self, channels: int, numbers: int, outputs: int, *, backbone: str, hidden: int, dropout: float
    ) -> None:
        super().__init__()
        backbones = {"points": PointBackbone, "edges": EdgeBackbone}
        self.near: nn.Module = backbones[backbone](channels)  # the same for both contacts
        self.whole: nn.Module = backbones[backbone](channels)
        self.head = nn.Sequential(
            nn.Linear(3 * 2 * WIDTHS[-1] + numbers, hidden),
            nn.LayerNorm(hidden),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Linear(hidden, hidden // 2),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Linear(hidden // 2, outputs),
        )

    def forward(self, patches: Tensor, numbers: Tensor) -> Tensor:
        """Return the values of touch; the patches are those about g1, about g2, and the whole cloud."""
        clouds, _, points, channels = patches.shape
        near = self.near(patches[:, :2].reshape(-1, points, channels)).view(clouds, -1)
        values: Tensor = self.head(torch.cat([near, self.whole(patches[:, 2]), numbers], dim=1))
        return values


class PointBackbone(nn.Module):
    """Largest and mean value of each channel over points, (cloud, point, channel) to (cloud, 512)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        first, second, last = WIDTHS
        self.layers = nn.Sequential(
            nn.Linear(channels, first), nn.ReLU(), nn.Linear(first, second), nn.ReLU(), nn.Linear(second, last)
        )

    def forward(self, points: Tensor) -> Tensor:
        """Return the features."""
        return _pooled(self.layers(points))


class EdgeBackbone(nn.Module):
    """The same behind one layer that reads each point with its 12 nearest ones: how they lie about it."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        first, second, last = WIDTHS
        self.edges = nn.Sequential(nn.Linear(2 * channels, first), nn.ReLU(), nn.Linear(first, first))
        self.layers = nn.Sequential(nn.ReLU(), nn.Linear(first, second), nn.ReLU(), nn.Linear(second, last))

    def forward(self, points: Tensor) -> Tensor:
        """Return the features; neighbours are those in space, which comes first among the channels."""
        clouds, count, channels = points.shape
        distances = torch.cdist(points[:, :, :3], points[:, :, :3])
        nearest = distances.topk(min(NEIGHBOURS, count), largest=False).indices  # (cloud, point, neighbour)
        rows = torch.arange(clouds, device=points.device)[:, None, None]
        around = points[rows, nearest] - points[:, :, None]  # (cloud, point, neighbour, channel)
        centre = points[:, :, None].expand(clouds, count, nearest.shape[2], channels)
        return _pooled(self.layers(self.edges(torch.cat([centre, around], dim=3)).amax(dim=2)))


def _pooled(values: Tensor) -> Tensor:
    return torch.cat([values.amax(dim=1), values.mean(dim=1)], dim=1)
