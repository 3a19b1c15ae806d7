"""Pages without the chart library, for tests of their content, because bundling takes a second."""

import pytest

from tacpipe.report import page


@pytest.fixture
def unbundled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages hold a mark in place of the library of charts."""
    monkeypatch.setattr(page, "bundle", lambda: "/* library */")
