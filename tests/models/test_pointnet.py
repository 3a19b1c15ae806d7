"""PointNet against a plain one of torch's convolutions, and against its size by hand."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from tacpipe.models.point_networks import HEADS, NormalisedLinear, PointFeatures, PointNet


class Trunk(nn.Module):
    """Convolutions of one point at a time, as the group's published code has them."""

    def __init__(self, features: PointFeatures) -> None:
        super().__init__()
        layers = [layer for layer in (*features.layers, features.last) if isinstance(layer, NormalisedLinear)]
        self.convolutions = nn.ModuleList(nn.Conv1d(layer.weight.shape[1], len(layer.weight), 1) for layer in layers)
        self.normals = nn.ModuleList(nn.BatchNorm1d(len(layer.weight)) for layer in layers)
        with torch.no_grad():
            for layer, convolution, normal in zip(layers, self.convolutions, self.normals, strict=True):
                assert isinstance(convolution, nn.Conv1d) and isinstance(normal, nn.BatchNorm1d)
                convolution.weight.copy_(layer.weight[:, :, None])
                normal.weight.copy_(layer.scale)
                normal.bias.copy_(layer.shift)

    def forward(self, points: Tensor) -> Tensor:
        for index, (convolution, normal) in enumerate(zip(self.convolutions, self.normals, strict=True)):
            points = normal(convolution(points))
            points = torch.relu(points) if index < 2 else points
        return points.max(dim=2).values


class Plain(nn.Module):
    """PointNet with a transform, channels first."""

    def __init__(self, network: PointNet) -> None:
        super().__init__()
        assert network.transform is not None
        self.transform, self.points = Trunk(network.transform.points), Trunk(network.points)
        self.transform_head, self.head = network.transform.head, network.head

    def forward(self, points: Tensor, grasp: Tensor) -> Tensor:
        cloud = points.transpose(2, 1)
        channels = cloud.shape[1]
        turned = self.transform_head(torch.relu(self.transform(cloud))).view(-1, channels, channels)
        cloud = torch.bmm(cloud.transpose(2, 1), turned + torch.eye(channels)).transpose(2, 1)
        values: Tensor = self.head(torch.cat([self.points(cloud), grasp], dim=1))
        return values


def clouds(channels: int = 6, count: int = 5, points: int = 40, numbers: int = 6) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(7)
    return (
        torch.rand(count, points, channels, generator=generator) * 2 - 1,
        torch.rand(count, numbers, generator=generator),
    )


def test_loss_and_gradients_are_those_of_a_plain_pointnet() -> None:
    torch.manual_seed(0)
    network = PointNet(6, 6, 24, head=HEADS["fc2"])
    for layer in network.modules():
        if isinstance(layer, NormalisedLinear):  # puts the largest value of some channels below zero
            nn.init.normal_(layer.scale)
            nn.init.normal_(layer.shift, std=2)
    plain = Plain(network)
    inputs, aim = clouds(), torch.rand(5, 24)
    losses = [torch.sqrt(nn.functional.mse_loss(ours(*inputs), aim)) for ours in (network, plain)]
    assert losses[0].item() == pytest.approx(losses[1].item(), abs=1e-5)
    ours = torch.autograd.grad(losses[0], [network.points.last.weight, network.points.last.scale])
    last = plain.points.convolutions[-1].weight, plain.points.normals[-1].weight
    theirs = torch.autograd.grad(losses[1], last)  # type: ignore[arg-type]
    torch.testing.assert_close(ours[0], theirs[0][:, :, 0], atol=1e-5, rtol=1e-3)
    torch.testing.assert_close(ours[1], theirs[1], atol=1e-5, rtol=1e-3)


@pytest.mark.parametrize("transform", [False, True])
def test_the_order_of_points_changes_nothing(transform: bool) -> None:
    torch.manual_seed(1)
    network = PointNet(3, 6, 1, transform=transform)
    points, grasp = clouds(3)
    network(points, grasp)
    network.eval()
    torch.testing.assert_close(network(points.flip(1), grasp), network(points, grasp), atol=1e-6, rtol=0)
    assert not torch.allclose(network(points, grasp.flip(0)), network(points, grasp), atol=1e-4)


def test_a_point_twice_changes_nothing_once_training_is_over() -> None:
    torch.manual_seed(2)
    network = PointNet(3, 0, 1)
    points, grasp = clouds(3, numbers=0)
    network(points, grasp)
    network.eval()
    torch.testing.assert_close(network(torch.cat([points, points[:, :9]], 1), grasp), network(points, grasp))


@pytest.mark.parametrize(
    ("head", "weights"),
    [  # 1,030 inputs: a layer has its matrix, its bias, and a scale and a shift a value; the last has no two of these
        ("fc1", (1030 + 3) * 1024 + 1025),
        ("fc2", (1030 + 3) * 1024 + (1024 + 3) * 512 + 513),
        ("fc3", (1030 + 3) * 1024 + (1024 + 3) * 512 + (512 + 3) * 256 + 257),
        ("fc4", (1030 + 3) * 1024 + (1024 + 3) * 512 + (512 + 3) * 256 + (256 + 3) * 128 + 129),
        ("fc5", 1057792 + 525824 + 131840 + 33152 + (128 + 3) * 64 + 65),
        ("fc6", 1057792 + 525824 + 131840 + 33152 + 8384 + (64 + 3) * 32 + 33),
    ],
)
def test_each_head_has_the_weights_counted_by_hand(head: str, weights: int) -> None:
    network = PointNet(6, 6, 1, head=HEADS[head], transform=False)
    trunk = (6 + 2) * 64 + (64 + 2) * 128 + (128 + 2) * 1024  # no bias, because a normalisation removes it
    assert sum(weight.numel() for weight in network.parameters()) == trunk + weights


def test_the_transform_of_all_channels_has_the_weights_counted_by_hand() -> None:
    without, with_ = (
        sum(weight.numel() for weight in PointNet(6, 6, 1, transform=transform).parameters())
        for transform in (False, True)
    )
    trunk = (6 + 2) * 64 + (64 + 2) * 128 + (128 + 2) * 1024
    assert with_ - without == trunk + (1024 + 3) * 512 + (512 + 3) * 256 + (256 + 1) * 36


def test_the_transform_is_the_identity_and_what_its_layers_say() -> None:
    torch.manual_seed(3)
    network = PointNet(6, 0, 1)
    assert network.transform is not None
    points, _ = clouds()
    transform = network.transform(points)
    off = transform - torch.eye(6)
    assert transform.shape == (5, 6, 6)
    assert 0 < off.abs().mean() < 0.6
    assert transform.diagonal(dim1=1, dim2=2).mean() > 0.7
    assert abs(transform.mean() - 1 / 6) < 0.2
    last = network.transform.head[-1]
    assert isinstance(last, nn.Linear)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    torch.testing.assert_close(network.transform(points), torch.eye(6).expand(5, 6, 6))
    plain = PointNet(6, 0, 1, transform=False)
    plain.load_state_dict({name: value for name, value in network.state_dict().items() if "transform" not in name})
    torch.testing.assert_close(plain.eval()(points, torch.zeros(5, 0)), network.eval()(points, torch.zeros(5, 0)))
