"""Train an autoencoder, or search for the best of several networks with the same budget.

The training recordings are split into learned and held-out ones. The mean squared error of reconstructing the held-out
rows, all their frames, in units of each channel's scale, determines when to stop and which network is best. Recordings
of the role val are not used, so that they can evaluate a forecaster that reads the codec's latents.

Networks for increments have no biases: an increment of 0 has latents 0 and is decoded as 0, so that the sum of decoded
increments does not drift.
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
from tacpipe.codecs.autoencoder import Autoencoder, standardise
from tacpipe.codecs.measures import mean_and_scale
from tacpipe.codecs.training_rows import TrainingRows
from tacpipe.errors import TacpipeError
from tacpipe.training import devices, loop

FRAMES = (1, 2, 3)  # frames of the classes C1, C2 and C3
HIDDEN = {1: (64, 32), 2: (128, 64), 3: (192, 96)}  # frames -> hidden layers between input and latents
SHAPES = ((64, 32), (128, 64, 32), (128, 64))  # hidden layers that a search tries, to be multiplied by the frames
STEPS = ((1, 1), (3, 1), (1, 10), (3, 10))  # factors of learning rate and weight decay that a search tries, as pairs
MAX_SEARCH = len(SHAPES) * len(STEPS)
GRADIENT_CLIP = 1.0  # maximum norm of the gradient, as for the forecasters


@dataclass(frozen=True)
class NetworkShape:
    """A candidate network: hidden layers of the encoder, mirrored in the decoder, and the settings of Adam."""

    hidden: tuple[int, ...]
    learning_rate: float
    weight_decay: float  # weight decay of Adam: fraction of a weight that is added to its gradient


def candidate_networks(
    frames: int, hidden: str, search: int, learning_rate: float = 1e-3, weight_decay: float = 1e-5
) -> list[NetworkShape]:
    """Return the candidate networks: the first ``search`` of the search space, or the one with ``hidden`` layers.

    A ``search`` of 0 selects the latter. ``hidden`` is text such as ``64,32``, or empty for the default of ``frames``.
    Raises `TacpipeError` if a value is out of range.

    >>> [shape.hidden for shape in candidate_networks(2, "", search=3)]
    [(128, 64), (256, 128, 64), (256, 128)]
    """
    if frames not in FRAMES:
        raise TacpipeError(f"frames is {frames}; an autoencoder reads 1, 2 or 3 frames in a row.")
    if not 0 <= search <= MAX_SEARCH:
        raise TacpipeError(
            f"search is {search}; it must be the number of networks to try, 1 to {MAX_SEARCH}, or 0 for no search."
        )
    if not weight_decay >= 0:
        raise TacpipeError(f"weight_decay is {weight_decay}; it must be 0 or above.")
    if search and hidden:
        raise TacpipeError(
            f"hidden is {hidden!r} and search is {search}, which chooses its own widths. Give only one of them."
        )
    if not search:
        return [NetworkShape(_parse_widths(hidden) if hidden else HIDDEN[frames], learning_rate, weight_decay)]
    candidates = [
        NetworkShape(tuple(frames * width for width in shape), learning_rate * rate_factor, weight_decay * decay_factor)
        for (rate_factor, decay_factor), shape in itertools.product(STEPS, SHAPES)
    ]
    return candidates[:search]


def fit(
    rows: TrainingRows,
    candidates: Sequence[NetworkShape],
    schedule: loop.Schedule,
    workspace: Path,
    *,
    components: int,
    representation: str = codecs.LEVELS,
) -> Autoencoder:
    """Fit the ``candidates`` and return the codec with ``components`` latents that reconstructs held-out rows best.

    Its ``measured["search"]`` contains each network's lowest validation error, its epochs and whether it was selected.
    Networks trained before an interruption are read from ``workspace``. Raises `TacpipeError` if there are too few
    recordings or rows, or if ``components`` exceeds the number of channels.
    """
    width = len(rows.channels)
    if not 1 <= components <= width:
        raise TacpipeError(f"components is {components}; {width} channels give 1 to {width}.")
    if len(rows.inputs) < 2:
        raise TacpipeError(
            "An autoencoder needs at least 2 training recordings, one of which determines when to stop, and there is "
            "1. Make a split with more."
        )
    train, val = rows.parts
    if len(train) < 2 or not len(val):
        raise TacpipeError(
            f"An autoencoder cannot be fitted to {len(train)} rows and stopped by {len(val)}. Give it longer training "
            "recordings with contact."
        )
    mean, scale = mean_and_scale(train[:, -width:], representation)
    train_tensor, val_tensor = (
        torch.from_numpy(standardise(part, mean, scale)).to(devices.kind()) for part in (train, val)
    )
    results = [
        _train_network(
            train_tensor, val_tensor, network, schedule, workspace, (index, len(candidates)), components, representation
        )
        for index, network in enumerate(candidates)
    ]
    best = min(range(len(results)), key=lambda index: _lowest_loss(results[index]))
    encoder, decoder = (_layers(results[best].weights, part) for part in ("encoder", "decoder"))
    codec = Autoencoder(
        rows.channels, rows.layout, mean, scale, encoder, decoder, train.shape[1] // width, representation
    )
    search_records = [
        _record(network, trained, kept=index == best)
        for index, (network, trained) in enumerate(zip(candidates, results, strict=True))
    ]
    measured: measures.CodecMeasures = {
        "reconstruction": measures.reconstructions(codec, {"train": [train], "val": [val]}),
        "latent_covariance": measures.covariance(codec.project(train)),
        "search": search_records,
    }
    return replace(codec, measured=measured)


class _MirroredNetwork(nn.Module):
    """An encoder, and a decoder with the same layers in reverse."""

    def __init__(self, widths: Sequence[int], *, bias: bool) -> None:
        super().__init__()
        self.encoder, self.decoder = _stack(widths, bias), _stack(widths[::-1], bias)

    def forward(self, rows: Tensor) -> Tensor:
        """Return the reconstructions of ``rows`` (row, frames * channel)."""
        reconstruction: Tensor = self.decoder(self.encoder(rows))
        return reconstruction


def _stack(widths: Sequence[int], bias: bool) -> nn.Sequential:
    """Return linear layers between successive widths, with ELUs between them."""
    layers: list[nn.Module] = []
    for in_width, out_width in itertools.pairwise(widths):
        layers += [nn.Linear(in_width, out_width, bias=bias), nn.ELU()]
    return nn.Sequential(*layers[:-1])


def _train_network(
    train_tensor: Tensor,
    val_tensor: Tensor,
    network: NetworkShape,
    schedule: loop.Schedule,
    workspace: Path,
    position: tuple[int, int],  # index and number of the candidates
    components: int,
    representation: str,
) -> loop.TrainingResult:
    """Train a network that reproduces its inputs, and return its best weights.

    Its state is saved in ``workspace``, so that training resumes after an interruption. Progress shows ``position``.
    """
    widths, (index, count) = (train_tensor.shape[1], *network.hidden, components), position

    def window_set(rows: Tensor) -> loop.WindowSet:
        def loss(model: nn.Module, indices: Tensor) -> Tensor:
            batch = rows[indices]
            return nn.functional.mse_loss(model(batch), batch)

        return loop.WindowSet(len(rows), loss)

    return loop.train(
        lambda: _MirroredNetwork(widths, bias=representation == codecs.LEVELS).to(train_tensor.device),
        loop.WindowTraining(window_set(train_tensor), window_set(val_tensor), schedule.batch),
        replace(schedule, learning_rate=network.learning_rate),
        workspace / f"{index:02d}",
        weight_decay=network.weight_decay,
        number=index + 1,
        count=count,
        labels={"network": index} if count > 1 else None,
    )


def _lowest_loss(trained: loop.TrainingResult) -> float:
    return min(float(line["val_loss"]) for line in trained.history)


def _record(network: NetworkShape, trained: loop.TrainingResult, *, kept: bool) -> measures.SearchedNetwork:
    """Return the record of a network in the search, without its training time, which is not reproducible."""
    return {
        "hidden": list(network.hidden),
        "learning_rate": measures.rounded(network.learning_rate),
        "weight_decay": measures.rounded(network.weight_decay),
        "parameters": sum(value.numel() for value in trained.weights.values()),
        "epochs": len(trained.history),
        "val_loss": measures.rounded(_lowest_loss(trained)),
        "kept": kept,
    }


def _layers(weights: dict[str, Tensor], part: str) -> tuple[tuple[AnyFloats, AnyFloats], ...]:
    """Return the weight and the bias of each layer of ``part``, encoder or decoder; missing biases are zeros."""
    tensors = {name: value.numpy() for name, value in weights.items() if name.startswith(f"{part}.")}
    indices = sorted({int(name.split(".")[1]) for name in tensors})
    layers = []
    for index in indices:
        weight = tensors[f"{part}.{index}.weight"]
        bias = tensors.get(f"{part}.{index}.bias", np.zeros(len(weight), dtype=np.float32))
        layers.append((weight, bias))
    return tuple(layers)


def _parse_widths(text: str) -> tuple[int, ...]:
    """Parse widths such as ``64,32``. Raises `TacpipeError` unless they are positive integers."""
    pieces = [piece.strip() for piece in text.split(",")]
    if not all(piece.isascii() and piece.isdecimal() and int(piece) > 0 for piece in pieces):
        raise TacpipeError(
            f"hidden is {text!r}; it must be the widths of the hidden layers, positive integers separated by commas, "
            "such as 64,32. Leave it empty for the default."
        )
    return tuple(int(piece) for piece in pieces)
