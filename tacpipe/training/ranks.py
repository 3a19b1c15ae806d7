"""One training in several processes, its ranks: each computes a part of every batch, and all take the same step.

Every rank draws the whole batch, gives its network a part of the rows, and gathers what the networks of all ranks
return. So each has the loss of the whole batch, whatever it compares or averages, and its gradient by the rank's own
rows; the sum of these over ranks is the gradient that one process computes, but for the order in which numbers are
added. Layers that draw for a batch or average over it ask `tacpipe.models.batch`. A batch of fewer rows than ranks is
computed by each of them.

Rank 0 alone reads and writes checkpoints, decides which epoch was the best, and has followers.
"""

from __future__ import annotations

import contextlib
import functools
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextvars import ContextVar
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch import distributed as dist
from torch.distributed.rendezvous import rendezvous

from tacpipe.errors import TacpipeError
from tacpipe.models import batch
from tacpipe.models.batch import Part, Rows

T = TypeVar("T")
FAILURES = (RuntimeError, dist.DistError)  # of an operation of ranks of which one has ended
NEVER = timedelta(days=365)


class Alone:
    """The only process of a training."""

    rank, size = 0, 1

    def agreed(self, make: Callable[[], T]) -> T:
        """Return what rank 0 makes."""
        return make()

    def sharing(self, model: nn.Module) -> contextlib.AbstractContextManager[None]:
        """Have the networks of ``model`` compute this rank's part of each batch in the block, and return all of it."""
        return contextlib.nullcontext()

    def sum_gradients(self, weights: Iterable[nn.Parameter]) -> None:
        """Add up the gradients of all ranks."""


class Rank(Alone):
    """One of several processes of a training, which have joined one group of `torch.distributed`."""

    def __init__(self) -> None:
        self.rank, self.size = dist.get_rank(), dist.get_world_size()

    def agreed(self, make: Callable[[], T]) -> T:
        """Return what rank 0 makes."""
        found: list[Any] = [make() if self.rank == 0 else None]
        dist.broadcast_object_list(found, 0, device=torch.device("cpu"))
        made: T = found[0]
        return made

    @contextlib.contextmanager
    def sharing(self, model: nn.Module) -> Iterator[None]:
        """Have the networks of ``model`` compute this rank's part of each batch in the block, and return all of it.

        Raises `TacpipeError` for a model that has weights outside of networks with ``ROWS``.
        """
        networks = list(_networks(model))
        known = {id(weight) for one in networks for weight in one.parameters()}
        if any(id(weight) not in known for weight in model.parameters() if weight.requires_grad):
            raise TacpipeError(
                f"{type(model).__name__} cannot be trained on {self.size} devices: it does not declare the rows of a batch "
                f"(ROWS, see tacpipe.models.batch). Train it on one."
            )
        for one in networks:
            one.forward = partial(self._shared, one.forward, one.ROWS)  # type: ignore[arg-type]
        try:
            yield
        finally:
            for one in networks:
                del one.forward

    def sum_gradients(self, weights: Iterable[nn.Parameter]) -> None:
        """Add up the gradients of all ranks: one sum for all weights."""
        gradients = [weight.grad for weight in weights if weight.grad is not None]
        if not gradients:
            return
        flat = torch.cat([one.flatten() for one in gradients])
        dist.all_reduce(flat)
        for one, summed in zip(gradients, torch.split(flat, [one.numel() for one in gradients]), strict=True):
            one.copy_(summed.view_as(one))

    def _shared(self, forward: Callable[..., Any], rows: Rows, *given: Any, **options: Any) -> Any:
        whole = next(_tensors(given)).shape[rows.given]
        if whole < self.size:
            return _each(forward(*given, **options), rows.returned, lambda one, dim: _applied(_Replica, one, self.size))
        counts = [len(one) for one in torch.arange(whole).tensor_split(self.size)]
        first, count = sum(counts[: self.rank]), counts[self.rank]
        own = _narrowed(given, rows.given, first, count)
        with batch.computing(Part(first, count, whole, partial(_applied, _Sum))):
            made = forward(*own, **options)
        return _each(made, rows.returned, lambda one, dim: _applied(_Gathered, one, dim, counts, self.rank))


ALONE = Alone()
_current: ContextVar[Alone | None] = ContextVar("rank", default=None)
_start: ContextVar[Callable[[], None] | None] = ContextVar("start", default=None)


