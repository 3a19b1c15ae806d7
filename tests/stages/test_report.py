from __future__ import annotations

from typing import Any

import pytest

from tacpipe.errors import TacpipeError
from tacpipe.plugins import registry
from tests.fake_recordings import FakeDataset, dataset

REPORT = registry.load("report")


def test_a_report_is_one_file_with_the_title_asked_for() -> None:
    files = {"metrics.json": b'{"counts": {"recordings": 0}}', "config.json": b'{"task": "forward"}'}
    nothing: Any = FakeDataset(files=files, manifest={"stage": "evaluate"})
    made = REPORT(REPORT.params(title="Monday"), (nothing,)).files
    assert set(made) == {"report.html"}
    assert b"<h1>Monday</h1>" in made["report.html"]
    assert b"No recording was left" in made["report.html"]
    assert b"<title>Forecasts of tactile signals</title>" in REPORT(REPORT.params(), (nothing,)).files["report.html"]


def test_what_is_no_result_is_refused() -> None:
    with pytest.raises(TacpipeError, match="tacpipe evaluate"):
        REPORT(REPORT.params(), (dataset(),))
