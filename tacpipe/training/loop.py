"""Train a network: Adam, gradient clipping, early stopping, and a checkpoint after every epoch.

A `TrainingWork` provides the batches, the loss, and the validation after each epoch. Batches are rows of tensors,
selected by index, so no data loader is needed. All randomness (initial weights, dropout, shuffling) comes from torch's
generator with one seed, whose state is part of the checkpoint: on a CPU, a run that was killed and resumed gives the
same bits as an uninterrupted run. A GPU adds in a different order each time.
"""

from __future__ import annotations

import contextlib
import functools
import json
import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn
from torch.optim.adam import adam

from tacpipe.errors import TacpipeError
from tacpipe.io import regular
from tacpipe.io.files import make_folder, readable_errors, sync_folder, write_whole
from tacpipe.io.hashing import bytes_digest
from tacpipe.models.tensors import tensors_under
from tacpipe.training import following
from tacpipe.training.following import Followers, NetworkLabels, TrainedNetwork, Validated
from tacpipe.training.following import Line as Line
from tacpipe.training.schedule import Schedule as Schedule

BETAS, EPSILON = (0.9, 0.999), 1e-8  # Adam's constants, as in the paper and torch's defaults


class Adam:
    """Update weights along their gradients; ``weight_decay`` of each weight is added to its gradient.

    Adam (Kingma and Ba, Adam: A Method for Stochastic Optimization, 2015), bit-identical to `torch.optim.Adam`.

    The first `torch.optim.Adam` of a process imports torch's compiler, which takes as long as torch itself: 1.2 s of
    CPU time, of some 6 s for a short training of one epoch. The function that it calls at each step needs none of it.
    """

    def __init__(self, weights: Iterable[Tensor], learning_rate: float, weight_decay: float = 0.0) -> None:
        self.weights = list(weights)
        self.learning_rate, self.weight_decay = learning_rate, weight_decay
        self._state: dict[int, dict[str, Tensor]] = {}

    def zero_grad(self) -> None:
        """Discard all gradients."""
        for weight in self.weights:
            weight.grad = None

    def step(self) -> None:
        """Update each weight that has a gradient, and its moments; others are not changed."""
        changed = [(number, weight) for number, weight in enumerate(self.weights) if weight.grad is not None]
        state = [self._moments(number) for number, _ in changed]
        with torch.no_grad():
            adam(
                [weight for _, weight in changed],
                [weight.grad for _, weight in changed if weight.grad is not None],
                [moments["exp_avg"] for moments in state],
                [moments["exp_avg_sq"] for moments in state],
                [],
                [moments["step"] for moments in state],
                fused=True,
                amsgrad=False,
                beta1=BETAS[0],
                beta2=BETAS[1],
                lr=self.learning_rate,
                weight_decay=self.weight_decay,
                eps=EPSILON,
                maximize=False,
            )

    def state(self) -> dict[int, dict[str, Tensor]]:
        """Return the moments of each weight that had a gradient, by its number: ``step``, ``exp_avg``, ``exp_avg_sq``."""
        return self._state

    def load(self, state: Mapping[int, Mapping[str, Tensor]]) -> None:
        """Restore what `state` returned, for weights in the same order, possibly on another device."""
        self._state = {
            number: {name: value.to(self.weights[number].device) for name, value in moments.items()}
            for number, moments in state.items()
        }

    def _moments(self, number: int) -> dict[str, Tensor]:
        """Return the state of the weight ``number``, which is zero before its first update."""
        if number not in self._state:
            weight = self.weights[number]
            self._state[number] = {
                "step": torch.zeros((), dtype=torch.float32, device=weight.device),
                "exp_avg": torch.zeros_like(weight, memory_format=torch.preserve_format),
                "exp_avg_sq": torch.zeros_like(weight, memory_format=torch.preserve_format),
            }
        return self._state[number]


FILE = "checkpoint"
log = logging.getLogger(__name__)


def write_checkpoint(folder: Path, tensors: Mapping[str, Tensor], history: Sequence[Line]) -> None:
    """Replace the checkpoint in ``folder`` atomically; on return it is on disk.

    Its first line is the digest of the rest, a safetensors file with the history as JSON in its header. A crash could
    separate two files, and training must not resume from weights that a disk has corrupted.
    """
    state = json.dumps({"history": history})
    content = save({name: tensor.cpu().contiguous() for name, tensor in tensors.items()}, {"state": state})
    signed = bytes_digest(content).encode() + b"\n" + content
    with readable_errors(folder):
        make_folder(folder)
        draft = folder / f"{FILE}.draft"
        draft.unlink(missing_ok=True)  # a killed run may have left a draft
        write_whole(str(folder / FILE), signed, str(draft), in_store=True)
        sync_folder(str(folder))


