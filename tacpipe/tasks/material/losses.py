"""Learn networks jointly on slides: batches of slides of different sensors, and losses.

The losses are reconstruction, classification, and alignment with other sensors. Slides of different sensors do not
correspond to each other; a pair shares only its material. So latents are aligned by labels, and pairs of *different*
materials are the control: see `permuted_classes`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, permutations

import numpy as np
import torch
from torch import Tensor, nn

from tacpipe.errors import TacpipeError
from tacpipe.models.recurrent_autoencoder import (
    NetworkOutput,
    RecurrentAutoencoder,
    RecurrentClassifier,
)
from tacpipe.training.following import Line, Validated
from tacpipe.training.loop import to_float64

NONE = -1  # index of a missing slide in a row of a batch, and class of a slide without label
PAIRINGS = ("random", "fixed", "permuted")
BATCH_STEPS = {50: 2, 25: 4, 17: 6, 11: 9}  # percentage of batches of a subsampled sensor -> it uses each n-th


@dataclass(frozen=True)
class BatchPairs:
    """Distribution of the slides of all sensors over the batches of each epoch."""

    classes: Mapping[str, Tensor]  # sensor -> class of each slide, from 0; NONE for slides without label
    batch: int
    pairing: str = "random"  # random: new pairs in each epoch; fixed: drawn once; permuted: random, of other classes
    shuffle: bool = True  # whether new batches are drawn in each epoch; otherwise, pairs are also fixed
    drop_last: bool = False  # omit the last batch if it is not full
    subsample_sensor: str = ""  # sensor that learns only from a subset of the batches
    subsample_percent: int = 100  # percentage of the batches
    partners: Mapping[int, int] | None = None  # class of the first sensor -> class of the others, for permuted pairs
    seed: int = 0  # seed of pairs and orders that are drawn once

    def __post_init__(self) -> None:
        """Raise `TacpipeError` for unknown or incompatible options."""
        if self.pairing not in PAIRINGS:
            raise TacpipeError(f"pairing is {self.pairing!r}; it must be {', '.join(PAIRINGS)}.")
        if self.subsample_percent not in (100, 90, *BATCH_STEPS):
            raise TacpipeError(
                f"subsample_percent is {self.subsample_percent}; it must be 100, 90, {', '.join(map(str, BATCH_STEPS))}."
            )
        if self.subsample_sensor and self.subsample_sensor not in self.classes:
            raise TacpipeError(
                f"subsample_sensor is {self.subsample_sensor}; it must be one of {', '.join(self.classes)}."
            )
        if self.subsample_sensor and self.shuffle:
            raise TacpipeError(
                "A subsampled sensor must see the same slides in every epoch, or it would see all of them over the epochs: "
                "give --no-shuffle with --subsample-sensor."
            )

    def epoch(self) -> list[dict[str, Tensor]]:
        """Return the batches of an epoch: for each sensor the slide in each row (row,) of the batch, or NONE.

        Random choices use torch's generator; choices that are drawn once use ``seed``. Rows and batches without slides
        are omitted.
        """
        rows = self._rows()  # (sensor, row)
        size = self.batch
        batches = [rows[:, first : first + size] for first in range(0, rows.shape[1], size)]
        if (self.drop_last or self.subsample_sensor) and batches and batches[-1].shape[1] < size:
            batches.pop()
        slide_batches = []
        for number, batch in enumerate(batches):
            slides_by_sensor = dict(zip(self.classes, batch.clone(), strict=True))
            if self.subsample_sensor and not uses_batch(number, self.subsample_percent):
                slides_by_sensor[self.subsample_sensor][:] = NONE
            if any((slide_rows != NONE).any() for slide_rows in slides_by_sensor.values()):
                slide_batches.append(slides_by_sensor)
        return slide_batches

    def _rows(self) -> Tensor:
        """Return the slide of each sensor in each row (sensor, row), in the order of the epoch."""
        seeded = torch.Generator().manual_seed(self.seed)
        pair_generator = None if self.pairing != "fixed" and self.shuffle else seeded
        rows = self._pair_rows(pair_generator)
        order = torch.randperm(rows.shape[1], generator=None if self.shuffle else seeded)
        return rows[:, order]

    def _pair_rows(self, generator: torch.Generator | None) -> Tensor:
        """Return slide indices (sensor, row): rows of one class each, then one row per slide without a label.

        The index of a missing slide is `NONE`.
        """
        blocks = []
        first = next(iter(self.classes.values()))
        all_classes = {int(number) for classes in self.classes.values() for number in set(classes.tolist())} - {NONE}
        for number in sorted(all_classes):
            members = []
            for classes in self.classes.values():
                sensor_class = number if classes is first or self.partners is None else self.partners[number]
                class_slides = (classes == sensor_class).nonzero()[:, 0]
                members.append(class_slides[torch.randperm(len(class_slides), generator=generator)])
            blocks.append(_stack_padded(members))
        for sensor_index, classes in enumerate(self.classes.values()):
            unlabelled = (classes == NONE).nonzero()[:, 0]
            block = torch.full((len(self.classes), len(unlabelled)), NONE)
            block[sensor_index] = unlabelled
            blocks.append(block)
        return torch.cat(blocks, dim=1)


def uses_batch(number: int, percent: int) -> bool:
    """Return whether a subsampled sensor learns from the batch with this number, from 0.

    The published code uses batches whose number is a multiple of 2, 4, 6 or 9 for 50, 25, 17 and 11 %, i.e. 288, 160,
    96 and 64 of 576 slides. For 90 %, which is no multiple, every tenth batch is skipped here, which uses 512.

    >>> [32 * sum(uses_batch(i, percent) for i in range(18)) for percent in (100, 90, 50, 25, 17, 11)]
    [576, 512, 288, 160, 96, 64]
    """
    if percent == 90:
        return number % 10 != 0
    return percent == 100 or number % BATCH_STEPS[percent] == 0


def permuted_classes(classes: Sequence[int], seed: int) -> dict[int, int]:
    """Return a different partner class for each class, for permuted pairs; all partners are distinct.

    Raises `TacpipeError` for fewer than two classes.
    """
    if len(classes) < 2:
        raise TacpipeError(f"{len(classes)} material cannot be paired with another one; permuted needs two or more.")
    order = np.random.default_rng([seed, 1]).permutation(np.array(sorted(classes)))
    return {int(number): int(partner) for number, partner in zip(order, np.roll(order, 1), strict=True)}


def _stack_padded(members: Sequence[Tensor]) -> Tensor:
    """Return index tensors as rows of one tensor (member, index), the shorter ones padded with NONE."""
    longest = max(map(len, members))
    block = torch.full((len(members), longest), NONE)
    for row, indices in zip(block, members, strict=True):
        row[: len(indices)] = indices
    return block


Network = RecurrentAutoencoder | RecurrentClassifier
TEMPERATURE = 0.1  # published temperature of the contrastive loss
CHUNK = 128  # slides per forward pass without gradients


@dataclass(frozen=True)
class Weights:
    """Weights of the losses (0.01, 1, 1 in section IV of the paper), and the first epoch with alignment."""

    reconstruction: float = 0.01
    classification: float = 1.0
    alignment: float = 1.0  # 0 to train sensors independently
    align_from: int = 20  # first epoch with alignment, from 0
    # pairs: align slides in the same row; contrast: align slides of one class against all others
    alignment_loss: str = "pairs"

    def __post_init__(self) -> None:
        """Raise an error for an unknown alignment loss."""
        if self.alignment_loss not in ("pairs", "contrast"):
            raise TacpipeError(f"alignment_loss is {self.alignment_loss!r}; it must be pairs or contrast.")


@dataclass(frozen=True)
class ScaledSlides:
    """Slides of one sensor as network input."""

    frames: Tensor  # (slide, time, channel), scaled
    classes: Tensor  # (slide,), from 0; NONE if unlabelled

    def batch(self, indices: Tensor) -> Tensor:
        """Return the frames of the chosen slides (time, slide, channel)."""
        return self.frames[indices].transpose(0, 1).contiguous()


@dataclass
class _EpochSums:
    """Sums over the batches of one epoch."""

    values: dict[str, Tensor | float] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)

    def add(self, name: str, mean: Tensor, count: int) -> None:
        self.values[name] = self.values.get(name, 0.0) + to_float64(mean) * count
        self.counts[name] = self.counts.get(name, 0) + count

    def mean(self, name: str) -> float | None:
        return float(self.values[name]) / self.counts[name] if self.counts.get(name) else None


class JointWork:
    """Training of networks of one or more sensors, jointly if ``weights.alignment`` is above 0.

    Each sensor's network minimises the mean squared reconstruction error and the negative log-likelihood of the
    classes. From epoch ``align_from`` it also minimises the mean squared difference between its latents and those of
    other sensors' slides in the same row of the batch (Gao et al. 2020, section IV). The network of ``frozen_sensor``
    is not trained: other sensors' latents are aligned to its latents, without using their classes. Joint networks are
    selected together by mean validation accuracy over sensors, others separately; ties select the later epoch.
    """

    def __init__(
        self,
        training: Mapping[str, ScaledSlides],
        validation: Mapping[str, ScaledSlides],
        pairs: BatchPairs,
        weights: Weights,
        frozen_sensor: str = "",
        drop_last: bool = False,
    ) -> None:
        """Store the slides of each sensor, their pairs and the weights; ``frozen_sensor`` is not trained."""
        self.training, self.validation, self.pairs, self.weights = training, validation, pairs, weights
        self.frozen_sensor, self.drop_last = frozen_sensor, drop_last
        self._sums = _EpochSums()

    @property
    def joint(self) -> bool:
        """Whether latents of different sensors are aligned."""
        return self.weights.alignment > 0 and len(self.training) > 1

    def batches(self, epoch: int) -> list[dict[str, Tensor]]:
        """Return the batches of an epoch: for each sensor the slide in each row (row,), or NONE."""
        self._sums = _EpochSums()
        return self.pairs.epoch()

    def loss(self, model: nn.Module, batch: Mapping[str, Tensor], epoch: int) -> tuple[Tensor, int]:
        """Return the sum of all losses of a batch, and its number of rows."""
        output, total = {}, torch.zeros(())
        for sensor, rows in batch.items():
            indices = rows[rows != NONE]
            if len(indices):
                output[sensor], loss = self._sensor_losses(sensor, model.get_submodule(sensor), indices)
                total = total.to(loss.device) + loss
        if self.joint:
            aligned = self._pair_loss(batch, output)
            if self.weights.alignment_loss == "contrast":
                aligned = self._contrastive_loss(batch, output)
            if aligned is not None and epoch >= self.weights.align_from:
                total = total + self.weights.alignment * aligned
        return total, max(int((rows != NONE).sum()) for rows in batch.values())

    def _sensor_losses(self, sensor: str, network: nn.Module, indices: Tensor) -> tuple[NetworkOutput, Tensor]:
        """Return the output of a sensor's network for the chosen slides, and its losses without alignment."""
        slides, weights = self.training[sensor], self.weights
        frames, classes = slides.batch(indices), slides.classes[indices]
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
            if not self.frozen_sensor:  # a sensor aligned to a frozen one does not use its classes
                total = total + weights.classification * loss
        if output.frames is not None:
            loss = nn.functional.mse_loss(output.frames, frames)
            self._sums.add(f"{sensor}.reconstruction", loss, len(indices))
            total = total + weights.reconstruction * loss
        return output, total

    def _pair_loss(self, batch: Mapping[str, Tensor], output: Mapping[str, NetworkOutput]) -> Tensor | None:
        """Return the mean squared difference of latents in rows that two sensors share, or None if there are none.

        It is averaged over pairs of sensors.
        """
        pair_losses = []
        for sensor, partner in combinations(output, 2):
            latents, valid = zip(
                *(self._latents_by_row(batch[name], output[name], name) for name in (sensor, partner)), strict=True
            )
            in_both = valid[0] & valid[1]
            if in_both.any():
                pair_losses.append(nn.functional.mse_loss(latents[0][in_both], latents[1][in_both]))
        if not pair_losses:
            return None
        mean = torch.stack(pair_losses).mean()
        self._sums.add("alignment", mean, 1)
        return mean

    def _contrastive_loss(self, batch: Mapping[str, Tensor], output: Mapping[str, NetworkOutput]) -> Tensor | None:
        """Return the contrastive loss between two sensors' slides of the same class, against all others; None without pairs.

        This is the supervised contrastive loss (Khosla et al., Supervised Contrastive Learning, 2020, equation 2)
        between sensors: cosine similarities of latents divided by a temperature, with one term per slide and direction.
        A row has the class of its first sensor, so that permuted pairs are aligned as paired.
        """
        first = next(iter(batch))
        classes = torch.where(batch[first] != NONE, self.training[first].classes.cpu()[batch[first]], NONE)
        losses = []
        for sensor, partner in permutations(output, 2):
            (from_, valid), (to, partner_valid) = (
                self._latents_by_row(batch[name], output[name], name) for name in (sensor, partner)
            )
            has_class, partner_has_class = (
                (classes != NONE).to(valid.device) & valid,
                (classes != NONE).to(partner_valid.device) & partner_valid,
            )
            is_same_class = (
                classes.to(valid.device)[has_class][:, None] == classes.to(valid.device)[partner_has_class]
            )  # (slide, other slide)
            in_pairs = is_same_class.any(dim=1)
            if in_pairs.any():
                cosines = (
                    nn.functional.normalize(from_[has_class], dim=1)
                    @ nn.functional.normalize(to[partner_has_class], dim=1).t()
                )
                shares = nn.functional.log_softmax(cosines / TEMPERATURE, dim=1)[in_pairs]
                counted = is_same_class[in_pairs]
                losses.append(-((shares * counted).sum(dim=1) / counted.sum(dim=1)).mean())
        return torch.stack(losses).mean() if losses else None

    def _latents_by_row(self, rows: Tensor, output: NetworkOutput, sensor: str) -> tuple[Tensor, Tensor]:
        """Return latents (row, latent), and a mask of rows with a labelled slide."""
        filled = rows != NONE
        latents = output.latents.new_zeros(len(rows), output.latents.shape[1])
        latents[filled.to(latents.device)] = output.latents
        valid = filled.clone()
        valid[filled] = (self.training[sensor].classes[rows[filled]] != NONE).cpu()
        return latents, valid.to(latents.device)

    def validate(self, model: nn.Module) -> Validated:
        """Return the epoch's training losses, and losses and accuracy of each sensor on its validation slides."""
        evaluated = {
            sensor: self._evaluate_network(model.get_submodule(sensor), slides)
            for sensor, slides in self.validation.items()
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
    def _evaluate_network(self, network: nn.Module, slides: ScaledSlides) -> dict[str, float]:
        """Return accuracy and mean losses of a network on labelled slides, NaN without any."""
        labelled = (slides.classes != NONE).nonzero()[:, 0]
        if self.drop_last:
            # fewer slides than a batch are all counted
            labelled = labelled[: len(labelled) // self.pairs.batch * self.pairs.batch or None]
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
        decodes = getattr(network, "DECODES", True)
        return {**measures, "reconstruction": reconstruction / count} if decodes else measures

    def ranks(self, line: Line) -> dict[str, tuple[float, ...]]:
        """Return the error rate on validation slides as the rank of an epoch; ties select the later epoch."""
        wrong = {sensor: 1 - measures["accuracy"] for sensor, measures in line["val"].items()}
        later = -line["epoch"]
        if self.joint:
            return {"": (sum(wrong.values()) / len(wrong), later)}
        return {f"{sensor}.": (rate, later) for sensor, rate in wrong.items()}
