"""An epoch of PointNet on clouds of 750 points, beside a plain PyTorch loop of the same maths."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import timing
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.models.pointnet import PointFeatures, PointNet
from tacpipe.simulation.grasp import simulate_trial
from tacpipe.simulation.grasp_scene import Rig
from tacpipe.tasks.touch.inputs import Inputs, Sources
from tacpipe.tasks.touch.losses import SMALLEST, ScaledGrasps, TouchWork
from tacpipe.training import loop

CLOUDS = 9_000  # that the letter trains on
MADE = 300  # simulated; the epoch goes through each of them thirty times
PIECE = 600  # clouds timed at a time: a fifteenth of the epoch, so that both take turns
BATCH, RATE = 10, 0.01
INPUTS = Inputs("rgbpose", 750, "minmax")
SAME = 1e-5  # difference of losses that rounding explains


def measure(folder: Path, rounds: int) -> list[timing.Line]:
    """Return the ratio of training speeds, the losses being the same."""
    clouds, grasps = _simulated()
    values = torch.rand(MADE, 1, generator=torch.Generator().manual_seed(0))
    sources = Sources(INPUTS, [f"cloud {number}" for number in range(MADE)], clouds, grasps)
    torch.manual_seed(0)
    first = PointNet(INPUTS.channels, INPUTS.grasp_numbers, 1).state_dict()
    _check(first, sources, values)
    part = ScaledGrasps(_Repeated(sources), values.repeat(PIECE // MADE, 1))
    work = TouchWork(part, ScaledGrasps(sources, values[:2]), BATCH, "rmse", torch.ones(1))
    schedule = loop.Schedule(epochs=1, batch=BATCH, learning_rate=RATE, patience=1, gradient_clip=math.inf, seed=0)

    def ours() -> None:
        with tempfile.TemporaryDirectory(dir=folder) as workspace:
            loop.train(lambda: _ours(first), work, schedule, Path(workspace))

    plain = _plain_pieces(first, clouds, grasps, values)
    times = timing.interleaved({"tacpipe": ours, "plain loop": lambda: next(plain)}, max(3, rounds // 4))
    found = 1 / timing.ratio(times, "tacpipe", "plain loop")
    mine, beside = (timing.median(times, name) * CLOUDS / PIECE for name in ("tacpipe", "plain loop"))
    return [
        timing.Line(
            f"PointNet, {CLOUDS} simulated clouds of {INPUTS.points} points, {torch.get_num_threads()} threads",
            f"{mine:.0f} s an epoch",
            f"plain PyTorch loop: {beside:.0f} s",
            f"{found:.2f} times as fast",
            "2 times as fast",
            found >= 2,
        )
    ]


def _simulated() -> tuple[list[Cloud], list[Grasp]]:
    """Return clouds of enough points, and their grasps."""
    clouds: list[Cloud] = []
    grasps: list[Grasp] = []
    number = 0
    while len(clouds) < MADE:
        streams = simulate_trial(0, number, Rig()).streams
        number += 1
        cloud = Cloud.of(streams["cloud"])
        if len(cloud) >= INPUTS.points:
            clouds.append(cloud)
            grasps.append(Grasp.of(streams["grasp"]))
    return clouds, grasps


class _Repeated:
    """The same clouds again and again."""

    def __init__(self, sources: Sources) -> None:
        self.draw = lambda indices, rng: sources.draw([index % MADE for index in indices], rng)
        self.fixed = lambda indices, visit: sources.fixed([index % MADE for index in indices], visit)


def _ours(first: dict[str, Tensor]) -> PointNet:
    model = PointNet(INPUTS.channels, INPUTS.grasp_numbers, 1)
    model.load_state_dict(first)
    return model


def _check(first: dict[str, Tensor], sources: Sources, values: Tensor) -> None:
    """Fail where the losses of the same batch differ by more than rounding."""
    points, numbers = (torch.from_numpy(array) for array in sources.draw(range(BATCH), np.random.default_rng(0)))
    losses = [_loss(model(points, numbers), values[:BATCH]).item() for model in (_ours(first), PlainPointNet(first))]
    if abs(losses[0] - losses[1]) > SAME:
        raise SystemExit(f"The losses differ: {losses[0]:.7f} and {losses[1]:.7f}.")


def _loss(found: Tensor, values: Tensor) -> Tensor:
    return torch.sqrt(((found - values) ** 2).mean() + SMALLEST)


class PlainPointNet(nn.Module):
    """The same network as one writes it down: convolutions of width 1, batch normalisation, maximum."""

    def __init__(self, first: dict[str, Tensor]) -> None:
        super().__init__()
        ours = _ours(first)
        assert ours.transform is not None
        self.transform_points = PlainFeatures(ours.transform.points)
        self.transform_head = ours.transform.head
        self.features = PlainFeatures(ours.points)
        self.head = ours.head

    def forward(self, points: Tensor, numbers: Tensor) -> Tensor:
        """Return the values of touch."""
        channels = points.shape[2]
        found = self.transform_head(torch.relu(self.transform_points(points.transpose(1, 2))))
        points = points @ (found.view(-1, channels, channels) + torch.eye(channels))
        values: Tensor = self.head(torch.cat([self.features(points.transpose(1, 2)), numbers], dim=1))
        return values


class PlainFeatures(nn.Module):
    """The largest value of each channel over the points of a cloud."""

    def __init__(self, like: PointFeatures) -> None:
        super().__init__()
        widths = [layer.weight.shape for layer in (*like.layers, like.last)]
        self.layers = nn.ModuleList(nn.Conv1d(inputs, outputs, 1) for outputs, inputs in widths)
        self.norms = nn.ModuleList(nn.BatchNorm1d(outputs) for outputs, _ in widths)
        with torch.no_grad():
            for layer, own in zip(self.layers, (*like.layers, like.last), strict=True):
                assert isinstance(layer, nn.Conv1d)
                layer.weight.copy_(own.weight[:, :, None])

    def forward(self, points: Tensor) -> Tensor:
        """Return the features (cloud, feature) of points (cloud, channel, point)."""
        for number, (layer, norm) in enumerate(zip(self.layers, self.norms, strict=True), 1):
            points = norm(layer(points))
            points = torch.relu(points) if number < len(self.layers) else points
        return points.amax(dim=2)


class PlainGrasps(Dataset[tuple[Tensor, Tensor, Tensor]]):
    """A cloud at a time, sampled and normalised when asked for."""

    def __init__(self, clouds: list[Cloud], grasps: list[Grasp], values: Tensor) -> None:
        self.clouds, self.grasps, self.values = clouds, grasps, values

    def __len__(self) -> int:
        """Return how many clouds a piece of the epoch has."""
        return PIECE

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return points, numbers of the grasp, and the value."""
        cloud, grasp = self.clouds[index % MADE], self.grasps[index % MADE]
        assert cloud.colours is not None and grasp.wrist is not None
        chosen = np.random.default_rng().choice(len(cloud), INPUTS.points, replace=False)
        low, high = cloud.points_m.min(axis=0), cloud.points_m.max(axis=0)
        dark, bright = cloud.colours.min(axis=0), cloud.colours.max(axis=0)
        points = 2 * (cloud.points_m[chosen] - low) / (high - low) - 1
        colours = 2 * (cloud.colours[chosen] - dark.astype(float)) / np.maximum(bright - dark, 1) - 1
        contacts = 2 * (np.stack([grasp.g1_m, grasp.g2_m]) - low) / (high - low) - 1
        numbers = np.concatenate([contacts.ravel(), grasp.wrist.ravel()])
        both = np.concatenate([points, colours], axis=1)
        return torch.from_numpy(both).float(), torch.from_numpy(numbers).float(), self.values[index % MADE]


def _plain_pieces(first: dict[str, Tensor], clouds: list[Cloud], grasps: list[Grasp], values: Tensor) -> Iterator[None]:
    """Train on as many clouds at each turn, with torch's own loader as it comes."""
    model = PlainPointNet(first)
    optimiser = torch.optim.Adam(model.parameters(), lr=RATE)
    loader = DataLoader(PlainGrasps(clouds, grasps, values), batch_size=BATCH, shuffle=True)
    while True:
        model.train()
        for points, numbers, felt in loader:
            optimiser.zero_grad()
            _loss(model(points, numbers), felt).backward()  # type: ignore[no-untyped-call]
            optimiser.step()
        yield
