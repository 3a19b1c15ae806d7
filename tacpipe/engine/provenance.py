"""Describe the processor, threads and software that computed a result. Stored with results; never part of a key or digest.

The last digit of a sum depends on them: the processor's instructions determine the matrix kernels, and each thread sums
its own part.
"""

from __future__ import annotations

import contextlib
import functools
import os
import platform
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from tacpipe.errors import UsageError
from tacpipe.io.hashing import digest, remembered_file_digest
from tacpipe.plugins import architectures, registry
from tacpipe.plugins.stage import AnyStage
from tacpipe.store.records import Environment, Processor, Provenance, RunProvenance, StageIdentity, Summary
from tacpipe.training import devices

_CPUINFO = Path("/proc/cpuinfo")
# instruction sets from which OpenBLAS, oneDNN, torch and numpy select kernels
_INSTRUCTIONS = ("avx", "avx2", "fma", "avx512f", "avx512bw", "avx512_bf16", "amx_tile", "asimd", "sve", "sve2")
# environment variables that select kernels
_CHOSEN = ("OPENBLAS_CORETYPE", "ATEN_CPU_CAPABILITY", "ONEDNN_MAX_CPU_ISA", "MKL_CBWR", "NPY_DISABLE_CPU_FEATURES")
JOBS = "TACPIPE_JOBS"  # number of processes of a command without --jobs, or with 0
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# Waiting threads of OpenMP sleep. By default they spin for 3 ms: on a core that another program uses, they spin instead of
# the thread for which they wait. OpenMP reads the variable when torch is imported, which happens after this module.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def describe_processor() -> Processor:
    """Return the processor's ``model``, vector ``instructions``, kernels ``chosen`` by variables, and ``threads``."""
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
    """Divide the cores among this number of processes started in the block."""
    variables = each_of(processes)
    os.environ.update(variables)
    try:
        yield
    finally:
        for name in variables:
            os.environ.pop(name, None)


