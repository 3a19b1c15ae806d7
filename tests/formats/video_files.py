"""Write trials as the published GelSight set has them."""

from __future__ import annotations

from pathlib import Path

from tests.video import videos

FRAMES = 12


def write_gelsight(place: Path, label: str = "lemon", trial: int = 1, *, slip: bool = False) -> Path:
    """Write a trial of two videos below ``place``, and return its folder."""
    folder = place / label / f"exp_num_{trial}"
    folder.mkdir(parents=True)
    for camera in (0, 2):
        videos.write(folder / f"camera_{camera}.avi", "mpeg4", FRAMES + trial + camera)
    if slip:
        (folder / "slip.txt").touch()
    return folder
