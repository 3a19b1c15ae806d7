"""Pages without their figures' drawings, for tests that read what a page says beside them."""

from typing import Any

import pytest


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are made and filled, but saved as empty ones: laying out letters and lines takes most of a page's time."""
    from matplotlib.figure import Figure

    def save(figure: Figure, content: Any, **_: Any) -> None:
        assert figure.axes, "a figure without axes"
        content.write("<svg></svg>")

    monkeypatch.setattr(Figure, "savefig", save)
