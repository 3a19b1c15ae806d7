"""An epoch of joint learning next to a plain PyTorch loop of the same maths, and seconds of the MiniRocket classifier."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import timing
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from tacpipe.models.minirocket import MinirocketClassifier
from tacpipe.models.recurrent_autoencoder import AutoencoderShape, RecurrentAutoencoder
from tacpipe.tasks.material.losses import BatchPairs, JointWork, ScaledSlides, Weights
from tacpipe.training import loop

SLIDES, CLASSES, BATCH, RATE = 600, 20, 32, 5e-4
SHAPES = {"biotac": AutoencoderShape(19, CLASSES), "roboskin": AutoencoderShape(60, CLASSES, header="cnn")}
FRAMES = {"biotac": 400, "roboskin": 75}
WEIGHTS = Weights(align_from=0)
FIT_S = 30.0  # seconds that the MiniRocket classifier may take on two cores


def measure(folder: Path, rounds: int) -> list[timing.Line]:
    """Return the ratio of training speeds, the losses being the same, and the MiniRocket classifier's seconds."""
    torch.manual_seed(0)
    felt = {name: _felt(name) for name in SHAPES}
    first = nn.ModuleDict({name: RecurrentAutoencoder(shape) for name, shape in SHAPES.items()}).state_dict()
    _check(first, felt)
    work = _work(felt)
    schedule = loop.Schedule(epochs=1, batch=BATCH, learning_rate=RATE, patience=1, gradient_clip=math.inf, seed=0)
    plain = _plain_epochs(first, felt)

    def epoch() -> None:
        with tempfile.TemporaryDirectory(dir=folder) as workspace:
            loop.train(lambda: _load_weights(_ours(), first), work, schedule, Path(workspace))

    times = timing.interleaved({"tacpipe": epoch, "plain loop": lambda: next(plain)}, max(3, rounds // 4))
    ours, plain_s = (f"{timing.median(times, name):.2f} s per epoch" for name in times)
    case = f"joint training, {SLIDES} slides of BioTac and RoboSkin each, {torch.get_num_threads()} threads"
    return [timing.faster(case, times, "tacpipe", "plain loop", 3, (ours, plain_s)), _minirocket(felt)]


class _Plain(nn.Module):
    """The paper's network as one would write it, batches first."""

    def __init__(self, shape: AutoencoderShape) -> None:
        super().__init__()
        self.shape = shape
        self.grid = shape.header == "cnn"
        width = 18 if self.grid else shape.channels
        if self.grid:
            self.conv, self.deconv = nn.Conv2d(1, 3, (3, 5)), nn.ConvTranspose2d(3, 1, (3, 5))
        self.encoder = nn.LSTM(width, shape.hidden, batch_first=True)
        self.to_latents = nn.Linear(shape.hidden, shape.latents)
        self.classifier = nn.Linear(shape.latents, shape.classes)
        self.from_latents = nn.Linear(shape.latents, shape.hidden)
        self.decoder = nn.LSTM(1, shape.hidden, batch_first=True)
        self.to_features = nn.Linear(shape.hidden, width)

    def forward(self, frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        slides, steps, channels = frames.shape
        features = frames
        if self.grid:
            maps = nn.functional.max_pool2d(self.conv(frames.reshape(-1, 1, 6, 10)), 2)
            features = maps.reshape(slides, steps, -1)
        _, (hidden, _) = self.encoder(features)
        latents = self.to_latents(hidden[0])
        decoder_state = self.from_latents(latents)[None]
        states, _ = self.decoder(torch.zeros(slides, steps, 1), (decoder_state, torch.zeros_like(decoder_state)))
        decoded = self.to_features(states)
        if self.grid:
            maps = nn.functional.interpolate(decoded.reshape(-1, 3, 2, 3), scale_factor=2.0)
            decoded = torch.relu(self.deconv(maps)).reshape(slides, steps, channels)
        return latents, self.classifier(latents), decoded


class _Paired(Dataset[tuple[Tensor, ...]]):
    """A slide of each sensor and their class."""

    def __init__(self, felt: Mapping[str, ScaledSlides]) -> None:
        self.felt = felt

    def __len__(self) -> int:
        return SLIDES

    def __getitem__(self, index: int) -> tuple[Tensor, ...]:
        return (*(slides.frames[index] for slides in self.felt.values()), self.felt["biotac"].classes[index])


def _plain_epochs(first: Mapping[str, Tensor], felt: Mapping[str, ScaledSlides]) -> Iterator[None]:
    """Train for an epoch each time it is asked."""
    models = _plain(first)
    optimiser = torch.optim.Adam(models.parameters(), lr=RATE)
    while True:
        for *frames, classes in DataLoader(_Paired(felt), batch_size=BATCH, shuffle=True):
            _step(optimiser, _plain_loss(models, frames, classes))
        yield


def _plain_loss(models: nn.ModuleDict, frames: list[Tensor], classes: Tensor) -> Tensor:
    total, latents = torch.zeros(()), []
    for model, sensor_frames in zip(models.values(), frames, strict=True):
        z, scores, decoded = model(sensor_frames)
        latents.append(z)
        total = (
            total + nn.functional.cross_entropy(scores, classes) + 0.01 * nn.functional.mse_loss(decoded, sensor_frames)
        )
    return total + nn.functional.mse_loss(*latents)


def _check(first: Mapping[str, Tensor], felt: Mapping[str, ScaledSlides]) -> None:
    """Refuse to compare loops whose losses over the first steps differ."""
    work = _work(felt)
    losses: list[list[float]] = []
    rows = torch.arange(8 * BATCH).chunk(8)
    ours, plain = _load_weights(_ours(), first), _plain(first)
    for model, fused in ((ours, True), (plain, False)):
        optimiser = torch.optim.Adam(model.parameters(), lr=RATE, fused=fused)
        losses.append([])
        for slide_indices in rows:
            if model is ours:
                loss, _ = work.loss(ours, dict.fromkeys(felt, slide_indices), 0)
            else:
                frames = [slides.frames[slide_indices] for slides in felt.values()]
                loss = _plain_loss(plain, frames, felt["biotac"].classes[slide_indices])
            losses[-1].append(_step(optimiser, loss))
    difference = max(abs(a - b) / abs(b) for a, b in zip(*losses, strict=True))
    if difference > 1e-5:
        raise SystemExit(f"The losses of the two training loops differ by {difference}.")


def _step(optimiser: torch.optim.Optimizer, loss: Tensor) -> float:
    optimiser.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    optimiser.step()
    return float(loss.detach())


def _minirocket(felt: Mapping[str, ScaledSlides]) -> timing.Line:
    """Return how long the MiniRocket classifier takes to fit the slides of both sensors."""
    seconds = {}
    for name, slides in felt.items():
        start_s = time.perf_counter()
        MinirocketClassifier.fit(slides.frames.numpy(), slides.classes.numpy())
        seconds[name] = time.perf_counter() - start_s
    worst = max(seconds.values())
    seconds_by_sensor = " and ".join(f"{value:.1f} s ({name})" for name, value in seconds.items())
    return timing.Line(
        f"MiniRocket classifier, {SLIDES} slides fitted", seconds_by_sensor, "–", "", f"{FIT_S:.0f} s", worst <= FIT_S
    )


def _felt(name: str) -> ScaledSlides:
    """Return slides like those of a sensor: smooth, each class with a frequency of its own."""
    rng = np.random.default_rng(len(name))
    classes = np.arange(SLIDES) % CLASSES
    times = np.arange(FRAMES[name])[None, :, None] / FRAMES[name]
    phases = rng.uniform(0, 2 * np.pi, (SLIDES, 1, SHAPES[name].channels))
    frames = 1 + np.sin(2 * np.pi * (2 + classes[:, None, None]) * times + phases)
    frames += rng.normal(0, 0.1, frames.shape)
    return ScaledSlides(torch.from_numpy(frames.astype(np.float32)), torch.from_numpy(classes))


def _work(felt: Mapping[str, ScaledSlides]) -> JointWork:
    one_each = {name: ScaledSlides(slides.frames[:1], slides.classes[:1]) for name, slides in felt.items()}
    return JointWork(
        felt, one_each, BatchPairs({name: slides.classes for name, slides in felt.items()}, BATCH), WEIGHTS
    )


def _ours() -> nn.ModuleDict:
    return nn.ModuleDict({name: RecurrentAutoencoder(shape) for name, shape in SHAPES.items()})


def _plain(first: Mapping[str, Tensor]) -> nn.ModuleDict:
    renamed = {
        name.replace("header.encoder", "conv").replace("header.decoder", "deconv"): value
        for name, value in first.items()
    }
    models = nn.ModuleDict({name: _Plain(shape) for name, shape in SHAPES.items()})
    models.load_state_dict(renamed)
    return models


def _load_weights(model: nn.ModuleDict, weights: Mapping[str, Tensor]) -> nn.ModuleDict:
    model.load_state_dict(weights)
    return model
