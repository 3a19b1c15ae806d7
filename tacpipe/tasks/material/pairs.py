"""Batches of slides of unlike sensors that are learned from together: each row holds one material.

No slide of one sensor belongs to one of another; all that a pair shares is its material. So the latents are drawn
together by labels, and a pairing of *other* materials serves as the control: see `permuted_classes`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tacpipe.errors import TacpipeError

NONE = -1  # stands where a sensor has no slide in a row of a batch, and for the class of a slide without label
PAIRINGS = ("random", "fixed", "permuted")
EVERY = {50: 2, 25: 4, 17: 6, 11: 9}  # percentage of the batches for a subsampled sensor: 1 of how many that is


@dataclass(frozen=True)
class Pairs:
    """How the slides of all sensors are distributed over the batches of each epoch."""

    classes: Mapping[str, Tensor]  # sensor -> class of each slide, from 0; NONE for slides without label
    batch: int
    pairing: str = "random"  # random: other pairs every epoch; fixed: drawn once; permuted: random, of other classes
    shuffle: bool = True  # other batches every epoch; without, pairs are fixed as well
    drop_last: bool = False  # leave out the batch that is not full
    subsample_sensor: str = ""  # sensor that learns from a part of the batches alone
    subsample_percent: int = 100  # percentage of the batches
    partners: Mapping[int, int] | None = None  # class of the first sensor -> class of the others, of permuted pairs
    seed: int = 0  # seed of the pairs and orders that are drawn once

    def __post_init__(self) -> None:
        """Refuse options that do not fit."""
        if self.pairing not in PAIRINGS:
            raise TacpipeError(f"pairing is {self.pairing!r}; it must be {', '.join(PAIRINGS)}.")
        if self.subsample_percent not in (100, 90, *EVERY):
            raise TacpipeError(
                f"subsample_percent is {self.subsample_percent}; it must be 100, 90, {', '.join(map(str, EVERY))}."
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
        """Return the batches of an epoch: for each sensor the slide in every row of the batch, NONE where it has none.

        What is random comes from torch's generator, and what is drawn once from ``seed``. Rows without any slide are
        left out, and so are batches without.
        """
        rows = self._rows()  # (sensor, row)
        size = self.batch
        batches = [rows[:, first : first + size] for first in range(0, rows.shape[1], size)]
        if (self.drop_last or self.subsample_sensor) and batches and batches[-1].shape[1] < size:
            batches.pop()
        slide_batches = []
        for number, batch in enumerate(batches):
            slides_by_sensor = dict(zip(self.classes, batch.clone(), strict=True))
            if self.subsample_sensor and not visited(number, self.subsample_percent):
                slides_by_sensor[self.subsample_sensor][:] = NONE
            if any((slide_rows != NONE).any() for slide_rows in slides_by_sensor.values()):
                slide_batches.append(slides_by_sensor)
        return slide_batches

    def _rows(self) -> Tensor:
        """Return the slide of each sensor in every row (sensor, row), in the order of the epoch."""
        seeded = torch.Generator().manual_seed(self.seed)
        pairs = None if self.pairing != "fixed" and self.shuffle else seeded
        rows = self._paired(pairs)
        order = torch.randperm(rows.shape[1], generator=None if self.shuffle else seeded)
        return rows[:, order]

    def _paired(self, generator: torch.Generator | None) -> Tensor:
        """Return rows (sensor, row) of one class each, those without label at the end, alone in their rows."""
        blocks = []
        first = next(iter(self.classes.values()))
        all_classes = sorted({int(c) for classes in self.classes.values() for c in set(classes.tolist()) if c != NONE})
        for number in all_classes:
            members = []
            for classes in self.classes.values():
                sensor_class = number if classes is first or self.partners is None else self.partners[number]
                at = (classes == sensor_class).nonzero()[:, 0]
                members.append(at[torch.randperm(len(at), generator=generator)])
            blocks.append(_side_by_side(members))
        for place, classes in enumerate(self.classes.values()):
            unlabelled = (classes == NONE).nonzero()[:, 0]
            block = torch.full((len(self.classes), len(unlabelled)), NONE)
            block[place] = unlabelled
            blocks.append(block)
        return torch.cat(blocks, dim=1)


def visited(number: int, percent: int) -> bool:
    """Return whether a subsampled sensor learns from the batch of this number, from 0.

    The published code takes batches whose number is a multiple of 2, 4, 6 or 9 for 50, 25, 17 and 11 %, and so 288, 160,
    96 and 64 of 576 slides. No such number gives 90 %; here each tenth batch is left out, which gives 512.

    >>> [32 * sum(visited(i, percent) for i in range(18)) for percent in (100, 90, 50, 25, 17, 11)]
    [576, 512, 288, 160, 96, 64]
    """
    if percent == 90:
        return number % 10 != 0
    return percent == 100 or number % EVERY[percent] == 0


def permuted_classes(classes: Sequence[int], seed: int) -> dict[int, int]:
    """Return another class for each class, all different and none its own: the partners of a permuted pairing.

    Raises `TacpipeError` with fewer than two classes.
    """
    if len(classes) < 2:
        raise TacpipeError(f"{len(classes)} material cannot be paired with another one; permuted needs two or more.")
    order = np.random.default_rng([seed, 1]).permutation(np.array(sorted(classes)))
    return {int(number): int(partner) for number, partner in zip(order, np.roll(order, 1), strict=True)}


def _side_by_side(members: Sequence[Tensor]) -> Tensor:
    """Return what may be of unlike lengths as rows of one tensor, NONE at the end of the shorter."""
    longest = max(map(len, members))
    block = torch.full((len(members), longest), NONE)
    for row, indices in zip(block, members, strict=True):
        row[: len(indices)] = indices
    return block
