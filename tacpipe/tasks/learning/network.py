"""A causal convolutional network on the windows of all streams, for quantities and for classes.

Each layer combines rows that are twice as far apart as in the layer before; the last row of the last layer and its mean over
time give the outputs. Outputs are computed window by window, so that a live session computes the same bits.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from tacpipe.arrays import AnyArray, AnyFloats, Float32s, Floats, Indices
from tacpipe.tasks.learning.examples import Examples
from tacpipe.tasks.learning.features import SMALLEST_DEVIATION, Kind
from tacpipe.training import loop
from tacpipe.training.following import Line, Validated

KERNEL = 3
HELD_OUT = 5  # every fifth group stops the training early
LIMIT = 10.0  # maximum scaled value
MAX_WIDTH, MAX_LAYERS = 4096, 8  # maximum number of channels and layers of a stored network


class CausalNetwork(nn.Module):
    """Convolutions over time whose last output depends on the whole window."""

    def __init__(self, inputs: int, channels: int, layers: int, outputs: int) -> None:
        """Create a network of ``layers`` convolutions with ``channels`` each, with random weights."""
        super().__init__()
        widths = [inputs, *[channels] * layers]
        self.layers = nn.ModuleList(
            nn.Conv1d(before, after, KERNEL, dilation=2**number)
            for number, (before, after) in enumerate(itertools.pairwise(widths))
        )
        self.readout = nn.Linear(2 * channels, outputs)

    def forward(self, windows: Tensor) -> Tensor:
        """Return the outputs (window, output) of windows (window, channel, time)."""
        values = windows
        for number, layer in enumerate(self.layers):
            values = torch.relu(layer(nn.functional.pad(values, ((KERNEL - 1) * 2**number, 0))))
        outputs: Tensor = self.readout(torch.cat([values[..., -1], values.mean(dim=-1)], dim=1))
        return outputs


def stack_windows(windows: Sequence[AnyFloats]) -> Float32s:
    """Return windows (window, time, channel) side by side as (window, channel, time), with the rows of the first stream.

    A window with other rows is read at as many equal intervals. Missing values are 0.
    """
    rows = windows[0].shape[1]
    parts = [part[:, np.linspace(0, part.shape[1] - 1, rows).astype(np.intp)] for part in windows]
    joined = np.concatenate([np.nan_to_num(np.clip(part, -LIMIT, LIMIT)) for part in parts], axis=2)
    return np.ascontiguousarray(joined.transpose(0, 2, 1), np.float32)


class ExampleWork:
    """Training of the network by the absolute error of scaled values, or by cross-entropy; every fifth group is held out."""

    def __init__(self, examples: Examples, outputs: Floats, kind: Kind, batch: int) -> None:
        """Hold out every fifth group; without five groups, none."""
        self.examples, self.outputs, self.kind, self.batch = examples, outputs.astype(np.float32), kind, batch
        self.weights = examples.training_weights.astype(np.float32)
        groups = np.unique(np.array(examples.example_groups), return_inverse=True)[1]
        is_held_out = groups % HELD_OUT == HELD_OUT - 1
        self.training = np.flatnonzero(~is_held_out & (self.weights > 0))
        self.held_out = np.flatnonzero(is_held_out) if self.weights[is_held_out].any() else self.training

    def batches(self, epoch: int) -> list[Tensor]:
        """Return shuffled batches of indices of the training windows."""
        order = torch.randperm(len(self.training))
        return list(torch.split(torch.from_numpy(self.training)[order], self.batch))

    def loss(self, model: nn.Module, batch: Tensor, epoch: int) -> tuple[Tensor, int]:
        """Return the loss of a batch of windows, and its size."""
        return self._loss(model, batch.numpy()), len(batch)

    def validate(self, model: nn.Module) -> Validated:
        """Return the loss over the windows that are held out."""
        with torch.no_grad():
            parts = [self.held_out[first : first + 1024] for first in range(0, len(self.held_out), 1024)]
            losses = [float(self._loss(model, part)) * len(part) for part in parts]
        return {"val_loss": sum(losses) / len(self.held_out)}

    def ranks(self, line: Line) -> dict[str, tuple[float]]:
        """Return the loss as the only criterion by which epochs are ranked."""
        return {"": (float(line["val_loss"]),)}

    def _loss(self, model: nn.Module, chosen: Indices) -> Tensor:
        """Return the weighted mean loss of a network on windows with these indices."""
        predicted = model(torch.from_numpy(stack_windows(self.examples.select(chosen).windows())))
        targets = torch.from_numpy(self.outputs[chosen])
        if self.kind == "quantity":
            losses = (predicted - targets).abs().mean(dim=1)
        else:
            losses = nn.functional.cross_entropy(predicted, targets, reduction="none")
        mean: Tensor = (losses * torch.from_numpy(self.weights[chosen])).mean()
        return mean


@dataclass(frozen=True)
class FittedNetwork:
    """A trained network; its outputs are values in ``deviations`` from ``means``, or scores of classes."""

    network: CausalNetwork
    sizes: Mapping[str, int]
    means: Floats  # (output,), 0 for classes
    deviations: Floats  # (output,), 1 for classes

    @classmethod
    def fit(
        cls,
        examples: Examples,
        outputs: Floats,
        kind: Kind,
        schedule: loop.Schedule,
        workspace: Path,
        *,
        channels: int,
        layers: int,
        weight_decay: float,
    ) -> FittedNetwork:
        """Return a network that the shared loop trained; ``workspace`` is a folder for checkpoints."""
        means, deviations = np.zeros(outputs.shape[1]), np.ones(outputs.shape[1])
        if kind == "quantity":
            means, deviations = outputs.mean(axis=0), np.maximum(outputs.std(axis=0), SMALLEST_DEVIATION)
        work = ExampleWork(examples, (outputs - means) / deviations, kind, schedule.batch)
        inputs = sum(width for _, width in examples.inputs.window_shapes)
        sizes = {"inputs": inputs, "channels": channels, "layers": layers, "outputs": outputs.shape[1]}
        trained = loop.train(lambda: CausalNetwork(**sizes), work, schedule, workspace, weight_decay=weight_decay)
        network = CausalNetwork(**sizes)
        network.load_state_dict(trained.weights)
        return cls(network.eval(), sizes, means, deviations)

    def outputs(self, examples: Examples) -> Floats:
        """Return the outputs (example, output), one window at a time."""
        outputs = np.empty((len(examples), len(self.means)))
        with torch.no_grad():
            for index in range(len(examples)):
                windows = torch.from_numpy(stack_windows(examples.select(np.array([index])).windows()))
                outputs[index] = self.network(windows)[0].numpy()
        return outputs * self.deviations + self.means

    def arrays(self) -> dict[str, AnyArray]:
        """Return the weights, and the scale of the outputs."""
        weights = {f"network.{name}": value.numpy() for name, value in self.network.state_dict().items()}
        return {**weights, "means": self.means, "deviations": self.deviations}

    def describe(self) -> dict[str, Any]:
        """Return the sizes of the network."""
        return {"estimator": "network", **self.sizes}

    @classmethod
    def load(cls, arrays: Mapping[str, AnyArray], described: Mapping[str, Any], outputs: int) -> FittedNetwork:
        """Return the stored network. Raises `ValueError` or `RuntimeError` if its parts do not fit one another."""
        sizes = {name: int(described[name]) for name in ("inputs", "channels", "layers", "outputs")}
        widths = (sizes["inputs"], sizes["channels"])
        is_sized = all(0 < width <= MAX_WIDTH for width in widths) and 0 < sizes["layers"] <= MAX_LAYERS
        if sizes["outputs"] != outputs or not is_sized:
            raise ValueError(f"a network of {sizes} for {outputs} outputs")
        network = CausalNetwork(**sizes)
        weights = {name.removeprefix("network."): torch.from_numpy(np.array(value)) for name, value in arrays.items()}
        means, deviations = (weights.pop(name).numpy().astype(np.float64) for name in ("means", "deviations"))
        network.load_state_dict(weights)
        if means.shape != (outputs,) or deviations.shape != (outputs,):
            raise ValueError(f"scales of {means.shape} for {outputs} outputs")
        return cls(network.eval(), sizes, means, deviations)
