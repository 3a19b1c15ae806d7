"""The disk of a recording: one line each time the remaining room falls below an hour, ten minutes and a minute."""

from pathlib import Path

import pytest

from tacpipe.recording import clock
from tacpipe.recording.disk import DiskForecast


def test_a_line_is_given_once_at_each_level_and_counts_the_bytes_that_sealing_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, total_bytes, rate = 0.0, 0.0, 1e6
    monkeypatch.setattr(clock, "now_s", lambda: now_s)
    spool = tmp_path / "bytes"
    spool.touch()
    capacity = 2 * 1e6 * 4000  # room for 4,000 s of spool and of its sealed samples
    forecast = DiskForecast(tmp_path, lambda path: int(capacity - total_bytes))
    lines: dict[float, str] = {}
    while now_s < 4000:
        now_s, total_bytes = now_s + 5, total_bytes + 5 * rate
        with spool.open("r+b") as file:
            file.truncate(int(total_bytes))
        if line := forecast.warning():
            lines[now_s] = line
    assert list(lines) == [410, 3410, 3950]
    assert lines[410].startswith("The disk has room for 60 minutes more of this recording: 7.6 GB are free.")
    assert "less than a minute" in lines[3950]


def test_nothing_is_said_while_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bytes").touch()
    for now_s in range(0, 100, 10):
        monkeypatch.setattr(clock, "now_s", lambda now_s=now_s: float(now_s))
        assert DiskForecast(tmp_path, lambda path: 1).warning() == ""