def each_of(processes: int) -> dict[str, str]:
    """Return the variables that assign each of several processes its part of the cores; empty if one is already set.

    If each process had as many threads as there are cores, threads would wait for one another.
    """
    if any(name in os.environ for name in THREADS):
        return {}
    return dict.fromkeys(THREADS, str(max(1, usable_cores() // max(1, processes))))


def jobs() -> int:
    """Return the default number of processes of a command: the value of `JOBS`, else one per usable core.

    Raises `UsageError` if `JOBS` is not a positive integer.
    """
    setting = os.environ.get(JOBS, "")
    if not setting:
        return usable_cores()
    if not setting.isdecimal() or not int(setting):
        raise UsageError(f"{JOBS} is {setting!r}; it must be a number of processes, 1 or more.")
    return int(setting)


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1  # macOS


@functools.cache
def _processor() -> Processor:
    """Return the model of the first core, and those of `_INSTRUCTIONS` that it supports."""
    values: dict[str, str] = {}  # values for the first core
    try:
        with _CPUINFO.open(encoding="utf-8", errors="replace") as lines:
            for line in lines:
                name, _, value = line.partition(":")
                if not value:
                    break
                values[name.strip().lower()] = value.strip()
    except OSError:  # macOS
        pass
    flags = set(f"{values.get('flags', '')} {values.get('features', '')}".split())
    return {
        "model": values.get("model name") or platform.processor() or platform.machine(),
        "instructions": [name for name in _INSTRUCTIONS if name in flags],
    }


_worker: ContextVar[str] = ContextVar("worker", default="")
_LIBRARIES = ("numpy", "pandas", "pyarrow", "scikit-learn", "tacpipe", "torch")


@functools.cache
def _environment() -> Provenance:
    """Return the versions of libraries and Python, the git commit if there is one, and the host."""
    import subprocess
    from importlib.metadata import PackageNotFoundError, version

    libraries = {}
    for name in _LIBRARIES:
        try:
            libraries[name] = version(name)
        except PackageNotFoundError:
            continue
    git = ["git", "rev-parse", "HEAD"]
    try:
        commit = subprocess.run(git, capture_output=True, text=True, check=False, timeout=5).stdout.strip()
    except (OSError, subprocess.SubprocessError):  # git is not installed or does not respond in time
        commit = ""
    return {
        "libraries": libraries,
        "git_commit": commit or None,
        "host": platform.node(),
        "python": sys.version.split()[0],
    }


def describe_provenance(seconds: float) -> Provenance:
    """Return libraries, git commit, host, device, processor and worker of this process, and a duration in ``seconds``."""
    environment: Provenance = {
        **_environment(),
        "device": devices.kind(),
        "processor": describe_processor(),
        "seconds": seconds,
    }
    return {**environment, "worker": _worker.get()} if _worker.get() else environment


def describe_run(summary: Summary) -> RunProvenance:
    """Return the provenance of the results of a command or a group of recordings from their ``summary``."""
    environment: Environment = describe_provenance(0.0)
    return {**environment, **summary}


@contextlib.contextmanager
def worker(name: str) -> Iterator[None]:
    """Record ``name`` as the executor's worker for results computed in the block."""
    token = _worker.set(name)
    try:
        yield
    finally:
        _worker.reset(token)


def environment_differences(stored: Environment, now: Environment) -> list[str]:
    """Return sentences on the differences between two computers that affect rounding.

    Differences that ``stored`` does not record are left out.

    >>> environment_differences({"processor": {"threads": 1}}, {"processor": {"threads": 2}})
    ['threads: 1, now 2']
    """
    differences = []
    for name in ("device", "processor", "libraries"):
        stored_value, current_value = stored.get(name), now.get(name)
        if isinstance(stored_value, Mapping) and isinstance(current_value, Mapping):
            compared = [
                (quantity, stored_value.get(quantity), current_value.get(quantity))
                for quantity in sorted({*stored_value, *current_value})
            ]
        else:
            compared = [(name, stored_value, current_value)] if stored_value and current_value else []
        differences += [f"{quantity}: {_text(old)}, now {_text(new)}" for quantity, old, new in compared if old != new]
    return differences


def _text(value: Any) -> str:
    if isinstance(value, Mapping):
        value = [f"{name}={value[name]}" for name in sorted(value)]
    return " ".join(map(str, value)) if isinstance(value, list) else str(value if value is not None else "none")


def code(stage: AnyStage) -> str | None:
    """Return the digest of the file with a stage's function, or None if it cannot change on its own.

    An installed built-in stage changes only with the version of tacpipe.
    """
    name = stage.function.__module__
    file = getattr(sys.modules.get(name), "__file__", None)
    built_in = name.partition(".")[0] in ("tacpipe", "tacpipe_stages")
    if file is None or (built_in and any(part.endswith("-packages") for part in Path(file).parts)):
        return None
    try:
        return remembered_file_digest(file)
    except OSError:  # the file was removed while the program runs
        return None


def code_of_packages(identity: StageIdentity, used: Iterable[str] = ()) -> dict[str, str]:
    """Return the code digest of each plug-in package that takes part in a result, by package name.

    These are the packages ``used`` by the stage and those of the architectures named in its ``identity``.
    """
    lineages = (value.get("lineage") or {} for value in identity["inputs"].values() if isinstance(value, Mapping))
    params = [identity["params"], *(lineage.get("params") or {} for lineage in lineages)]
    packages = {
        str(values[architectures.PLUGIN]).partition(" ")[0] for values in params if architectures.PLUGIN in values
    }
    codes = {package: registry.package_code(package) for package in sorted({*used, *packages})}
    return {package: code for package, code in codes.items() if code is not None}


def code_of_training() -> str:
    """Return the digest of all code that may take part in a training: tacpipe and every plug-in package."""
    return digest({package: registry.package_code(package) for package in (registry.OWN, *registry.plugin_packages())})
