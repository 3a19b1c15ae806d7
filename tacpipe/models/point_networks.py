"""Networks that read points: patches around the contacts, PointNet, and the fast layers of both.

Batch normalisation needs mean and variance of a linear layer's output. Both follow from mean and covariance of its
input, which is an order of magnitude smaller, so the layer and its normalisation become one affine map and no array is
read twice. The maximum of a channel over a cloud depends on a single point, so its backward pass needs one row per
channel instead of a product over all points. The results are those of `torch.nn.Linear`, `torch.nn.BatchNorm1d` and
`torch.max`, up to rounding; among equal maxima, the first point receives the gradient.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

EPSILON = 1e-5  # added to a variance, as in torch
MOMENTUM = 0.1  # weight of a batch in the running mean and variance, as in torch
MAX_PLAIN_SUM = 16  # maximum number of clouds for a plain sum, which has the summation order of einsum


class NormalisedLinear(nn.Module):
    """A linear layer followed by batch normalisation over points, as `torch.nn.BatchNorm1d` of a `torch.nn.Linear`.

    In training it normalises by the batch and updates running means, by which it normalises otherwise.
    """

    mean: Tensor
    variance: Tensor

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(outputs, inputs))
        self.scale = nn.Parameter(torch.ones(outputs))
        self.shift = nn.Parameter(torch.zeros(outputs))
        self.register_buffer("mean", torch.zeros(outputs))
        self.register_buffer("variance", torch.ones(outputs))
        nn.init.kaiming_uniform_(self.weight, a=5**0.5)  # the initial weights of torch.nn.Linear

    def affine(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return the layer's weight (output, input) and bias (output,) for these inputs (…, input)."""
        if self.training:
            with torch.autocast(inputs.device.type, enabled=False):  # small differences of sums over many points
                mean, variance = self._moments(inputs.reshape(-1, inputs.shape[-1]).to(self.weight.dtype))
        else:
            mean, variance = self.mean, self.variance
        gain = self.scale * torch.rsqrt(variance + EPSILON)
        return self.weight * gain[:, None], self.shift - mean * gain

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the normalised outputs (…, output) of inputs (…, input)."""
        return nn.functional.linear(inputs, *self.affine(inputs))

    def _moments(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and variance (output,) over rows (row, input), and update the running ones."""
        centre, rows = inputs.mean(dim=0), len(inputs)
        centred = inputs - centre
        covariance = centred.T @ centred / rows  # (input, input)
        mean = self.weight @ centre
        variance = ((self.weight @ covariance) * self.weight).sum(dim=1).clamp_min(0)
        with torch.no_grad():
            unbiased = variance * (rows / max(rows - 1, 1))
            self.mean.lerp_(mean, MOMENTUM)
            self.variance.lerp_(unbiased, MOMENTUM)
        return mean, variance


class LargestOverPoints(torch.autograd.Function):
    """Compute the maximum over points (cloud, output) of an affine map of points (cloud, point, input)."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """Return the maxima (cloud, output) over points (cloud, point, input) of a linear layer.

        ``weight`` is (output, input) and ``bias`` (output,).
        """
        largest, indices = (_largest_product_cached if points.device.type == "cpu" else _largest_product)(
            points, weight
        )
        ctx.save_for_backward(points, weight, indices)
        return largest + bias

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the gradients of points, weight and bias. The gradient of points is nonzero only at the maxima."""
        points, weight, indices = ctx.saved_tensors
        (gradient,) = gradients
        maximum_rows = (indices + torch.arange(len(indices), device=indices.device)[:, None] * points.shape[1]).ravel()
        rows = points.reshape(-1, points.shape[2])  # (cloud and point, input)
        to_points = torch.zeros_like(rows)
        to_points.index_add_(0, maximum_rows, (gradient[:, :, None] * weight).view(len(maximum_rows), -1))
        to_weight = _weighted_sum(gradient, rows.index_select(0, maximum_rows).view(*indices.shape, -1))
        return to_points.view_as(points), to_weight, gradient.sum(dim=0)


