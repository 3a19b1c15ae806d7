"""What networks are trained on: the processor or accelerators, one or several. No part of any key; records state it."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Literal

from tacpipe.errors import UsageError

Device = Literal["auto", "cpu", "cuda", "mps"]
AUTO: Device = "auto"
CPU, CUDA, MPS = "cpu", "cuda", "mps"
Precision = Literal["float32", "bfloat16"]


@dataclass(frozen=True)
class Compute:
    """What was asked for: a kind of device, ``auto`` for CUDA where there is one, and how many of it."""

    device: Device = AUTO
    devices: int = 1


_chosen: ContextVar[Compute] = ContextVar("compute", default=Compute())  # noqa: B039  (it is frozen)


def current() -> Compute:
    """Return what the work at hand was given."""
    return _chosen.get()


@contextlib.contextmanager
def given(compute: Compute) -> Iterator[None]:
    """Have networks in the block trained on this. Raises `UsageError` where this computer does not have it."""
    if compute.device != AUTO or compute.devices > 1:
        _check(compute)
    before = _chosen.set(compute)
    try:
        yield
    finally:
        _chosen.reset(before)


def kind() -> str:
    """Return the kind of device that networks are trained on: cpu, cuda or mps; it is cpu as long as torch is not loaded."""
    asked = current().device
    if asked != AUTO:
        return asked
    torch = sys.modules.get("torch")
    return CUDA if torch is not None and torch.cuda.is_available() else CPU


def _check(compute: Compute) -> None:
    """Raise `UsageError` where this computer has no such device, or not as many."""
    import torch

    has = {CPU: True, CUDA: torch.cuda.is_available(), MPS: torch.backends.mps.is_available()}
    if not has.get(compute.device, True):
        there = ", ".join(name for name, found in has.items() if found)
        raise UsageError(
            f"device is {compute.device}, and this computer or this build of torch has none; it has {there}. "
            f"Leave --device out to use what there is."
        )
    asked = CUDA if compute.device == AUTO and has[CUDA] else compute.device
    counts = {CUDA: torch.cuda.device_count(), MPS: 1}  # the processor takes any number of processes
    here = int(os.environ.get("LOCAL_WORLD_SIZE", compute.devices))  # torchrun counts those of all computers
    if here > counts.get(asked, here):
        raise UsageError(
            f"--devices is {compute.devices}, and this computer has {counts[asked]} of {asked}. "
            f"Give --devices {counts[asked]}, or --device cpu to train in {compute.devices} processes of the processor."
        )
