from __future__ import annotations

from typing import Any

import pytest

from tacpipe import registry
from tacpipe.errors import TacpipeError
from tests.stages.learning_fakes import FakeDataset, dataset

REPORT = registry.load("report")


def test_a_report_is_one_file_with_the_title_asked_for() -> None:
    nothing: Any = FakeDataset(files={"metrics.json": b'{"counts": {"recordings": 0}}'}, manifest={"stage": "evaluate"})
    files = REPORT(REPORT.params(title="Monday"), (nothing,)).files
    assert set(files) == {"report.html"}
    assert b"<h1>Monday</h1>" in files["report.html"]
    assert b"No recording was left" in files["report.html"]


def test_what_is_no_result_is_refused() -> None:
    with pytest.raises(TacpipeError, match="tacpipe evaluate"):
        REPORT(REPORT.params(), (dataset(),))
