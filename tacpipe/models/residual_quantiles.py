"""Quantiles of a forecast's error, learned from what the forecast and its inputs show: for a model of any architecture.

A small network, the same for all channels, reads features of a channel at a moment and gives, for each step ahead, where
the median of the error lies and how far each further quantile lies beyond the one before, so that quantiles never cross.
It works in units of each channel's and step's mean absolute error in fitting, and minimises the pinball loss (Koenker and
Bassett, Regression quantiles, 1978), as quantile regression networks do (Taylor, 2000).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from tacpipe.arrays import AnyArray, AnyFloats, Float32s
from tacpipe.errors import TacpipeError

HIDDEN = 32
PASSES = 1200  # steps of the optimiser
BATCH = 1024  # values of each, a value being a channel of a window
LEARNING_RATE = 3e-3
FEWEST = 100  # values to fit on
LOWEST = 1e-3  # unit of a channel that never errs, as a fraction of the mean unit
FARTHEST = 8.0  # deviations at which a feature is cut


@dataclass(frozen=True)
class ResidualQuantiles:
    """Hold the weights of the network, scales of its features, and units of errors."""

    levels: AnyFloats  # (level,), fractions in ascending order, symmetric about 0.5
    unit: AnyFloats  # (channel, step), mean absolute error
    centre: AnyFloats  # (feature,)
    spread: AnyFloats  # (feature,)
    weights: tuple[AnyFloats, ...]  # three layers, (in, out)
    biases: tuple[AnyFloats, ...]  # three layers, (out,)

    @classmethod
    def fit(
        cls, features: Float32s, errors: Float32s, levels: AnyFloats, *, seed: int = 0, passes: int = PASSES
    ) -> Self:
        """Fit quantiles to errors, and return them.

        ``errors`` are true less predicted values (window, channel, step), ``features`` those of each channel (window,
        channel, feature). ``passes`` are steps of the optimiser. The same seed gives the same weights. Raises
        `TacpipeError` for fewer than 100 values, and where one is not finite.
        """
        if errors.shape[0] * errors.shape[1] < FEWEST:
            raise TacpipeError(
                f"{errors.shape[0]} windows of {errors.shape[1]} channels are too few to fit quantiles on; there must be "
                f"{FEWEST} values or more. Give longer recordings, or more of them."
            )
        if not (np.isfinite(features).all() and np.isfinite(errors).all()):
            raise TacpipeError("Some features or errors are not finite, so that no quantiles can be fitted to them.")
        unit = np.abs(errors).mean(axis=0)  # (channel, step)
        unit = np.maximum(unit, LOWEST * unit.mean() or 1.0).astype(np.float32)
        rows = features.reshape(-1, features.shape[2])
        centre = rows.mean(axis=0, dtype=np.float64)
        spread = rows.std(axis=0, dtype=np.float64)
        spread = np.where(spread > 0, spread, 1.0)
        read = _scaled(rows, centre, spread)
        network = _trained(read, (errors / unit).reshape(len(rows), -1), levels, seed, passes)
        layers = [layer for layer in network if isinstance(layer, nn.Linear)]
        weights = tuple(layer.weight.detach().numpy().T.copy() for layer in layers)
        biases = tuple(layer.bias.detach().numpy().copy() for layer in layers)
        return cls(np.asarray(levels, np.float64), unit, centre, spread, weights, biases)

    def predict(self, features: Float32s) -> Float32s:
        """Return quantiles of the error (window, channel, step, level), in ascending order.

        ``features`` are (window, channel, feature).
        """
        hidden: AnyFloats = _scaled(features.reshape(-1, features.shape[-1]), self.centre, self.spread)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = _silu(hidden @ weight + bias)
        raw = hidden @ self.weights[-1] + self.biases[-1]
        steps = self.unit.shape[1]
        ordered = _ordered(raw.reshape(*features.shape[:2], steps, len(self.levels)), len(self.levels) // 2)
        return (ordered * self.unit[None, :, :, None]).astype(np.float32, copy=False)

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return all that `from_tensors` needs."""
        layers = zip(self.weights, self.biases, strict=True)
        return {
            **{name: getattr(self, name) for name in ("levels", "unit", "centre", "spread")},
            **{f"{n}.{part}": v for n, pair in enumerate(layers) for part, v in zip(("w", "b"), pair, strict=True)},
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> Self:
        """Return what `to_tensors` described. Raises `ValueError` where shapes do not fit one another."""
        quantiles = cls(
            tensors["levels"],
            tensors["unit"],
            tensors["centre"],
            tensors["spread"],
            tuple(tensors[f"{n}.w"] for n in range(3)),
            tuple(tensors[f"{n}.b"] for n in range(3)),
        )
        widths = [array.shape for array in quantiles.weights]
        inner = [quantiles.centre.shape[0], widths[0][1], widths[1][1], quantiles.unit.shape[1] * len(quantiles.levels)]
        if widths != [(inner[n], inner[n + 1]) for n in range(3)] or [array.shape for array in quantiles.biases] != [
            (array,) for array in inner[1:]
        ]:
            raise ValueError(f"the layers of quantiles are {widths}")
        if len(quantiles.levels) % 2 == 0 or (np.diff(quantiles.levels) <= 0).any():
            raise ValueError(f"the levels of quantiles are {quantiles.levels.tolist()}")
        return quantiles


def _trained(read: Float32s, errors: Float32s, levels: AnyFloats, seed: int, passes: int) -> nn.Sequential:
    """Return the network of the least pinball loss on ``errors`` (value, step), in units of the channel."""
    steps, middle = errors.shape[1], len(levels) // 2
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        last = nn.Linear(HIDDEN, steps * len(levels))
        network = nn.Sequential(nn.Linear(read.shape[1], HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, HIDDEN), nn.SiLU(), last)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        x, y, p = torch.from_numpy(read), torch.from_numpy(errors), torch.tensor(levels, dtype=torch.float32)
        optimiser = torch.optim.Adam(network.parameters(), LEARNING_RATE)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, LEARNING_RATE, total_steps=passes + 1)
        for _ in range(passes):
            rows = torch.randint(len(x), (BATCH,))
            quantiles = _ordered_tensor(network(x[rows]).view(BATCH, steps, len(levels)), middle)
            above = y[rows][..., None] - quantiles
            lost = torch.maximum(p * above, (p - 1) * above).mean()
            optimiser.zero_grad()
            lost.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            schedule.step()
    return network


