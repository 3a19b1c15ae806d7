"""The losses of networks on slides: reconstruction, classification, and alignment with other sensors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations, permutations
from typing import Any

import torch
from torch import Tensor, nn

from tacpipe.errors import TacpipeError
from tacpipe.models.recurrent_autoencoder import NetworkOutput, RecurrentAutoencoder, RecurrentClassifier
from tacpipe.tasks.material.pairs import NONE, Pairs
from tacpipe.training.loop import Line, precise

Network = RecurrentAutoencoder | RecurrentClassifier
TEMPERATURE = 0.1  # the published temperature of the contrastive loss
CHUNK = 128  # slides that go through a network at once where nothing is learned


@dataclass(frozen=True)
class Weights:
    """Weights of the losses (the paper's section IV: 0.01, 1, 1), and the first epoch that aligns latents."""

    reconstruction: float = 0.01
    classification: float = 1.0
    alignment: float = 1.0  # 0: sensors are learned independently
    align_from: int = 20  # first epoch, from 0, in which the alignment counts
    # Aligns pairs of one row, or each slide with all of its class, in contrast to others
    alignment_loss: str = "pairs"

    def __post_init__(self) -> None:
        """Refuse an unknown alignment loss."""
        if self.alignment_loss not in ("pairs", "contrast"):
            raise TacpipeError(f"alignment_loss is {self.alignment_loss!r}; it must be pairs or contrast.")


@dataclass(frozen=True)
class ScaledSlides:
    """Slides of one sensor as a network reads them."""

    frames: Tensor  # (slide, time, channel), scaled
    classes: Tensor  # (slide,), from 0; NONE where there is no label

    def batch(self, chosen: Tensor) -> Tensor:
        """Return the frames of some slides (time, slide, channel)."""
        return self.frames[chosen].transpose(0, 1).contiguous()


@dataclass
class _Sums:
    """Sums over the batches of one epoch."""

    values: dict[str, Tensor | float] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)

    def add(self, name: str, mean: Tensor, count: int) -> None:
        self.values[name] = self.values.get(name, 0.0) + precise(mean) * count
        self.counts[name] = self.counts.get(name, 0) + count

    def mean(self, name: str) -> float | None:
        return float(self.values[name]) / self.counts[name] if self.counts.get(name) else None


