"""The processor and the number of threads that numbers are computed with, on which the last digit of a sum depends.

Matrix kernels are chosen by the processor's instructions, and each thread adds up its own part: either changes the order of
additions, and so how they round.
"""

from __future__ import annotations

import contextlib
import functools
import os
import platform
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tacpipe.errors import UsageError

_CPUINFO = Path("/proc/cpuinfo")
# those that the kernels of OpenBLAS, oneDNN, torch and numpy are chosen by
_INSTRUCTIONS = ("avx", "avx2", "fma", "avx512f", "avx512bw", "avx512_bf16", "amx_tile", "asimd", "sve", "sve2")
# variables that choose kernels by name
_CHOSEN = ("OPENBLAS_CORETYPE", "ATEN_CPU_CAPABILITY", "ONEDNN_MAX_CPU_ISA", "MKL_CBWR", "NPY_DISABLE_CPU_FEATURES")
JOBS = "TACPIPE_JOBS"  # processes of a command that is given no --jobs, or 0
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def describe() -> dict[str, Any]:
    """Return the processor's ``model``, its vector ``instructions``, kernels ``chosen`` by variables, and ``threads``."""
    chosen = {name: os.environ[name] for name in _CHOSEN if name in os.environ}
    return {**_processor(), "chosen": chosen, "threads": threads()}


def threads() -> int:
    """Return the number of threads that this process computes with."""
    torch = sys.modules.get("torch")
    if torch is not None:
        return int(torch.get_num_threads())
    settings = (os.environ.get(name, "") for name in THREADS)
    return next((int(text) for text in settings if text.isdecimal() and int(text)), usable_cores())


@contextlib.contextmanager
def shared_by(processes: int) -> Iterator[None]:
    """Have processes that start in the block compute with `each_of` so many."""
    variables = each_of(processes)
    os.environ.update(variables)
    try:
        yield
    finally:
        for name in variables:
            os.environ.pop(name, None)


def each_of(processes: int) -> dict[str, str]:
    """Return the variables that give each of so many processes its part of the cores; none where the environment has one.

    Of several processes with as many threads each as there are cores, most threads wait for one another.
    """
    if any(name in os.environ for name in THREADS):
        return {}
    return dict.fromkeys(THREADS, str(max(1, usable_cores() // max(1, processes))))


def jobs() -> int:
    """Return the default number of processes of a command: the value of `JOBS`, else one per usable core.

    Raises `UsageError` where `JOBS` is no number above 0.
    """
    setting = os.environ.get(JOBS, "")
    if not setting:
        return usable_cores()
    if not setting.isdecimal() or not int(setting):
        raise UsageError(f"{JOBS} is {setting!r}; it must be a number of processes, 1 or more.")
    return int(setting)


def jobs_of(commands: int) -> dict[str, str]:
    """Return the variable that gives each of so many commands its part of the cores; none where the environment has it."""
    return {} if JOBS in os.environ else {JOBS: str(max(1, usable_cores() // max(1, commands)))}


def usable_cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1  # macOS


@functools.cache
def _processor() -> dict[str, Any]:
    values: dict[str, str] = {}  # Values of the first core
    try:
        with _CPUINFO.open(encoding="utf-8", errors="replace") as lines:
            for line in lines:
                name, _, value = line.partition(":")
                if not value:
                    break
                values[name.strip().lower()] = value.strip()
    except OSError:  # macOS
        pass
    words = set(f"{values.get('flags', '')} {values.get('features', '')}".split())
    return {
        "model": values.get("model name") or platform.processor() or platform.machine(),
        "instructions": [name for name in _INSTRUCTIONS if name in words],
    }
