"""Write trials as the published GelSight set has them."""

from pathlib import Path

import numpy as np

from tests.video import gels, videos

FRAMES = 12


def write_gelsight(
    place: Path, label: str = "lemon", trial: int = 1, *, slip: bool = False, markers: bool = False
) -> Path:
    """Write a trial of two videos, of a gel with ``markers`` or not, below ``place``, and return its folder."""
    folder = place / label / f"exp_num_{trial}"
    folder.mkdir(parents=True)
    for camera in (0, 2):
        path, count = folder / f"camera_{camera}.avi", FRAMES + trial + camera
        if markers:
            images = [gels.image(gels.press(gels.places(), frame / count), frame) for frame in range(count)]
            videos.write_images(path, "mpeg4", np.array(images))
        else:
            videos.write(path, "mpeg4", count)
    if slip:
        (folder / "slip.txt").touch()
    return folder
