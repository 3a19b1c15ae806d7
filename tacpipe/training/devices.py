"""Choose the device for training networks: the CPU or one accelerator.

The device is not part of any key, but records contain it. A training uses one device.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Literal

from tacpipe.errors import UsageError

Device = Literal["auto", "cpu", "cuda", "mps"]
AUTO: Device = "auto"
CPU, CUDA, MPS = "cpu", "cuda", "mps"
Precision = Literal["float32", "bfloat16"]
VISIBLE_GPUS = "CUDA_VISIBLE_DEVICES"  # CUDA's variable for the visible GPUs, separated by commas
_GPUS = Path("/proc/driver/nvidia/gpus")  # NVIDIA's driver creates one folder here per GPU

_device: ContextVar[Device] = ContextVar("device", default=AUTO)


@contextlib.contextmanager
def use_device(device: Device) -> Iterator[None]:
    """Train networks in the block on ``device``; ``auto`` is CUDA if there is a GPU.

    Raises `UsageError` if this computer lacks the device, and under ``torchrun``.
    """
    _reject_torchrun()
    if device != AUTO:
        _require_available(device)
    token = _device.set(device)
    try:
        yield
    finally:
        _device.reset(token)


def kind() -> str:
    """Return the kind of device for training: cpu, cuda or mps. With ``auto`` it is cpu until torch is imported."""
    device = _device.get()
    if device != AUTO:
        return device
    torch = sys.modules.get("torch")
    return CUDA if torch is not None and torch.cuda.is_available() else CPU


def gpu_for(worker: int) -> dict[str, str]:
    """Return the environment variable that restricts ``worker`` (from 0) to one GPU; empty with fewer than two GPUs.

    Workers are assigned the visible GPUs in turn, so that concurrent trainings do not share a GPU while another is
    idle.
    """
    visible = os.environ.get(VISIBLE_GPUS)
    if visible is None:
        names = [str(number) for number in range(len(list(_GPUS.iterdir())))] if _GPUS.is_dir() else []
    else:
        names = [name.strip() for name in visible.split(",") if name.strip()]
    return {VISIBLE_GPUS: names[worker % len(names)]} if len(names) > 1 else {}


def _require_available(device: Device) -> None:
    """Raise `UsageError` if this computer has no such device."""
    import torch

    available = {CPU: True, CUDA: torch.cuda.is_available(), MPS: torch.backends.mps.is_available()}
    if not available[device]:
        names = ", ".join(name for name, is_available in available.items() if is_available)
        raise UsageError(
            f"device is {device}, and this computer or this build of torch has none; it has {names}. "
            f"Leave --device out to use what there is."
        )


def _reject_torchrun() -> None:
    """Raise `UsageError` in one of several processes that ``torchrun`` started."""
    size = os.environ.get("WORLD_SIZE", "1")
    if "TORCHELASTIC_RUN_ID" in os.environ and size != "1":
        raise UsageError(
            f"torchrun has started {size} processes, and a training run uses one process and one device. Run the command "
            f"without torchrun; --jobs trains several folds at the same time, each on a GPU of its own."
        )
