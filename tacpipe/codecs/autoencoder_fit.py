"""The training of an autoencoder, and the search for the best of some networks under one budget.

Rows of all but the held-out training recordings are learned, and the mean squared error of giving the held-out ones
back, all frames of them, in units of each channel's scale, decides when to stop and which network is best. Recordings of
the role val are not touched, so that they can evaluate a forecaster trained behind the codec.

Networks of increments have no biases: a row that does not move has latents 0 and comes back as 0, so that increments
that are added up do not drift.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from tacpipe.arrays import AnyFloats
from tacpipe.codecs import codec as codecs
from tacpipe.codecs import measures
from tacpipe.codecs.autoencoder import Autoencoder, scaled
from tacpipe.codecs.measures import standard
from tacpipe.codecs.training_rows import TrainingRows
from tacpipe.errors import TacpipeError
from tacpipe.training import devices, loop

FRAMES = (1, 2, 3)  # widths for the classes C1, C2 and C3
HIDDEN = {1: (64, 32), 2: (128, 64), 3: (192, 96)}  # layers between input and latent, by frames
SHAPES = ((64, 32), (128, 64, 32), (128, 64))  # widths that a search tries, times the frames
STEPS = ((1, 1), (3, 1), (1, 10), (3, 10))  # factors of learning rate and weight decay that a search tries
MAX_TENSORS = len(SHAPES) * len(STEPS)
GRADIENT_CLIP = 1.0  # largest norm of the gradient, without unit, as of the forecasters


@dataclass(frozen=True)
class NetworkShape:
    """One of the networks to try: hidden layers of the encoder, mirrored in the decoder, and how Adam steps."""

    hidden: tuple[int, ...]
    learning_rate: float
    weight_decay: float  # Adam: this fraction of a weight is added to its gradient


def networks(
    frames: int, hidden: str, search: int, learning_rate: float = 1e-3, weight_decay: float = 1e-5
) -> list[NetworkShape]:
    """Return the networks to try: the first ``search`` of those that there are or, where it is 0, that of ``hidden``.

    ``hidden`` is text such as ``64,32``; empty, it is that of the class of ``frames``. Raises `TacpipeError`
    for what makes no network.

    >>> [one.hidden for one in networks(2, "", search=3)]
    [(128, 64), (256, 128, 64), (256, 128)]
    """
    if frames not in FRAMES:
        raise TacpipeError(f"frames is {frames}; an autoencoder reads 1, 2 or 3 frames in a row.")
    if not 0 <= search <= MAX_TENSORS:
        raise TacpipeError(
            f"search is {search}; it must be the number of networks to try, 1 to {MAX_TENSORS}, or 0 for no search."
        )
    if not weight_decay >= 0:
        raise TacpipeError(f"weight_decay is {weight_decay}; it must be 0 or above.")
    if search and hidden:
        raise TacpipeError(
            f"hidden is {hidden!r} and search is {search}, which chooses its own widths. Give only one of them."
        )
    if not search:
        return [NetworkShape(_widths(hidden) if hidden else HIDDEN[frames], learning_rate, weight_decay)]
    tried = [
        NetworkShape(tuple(frames * width for width in shape), learning_rate * fast, weight_decay * decay)
        for fast, decay in STEPS
        for shape in SHAPES
    ]
    return tried[:search]


def fit(
    rows: TrainingRows,
    tried: Sequence[NetworkShape],
    schedule: loop.Schedule,
    workspace: Path,
    *,
    components: int,
    representation: str = codecs.LEVELS,
) -> Autoencoder:
    """Fit the networks in ``tried`` and return the codec that reconstructs held-out rows best, with ``components`` latents.

    Its ``measured["search"]`` contains each network's lowest validation error, its epochs and whether it was selected.
    Networks trained before an interruption are read from ``workspace``. Raises `TacpipeError` if there are too few
    recordings or rows, or if ``components`` exceeds the number of channels.
    """
    width = len(rows.channels)
    if not 1 <= components <= width:
        raise TacpipeError(f"components is {components}; {width} channels give 1 to {width}.")
    if len(rows.inputs) < 2:
        raise TacpipeError(
            "An autoencoder is stopped by recordings that it does not learn, so it needs at least 2 training "
            "recordings and there is 1. Make a split with more."
        )
    train, val = rows.parts
    if len(train) < 2 or not len(val):
        raise TacpipeError(
            f"An autoencoder cannot be fitted to {len(train)} rows and stopped by {len(val)}. Give it longer training "
            "recordings with contact."
        )
    mean, scale = standard(train[:, -width:], representation)
    learned, watched = (torch.from_numpy(scaled(part, mean, scale)).to(devices.kind()) for part in (train, val))
    results = [
        _trained(learned, watched, network, schedule, workspace, (index, len(tried)), components, representation)
        for index, network in enumerate(tried)
    ]
    best = min(range(len(results)), key=lambda index: _lowest(results[index]))
    encoder, decoder = (_layers(results[best].weights, part) for part in ("encoder", "decoder"))
    codec = Autoencoder(
        rows.channels, rows.layout, mean, scale, encoder, decoder, train.shape[1] // width, representation
    )
    described = [
        _record(network, trained, kept=at == best)
        for at, (network, trained) in enumerate(zip(tried, results, strict=True))
    ]
    measured: measures.CodecMeasures = {
        "reconstruction": measures.reconstructions(codec, {"train": [train], "val": [val]}),
        "latent_covariance": measures.covariance(codec.project(train)),
        "search": described,
    }
    return replace(codec, measured=measured)


class _Mirrored(nn.Module):
    """Encoder and decoder whose layers mirror each other."""

    def __init__(self, widths: Sequence[int], *, bias: bool) -> None:
        super().__init__()
        self.encoder, self.decoder = _stack(widths, bias), _stack(widths[::-1], bias)

    def forward(self, rows: Tensor) -> Tensor:
        """Return ``rows`` (row, frames * channel) as they come back."""
        back: Tensor = self.decoder(self.encoder(rows))
        return back


def _stack(widths: Sequence[int], bias: bool) -> nn.Sequential:
    """Return linear layers between the widths, an ELU behind all but the last."""
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(widths):
        layers += [nn.Linear(before, after, bias=bias), nn.ELU()]
    return nn.Sequential(*layers[:-1])


def _trained(
    learned: Tensor,
    watched: Tensor,
    network: NetworkShape,
    schedule: loop.Schedule,
    workspace: Path,
    place: tuple[int, int],  # index and number among the networks that are tried
    components: int,
    representation: str,
) -> loop.Trained:
    widths, (index, count) = (learned.shape[1], *network.hidden, components), place

    def part(rows: Tensor) -> loop.WindowSet:
        def loss(model: nn.Module, indices: Tensor) -> Tensor:
            picked = rows[indices]
            return nn.functional.mse_loss(model(picked), picked)

        return loop.WindowSet(len(rows), loss)

    return loop.train(
        lambda: _Mirrored(widths, bias=representation == codecs.LEVELS).to(learned.device),
        loop.WindowTraining(part(learned), part(watched), schedule.batch),
        replace(schedule, learning_rate=network.learning_rate),
        workspace / f"{index:02d}",
        weight_decay=network.weight_decay,
        number=index + 1,
        count=count,
        labels={"network": index} if count > 1 else None,
    )


def _lowest(trained: loop.Trained) -> float:
    return min(float(line["val_loss"]) for line in trained.history)


def _record(network: NetworkShape, trained: loop.Trained, *, kept: bool) -> measures.SearchedNetwork:
    """Return the record of a network in the search; no seconds, which are never the same."""
    return {
        "hidden": list(network.hidden),
        "learning_rate": measures.rounded(network.learning_rate),
        "weight_decay": measures.rounded(network.weight_decay),
        "parameters": sum(value.numel() for value in trained.weights.values()),
        "epochs": len(trained.history),
        "val_loss": measures.rounded(_lowest(trained)),
        "kept": kept,
    }


def _layers(weights: dict[str, Tensor], part: str) -> tuple[tuple[AnyFloats, AnyFloats], ...]:
    """Return weight and bias of each layer of ``encoder`` or ``decoder``; a layer without bias has zeros."""
    tensors = {name: value.numpy() for name, value in weights.items() if name.startswith(f"{part}.")}
    places = sorted({int(name.split(".")[1]) for name in tensors})
    pairs = ((tensors[f"{part}.{at}.weight"], tensors.get(f"{part}.{at}.bias")) for at in places)
    return tuple((w, np.zeros(len(w), dtype=np.float32) if b is None else b) for w, b in pairs)


def _widths(text: str) -> tuple[int, ...]:
    """Return the widths that text such as ``64,32`` names."""
    pieces = [piece.strip() for piece in text.split(",")]
    if not all(piece.isascii() and piece.isdecimal() and int(piece) > 0 for piece in pieces):
        raise TacpipeError(
            f"hidden is {text!r}; it is the widths of the hidden layers, whole numbers above 0 with commas between, as "
            "64,32. Leave it empty for those of the class."
        )
    return tuple(int(piece) for piece in pieces)
