"""Describe where and with which software a result was computed; stored with results, part of no key or digest."""

from __future__ import annotations

import contextlib
import functools
import platform
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from tacpipe.engine import processor
from tacpipe.io.hashing import digest, remembered_file_digest
from tacpipe.plugins import architectures, registry
from tacpipe.plugins.stage import AnyStage
from tacpipe.training import devices

_worker: ContextVar[str] = ContextVar("worker", default="")
_LIBRARIES = ("numpy", "pandas", "pyarrow", "scikit-learn", "tacpipe", "torch")


@functools.cache
def _environment() -> dict[str, Any]:
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
    except (OSError, subprocess.SubprocessError):  # no git, or none that answers in time
        commit = ""
    return {
        "libraries": libraries,
        "git_commit": commit or None,
        "host": platform.node(),
        "python": sys.version.split()[0],
    }


def describe(seconds: float) -> dict[str, Any]:
    """Return libraries, git commit, host, device, processor and worker of this process, and a duration in ``seconds``."""
    environment = {**_environment(), "device": devices.kind(), "processor": processor.describe(), "seconds": seconds}
    return {**environment, "worker": _worker.get()} if _worker.get() else environment


@contextlib.contextmanager
def worker(name: str) -> Iterator[None]:
    """Have what is made in the block state the name of the executor's worker that made it."""
    token = _worker.set(name)
    try:
        yield
    finally:
        _worker.reset(token)


def unlike(stored: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return the differences between two computers that change rounding; empty if ``stored`` does not state them.

    >>> unlike({"device": "cpu", "processor": {"threads": 1}}, {"device": "cpu", "processor": {"threads": 2}})
    ['threads: 1, now 2']
    """
    differences = []
    for name in ("device", "processor", "libraries"):
        before, after = stored.get(name), now.get(name)
        if isinstance(before, Mapping) and isinstance(after, Mapping):
            parts = [(part, before.get(part), after.get(part)) for part in sorted({*before, *after})]
        else:
            parts = [(name, before, after)] if before and after else []
        differences += [f"{part}: {_text(old)}, now {_text(new)}" for part, old, new in parts if old != new]
    return differences


def _text(value: Any) -> str:
    if isinstance(value, Mapping):
        value = [f"{name}={value[name]}" for name in sorted(value)]
    return " ".join(map(str, value)) if isinstance(value, list) else str(value if value is not None else "none")


def code(stage: AnyStage) -> str | None:
    """Return the digest of the file that a stage's function is written in; None where it cannot change by itself.

    That is a built-in stage that was installed: it changes with the version of tacpipe alone.
    """
    name = stage.function.__module__
    file = getattr(sys.modules.get(name), "__file__", None)
    built_in = name.partition(".")[0] in ("tacpipe", "tacpipe_stages")
    if file is None or (built_in and any(part.endswith("-packages") for part in Path(file).parts)):
        return None
    try:
        return remembered_file_digest(file)
    except OSError:  # it was removed while it ran
        return None


def code_of_packages(identity: Mapping[str, Any], used: Iterable[str] = ()) -> dict[str, str]:
    """Return the digest of the code of each plug-in package that computes a result, by the package's name.

    These are the packages ``used`` by the stage and those of the architectures that its ``identity`` names.
    """
    lineages = (value.get("lineage") or {} for value in identity["inputs"].values() if isinstance(value, Mapping))
    params = [identity["params"], *(lineage.get("params") or {} for lineage in lineages)]
    packages = {
        str(values[architectures.PLUGIN]).partition(" ")[0] for values in params if architectures.PLUGIN in values
    }
    codes = {package: registry.package_code(package) for package in sorted({*used, *packages})}
    return {package: code for package, code in codes.items() if code is not None}


def code_of_training() -> str:
    """Return the digest of all code that may take part in a training: tacpipe's own and that of every plug-in package."""
    return digest({package: registry.package_code(package) for package in (registry.OWN, *registry.plugin_packages())})
