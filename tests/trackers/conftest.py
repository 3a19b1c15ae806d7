"""A project in which the forward chain has run, and the trackers of `tests.trackers.fakes` are installed."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.conftest import Lab, Ran, forget
from tests.trackers import fakes


def install(folder: Path) -> None:
    """Install the fakes as a package of a third party would be."""
    shutil.copy(str(fakes.__file__), folder / "keeping_tracker.py")
    (folder / "keeping.egg-info").mkdir()
    (folder / "keeping.egg-info" / "entry_points.txt").write_text(fakes.ENTRY_POINTS)


@pytest.fixture
def tracked(
    chained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: Callable[[str], Ran]
) -> Iterator[Lab]:
    """The chained project, as a lab in which the fakes can be asked for."""
    install(tmp_path)
    project = shutil.copytree(chained, tmp_path / "project", symlinks=True)
    monkeypatch.chdir(project)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delenv("TACPIPE_STORE", raising=False)
    forget()
    yield Lab(project, call)
    forget()