@contextlib.contextmanager
def available(start: Callable[[], None]) -> Iterator[None]:
    """Have the first training in the block call ``start``, which begins other ranks and calls `join`; leave at the end."""
    before, rank = _start.set(start), _current.set(None)
    try:
        yield
    finally:
        _start.reset(before)
        _current.reset(rank)
        if dist.is_initialized():
            with contextlib.suppress(RuntimeError):  # of a group whose ranks have died
                dist.destroy_process_group()


def join(store: Any, rank: int, size: int, device: str, local: int) -> None:
    """Join the group of ranks that meet at a store; ``local`` is the number of the rank on its computer."""
    if device == "cuda":
        torch.cuda.set_device(local)
    backend = "cpu:gloo,cuda:nccl" if device == "cuda" else "gloo"
    dist.init_process_group(backend, store=store, rank=rank, world_size=size)
    _current.set(Rank())


def current() -> Alone:
    """Return what this process is in the training at hand, having begun the other ranks where some were asked for."""
    start, found = _start.get(), _current.get()
    if found is None and start is not None:
        start()
        found = _current.get()
    return found or ALONE


def folder_store(place: Path, size: int) -> Any:
    """Return where ranks of this computer meet: a file in a folder that other users cannot read, and no port."""
    if sys.platform == "linux":
        os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    return dist.FileStore(str(place), size)  # type: ignore[attr-defined]


@functools.cache
def launched_store() -> Any:
    """Return where the processes meet that ``torchrun`` has started."""
    return next(rendezvous("env://", timeout=NEVER))[0]


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """Have this process compute with so many threads in the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _networks(model: nn.Module) -> Iterator[nn.Module]:
    """Yield the networks that declare the rows of a batch, and none within another."""
    if hasattr(model, "ROWS"):
        yield model
        return
    for child in model.children():
        yield from _networks(child)


def _tensors(values: Any) -> Iterator[Tensor]:
    for one in values:
        if isinstance(one, Tensor):
            yield one
        elif isinstance(one, tuple):
            yield from _tensors(one)


def _narrowed(values: Any, dim: int, first: int, count: int) -> Any:
    """Return tensors, and tuples of tensors, cut to some rows of dimension ``dim``."""
    if isinstance(values, Tensor):
        return values.narrow(dim, first, count)
    made = [_narrowed(one, dim, first, count) for one in values]
    return type(values)(*made) if hasattr(values, "_fields") else tuple(made)


def _each(made: Any, dims: Sequence[int], change: Callable[[Tensor, int], Any]) -> Any:
    """Return a tensor, or a named tuple of tensors and None, with each tensor changed by its dimension of the rows."""
    if isinstance(made, Tensor):
        return change(made, dims[0])
    return type(made)(*(None if one is None else change(one, dim) for one, dim in zip(made, dims, strict=True)))


def _applied(function: type[torch.autograd.Function], *given: Any) -> Any:
    return function.apply(*given)  # type: ignore[no-untyped-call]


class _Gathered(torch.autograd.Function):
    """The rows of all ranks, one behind the other; of the gradient each rank takes that of its own rows."""

    @staticmethod
    def forward(ctx: Any, own: Tensor, dim: int, counts: Sequence[int], rank: int) -> Tensor:
        ctx.place = dim, sum(counts[:rank]), counts[rank]
        rows = own.detach().movedim(dim, 0).float().contiguous()
        sent = rows.new_zeros(max(counts), *rows.shape[1:])
        sent[: len(rows)] = rows
        found = [torch.empty_like(sent) for _ in counts]
        dist.all_gather(found, sent)
        whole = torch.cat([one[:count] for one, count in zip(found, counts, strict=True)])
        return whole.movedim(0, dim).to(own.dtype)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None, None]:
        return gradients[0].narrow(*ctx.place), None, None, None


class _Replica(torch.autograd.Function):
    """What each of the ranks has computed alike: of the gradient each takes its fraction."""

    @staticmethod
    def forward(ctx: Any, own: Tensor, size: int) -> Tensor:
        ctx.size = size
        return own.view_as(own)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0] / ctx.size, None


class _Sum(torch.autograd.Function):
    """The sum over ranks, each of which passes on what the sum's gradient is on all of them."""

    @staticmethod
    def forward(ctx: Any, own: Tensor) -> Tensor:
        summed = own.detach().clone().contiguous()
        dist.all_reduce(summed)
        return summed

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        summed = gradients[0].clone().contiguous()
        dist.all_reduce(summed)
        return summed
