"""Compare the layers for points with torch's own: a linear layer, batch normalisation, and the maximum over points."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from tacpipe.models import point_networks
from tacpipe.models.point_networks import LargestOverPoints, NormalisedLinear, largest_output

Sizes = tuple[int, int, int, int]  # clouds, points, inputs, outputs
SIZES = st.tuples(st.integers(1, 4), st.integers(2, 40), st.integers(1, 9), st.integers(1, 12))


class Plain(nn.Module):
    """The same layer as torch has it, and the largest of its values over points."""

    def __init__(self, layer: NormalisedLinear) -> None:
        super().__init__()
        outputs, inputs = layer.weight.shape
        self.linear = nn.Linear(inputs, outputs, bias=False, dtype=layer.weight.dtype)
        self.normal = nn.BatchNorm1d(outputs, dtype=layer.weight.dtype)
        with torch.no_grad():
            self.linear.weight.copy_(layer.weight)
            self.normal.weight.copy_(layer.scale)
            self.normal.bias.copy_(layer.shift)

    def forward(self, points: Tensor) -> Tensor:
        values = self.linear(points)
        normalised: Tensor = self.normal(values.flatten(0, 1)).view_as(values)
        return normalised


def layer_and_points(sizes: Sizes, seed: int) -> tuple[NormalisedLinear, Tensor]:
    """A layer in float64, half of whose scales are negative, and points off their origin."""
    torch.manual_seed(seed)
    clouds, points, inputs, outputs = sizes
    layer = NormalisedLinear(inputs, outputs).double()
    with torch.no_grad():
        layer.scale.copy_(torch.randn(outputs))
        layer.shift.copy_(torch.randn(outputs))
    return layer, 3 + 2 * torch.randn(clouds, points, inputs, dtype=torch.float64)


def gradients(loss: Tensor, *tensors: Tensor) -> list[Tensor]:
    return list(torch.autograd.grad(loss, tensors))


@settings(deadline=None, max_examples=40)
@given(SIZES, st.integers(0, 2**31), st.booleans())
def test_values_statistics_and_all_gradients_are_those_of_torch(sizes: Sizes, seed: int, pooled: bool) -> None:
    layer, points = layer_and_points(sizes, seed)
    plain = Plain(layer)
    points.requires_grad_()
    for _ in range(2):  # the running statistics follow twice
        ours_values = largest_output(layer, points) if pooled else layer(points)
        torch_values = plain(points).amax(dim=1) if pooled else plain(points)
        torch.testing.assert_close(ours_values, torch_values, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(layer.mean, plain.normal.running_mean, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(layer.variance, plain.normal.running_var, rtol=1e-8, atol=1e-10)
    weights = torch.randn_like(ours_values)
    our_gradients = gradients((weights * ours_values).sum(), points, layer.weight, layer.scale, layer.shift)
    torch_gradients = gradients(
        (weights * torch_values).sum(), points, plain.linear.weight, plain.normal.weight, plain.normal.bias
    )
    for mine, theirs in zip(our_gradients, torch_gradients, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("pooled", [False, True])
def test_when_nothing_is_learned_the_running_statistics_normalise_as_in_torch(pooled: bool) -> None:
    layer, points = layer_and_points((3, 20, 5, 7), 1)
    plain = Plain(layer)
    for at in range(3):
        layer(points + at)
        plain(points + at)
    layer.eval(), plain.eval()
    before = layer.mean.clone()
    ours_values = largest_output(layer, points) if pooled else layer(points)
    torch_values = plain(points).amax(dim=1) if pooled else plain(points)
    torch.testing.assert_close(ours_values, torch_values, rtol=1e-9, atol=1e-9)
    assert torch.equal(layer.mean, before)
    torch.testing.assert_close(
        gradients(ours_values.sum(), layer.weight, layer.scale)[0],
        gradients(torch_values.sum(), plain.linear.weight)[0],
    )


def test_a_batch_says_nothing_of_another_when_nothing_is_learned() -> None:
    layer, points = layer_and_points((4, 9, 3, 6), 2)
    layer(points)
    layer.eval()
    torch.testing.assert_close(largest_output(layer, points)[:1], largest_output(layer, points[:1]))


def test_the_gradients_of_the_largest_value_are_those_of_small_differences() -> None:
    torch.manual_seed(3)
    points, weight, bias = (torch.randn(*size, dtype=torch.float64) for size in ((2, 6, 3), (5, 3), (5,)))
    learned_from = tuple(tensor.requires_grad_() for tensor in (points, weight, bias))
    assert torch.autograd.gradcheck(LargestOverPoints.apply, learned_from)


def test_the_gradients_through_layer_and_largest_value_are_those_of_small_differences() -> None:
    layer, points = layer_and_points((2, 7, 3, 4), 4)

    def pooled(points: Tensor, weight: Tensor, scale: Tensor, shift: Tensor) -> Tensor:
        changed = {"weight": weight, "scale": scale, "shift": shift}
        pooled_values: Tensor = torch.func.functional_call(
            Pooled(layer), {f"layer.{k}": v for k, v in changed.items()}, points
        )
        return pooled_values

    learned = [weight.detach().clone().requires_grad_() for weight in (layer.weight, layer.scale, layer.shift)]
    assert torch.autograd.gradcheck(pooled, (points.requires_grad_(), *learned))


class Pooled(nn.Module):
    def __init__(self, layer: NormalisedLinear) -> None:
        super().__init__()
        self.layer = layer

    def forward(self, points: Tensor) -> Tensor:
        return largest_output(self.layer, points)


@settings(deadline=None, max_examples=20)
@given(SIZES, st.integers(0, 2**31))
def test_one_cloud_at_a_time_gives_what_all_at_once_give(sizes: Sizes, seed: int) -> None:
    layer, points = layer_and_points(sizes, seed)
    with torch.no_grad():
        (values, places), (batched_values, at) = (
            way(points, layer.weight)
            for way in (point_networks._largest_product_cached, point_networks._largest_product)
        )
    torch.testing.assert_close(values, batched_values)
    assert torch.equal(places, at)


@pytest.mark.parametrize("way", [point_networks._largest_product_cached, point_networks._largest_product])
def test_of_points_equally_large_one_alone_takes_the_gradient(way: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(point_networks, "_largest_product_cached", way)
    points = torch.tensor([[[1.0, 0.0], [2.0, 5.0], [2.0, -5.0], [2.0, 1.0]]]).requires_grad_()
    weight = torch.tensor([[1.0, 0.0]]).requires_grad_()
    maxima = LargestOverPoints.apply(points, weight, torch.tensor([0.5]))  # type: ignore[no-untyped-call]
    assert maxima.tolist() == [[2.5]]
    to_points, to_weight = gradients(maxima.sum(), points, weight)
    chosen = [row for row in range(4) if to_points[0, row].any()]
    assert len(chosen) == 1 and chosen[0] > 0
    assert to_points[0, chosen[0]].tolist() == [1.0, 0.0]
    assert to_weight[0].tolist() == points[0, chosen[0]].tolist()


def test_a_channel_that_never_moves_becomes_its_shift() -> None:
    layer, _ = layer_and_points((1, 1, 3, 4), 5)
    points = torch.ones(2, 10, 3, dtype=torch.float64)
    torch.testing.assert_close(layer(points), layer.shift.expand(2, 10, 4), atol=1e-9, rtol=0)
    torch.testing.assert_close(largest_output(layer, points), layer.shift.expand(2, 4), atol=1e-9, rtol=0)


def test_points_that_are_not_finite_are_not_passed_over() -> None:
    layer, points = layer_and_points((2, 5, 3, 4), 6)
    layer.eval()
    points[1, 3, 0] = torch.nan
    maxima = largest_output(layer, points)
    assert torch.isfinite(maxima[0]).all()
    assert torch.isnan(maxima[1]).all()


@pytest.mark.parametrize("clouds", [1, 2, point_networks.MAX_PLAIN_SUM, point_networks.MAX_PLAIN_SUM + 1, 40])
def test_rows_of_few_clouds_and_of_many_are_weighed_and_added_up(clouds: int) -> None:
    torch.manual_seed(clouds)
    weights, rows = torch.randn(clouds, 50), torch.randn(clouds, 50, 7)
    expected = torch.einsum("co,coi->oi", weights.double(), rows.double())
    torch.testing.assert_close(point_networks._weighted_sum(weights, rows).double(), expected, rtol=1e-5, atol=1e-5)
