"""Networks of patches: what they do not see, and neighbours against a tree's."""

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
    found = network(channels, numbers, outputs, backbone)(patches(channels=channels), torch.zeros(4, numbers))
    assert found.shape == (4, outputs)


@pytest.mark.parametrize("backbone", BACKBONES)
def test_the_order_of_points_changes_nothing_and_that_of_contacts_does(backbone: str) -> None:
    one, given, numbers = network(backbone=backbone), patches(), torch.ones(4, 1)
    found = one(given, numbers)
    torch.testing.assert_close(one(given[:, :, torch.randperm(30)], numbers), found, atol=1e-6, rtol=1e-5)
    assert not torch.allclose(one(given[:, [1, 0, 2]], numbers), found, atol=1e-4)
    assert not torch.allclose(one(given[:, [0, 2, 1]], numbers), found, atol=1e-4)
    assert not torch.allclose(one(given, 2 * numbers), found, atol=1e-4)


@pytest.mark.parametrize("backbone", BACKBONES)
def test_both_contacts_go_through_the_same_layers(backbone: str) -> None:
    one = network(backbone=backbone)
    alike = patches()[:, [0, 0, 2]]
    given: list[Tensor] = []
    one.head.register_forward_pre_hook(lambda _, inputs: given.append(inputs[0]))
    one(alike, torch.zeros(4, 1))
    first, second, whole = torch.split(given[0][:, :-1], 2 * WIDTHS[-1], dim=1)
    torch.testing.assert_close(first, second)
    assert not torch.allclose(first, whole, atol=1e-3)


def test_a_cloud_says_nothing_of_another() -> None:
    one, given = network(), patches()
    torch.testing.assert_close(one(given[1:2], torch.zeros(1, 1)), one(given, torch.zeros(4, 1))[1:2])


@pytest.mark.parametrize("points", [2, 11, 40])
def test_neighbours_are_those_in_space_that_a_tree_finds(points: int) -> None:
    generator = torch.Generator().manual_seed(2)
    given = torch.randn(2, points, 5, generator=generator)
    given[:, :, 3:] *= 100  # colours, far apart, are no place
    backbone = EdgeBackbone(5)
    seen: list[Tensor] = []

    class Watch(nn.Module):
        def forward(self, pairs: Tensor) -> Tensor:
            seen.append(pairs)
            return torch.zeros(*pairs.shape[:3], WIDTHS[0])

    backbone.edges = Watch()  # type: ignore[assignment]
    backbone(given)
    centre, around = torch.split(seen[0], 5, dim=3)
    many = min(NEIGHBOURS, points)
    assert around.shape == (2, points, many, 5)
    for cloud, own, off in zip(given, centre, around, strict=True):
        nearest = cKDTree(cloud[:, :3].numpy()).query(cloud[:, :3].numpy(), many)[1]
        torch.testing.assert_close(own, cloud[:, None].expand(points, many, 5))
        torch.testing.assert_close(
            (own + off).sort(dim=1).values, cloud[torch.from_numpy(nearest)].sort(dim=1).values, atol=1e-4, rtol=1e-5
        )


def test_dropout_ends_with_training() -> None:
    one, given, numbers = network(), patches(), torch.ones(4, 1)
    assert torch.equal(one(given, numbers), one(given, numbers))
    one.train()
    assert not torch.equal(one(given, numbers), one(given, numbers))
