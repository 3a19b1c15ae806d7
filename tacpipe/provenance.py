"""Where and with what something was made: kept beside results, no part of any key or digest."""

from __future__ import annotations

import functools
import platform
import sys
from pathlib import Path
from typing import Any

from tacpipe.executors import usable_cores
from tacpipe.hashing import remembered_file_digest
from tacpipe.stage import Stage

_LIBRARIES = ("numpy", "pandas", "pyarrow", "scikit-learn", "tacpipe", "torch")


@functools.cache
def _here() -> dict[str, Any]:
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
    except OSError:
        commit = ""
    return {
        "libraries": libraries,
        "git_commit": commit or None,
        "host": platform.node(),
        "python": sys.version.split()[0],
        "threads": usable_cores(),
    }


def of(seconds: float) -> dict[str, Any]:
    """Return libraries, git commit, host, device and threads of this process, and the ``seconds`` that something took."""
    torch = sys.modules.get("torch")
    device = "cuda" if torch is not None and torch.cuda.is_available() else "cpu"
    return {**_here(), "device": device, "seconds": seconds}


def code(stage: Stage) -> str | None:
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
