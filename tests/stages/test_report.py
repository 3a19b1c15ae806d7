from typing import Any

import pytest

from tacpipe.errors import TacpipeError
from tacpipe.plugins import registry
from tests.fake_recordings import FakeDataset, dataset

REPORT = registry.load("report")


def test_a_report_is_one_file_with_the_title_asked_for() -> None:
    files = {"metrics.json": b'{"counts": {"recordings": 0}}', "config.json": b'{"task": "forward"}'}
    empty_results: Any = FakeDataset(files=files, manifest={"stage": "evaluate"})
    report_files = REPORT(REPORT.params(title="Monday"), (empty_results,), ((),)).files
    assert set(report_files) == {"report.html"}
    assert b"<h1>Monday</h1>" in report_files["report.html"]
    assert b"All recordings were used for training" in report_files["report.html"]
    assert (
        b"<title>Forecasts of tactile signals</title>"
        in REPORT(REPORT.params(), (empty_results,), ((),)).files["report.html"]
    )


def test_what_is_no_result_is_refused() -> None:
    with pytest.raises(TacpipeError, match="tacpipe evaluate"):
        REPORT(REPORT.params(), (dataset(),), ((),))
