"""PointNet against a plain one of torch's convolutions, and against its size by hand."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from torch import Tensor, nn

from tacpipe.models import point_networks
from tacpipe.models.point_networks import (
    BACKBONES,
    HEADS,
    NEIGHBOURS,
    WIDTHS,
    EdgeBackbone,
    LargestOverPoints,
    NormalisedLinear,
    PatchNetwork,
    PointFeatures,
    PointNet,
    largest_output,
)


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


Sizes = tuple[int, int, int, int]  # clouds, points, inputs, outputs
SIZES = st.tuples(st.integers(1, 4), st.integers(2, 40), st.integers(1, 9), st.integers(1, 12))


class PlainPooling(nn.Module):
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
    plain = PlainPooling(layer)
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
    plain = PlainPooling(layer)
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
