"""Compute the result pages of a release: `make result-pages DATA=FOLDER`.

Runs DVC's chain of each task on the published recordings in ``DATA``, in ``.cache/result-pages``, and copies the pages to
``dist/results``. An interrupted run resumes: DVC skips finished stages, and tacpipe what it has computed within one.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[1]
SETS = {  # of a task: the folders that its set has in DATA
    "forward": ("xela_flat_pick_move",),
    "material": ("biotac_slide_20_50", "roboskin_slide_20_50"),
    "touch": ("vision2tactile",),
}


def published(params: dict[str, Any], data: Path) -> dict[str, Any]:
    """Return the params of all tasks for the published recordings in ``data``, as ``params.yaml`` describes them."""
    folder = {name: data / name for names in SETS.values() for name in names}
    forward, material, touch = (dict(params[task]) for task in SETS)
    forward["recordings"] = f"ingest xela-flat {folder['xela_flat_pick_move']} --replace"
    forward["synchronize"] = {**forward["synchronize"], "grid": "logged"}
    material = _by_authors(material)
    material["sources"] = {
        "biotac": f"ingest biotac-slide {folder['biotac_slide_20_50']} --replace",
        "roboskin": f"ingest roboskin {folder['roboskin_slide_20_50']} --replace",
    }
    touch = _estimated(touch)
    touch["recordings"] = f"ingest vision2tactile {folder['vision2tactile']} --replace"
    objects = [path for path in folder["vision2tactile"].iterdir() if path.is_dir()]
    touch["objects"] = list(range(len(objects)))
    return {**params, "forward": forward, "material": material, "touch": touch}


def _by_authors(block: Any) -> Any:
    """Return params whose k-fold splits are the authors' own."""
    if not isinstance(block, dict):
        return block
    if block.get("scheme") == "kfold":
        block = {name: value for name, value in block.items() if name != "folds"} | {"scheme": "authors"}
    return {name: _by_authors(value) for name, value in block.items()}


def _estimated(block: Any) -> Any:
    """Return params whose wrist is estimated wherever it is given."""
    if not isinstance(block, dict):
        return block
    return {
        name: "estimated" if name == "wrist" and value == "given" else _estimated(value)
        for name, value in block.items()
    }


def main(data: Path, tasks: list[str]) -> None:
    """Compute the pages of ``tasks``; raises `SystemExit` with a sentence where a set is missing."""
    missing = [name for task in tasks for name in SETS[task] if not (data / name).is_dir()]
    if missing:
        raise SystemExit(
            f"{data} has no folder {', '.join(missing)}; data/README.md lists where the sets are published."
        )
    work, out = ROOT / ".cache" / "result-pages", ROOT / "dist" / "results"
    (work / "docs" / "tasks").mkdir(parents=True, exist_ok=True)
    out.mkdir(parents=True, exist_ok=True)
    for name in ("dvc.yaml", "docs/tasks/horizons.json"):
        shutil.copy(ROOT / name, work / name)
    params = published(yaml.safe_load((ROOT / "params.yaml").read_text(encoding="utf-8")), data.resolve())
    (work / "params.yaml").write_text(yaml.safe_dump(params, sort_keys=False), encoding="utf-8")
    programs = Path(sys.executable).parent
    dvc, environment = programs / "dvc", {**os.environ, "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}"}
    if not (work / ".dvc").exists():
        subprocess.run([dvc, "init", "--no-scm", "-q"], cwd=work, check=True)
    for task in tasks:
        subprocess.run([dvc, "repro", task], cwd=work, env=environment, check=True)
        shutil.copy(work / "results" / f"{task}.html", out)
        print(out / f"{task}.html")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:] or list(SETS))
