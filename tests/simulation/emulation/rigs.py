"""Rigs and links for tests of the emulator."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tacpipe.arrays import AnyArray
from tacpipe.recording import rig
from tacpipe.recording.rig import Rig

FOLDER = Path(__file__).parents[3] / "rigs"
ALL_SENSORS = rig.read(FOLDER / "all-sensors.toml")
FIRST_PAPER = rig.read(FOLDER / "first-paper.toml")
PATIENCE_S = 300.0  # of a test that waits for what comes at once on an idle machine: only what hangs takes so long


def one(sensor: str, transport: str = "serial:/dev/ttyUSB0", options: str = "{}", emulate: str = "{}") -> Rig:
    """Return a rig of one stream, ``load``."""
    lines = ["[[stream]]", 'name = "load"', f'sensor = "{sensor}"', f'transport = "{transport}"']
    return rig.parse("\n".join([*lines, f"options = {options}", f"emulate = {emulate}"]))


def awaited(found: Callable[[], Any]) -> Any:
    """Return what ``found`` returns once it is true; fails when that takes too long."""
    until = time.monotonic() + PATIENCE_S
    while not (value := found()):
        assert time.monotonic() < until, "what was awaited did not happen"
        time.sleep(0.01)
    return value


def in_order(rows: AnyArray, among: AnyArray) -> bool:
    """Return whether all of ``rows`` are found in ``among``, in this order, perhaps with others between."""
    left = iter(among)
    return len(rows) > 0 and all(any(np.array_equal(row, one) for one in left) for row in rows)
