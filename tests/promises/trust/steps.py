"""One small chain for three tools: numbers are read from text, scaled, and summed; each step says what it computed.

    python -m tests.promises.trust.steps dvc load|scale|total [FACTOR]      one step between folders, as a stage of DVC
    python -m tests.promises.trust.steps joblib load|scale|total [FACTOR]   the chain up to a step, its values printed
    python -m tests.promises.trust.steps clean                              a cleaning of joblib's cache

What a test wants of a step stands in the environment, which is part of no tool's key.
"""

import json
import os
import sys
import time
from pathlib import Path

import numpy as np

STEPS = ("load", "scale", "total")
LOG = "TRUST_LOG"  # names a file that gets a line for every recording that a step begins to compute
GATE = "TRUST_GATE"  # "scale after rec-3 PATH": the step waits for the file PATH.open before, or after, it reads a recording
PAUSE = "TRUST_PAUSE_S"  # how long scaling takes
NOISE = "TRUST_NOISE"  # if set, scaling is not deterministic
PATIENCE_S = 60.0


def note_begin(step: str, recording: str) -> None:
    """Note that a step works on a recording, before it reads it."""
    with open(os.environ[LOG], "a") as file:
        file.write(f"{step} {recording or 'unnamed'}\n")  # tacpipe makes lost content again without its name
    _wait(step, "before", recording)


def parse_numbers(recording: str, text: str) -> np.ndarray:
    """Return the numbers of a text (time,)."""
    _wait("load", "after", recording)
    return np.array(text.split(), dtype=np.int64)


def multiply(recording: str, values: np.ndarray, factor: int) -> np.ndarray:
    """Return the numbers times the factor."""
    _wait("scale", "after", recording)
    time.sleep(float(os.environ.get(PAUSE, "0")))
    noise = int.from_bytes(os.urandom(2), "big") if os.environ.get(NOISE) else 0
    return np.asarray(values * factor + noise)


def _wait(step: str, when: str, recording: str) -> None:
    gate = os.environ.get(GATE, "").split(" ", 3)
    if gate[:3] != [step, when, recording]:
        return
    Path(f"{gate[3]}.reached").touch()
    deadline = time.monotonic() + PATIENCE_S
    while not Path(f"{gate[3]}.open").exists() and time.monotonic() < deadline:
        time.sleep(0.02)


# ---- as commands of DVC: from files to files


def load() -> None:
    """Turn texts into arrays."""
    for path in sorted(Path("raw").glob("*.txt")):
        note_begin("load", path.stem)
        np.save(Path("load") / path.stem, parse_numbers(path.stem, path.read_text()))


def scale(factor: int) -> None:
    """Scale arrays."""
    for path in sorted(Path("load").glob("*.npy")):
        note_begin("scale", path.stem)
        np.save(Path("scale") / path.stem, multiply(path.stem, np.load(path), factor))


def total() -> None:
    """Sum arrays."""
    note_begin("total", "all")
    sums = {path.stem: int(np.load(path).sum()) for path in sorted(Path("scale").glob("*.npy"))}
    Path("total.json").write_text(json.dumps(sums))


def _by_dvc(step: str, factor: int) -> None:
    if step == "total":
        total()
        return
    Path(step).mkdir(exist_ok=True)
    load() if step == "load" else scale(factor)


# ---- as functions that joblib remembers by their arguments: what is read is an argument, as joblib knows no files


def load_one(recording: str, text: str) -> np.ndarray:
    """Turn a text into an array."""
    note_begin("load", recording)
    return parse_numbers(recording, text)


def scale_one(recording: str, values: np.ndarray, factor: int) -> np.ndarray:
    """Scale an array."""
    note_begin("scale", recording)
    return multiply(recording, values, factor)


def total_all(values: dict[str, np.ndarray]) -> dict[str, int]:
    """Sum arrays."""
    note_begin("total", "all")
    return {name: int(array.sum()) for name, array in values.items()}


def _by_joblib(step: str, factor: int) -> object:
    from joblib import Memory, Parallel, delayed

    from tests.promises.trust import steps  # joblib names a function by its module, and this one is __main__

    memory = Memory("cache", verbose=0)
    loading = memory.cache(steps.load_one, ignore=["recording"])
    scaling = memory.cache(steps.scale_one, ignore=["recording"])
    texts = {path.stem: path.read_text() for path in sorted(Path("raw").glob("*.txt"))}
    parallel = Parallel(n_jobs=2)
    values = dict(zip(texts, parallel(delayed(loading)(*item) for item in texts.items()), strict=True))
    if step != "load":
        scaled_values = parallel(delayed(scaling)(*item, factor) for item in values.items())
        values = dict(zip(texts, scaled_values, strict=True))
    if step == "total":
        return memory.cache(steps.total_all)(values)
    return {name: array.tolist() for name, array in values.items()}


def main() -> None:
    """Do as the command line says."""
    tool, *arguments = sys.argv[1:]
    if tool == "clean":
        from joblib import Memory

        Memory("cache", verbose=0).reduce_size(bytes_limit=0)
        return
    step, factor = arguments[0], int(arguments[1]) if len(arguments) > 1 else 2
    if tool == "dvc":
        _by_dvc(step, factor)
    else:
        print(json.dumps(_by_joblib(step, factor)))


if __name__ == "__main__":
    main()