def _ordered_tensor(raw: torch.Tensor, middle: int) -> torch.Tensor:
    """Return quantiles in ascending order: the median as it is, each further one beyond by a softplus."""
    median = raw[..., middle : middle + 1]
    up = median + functional.softplus(raw[..., middle + 1 :]).cumsum(-1)
    down = median - functional.softplus(raw[..., :middle].flip(-1)).cumsum(-1).flip(-1)
    return torch.cat([down, median, up], -1)


def _ordered(raw: AnyFloats, middle: int) -> AnyFloats:
    """Return what `_ordered_tensor` returns."""
    median = raw[..., middle : middle + 1]
    up = median + np.logaddexp(raw[..., middle + 1 :], 0).cumsum(-1)
    down = median - np.logaddexp(raw[..., :middle][..., ::-1], 0).cumsum(-1)[..., ::-1]
    return np.concatenate([down, median, up], axis=-1)


def _silu(x: AnyFloats) -> AnyFloats:
    activated: AnyFloats = x / (1 + np.exp(-np.clip(x, -60, 60)))
    return activated


def _scaled(rows: AnyFloats, centre: AnyFloats, spread: AnyFloats) -> Float32s:
    return np.clip((rows - centre) / spread, -FARTHEST, FARTHEST).astype(np.float32)
