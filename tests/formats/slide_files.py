"""Slides in the layouts of the published sets, small and made up."""

from pathlib import Path

import numpy as np

from tacpipe.formats.roboskin import scramble

ARM = {
    "cp": "posx,posy,posz,ox,oy,oz, ow",
    "cv": "x,y,z,a,b,c",
    "cw": "fx,fy,fz,tx,ty,tz",
    "jp": ",".join(f"pa{joint}" for joint in range(1, 8)),
    "jt": ",".join(f"ta{joint}" for joint in range(1, 8)),
    "jv": ",".join(f"va{joint}" for joint in range(1, 8)),
}
FINGER = ["tdc", "tac", "pdc", *(f"pac{n}" for n in range(1, 23)), *(f"ele{n}" for n in range(1, 20))]
SECOND = 1_581_072_654  # UTC time at which slides begin


def stamp(nanoseconds: int) -> str:
    """Return so many nanoseconds after `SECOND` as the files have them."""
    return f"{SECOND + nanoseconds // 10**9}.{nanoseconds % 10**9:09d}"


def write_biotac(folder: Path, material: int = 3, trial: int = 7, rows: int = 6, arm: bool = True) -> Path:
    """Write a slide, its counts 0, 1, 2, … row by row; returns the finger's file."""
    folder.mkdir(parents=True, exist_ok=True)
    values = np.arange(rows * len(FINGER)).reshape(rows, len(FINGER)).tolist()
    lines = [",".join([stamp(10_000_001 * n), *map(str, row)]) + "," for n, row in enumerate(values)]
    path = folder / f"mat{material}_{trial}_bio.csv"
    path.write_text("\n".join(["timestamp," + ",".join(FINGER), *lines]) + "\n")
    for place, (end, names) in enumerate(ARM.items() if arm else ()):
        width = names.count(",") + 1
        numbers = np.arange(rows * width).reshape(rows, width) / 8
        cells = [[f"{value:g}" for value in row] for row in numbers.tolist()]
        if end == "cv":
            cells = [[*row[:3], "-nan", "-nan", "-nan"] for row in cells]
        lines = [",".join([stamp(6_000_000 * n + place), *row]) for n, row in enumerate(cells)]
        (folder / f"mat{material}_{trial}_{end}.csv").write_text("\n".join([f"timestamp,{names}", *lines]) + "\n")
    return path


def touched(slides: int = 3, frames: int = 75, seed: int = 0) -> np.ndarray:
    """Return slides that touch some taxels of some triangles, (slide, triangle, taxel, time), from 0 to 200."""
    rng = np.random.default_rng(seed)
    level = rng.uniform(0, 160, (slides, 6, 10, 1)) * (rng.random((slides, 6, 10, 1)) < 0.5)
    waves = 1 + 0.2 * np.sin(np.arange(frames) / 7 + rng.uniform(0, 6, (slides, 6, 10, 1)))
    return np.asarray(level * waves, dtype=np.float32)


def write_roboskin(folder: Path, slides: np.ndarray, name: str = "fold_0", labels: np.ndarray | None = None) -> Path:
    """Write a block as it is published, scrambled, and its labels; returns the block's file."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"icub_{name}.npy"
    np.save(path, scramble(slides))
    np.save(folder / f"labels_{name}.npy", np.arange(len(slides)) if labels is None else labels)
    return path
