"""Messages published by LSL reach pylsl's own inlet, described channel by channel."""

import json
import os
import subprocess
import sys
import uuid
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.links.test_lsl import CONFIG
from tests.live.lsl_subscriber import COUNT, forecast, material
from tests.recording.live import ROOT

pytestmark = pytest.mark.rig


def heard(folder: Path, kind: str) -> dict[str, Any]:
    """Return what the inlet got, in a process that keeps its streams within this computer."""
    (folder / "lsl_api.cfg").write_text(CONFIG.format(session=uuid.uuid4()))
    environment = {**os.environ, "LSLAPICFG": str(folder / "lsl_api.cfg"), "PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-m", "tests.live.lsl_subscriber", kind, f"tacpipe-{uuid.uuid4()}"]
    ran = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert ran.returncode == 0 and not ran.stderr, ran.stderr
    outlet: dict[str, Any] = json.loads(ran.stdout)
    return outlet


def test_forecasts_come_with_each_channel_and_step_and_nan_where_there_is_none(tmp_path: Path) -> None:
    pytest.importorskip("pylsl")
    outlet = heard(tmp_path, "forecast")
    assert (outlet["type"], outlet["rate"]) == ("Forecast", 50.0)
    assert outlet["labels"] == ["a_t1", "b_t1", "a_t2", "b_t2"]
    assert outlet["units"] == ["count"] * 4
    rows = np.array(outlet["rows"], np.float32)
    for seq, message in enumerate(forecast()[1]):
        expected = np.full(4, np.nan, np.float32) if message.values is None else message.values.ravel()
        assert np.array_equal(rows[seq], expected, equal_nan=True)


def test_materials_come_with_their_probabilities_and_how_much_was_seen(tmp_path: Path) -> None:
    pytest.importorskip("pylsl")
    outlet = heard(tmp_path, "material")
    assert outlet["type"] == "Material" and outlet["labels"][-2:] == ["probability_cork", "probability_felt"]
    rows = np.array(outlet["rows"], np.float32)
    description, messages = material()
    expected = np.array([message.numbers(description) for message in messages])
    assert len(rows) == COUNT and np.array_equal(rows, expected, equal_nan=True)
    assert rows[0, 0] == -1 and np.isnan(rows[0, -1]) and rows[1, 0] == 1
