"""Test the invariances of patch networks, and their neighbours against a k-d tree."""

from __future__ import annotations

import pytest
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from tacpipe.models.point_networks import BACKBONES, NEIGHBOURS, WIDTHS, EdgeBackbone, PatchNetwork


def network(channels: int = 3, numbers: int = 1, outputs: int = 50, backbone: str = "points") -> PatchNetwork:
    torch.manual_seed(0)
    return PatchNetwork(channels, numbers, outputs, backbone=backbone, hidden=16, dropout=0.5).eval()


def patches(clouds: int = 4, points: int = 30, channels: int = 3) -> Tensor:
    return torch.randn(clouds, 3, points, channels, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("backbone", BACKBONES)
@pytest.mark.parametrize(("channels", "numbers", "outputs"), [(3, 1, 1), (6, 13, 50)])
def test_values_come_out_a_row_a_cloud(backbone: str, channels: int, numbers: int, outputs: int) -> None:
    values = network(channels, numbers, outputs, backbone)(patches(channels=channels), torch.zeros(4, numbers))
    assert values.shape == (4, outputs)


@pytest.mark.parametrize("backbone", BACKBONES)
def test_the_order_of_points_changes_nothing_and_that_of_contacts_does(backbone: str) -> None:
    layers, points, numbers = network(backbone=backbone), patches(), torch.ones(4, 1)
    values = layers(points, numbers)
    torch.testing.assert_close(layers(points[:, :, torch.randperm(30)], numbers), values, atol=1e-6, rtol=1e-5)
    assert not torch.allclose(layers(points[:, [1, 0, 2]], numbers), values, atol=1e-4)
    assert not torch.allclose(layers(points[:, [0, 2, 1]], numbers), values, atol=1e-4)
    assert not torch.allclose(layers(points, 2 * numbers), values, atol=1e-4)


@pytest.mark.parametrize("backbone", BACKBONES)
def test_both_contacts_go_through_the_same_layers(backbone: str) -> None:
    layers = network(backbone=backbone)
    alike = patches()[:, [0, 0, 2]]
    head_inputs: list[Tensor] = []
    layers.head.register_forward_pre_hook(lambda _, inputs: head_inputs.append(inputs[0]))
    layers(alike, torch.zeros(4, 1))
    first, second, object_features = torch.split(head_inputs[0][:, :-1], 2 * WIDTHS[-1], dim=1)
    torch.testing.assert_close(first, second)
    assert not torch.allclose(first, object_features, atol=1e-3)


def test_a_cloud_says_nothing_of_another() -> None:
    layers, points = network(), patches()
    torch.testing.assert_close(layers(points[1:2], torch.zeros(1, 1)), layers(points, torch.zeros(4, 1))[1:2])


@pytest.mark.parametrize("points", [2, 11, 40])
def test_neighbours_are_those_in_space_that_a_tree_finds(points: int) -> None:
    generator = torch.Generator().manual_seed(2)
    clouds = torch.randn(2, points, 5, generator=generator)
    clouds[:, :, 3:] *= 100  # colours, far apart, are no place
    backbone = EdgeBackbone(5)
    pairs_read: list[Tensor] = []

    class Watch(nn.Module):
        def forward(self, pairs: Tensor) -> Tensor:
            pairs_read.append(pairs)
            return torch.zeros(*pairs.shape[:3], WIDTHS[0])

    backbone.edges = Watch()  # type: ignore[assignment]
    backbone(clouds)
    centre, around = torch.split(pairs_read[0], 5, dim=3)
    neighbours = min(NEIGHBOURS, points)
    assert around.shape == (2, points, neighbours, 5)
    for cloud, centres_of_cloud, off in zip(clouds, centre, around, strict=True):
        nearest = cKDTree(cloud[:, :3].numpy()).query(cloud[:, :3].numpy(), neighbours)[1]
        torch.testing.assert_close(centres_of_cloud, cloud[:, None].expand(points, neighbours, 5))
        torch.testing.assert_close(
            (centres_of_cloud + off).sort(dim=1).values,
            cloud[torch.from_numpy(nearest)].sort(dim=1).values,
            atol=1e-4,
            rtol=1e-5,
        )


def test_dropout_ends_with_training() -> None:
    layers, points, numbers = network(), patches(), torch.ones(4, 1)
    assert torch.equal(layers(points, numbers), layers(points, numbers))
    layers.train()
    assert not torch.equal(layers(points, numbers), layers(points, numbers))