class JointWork:
    """Networks of one or more sensors, learned side by side and, where ``weights.alignment`` is above 0, jointly.

    Each sensor's network lowers the mean squared error of its reconstructed slides and the negative log-likelihood of
    their classes; from epoch ``align_from`` on also the mean squared difference of its latents to those of the other
    sensors' slides in the same row of the batch (Gao et al. 2020, section IV). The network of ``frozen_sensor`` is not
    trained: the latents of others are aligned to its own, without their classes. Joint networks are chosen together, by
    the mean validation accuracy over sensors, others each by its own; of equals the later epoch.
    """

    def __init__(
        self,
        training: Mapping[str, ScaledSlides],
        validation: Mapping[str, ScaledSlides],
        pairs: Pairs,
        weights: Weights,
        frozen_sensor: str = "",
        drop_last: bool = False,
    ) -> None:
        self.training, self.validation, self.pairs, self.weights = training, validation, pairs, weights
        self.frozen_sensor, self.drop_last = frozen_sensor, drop_last
        self._sums = _Sums()

    @property
    def joint(self) -> bool:
        """True if latents of unlike sensors are aligned."""
        return self.weights.alignment > 0 and len(self.training) > 1

    def batches(self, epoch: int) -> list[dict[str, Tensor]]:
        """Return the batches of an epoch: for each sensor the slide of every row."""
        self._sums = _Sums()
        return self.pairs.epoch()

    def loss(self, model: nn.Module, batch: Mapping[str, Tensor], epoch: int) -> tuple[Tensor, int]:
        """Return the sum of all losses of a batch, and its rows."""
        output, total = {}, torch.zeros(())
        for sensor, rows in batch.items():
            chosen = rows[rows != NONE]
            if len(chosen):
                output[sensor], loss = self._sensor_losses(sensor, model.get_submodule(sensor), chosen)
                total = total.to(loss.device) + loss
        if self.joint:
            aligned = self._alignment(batch, output)
            if self.weights.alignment_loss == "contrast":
                aligned = self._contrast(batch, output)
            if aligned is not None and epoch >= self.weights.align_from:
                total = total + self.weights.alignment * aligned
        return total, max(int((rows != NONE).sum()) for rows in batch.values())

    def _sensor_losses(self, sensor: str, network: nn.Module, chosen: Tensor) -> tuple[NetworkOutput, Tensor]:
        """Return the output of a network for some slides, and its own losses."""
        slides, weights = self.training[sensor], self.weights
        frames, classes = slides.batch(chosen), slides.classes[chosen]
        if sensor == self.frozen_sensor:
            with torch.no_grad():
                output: NetworkOutput = network(frames, decode=False)
            return output, output.latents.new_zeros(())
        output = network(frames)
        total = output.latents.new_zeros(())
        labelled = classes != NONE
        if labelled.any():
            loss = nn.functional.cross_entropy(output.scores[labelled], classes[labelled])
            self._sums.add(f"{sensor}.classification", loss, int(labelled.sum()))
            if not self.frozen_sensor:  # a sensor that is aligned to a frozen one learns without classes
                total = total + weights.classification * loss
        if output.frames is not None:
            loss = nn.functional.mse_loss(output.frames, frames)
            self._sums.add(f"{sensor}.reconstruction", loss, len(chosen))
            total = total + weights.reconstruction * loss
        return output, total

    def _alignment(self, batch: Mapping[str, Tensor], output: Mapping[str, NetworkOutput]) -> Tensor | None:
        """Return the mean squared difference of latents in rows that two sensors share, averaged over their pairs."""
        pair_losses = []
        for sensor, partner in combinations(output, 2):
            latents, valid = zip(
                *(self._by_row(batch[name], output[name], name) for name in (sensor, partner)), strict=True
            )
            in_both = valid[0] & valid[1]
            if in_both.any():
                pair_losses.append(nn.functional.mse_loss(latents[0][in_both], latents[1][in_both]))
        if not pair_losses:
            return None
        mean = torch.stack(pair_losses).mean()
        self._sums.add("alignment", mean, 1)
        return mean

    def _contrast(self, batch: Mapping[str, Tensor], output: Mapping[str, NetworkOutput]) -> Tensor | None:
        """Return the contrastive loss between slides of the same row's class, of two sensors, and all others.

        The supervised contrastive loss (Khosla et al., Supervised Contrastive Learning, 2020, equation 2) between
        sensors: cosines of latents over a temperature, one term for each slide and direction. A row's class is that of
        its first sensor, so that permuted pairs are drawn together as they are paired.
        """
        first = next(iter(batch))
        classes = torch.where(batch[first] != NONE, self.training[first].classes.cpu()[batch[first]], NONE)
        losses = []
        for sensor, partner in permutations(output, 2):
            (from_, valid), (to, partner_valid) = (
                self._by_row(batch[name], output[name], name) for name in (sensor, partner)
            )
            has_class, partner_has_class = (
                (classes != NONE).to(valid.device) & valid,
                (classes != NONE).to(partner_valid.device) & partner_valid,
            )
            same = (
                classes.to(valid.device)[has_class][:, None] == classes.to(valid.device)[partner_has_class]
            )  # (slide, other slide)
            in_pairs = same.any(dim=1)
            if in_pairs.any():
                cosines = (
                    nn.functional.normalize(from_[has_class], dim=1)
                    @ nn.functional.normalize(to[partner_has_class], dim=1).t()
                )
                shares = nn.functional.log_softmax(cosines / TEMPERATURE, dim=1)[in_pairs]
                counted = same[in_pairs]
                losses.append(-((shares * counted).sum(dim=1) / counted.sum(dim=1)).mean())
        return torch.stack(losses).mean() if losses else None

    def _by_row(self, rows: Tensor, output: NetworkOutput, sensor: str) -> tuple[Tensor, Tensor]:
        """Return latents (row, latent), and which rows hold a slide with a label."""
        filled = rows != NONE
        latents = output.latents.new_zeros(len(rows), output.latents.shape[1])
        latents[filled.to(latents.device)] = output.latents
        valid = filled.clone()
        valid[filled] = (self.training[sensor].classes[rows[filled]] != NONE).cpu()
        return latents, valid.to(latents.device)

    def watch(self, model: nn.Module) -> Line:
        """Return the epoch's losses, and losses and accuracy of each sensor on its validation slides."""
        evaluated = {
            sensor: self._evaluated(model.get_submodule(sensor), slides) for sensor, slides in self.validation.items()
        }
        weights = self.weights
        return {
            "val_loss": sum(
                weights.classification * measures["classification"]
                + weights.reconstruction * measures.get("reconstruction", 0.0)
                for measures in evaluated.values()
            ),
            "alignment": self._sums.mean("alignment"),
            "train": {
                sensor: {name: self._sums.mean(f"{sensor}.{name}") for name in ("reconstruction", "classification")}
                for sensor in self.training
            },
            "val": evaluated,
        }

    @torch.no_grad()
    def _evaluated(self, network: nn.Module, slides: ScaledSlides) -> dict[str, float]:
        labelled = (slides.classes != NONE).nonzero()[:, 0]
        if self.drop_last:
            labelled = labelled[
                : len(labelled) // self.pairs.batch * self.pairs.batch or None
            ]  # fewer than one count all
        right = loss = reconstruction = 0.0
        for first in range(0, len(labelled), CHUNK):
            batch = labelled[first : first + CHUNK]
            frames, classes = slides.batch(batch), slides.classes[batch]
            output: NetworkOutput = network(frames)
            right += float((output.scores.argmax(dim=1) == classes).sum())
            loss += float(nn.functional.cross_entropy(output.scores, classes, reduction="sum"))
            if output.frames is not None:
                reconstruction += float(nn.functional.mse_loss(output.frames, frames)) * len(batch)
        count = len(labelled) or math.nan
        measures = {"accuracy": right / count, "classification": loss / count}
        return (
            measures
            if isinstance(network, RecurrentClassifier)
            else {**measures, "reconstruction": reconstruction / count}
        )

    def ranks(self, line: Mapping[str, Any]) -> dict[str, tuple[float, ...]]:
        """Return the error rate on validation slides, of equals the later epoch being better."""
        wrong = {sensor: 1 - measures["accuracy"] for sensor, measures in line["val"].items()}
        later = -line["epoch"]
        if self.joint:
            return {"": (sum(wrong.values()) / len(wrong), later)}
        return {f"{sensor}.": (rate, later) for sensor, rate in wrong.items()}