def _weighted_sum(weights: Tensor, rows: Tensor) -> Tensor:
    """Return the sums over clouds (output, input) of rows (cloud, output, input) with weights (cloud, output).

    For few clouds, einsum's matrix product per output takes six times as long.
    """
    if len(rows) > MAX_PLAIN_SUM or rows.device.type != "cpu":
        return torch.einsum("co,coi->oi", weights, rows)
    return (weights[:, :, None] * rows).sum(dim=0)


def _largest_product(points: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return the maximum products over points (cloud, output), and the index of the point of each."""
    maxima = torch.max(weight @ points.transpose(1, 2), dim=2)
    return maxima.values, maxima.indices


def _largest_product_cached(points: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return the result of `_largest_product` on a CPU: per cloud, so that products fit the cache, with numpy's argmax."""
    products = points.new_empty(len(weight), points.shape[1])  # (output, point)
    largest = points.new_empty(len(points), len(weight))
    indices = torch.empty(largest.shape, dtype=torch.long)
    for cloud, cloud_indices in enumerate(indices):
        torch.mm(weight, points[cloud].T, out=products)
        cloud_indices.copy_(torch.from_numpy(products.numpy().argmax(axis=1)))
        torch.gather(products, 1, cloud_indices[:, None], out=largest[cloud][:, None])
    return largest, indices


def largest_output(layer: NormalisedLinear, points: Tensor) -> Tensor:
    """Return the maximum over points (cloud, output) of a layer's output on clouds (cloud, point, input)."""
    weight, bias = layer.affine(points)
    with torch.autocast(points.device.type, enabled=False):
        maxima: Tensor = LargestOverPoints.apply(points.to(weight.dtype), weight, bias)  # type: ignore[no-untyped-call]
    return maxima


BACKBONES = ("points", "edges")
NEIGHBOURS = 12
WIDTHS = (64, 128, 256)


@dataclass(frozen=True)
class PointNetworkShape:
    """Sizes of the inputs and outputs of a network of touch."""

    channels: int  # numbers per point
    numbers: int  # numbers that describe the grasp
    values: int  # predicted values of all targets, concatenated


class PatchNetwork(nn.Module):
    """Predict touch (cloud, value) from patches (cloud, patch, point, channel) and the grasp's numbers (cloud, number).

    The patches are the surface under both fingertips and a coarse view of the object, in metres.

    Contact depends on the surface around it (curvature, slope and edges) and on sizes in metres. So points are given in
    the axes of the grasp, the contact patches have layers of their own, and the grasp's sizes are inputs, too. Moving
    object, hand and wrist together does not change the inputs. Two backbones describe a patch:

    - ``points``: every point separately, as in PointNet;
    - ``edges``: every point with its nearest neighbours (EdgeConv; Wang et al., Dynamic graph CNN, 2019).
    """

    def __init__(
        self, channels: int, numbers: int, outputs: int, *, backbone: str, hidden: int, dropout: float
    ) -> None:
        super().__init__()
        backbones = {"points": PointBackbone, "edges": EdgeBackbone}
        self.near: nn.Module = backbones[backbone](channels)  # shared by both contacts
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
        """Return the predicted touch (cloud, value) from patches (cloud, patch, point, channel) and numbers (cloud, number).

        The patches are those around g1, around g2, and the whole cloud.
        """
        clouds, _, points, channels = patches.shape
        near = self.near(patches[:, :2].reshape(-1, points, channels)).view(clouds, -1)
        values: Tensor = self.head(torch.cat([near, self.whole(patches[:, 2]), numbers], dim=1))
        return values


class PointBackbone(nn.Module):
    """Return the maximum and mean of each channel over points: (cloud, point, channel) to (cloud, 512)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        first, second, last = WIDTHS
        self.layers = nn.Sequential(
            nn.Linear(channels, first), nn.ReLU(), nn.Linear(first, second), nn.ReLU(), nn.Linear(second, last)
        )

    def forward(self, points: Tensor) -> Tensor:
        """Return the features (cloud, 512) of points (cloud, point, channel)."""
        return _pool(self.layers(points))


class EdgeBackbone(nn.Module):
    """Like `PointBackbone`, after a layer that reads each point with the offsets of its 12 nearest neighbours."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        first, second, last = WIDTHS
        self.edges = nn.Sequential(nn.Linear(2 * channels, first), nn.ReLU(), nn.Linear(first, first))
        self.layers = nn.Sequential(nn.ReLU(), nn.Linear(first, second), nn.ReLU(), nn.Linear(second, last))

    def forward(self, points: Tensor) -> Tensor:
        """Return the features (cloud, 512) of points (cloud, point, channel), whose first channels are x, y and z."""
        clouds, count, channels = points.shape
        distances = torch.cdist(points[:, :, :3], points[:, :, :3])
        nearest = distances.topk(min(NEIGHBOURS, count), largest=False).indices  # (cloud, point, neighbour)
        cloud_index = torch.arange(clouds, device=points.device)[:, None, None]
        offsets = points[cloud_index, nearest] - points[:, :, None]  # (cloud, point, neighbour, channel)
        centre = points[:, :, None].expand(clouds, count, nearest.shape[2], channels)
        return _pool(self.layers(self.edges(torch.cat([centre, offsets], dim=3)).amax(dim=2)))


def _pool(values: Tensor) -> Tensor:
    return torch.cat([values.amax(dim=1), values.mean(dim=1)], dim=1)


FEATURES = 1024
POINT_LAYERS = (64, 128)
TRANSFORM_LAYERS = (512, 256)
HEADS = {f"fc{depth}": (1024, 512, 256, 128, 64, 32)[:depth] for depth in range(1, 7)}  # Table I of the letter


class PointNet(nn.Module):
    """Predict values of touch (cloud, value) from points (cloud, point, channel) and the grasp's numbers (cloud, number).

    PointNet for touch (Zapata-Impata et al., Generation of tactile data from 3D vision and target robotic grasps,
    2020).

    Every point passes through the same layers, the maximum of each of 1,024 channels over the cloud describes the
    whole, and fully connected layers predict touch from it and the grasp (Qi et al., PointNet, CVPR 2017). The trunk
    follows the group's published code: one learned transform of all input channels, and no loss that keeps it
    orthogonal.
    """

    def __init__(
        self, channels: int, grasp: int, outputs: int, *, head: Sequence[int] = HEADS["fc3"], transform: bool = True
    ) -> None:
        super().__init__()
        self.transform = PointTransform(channels) if transform else None
        self.points = PointFeatures(channels)
        self.head = _fully_connected(FEATURES + grasp, head, outputs)

    def forward(self, points: Tensor, grasp: Tensor) -> Tensor:
        """Return the predicted touch (cloud, value) from points (cloud, point, channel) and grasp (cloud, number)."""
        turned = points if self.transform is None else points @ self.transform(points)
        values: Tensor = self.head(torch.cat([self.points(turned), grasp], dim=1))
        return values


class PointFeatures(nn.Module):
    """Return the maximum of each channel over a cloud: (cloud, point, channel) to (cloud, 1024)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        sizes = (channels, *POINT_LAYERS)
        self.layers = nn.ModuleList(NormalisedLinear(*pair) for pair in pairwise(sizes))
        self.last = NormalisedLinear(sizes[-1], FEATURES)

    def forward(self, points: Tensor) -> Tensor:
        """Return the features (cloud, 1024); the last layer has no ReLU."""
        for layer in self.layers:
            points = torch.relu(layer(points))
        return largest_output(self.last, points)


class PointTransform(nn.Module):
    """Learn a linear map of a cloud's channels: (cloud, point, channel) to (cloud, channel, channel).

    It is the identity plus a learned part, initialised at random, as in the group's published code.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.channels = channels
        self.points = PointFeatures(channels)
        self.head = _fully_connected(FEATURES, TRANSFORM_LAYERS, channels * channels)

    def forward(self, points: Tensor) -> Tensor:
        """Return the matrix (cloud, channel, channel) by which points are multiplied from the right."""
        transform: Tensor = self.head(torch.relu(self.points(points))).view(-1, self.channels, self.channels)
        return transform + torch.eye(self.channels, device=points.device)


def _fully_connected(inputs: int, hidden: Sequence[int], outputs: int) -> nn.Sequential:
    """Return fully connected layers with batch normalisation and ReLU, and a linear output layer."""
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise((inputs, *hidden)):
        layers += [nn.Linear(before, after), nn.BatchNorm1d(after), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear((inputs, *hidden)[-1], outputs))
