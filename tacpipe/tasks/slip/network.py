"""A causal convolutional network on the channels of all fingers.

Each layer combines rows that are twice as far apart as in the layer before, and the last row of the last layer gives the
score. Scores are computed window by window, so that a live session computes the same bits.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from tacpipe.arrays import AnyArray, AnyFloats, Float32s, Floats, Indices
from tacpipe.errors import TacpipeError
from tacpipe.tasks.slip.planned import CHANNELS
from tacpipe.tasks.slip.windows import FingerReader, GraspTrack, TrainingWindows
from tacpipe.training import loop
from tacpipe.training.following import Line, Validated

if TYPE_CHECKING:
    from tacpipe.tasks.slip.params import ConvolutionParams

KERNEL = 3
HELD_OUT = 5  # every fifth object stops the training early
GRADIENT_CLIP = 1.0
LIMIT = 10.0  # maximum scaled value
MAX_WIDTH = 4096  # maximum number of channels of a stored network


class CausalNetwork(nn.Module):
    """Convolutions over time whose last output depends on the whole window."""

    def __init__(self, inputs: int, channels: int, layers: int) -> None:
        """Create a network of ``layers`` convolutions with ``channels`` each, with random weights."""
        super().__init__()
        widths = [inputs, *[channels] * layers]
        self.layers = nn.ModuleList(
            nn.Conv1d(before, after, KERNEL, dilation=2**number)
            for number, (before, after) in enumerate(itertools.pairwise(widths))
        )
        self.readout = nn.Linear(2 * channels, 1)

    def forward(self, windows: Tensor) -> Tensor:
        """Return a score (window,) for windows (window, channel, time)."""
        values = windows
        for number, layer in enumerate(self.layers):
            values = torch.relu(layer(nn.functional.pad(values, ((KERNEL - 1) * 2**number, 0))))
        scores: Tensor = self.readout(torch.cat([values[..., -1], values.mean(dim=-1)], dim=1))
        return scores[:, 0]


def stack_windows(windows: Sequence[AnyFloats], reader: FingerReader) -> Float32s:
    """Return `FingerReader.windows` as (window, channel, time): the channels of all fingers, then those of the plan.

    The plan has as many rows as a finger, at equal intervals from the current row to the end of its second. It is 0 where
    it is unknown.
    """
    parts = list(windows)
    if reader.reads_plans:
        rows = reader.streams[0].rows
        parts[-1] = np.nan_to_num(parts[-1][:, np.linspace(0, parts[-1].shape[1] - 1, rows).astype(np.intp)])
    joined = np.concatenate([np.clip(part, -LIMIT, LIMIT) for part in parts], axis=2)
    return np.ascontiguousarray(joined.transpose(0, 2, 1), np.float32)


def input_count(reader: FingerReader) -> int:
    """Return the number of channels of `stack_windows`."""
    return sum(len(finger.channels) for finger in reader.streams) + len(CHANNELS) * reader.reads_plans


class WindowWork:
    """Training of the network by weighted cross-entropy; every fifth object is held out."""

    def __init__(self, windows: TrainingWindows, batch: int) -> None:
        """Hold out every fifth group of windows, or none if they have no slip.

        Raises `TacpipeError` if fingers have windows of different lengths.
        """
        _require_equal_rows(windows.reader)
        self.windows, self.batch = windows, batch
        held_out = windows.groups % HELD_OUT == HELD_OUT - 1
        self.held_out = np.flatnonzero(held_out)
        self.training = np.flatnonzero(~held_out & (windows.weights > 0))
        if not len(self.held_out) or not windows.slips[self.held_out].any():
            self.held_out = self.training

    def inputs(self, chosen: Indices) -> Tensor:
        """Return the windows with these indices (window, channel, time)."""
        windows = self.windows
        parts = np.empty((len(chosen), *self.shape), np.float32)
        for number in np.unique(windows.track[chosen]).tolist():
            positions = np.flatnonzero(windows.track[chosen] == number)
            rows = windows.rows[chosen[positions]]
            parts[positions] = stack_windows(windows.reader.windows(windows.tracks[number], rows), windows.reader)
        return torch.from_numpy(parts)

    @property
    def shape(self) -> tuple[int, int]:
        """Channels and rows of a window."""
        reader = self.windows.reader
        return input_count(reader), reader.streams[0].rows

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
        labels = torch.from_numpy(self.windows.slips[chosen].astype(np.float32))
        weights = torch.from_numpy(self.windows.weights[chosen].astype(np.float32))
        losses = nn.functional.binary_cross_entropy_with_logits(model(self.inputs(chosen)), labels, reduction="none")
        return (losses * weights).mean()


@dataclass(frozen=True)
class ConvolutionScorer:
    """A trained network."""

    network: CausalNetwork
    described: Mapping[str, int]
    runs_live: bool = True

    @classmethod
    def fit(cls, windows: TrainingWindows, params: ConvolutionParams, workspace: Path) -> ConvolutionScorer:
        """Return a network that the shared loop trained."""
        work = WindowWork(windows, params.batch)
        described = {"inputs": work.shape[0], "channels": params.channels, "layers": params.layers}
        schedule = loop.Schedule(
            epochs=params.epochs,
            batch=params.batch,
            learning_rate=params.learning_rate,
            patience=params.patience,
            gradient_clip=GRADIENT_CLIP,
            seed=params.seed,
        )
        trained = loop.train(
            lambda: CausalNetwork(**described), work, schedule, workspace, weight_decay=params.weight_decay
        )
        network = CausalNetwork(**described)
        network.load_state_dict(trained.weights)
        return cls(network.eval(), described)

    def score(self, reader: FingerReader, track: GraspTrack, rows: Indices) -> Floats:
        """Return the scores of rows of a track (row,), one window at a time."""
        scores = np.empty(len(rows))
        for index, row in enumerate(rows):
            windows = [part[0] for part in reader.windows(track, np.array([row]))]
            scores[index] = self.score_window(reader, windows)
        return scores

    def score_features(self, features: Floats) -> None:
        """Return None, because the network reads channels instead of features."""
        return

    def score_window(self, reader: FingerReader, windows: Sequence[AnyFloats]) -> float:
        """Return the score of one window of `FingerReader.windows`, each (time, channel)."""
        with torch.no_grad():
            return float(self.network(torch.from_numpy(stack_windows([window[None] for window in windows], reader)))[0])

    def arrays(self) -> dict[str, AnyArray]:
        """Return the weights."""
        return {name: value.numpy() for name, value in self.network.state_dict().items()}

    def describe(self) -> dict[str, object]:
        """Return the sizes of the network."""
        return dict(self.described)

    @classmethod
    def load(
        cls, arrays: Mapping[str, AnyArray], described: Mapping[str, Any], reader: FingerReader
    ) -> ConvolutionScorer:
        """Return the scorer that `arrays` and `describe` wrote. Raises `ValueError` if they do not fit one another.

        Raises `TacpipeError` if fingers have windows of different lengths.
        """
        _require_equal_rows(reader)
        sizes = {name: int(described[name]) for name in ("inputs", "channels", "layers")}
        inputs = input_count(reader)
        if sizes["inputs"] != inputs or not (0 < sizes["channels"] <= MAX_WIDTH and 0 < sizes["layers"] <= 8):
            raise ValueError(f"a network of {sizes} for {inputs} channels")
        network = CausalNetwork(**sizes)
        network.load_state_dict({name: torch.from_numpy(np.array(array)) for name, array in arrays.items()})
        return cls(network.eval(), sizes)


def _require_equal_rows(reader: FingerReader) -> None:
    """Raise `TacpipeError` if fingers have windows of different lengths."""
    rows = {finger.rows for finger in reader.streams}
    if len(rows) > 1:
        raise TacpipeError(
            f"The network reads fingers of the same rate, and these have windows of {sorted(rows)} rows. Synchronize the "
            f"recordings, or choose streams with --streams."
        )
