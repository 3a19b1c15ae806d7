"""How long `tacpipe view` takes for 10 minutes of 96 tactile channels and an arm at 1 kHz, and how large its file is.

    python benchmarks/viewer.py [--seconds 600] [--all-rows] [--window]

With ``--window``, the viewer opens the file on a virtual screen (Xvfb), drawn in software, as on a computer without a GPU:
printed are the seconds until the recording is there and the frames that it paints a second while it plays. Needs the extra
view. The file stays.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.channels import schema
from tacpipe.viewer import contents, session

SKIN_HZ, ARM_HZ, ARM = 50, 1000, 22
SIZE, SCREEN, PORT, FRAMES = "1440x900", ":79", 9957, 4
PATIENCE_S = 120.0


@dataclass
class Made:
    """A recording in memory."""

    tables: Mapping[str, pa.Table]
    name: str = "ten-minutes"
    attributes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def streams(self) -> tuple[str, ...]:
        """The names of its streams."""
        return tuple(self.tables)

    def table(self, stream: str = "") -> pa.Table:
        """Return a stream."""
        return self.tables[stream]


def recording(seconds: int) -> Made:
    """Return two fingers that are pressed every 20 s, and an arm that moves."""
    rng = np.random.default_rng(0)
    skin_s, arm_s = np.arange(seconds * SKIN_HZ) / SKIN_HZ, np.arange(seconds * ARM_HZ) / ARM_HZ
    pressed = 2000 * np.clip(np.sin(2 * np.pi * skin_s / 20), 0, 1)[:, None] * rng.uniform(0.2, 1, 48)
    counts = 16_000 + pressed + rng.normal(0, 3, (len(skin_s), 48))
    motion = np.stack([np.sin(2 * np.pi * arm_s / (7 + place)) for place in range(ARM)], axis=1)
    angles, speeds = schema.joint_fields()
    fields = [*angles, schema.float_field("finger_m", "m", "finger_width"), *speeds, *schema.pose_fields()]
    skin = schema.stream(stamps(skin_s), counts.T, schema.uskin_fields())
    return Made({"xela1": skin, "xela2": skin, "robot": schema.stream(stamps(arm_s), motion.T, fields)})


def stamps(seconds: Any) -> Any:
    """Return times in ns."""
    return 1_600_000_000_000_000_000 + (seconds * 1e9).astype(np.int64)


def in_window(file: Path) -> str:
    """Return how long the viewer takes to open a file, and how many frames a second it paints while it plays."""
    graphics = {"DISPLAY": SCREEN, "LIBGL_ALWAYS_SOFTWARE": "1", "WINIT_X11_SCALE_FACTOR": "1"}
    server = ["Xvfb", SCREEN, "-screen", "0", f"{SIZE}x24"]
    viewer = [session.program(), str(file), "--port", str(PORT), "--window-size", SIZE]
    with contextlib.ExitStack() as stack:
        for command in (server, viewer):
            environment = {**session.environment(), **graphics}
            process = stack.enter_context(subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL))
            stack.callback(process.terminate)
            begun_s = time.perf_counter()
        client = opened(begun_s + PATIENCE_S)
        opened_s = time.perf_counter() - begun_s
        client.set_time("time", duration=1.0, play_state="playing")
        trace = file.with_suffix(".puffin")
        client.capture_profile_trace(str(trace), num_frames=1)
        drawn_s = time.perf_counter()
        client.capture_profile_trace(str(trace), num_frames=FRAMES)
        rate_hz = FRAMES / (time.perf_counter() - drawn_s)
    return (
        f"{opened_s:.1f} s to open, {rate_hz:.1f} frames a second in software, "
        f"on {os.cpu_count()} cores with a load of {os.getloadavg()[0]:.1f}"
    )


def opened(until_s: float) -> Any:
    """Return a client of the viewer once it has loaded the recording and has views of it."""
    from rerun.experimental import ViewerClient

    while True:
        with contextlib.suppress(ConnectionError):
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{PORT}/proxy")
            state = client.get_state()
            if state.recordings and state.views and not state.loading:
                return client
        if time.perf_counter() > until_s:
            raise SystemExit(f"The viewer has not opened the file within {PATIENCE_S:g} s.")
        time.sleep(0.1)


def main() -> None:
    """Measure once and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=int, default=600)
    parser.add_argument("--all-rows", action="store_true")
    parser.add_argument("--window", action="store_true")
    options = parser.parse_args()
    made, folder = recording(options.seconds), Path(tempfile.mkdtemp())
    before_s = time.perf_counter()
    drawn = contents.of(made)  # type: ignore[arg-type]
    read_s = time.perf_counter()
    (file,) = session.write([drawn], folder, "long", several=False, all_rows=options.all_rows)
    done_s = time.perf_counter()
    print(
        f"{read_s - before_s:.1f} s to compute, {done_s - read_s:.1f} s to write, {file.stat().st_size / 1e6:.0f} MB: {file}"
    )
    if options.window:
        print(in_window(file))


if __name__ == "__main__":
    main()
