"""Take the pictures of the viewer in the docs: `make viewer-pictures`, under a virtual screen.

The script simulates recordings, trains quickly, and draws them with Rerun's viewer, without a GPU.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

IMAGES = Path(__file__).parent / "images"
SIZE, PORT, SCREEN = "1440x900", 9955, ":78"
TIMEOUT_S = 120.0
COMMANDS = (
    "simulate forward --trials 6 --duration-s 8 -o data/recordings",
    "synchronize data/recordings -o data/synced",
    "segment contacts data/synced -o data/segments",
    "segment slips data/segments -o data/slips",
    "split data/segments -o data/split --scheme random",
    "train forward data/segments --split data/split -o models/forward --epochs 2 --stride 2",
    "predict models/forward data/segments -o data/predictions",
    "simulate touch --trials 12 -o data/pinched",
    "segment grasps data/pinched -o data/grasps",
    "split data/grasps -o data/grasps-split --scheme random",
    "train touch data/grasps --split data/grasps-split -o models/touch --preset quick",
    "predict models/touch data/grasps -o data/touched",
    "simulate material --trials 96 --materials 4 -o data/slid",
    "segment slides data/slid -o data/slides",
    "split data/slides -o data/slides-split --stratify sensor,material",
    "train material data/slides --split data/slides-split -o models/material",
    "evaluate models/material data/slides -o results/material",
    "simulate gel --trials 2 -o data/gels",
    "extract markers data/gels --rows 7 --columns 9 -o data/markers",
)
PICTURES = {  # picture -> command of the viewer, and the time at the cursor (s)
    "view-forward": ("view data/slips trial-00[0-4]", 5.1),
    "view-forecast": ("view data/slips trial-000 --predictions data/predictions", 1.4),
    "view-material": ("view data/slides trial-001 --predictions results/material", 0.9),
    "view-gel": ("view data/markers trial-000 --video data/gels", 3.2),
    "view-touch": ("view data/pinched trial-000 --predictions data/touched", None),
}


def run(command: str, folder: Path) -> None:
    """Run a tacpipe command in a folder."""
    subprocess.run(
        [sys.executable, "-m", "tacpipe", *command.split()], cwd=folder, check=True, stdout=subprocess.DEVNULL
    )


@contextlib.contextmanager
def screen() -> Iterator[None]:
    """Run a virtual screen with software graphics during the block."""
    os.environ |= {"DISPLAY": SCREEN, "LIBGL_ALWAYS_SOFTWARE": "1", "WINIT_X11_SCALE_FACTOR": "1"}
    with subprocess.Popen(["Xvfb", SCREEN, "-screen", "0", f"{SIZE}x24"], stderr=subprocess.DEVNULL) as server:
        try:
            yield
        finally:
            server.terminate()


def picture(files: Sequence[Path], at_s: float | None, output: Path) -> None:
    """Open files in the viewer, set the cursor, and write a picture of its window."""
    from tacpipe.viewer import session

    command = [session.program(), *map(str, files), "--port", str(PORT), "--window-size", SIZE]
    with subprocess.Popen(command, env=session.environment(), stderr=subprocess.DEVNULL) as viewer:
        try:
            client = connect()
            time.sleep(10)
            if at_s is not None:
                client.set_time("time", duration=at_s, play_state="paused")
            time.sleep(8)
            client.save_screenshot(str(output))
            deadline_s = time.monotonic() + TIMEOUT_S
            while not output.exists() and time.monotonic() < deadline_s:
                time.sleep(0.2)
            time.sleep(2)
        finally:
            viewer.terminate()


def connect() -> Any:
    """Return a client of the viewer, after the viewer has opened a recording."""
    from rerun.experimental import ViewerClient

    deadline_s = time.monotonic() + TIMEOUT_S
    while True:
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{PORT}/proxy")
            client.get_state()
        except Exception:
            if time.monotonic() > deadline_s:
                raise
            time.sleep(0.5)
        else:
            return client


def reduce_colours(file: Path) -> None:
    """Reduce a picture to 128 colours, which takes a third of the bytes."""
    from PIL import Image

    with Image.open(file) as image:
        image.convert("RGB").quantize(128).save(file, optimize=True)


def main() -> None:
    """Take all pictures."""
    with tempfile.TemporaryDirectory() as workspace, screen():
        folder = Path(workspace)
        (folder / ".tacpipe").mkdir()
        for command in COMMANDS:
            run(command, folder)
        run("show data/slips trial-000 --plot plot.png", folder)
        (IMAGES / "plot.png").write_bytes((folder / "plot.png").read_bytes())
        for name, (command, at_s) in PICTURES.items():
            run(f"{command} --save {name}", folder)
            picture(sorted((folder / name).iterdir()), at_s, folder / f"{name}.png")
            (IMAGES / f"{name}.png").write_bytes((folder / f"{name}.png").read_bytes())
            reduce_colours(IMAGES / f"{name}.png")
        reduce_colours(IMAGES / "plot.png")


if __name__ == "__main__":
    main()
