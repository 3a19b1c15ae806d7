"""The training loop: Adam, clipped gradients, early stopping, and a checkpoint after every epoch.

Batches are rows of tensors picked by index, so no loader stands between the data and the step. All randomness
(first weights, dropout, shuffles) comes from torch's generator under one seed, whose state is part of the checkpoint:
a run that was killed and resumed gives the same bits as one that was not.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from tacpipe.errors import TacpipeError
from tacpipe.progress import bar
from tacpipe.training import checkpoint

RISE = 0.3  # share of all epochs over which the learning rate of a cycle rises
Loss = Callable[[nn.Module, Tensor], Tensor]  # mean loss of the windows with these indices


@dataclass(frozen=True)
class Schedule:
    """How long and how fast to train."""

    epochs: int
    batch: int
    learning_rate: float
    patience: int  # epochs without a better validation loss after which training ends
    gradient_clip: float  # largest norm of the gradient
    seed: int
    cycle: bool = False  # whether the rate rises over the first part of all epochs and falls over the rest

    def __post_init__(self) -> None:
        """Refuse what cannot be trained with."""
        for name in ("epochs", "batch", "patience", "learning_rate", "gradient_clip"):
            if not getattr(self, name) > 0:
                raise TacpipeError(f"{name} is {getattr(self, name)}; it must be above 0.")

    def rate(self, progress: float) -> float:
        """Return the learning rate when ``progress`` of all epochs has passed, from 0 to 1.

        With ``cycle`` it rises from a 25th to its peak and falls to nothing, both along a cosine (Smith and Topin,
        Super-convergence, 2018): the fall makes up for stopping early on few validation recordings.
        """
        if not self.cycle:
            return self.learning_rate
        if progress < RISE:
            return self.learning_rate * (1 / 25 + (1 - 1 / 25) * (1 - math.cos(math.pi * progress / RISE)) / 2)
        return self.learning_rate * (1 + math.cos(math.pi * (progress - RISE) / (1 - RISE))) / 2


@dataclass(frozen=True)
class Part:
    """Training or validation windows: how many, and the mean loss of some."""

    count: int
    loss: Loss


@dataclass(frozen=True)
class Trained:
    """The weights of the epoch with the lowest validation loss, and the losses of all epochs."""

    weights: dict[str, Tensor]
    history: list[dict[str, float | int | bool]]

    @property
    def history_lines(self) -> bytes:
        """The history as JSON lines, one an epoch."""
        return "".join(json.dumps(line) + "\n" for line in self.history).encode()


@dataclass
class _Run:
    """What an epoch changes; all of it is in the checkpoint."""

    model: nn.Module
    optimiser: torch.optim.Adam
    best: dict[str, Tensor]
    history: list[dict[str, float | int | bool]]

    def save(self, folder: Path) -> None:
        slots = self.optimiser.state_dict()["state"]
        tensors = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        tensors |= {f"best.{name}": value for name, value in self.best.items()}
        tensors |= {f"adam.{slot}.{name}": value for slot, held in slots.items() for name, value in held.items()}
        tensors["random"] = torch.get_rng_state()
        checkpoint.write(folder, tensors, {"history": self.history})

    def resume(self, folder: Path) -> None:
        found = checkpoint.read(folder)
        if found is None:
            return
        tensors, state = found
        self.model.load_state_dict(_under("model.", tensors))
        self.best = _under("best.", tensors)
        slots: dict[int, dict[str, Tensor]] = {}
        for name, value in _under("adam.", tensors).items():
            slot, held = name.split(".", 1)
            slots.setdefault(int(slot), {})[held] = value
        self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": slots})
        torch.set_rng_state(tensors["random"])
        self.history = state["history"]

    def over(self, schedule: Schedule) -> bool:
        if len(self.history) >= schedule.epochs:
            return True
        since = next((i for i, line in enumerate(reversed(self.history)) if line["best"]), 0)
        return since >= schedule.patience


def train(
    build: Callable[[], nn.Module],
    training: Part,
    validation: Part,
    schedule: Schedule,
    workspace: Path,
    *,
    weight_decay: float = 0.0,
) -> Trained:
    """Return the best weights of the model that ``build`` makes, trained to lower ``training``'s loss.

    ``weight_decay`` is Adam's: this share of each weight is added to its gradient.
    Goes on from the checkpoint in ``workspace`` if there is one. Leaves torch's own generator as it was.
    Raises `TacpipeError` where a part has no windows or the loss is no longer finite.
    """
    for name, part in (("training", training), ("validation", validation)):
        if not part.count:
            raise TacpipeError(
                f"The {name} recordings hold no window. Give more or longer ones, or shorten context and horizon."
            )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(schedule.seed)
        model = build()
        optimiser = torch.optim.Adam(
            model.parameters(), lr=schedule.learning_rate, weight_decay=weight_decay, fused=True
        )
        run = _Run(model, optimiser, {}, [])
        run.resume(workspace)
        with bar("train", schedule.epochs) as advance:
            advance(len(run.history))
            while not run.over(schedule):
                line = _epoch(run, training, validation, schedule)
                run.save(workspace)
                advance(1, f"validation {line['val_loss']:.5f}")
    return Trained({name: value.cpu() for name, value in run.best.items()}, run.history)


def _epoch(run: _Run, training: Part, validation: Part, schedule: Schedule) -> dict[str, float | int | bool]:
    """Train for one epoch, add its line to the history and return it."""
    run.model.train()
    total: Tensor | float = 0.0
    steps = -(-training.count // schedule.batch)
    for step, indices in enumerate(_batches(torch.randperm(training.count), schedule.batch)):
        for group in run.optimiser.param_groups:
            group["lr"] = schedule.rate((len(run.history) + step / steps) / schedule.epochs)
        loss = training.loss(run.model, indices)
        run.optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(run.model.parameters(), schedule.gradient_clip)
        run.optimiser.step()
        total = total + loss.detach().double() * len(indices)
    line: dict[str, float | int | bool] = {
        "epoch": len(run.history) + 1,
        "train_loss": float(total) / training.count,
        "val_loss": _mean_loss(run.model, validation, schedule.batch),
    }
    if not math.isfinite(line["train_loss"]) or not math.isfinite(line["val_loss"]):
        raise TacpipeError(
            f"The loss is {line['train_loss']} in epoch {line['epoch']}: training diverged. Lower the learning rate."
        )
    line["best"] = line["val_loss"] < min((float(old["val_loss"]) for old in run.history), default=math.inf)
    if line["best"]:
        run.best = {name: value.detach().clone() for name, value in run.model.state_dict().items()}
    run.history.append(line)
    return line


@torch.no_grad()
def _mean_loss(model: nn.Module, part: Part, batch: int) -> float:
    """Return the mean loss over all windows of ``part``."""
    model.eval()
    total: Tensor | float = 0.0
    for indices in _batches(torch.arange(part.count), batch):
        total = total + part.loss(model, indices).double() * len(indices)
    return float(total) / part.count


def _batches(indices: Tensor, batch: int) -> Iterator[Tensor]:
    """Yield the indices in pieces of ``batch``, the last maybe shorter."""
    for first in range(0, len(indices), batch):
        yield indices[first : first + batch]


def _under(prefix: str, tensors: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries whose name begins with ``prefix``, without it."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