def read_checkpoint(folder: Path) -> tuple[dict[str, Tensor], list[Line]] | None:
    """Return the tensors and history of the checkpoint in ``folder``, or None if it does not exist or is damaged.

    Logs a warning for a damaged checkpoint.
    """
    path = folder / FILE
    try:
        signed = regular.content(path, follow=False)
    except FileNotFoundError:
        return None
    except (OSError, TacpipeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        log.warning("The checkpoint %s cannot be read (%s); training starts over.", path, reason)
        return None
    stored, _, content = signed.partition(b"\n")
    try:
        if bytes_digest(content).encode() != stored:
            raise ValueError("its bytes do not give its digest")
        size = int.from_bytes(content[:8], "little")
        state = json.loads(json.loads(content[8 : 8 + size])["__metadata__"]["state"])
        return load(content), state["history"]
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        log.warning("The checkpoint %s cannot be read (%s); training starts over.", path, error)
        return None


Loss = Callable[[nn.Module, Tensor], Tensor]  # returns the mean loss of the windows with these indices


@dataclass(frozen=True)
class WindowSet:
    """Training or validation windows: their number, and the mean loss of a selection."""

    count: int
    loss: Loss


class TrainingWork(Protocol):
    """Define a training: the batches of an epoch, the loss of each, and the validation after the epoch."""

    def batches(self, epoch: int) -> Sequence[Any]:
        """Return the batches of an epoch, from 0; randomness comes from torch's generator."""

    def loss(self, model: nn.Module, batch: Any, epoch: int) -> tuple[Tensor, int]:
        """Return the loss to minimise and the weight of the batch in the epoch's mean."""

    def validate(self, model: nn.Module) -> Validated:
        """Validate the model: return ``val_loss`` and further entries of the epoch's line."""

    def ranks(self, line: Line) -> Mapping[str, Sequence[float]]:
        """Return the rank of an epoch, lowest best, for each part of the model that is selected separately.

        A part is the common prefix of its weights' names; the part ``""`` is the full model.
        """


@dataclass(frozen=True)
class WindowTraining:
    """Define the training of most models: windows are shuffled every epoch, and the validation loss selects the best."""

    training: WindowSet
    validation: WindowSet
    batch: int

    def __post_init__(self) -> None:
        """Raise `TacpipeError` if a part has no windows."""
        for name, part in (("training", self.training), ("validation", self.validation)):
            if not part.count:
                raise TacpipeError(
                    f"The {name} recordings contain no window. Give more or longer recordings, or shorten context "
                    f"and horizon."
                )

    def batches(self, epoch: int) -> list[Tensor]:
        """Return the indices of all training windows, shuffled, in batches (window,)."""
        return list(_chunks(torch.randperm(self.training.count), self.batch))

    def loss(self, model: nn.Module, batch: Tensor, epoch: int) -> tuple[Tensor, int]:
        """Return the mean loss of the windows with these indices, and their number."""
        return self.training.loss(model, batch), len(batch)

    def validate(self, model: nn.Module) -> Validated:
        """Return the mean loss over all validation windows."""
        total: Tensor | float = 0.0
        for indices in _chunks(torch.arange(self.validation.count), self.batch):
            total = total + to_float64(self.validation.loss(model, indices)) * len(indices)
        return {"val_loss": float(total) / self.validation.count}

    def ranks(self, line: Line) -> dict[str, tuple[float]]:
        """Return the validation loss as the only criterion by which epochs are ranked."""
        return {"": (float(line["val_loss"]),)}


@dataclass(frozen=True)
class TrainingResult:
    """The weights of the best and the last epoch, and the history of all epochs."""

    weights: dict[str, Tensor]
    history: list[Line]
    last: dict[str, Tensor]


@dataclass
class _TrainingState:
    """The state that an epoch changes; all of it is in the checkpoint."""

    model: nn.Module
    optimiser: Adam
    best: dict[str, Tensor]
    history: list[Line]

    def save(self, folder: Path) -> None:
        """Save the model, its best weights, the state of Adam, the random generator and the history to a checkpoint."""
        slots = self.optimiser.state()
        tensors = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        tensors |= {f"best.{name}": value for name, value in self.best.items()}
        tensors |= {f"adam.{slot}.{name}": value for slot, moments in slots.items() for name, value in moments.items()}
        tensors["random"] = torch.get_rng_state()
        write_checkpoint(folder, tensors, self.history)

    def resume(self, folder: Path) -> None:
        """Restore the state of a checkpoint, if there is one in ``folder``."""
        saved = read_checkpoint(folder)
        if saved is None:
            return
        tensors, self.history = saved
        self.model.load_state_dict(tensors_under("model.", tensors))
        self.best = tensors_under("best.", tensors)
        slots: dict[int, dict[str, Tensor]] = {}
        for name, value in tensors_under("adam.", tensors).items():
            slot, tensor = name.split(".", 1)
            slots.setdefault(int(slot), {})[tensor] = value
        self.optimiser.load(slots)
        torch.set_rng_state(tensors["random"])

    def is_finished(self, schedule: Schedule) -> bool:
        if len(self.history) >= schedule.epochs:
            return True
        epochs_since_best = next((i for i, line in enumerate(reversed(self.history)) if line["best"]), 0)
        return epochs_since_best >= schedule.patience


def train(
    build: Callable[[], nn.Module],
    work: TrainingWork,
    schedule: Schedule,
    workspace: Path,
    *,
    weight_decay: float = 0.0,
    number: int = 1,
    count: int = 1,
    labels: NetworkLabels | None = None,
) -> TrainingResult:
    """Train the model that ``build`` creates on ``work``, and return the best weights.

    ``weight_decay`` is Adam's: this fraction of each weight is added to its gradient. Weights without gradients do not
    change. Training resumes from the checkpoint in ``workspace`` if there is one, and leaves torch's own generator
    unchanged. ``number`` of ``count`` and ``labels`` identify one of several networks to followers. Raises
    `TacpipeError` if the loss is not finite.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(schedule.seed)
        model = build()
        learned = [weight for weight in model.parameters() if weight.requires_grad]
        run = _TrainingState(model, Adam(learned, schedule.learning_rate, weight_decay), {}, [])
        run.resume(workspace)
        _train_epochs(run, work, schedule, workspace, TrainedNetwork(schedule.epochs, number, count, labels or {}))
    return TrainingResult(
        {name: value.cpu() for name, value in run.best.items()},
        run.history,
        {name: value.detach().cpu() for name, value in run.model.state_dict().items()},
    )


def _train_epochs(
    run: _TrainingState, work: TrainingWork, schedule: Schedule, workspace: Path, network: TrainedNetwork
) -> None:
    """Train all remaining epochs and report each to the followers."""
    random = torch.get_rng_state()
    with following.follow_network(network, list(run.history)) as followers:
        torch.set_rng_state(random)  # restores the state before the followers drew random numbers
        while not run.is_finished(schedule):
            epochs_trained = len(run.history)
            with following.announce_resume(network, epochs_trained):
                line = _train_epoch(run, work, schedule, followers)
                run.save(workspace)
            with torch.random.fork_rng(devices=[]):
                followers.line(line, schedule.rate_at_epoch(epochs_trained + 1))


def _train_epoch(run: _TrainingState, work: TrainingWork, schedule: Schedule, followers: Followers) -> Line:
    """Train for one epoch, append its metrics to the history and return them.

    The parts of the model that improved are copied to the best weights. Raises `TacpipeError` if a loss is not finite.
    """
    run.model.train()
    epoch = len(run.history)
    total: Tensor | float = 0.0
    count = 0
    batches = work.batches(epoch)
    reduced_precision = _reduced_precision(run.model, schedule)
    for step, batch in enumerate(batches):
        run.optimiser.learning_rate = schedule.rate((epoch + step / len(batches)) / schedule.epochs)
        with reduced_precision:
            loss, weight = work.loss(run.model, batch, epoch)
        run.optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if math.isfinite(schedule.gradient_clip):
            nn.utils.clip_grad_norm_(run.model.parameters(), schedule.gradient_clip)
        run.optimiser.step()
        total = total + to_float64(loss) * weight
        count += weight
        followers.batch((step + 1) / len(batches), functools.partial(_mean, total, count))
    run.model.eval()
    with torch.no_grad():
        validated = work.validate(run.model)
    line: Line = {"epoch": epoch + 1, "train_loss": _mean(total, count), **validated}  # type: ignore[typeddict-item]  # no labels
    if not math.isfinite(line["train_loss"]) or not math.isfinite(line["val_loss"]):
        raise TacpipeError(
            f"The loss is {line['train_loss']} in epoch {line['epoch']}: training diverged. Lower the learning rate."
        )
    improved = _improved_parts(work.ranks(line), [work.ranks(earlier) for earlier in run.history])
    line["best"] = bool(improved)
    if improved:
        state = run.model.state_dict().items()
        run.best |= {name: value.detach().clone() for name, value in state if name.startswith(tuple(improved))}
    run.history.append(line)
    return line


def _reduced_precision(model: nn.Module, schedule: Schedule) -> contextlib.AbstractContextManager[Any]:
    """Return a context in which products are computed in the precision of the schedule."""
    device = next(model.parameters()).device.type
    return torch.autocast(device, torch.bfloat16, enabled=schedule.precision == "bfloat16")


def to_float64(value: Tensor) -> Tensor:
    """Convert a value to float64 for summation, without waiting for the device; to float32 if the device has no float64."""
    return value.detach().to(torch.float32 if value.device.type == "mps" else torch.float64)


def _mean(total: Tensor | float, count: int) -> float:
    return float(total) / count


def _improved_parts(
    ranks: Mapping[str, Sequence[float]], ranks_before: Iterable[Mapping[str, Sequence[float]]]
) -> list[str]:
    """Return the parts of the model whose rank is lower than in all earlier epochs."""
    earlier = list(ranks_before)
    return [part for part, rank in ranks.items() if all(tuple(rank) < tuple(old[part]) for old in earlier)]


def _chunks(indices: Tensor, batch: int) -> Iterator[Tensor]:
    """Yield the indices (index,) in chunks of ``batch``; the last may be shorter."""
    for first in range(0, len(indices), batch):
        yield indices[first : first + batch]
