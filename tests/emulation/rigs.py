"""Rigs and links for tests of the emulator."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tacpipe.arrays import AnyArray
from tacpipe.recording import rig
from tacpipe.recording.rig import Rig

FOLDER = Path(__file__).parents[2] / "rigs"
ALL_SENSORS = rig.read(FOLDER / "all-sensors.toml")
FIRST_PAPER = rig.read(FOLDER / "first-paper.toml")
PATIENCE_S = 300.0  # Longest wait of a test. On an idle machine the result is immediate.


def one_stream_rig(
    sensor: str, transport: str = "serial:/dev/ttyUSB0", options: str = "{}", emulate: str = "{}"
) -> Rig:
    """Return a rig of one stream, ``load``."""
    lines = ["[[stream]]", 'name = "load"', f'sensor = "{sensor}"', f'transport = "{transport}"']
    return rig.parse("\n".join([*lines, f"options = {options}", f"emulate = {emulate}"]))


def awaited(condition: Callable[[], Any]) -> Any:
    """Return the first true result of ``condition``; fail if that takes too long."""
    until = time.monotonic() + PATIENCE_S
    while not (value := condition()):
        assert time.monotonic() < until, "what was awaited did not happen"
        time.sleep(0.01)
    return value


def in_order(rows: AnyArray, sequence: AnyArray) -> bool:
    """Return whether all of ``rows`` occur in ``sequence`` in this order, possibly with others in between."""
    remaining = iter(sequence)
    return len(rows) > 0 and all(any(np.array_equal(row, candidate) for candidate in remaining) for row in rows)
