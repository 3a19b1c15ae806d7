"""Take the pictures of the viewer in the docs: `make viewer-pictures`, under a virtual screen.

It simulates recordings, trains quickly, and has Rerun's viewer draw them in software, as on a computer without a GPU.
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
PATIENCE_S = 120.0
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
)
PICTURES = {  # the recordings of each, and the time at the cursor
    "view-forward": ("view data/slips trial-00[0-4]", 5.1),
    "view-forecast": ("view data/slips trial-000 --predictions data/predictions", 1.4),
    "view-material": ("view data/slides trial-001 --predictions results/material", 0.9),
    "view-touch": ("view data/pinched trial-000 --predictions data/touched", None),
}


def run(command: str, folder: Path) -> None:
    """Run a command of tacpipe in a folder."""
    subprocess.run(
        [sys.executable, "-m", "tacpipe", *command.split()], cwd=folder, check=True, stdout=subprocess.DEVNULL
    )


@contextlib.contextmanager
def screen() -> Iterator[None]:
    """Have a virtual screen while in the block, with graphics in software."""
    os.environ |= {"DISPLAY": SCREEN, "LIBGL_ALWAYS_SOFTWARE": "1", "WINIT_X11_SCALE_FACTOR": "1"}
    with subprocess.Popen(["Xvfb", SCREEN, "-screen", "0", f"{SIZE}x24"], stderr=subprocess.DEVNULL) as server:
        try:
            yield
        finally:
            server.terminate()


def picture(files: Sequence[Path], at_s: float | None, output: Path) -> None:
    """Have the viewer open files, set the cursor and take a picture of its window."""
    from tacpipe.viewer import session

    command = [session.program(), *map(str, files), "--port", str(PORT), "--window-size", SIZE]
    with subprocess.Popen(command, env=session.environment(), stderr=subprocess.DEVNULL) as viewer:
        try:
            client = connected()
            time.sleep(10)
            if at_s is not None:
                client.set_time("time", duration=at_s, play_state="paused")
            time.sleep(8)
            client.save_screenshot(str(output))
            until_s = time.monotonic() + PATIENCE_S
            while not output.exists() and time.monotonic() < until_s:
                time.sleep(0.2)
            time.sleep(2)
        finally:
            viewer.terminate()


def connected() -> Any:
    """Return a client of the viewer, once it has opened a recording."""
    from rerun.experimental import ViewerClient

    until_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{PORT}/proxy")
            client.get_state()
        except Exception:
            if time.monotonic() > until_s:
                raise
            time.sleep(0.5)
        else:
            return client


def small(file: Path) -> None:
    """Write a picture again with 128 colours, a third of its size."""
    from PIL import Image

    with Image.open(file) as image:
        image.convert("RGB").quantize(128).save(file, optimize=True)


def main() -> None:
    """Take all pictures."""
    with tempfile.TemporaryDirectory() as place, screen():
        folder = Path(place)
        (folder / ".tacpipe").mkdir()
        for command in COMMANDS:
            run(command, folder)
        run("show data/slips trial-000 --plot plot.png", folder)
        (IMAGES / "plot.png").write_bytes((folder / "plot.png").read_bytes())
        for name, (command, at_s) in PICTURES.items():
            run(f"{command} --save {name}", folder)
            picture(sorted((folder / name).iterdir()), at_s, folder / f"{name}.png")
            (IMAGES / f"{name}.png").write_bytes((folder / f"{name}.png").read_bytes())
            small(IMAGES / f"{name}.png")
        small(IMAGES / "plot.png")


if __name__ == "__main__":
    main()
