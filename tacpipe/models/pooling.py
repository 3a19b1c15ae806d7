"""Layers of points, fast: a linear layer with batch normalisation as one product, and its largest value over a cloud.

Normalising a batch needs mean and variance of what a linear layer gives. Both follow from mean and covariance of what
it is given, which is an order of magnitude smaller, so the layer and its normalisation become one affine map and nothing
is passed over twice. The largest value of a channel over a cloud depends on one point alone, so going back through it
costs a row a channel instead of a product over all points. The maths is that of `torch.nn.Linear`,
`torch.nn.BatchNorm1d` and `torch.max`, down to rounding; of points equally large the first takes all the gradient.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

EPSILON = 1e-5  # added to a variance, as in torch
MOMENTUM = 0.1  # weight of a batch in the running mean and variance, as in torch
FEW = 16  # clouds, which a plain sum adds up in the order of einsum


class NormalisedLinear(nn.Module):
    """A linear layer with batch normalisation behind it, over points: what `torch.nn.BatchNorm1d` of a linear gives.

    In training it is normalised by the batch at hand and keeps running means, by which it is normalised otherwise.
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
        """Return weight (output, input) and bias (output,) of the layer for these inputs (…, input)."""
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
        """Return mean and variance (output,) over rows (row, input), and let the running ones follow."""
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
    """The largest value over points (cloud, output) of an affine map of points (cloud, point, input)."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """Return the largest values."""
        largest, places = (_largest_cached if points.device.type == "cpu" else _largest)(points, weight)
        ctx.save_for_backward(points, weight, places)
        return largest + bias

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the gradients: each reaches the one point that was largest."""
        points, weight, places = ctx.saved_tensors
        (gradient,) = gradients
        at = (places + torch.arange(len(places), device=places.device)[:, None] * points.shape[1]).ravel()
        rows = points.reshape(-1, points.shape[2])  # (cloud and point, input)
        to_points = torch.zeros_like(rows)
        to_points.index_add_(0, at, (gradient[:, :, None] * weight).view(len(at), -1))
        to_weight = _weighed(gradient, rows.index_select(0, at).view(*places.shape, -1))
        return to_points.view_as(points), to_weight, gradient.sum(dim=0)


def _weighed(weights: Tensor, rows: Tensor) -> Tensor:
    """Return the sums over clouds (output, input) of rows (cloud, output, input) by weights (cloud, output).

    Of few clouds a product of matrices per output, which is what einsum makes of it, takes six times as long.
    """
    if len(rows) > FEW or rows.device.type != "cpu":
        return torch.einsum("co,coi->oi", weights, rows)
    return (weights[:, :, None] * rows).sum(dim=0)


def _largest(points: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return the largest products over points (cloud, output), and which point gives each."""
    maxima = torch.max(weight @ points.transpose(1, 2), dim=2)
    return maxima.values, maxima.indices


def _largest_cached(points: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return what `_largest` does; a cloud at a time, whose products stay in the cache, and by numpy's faster argmax."""
    products = points.new_empty(len(weight), points.shape[1])  # (output, point)
    largest = points.new_empty(len(points), len(weight))
    places = torch.empty(largest.shape, dtype=torch.long)
    for cloud, at in enumerate(places):
        torch.mm(weight, points[cloud].T, out=products)
        at.copy_(torch.from_numpy(products.numpy().argmax(axis=1)))
        torch.gather(products, 1, at[:, None], out=largest[cloud][:, None])
    return largest, places


def largest(layer: NormalisedLinear, points: Tensor) -> Tensor:
    """Return the largest value over points (cloud, output) of the layer on clouds (cloud, point, input)."""
    weight, bias = layer.affine(points)
    with torch.autocast(points.device.type, enabled=False):
        maxima: Tensor = LargestOverPoints.apply(points.to(weight.dtype), weight, bias)  # type: ignore[no-untyped-call]
    return maxima
