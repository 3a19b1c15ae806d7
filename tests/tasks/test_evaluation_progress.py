"""An evaluation shows how far it is."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tacpipe.io import terminal
from tests.stages.learning_fakes import motion
from tests.tasks.forward import trials
from tests.tasks.material import textures
from tests.tasks.touch import handmade


def forward(folder: Path) -> Callable[[], Any]:
    model = trials.trained(folder)
    return lambda: trials.evaluated(model, motion(20), motion(21))


def material(folder: Path) -> Callable[[], Any]:
    slides = textures.slides(0, 2), textures.slides(2, 1)
    model = textures.trained(folder, *slides, architecture="minirocket")
    return lambda: textures.evaluated(model, textures.slides(3, 1))


def touch(folder: Path) -> Callable[[], Any]:
    model = handmade.trained(folder, architecture="trees")
    return lambda: handmade.evaluated(model, handmade.recordings(6, 1))


@pytest.mark.parametrize("task", [forward, material, touch])
def test_an_evaluation_moves_a_bar_to_its_end(
    task: Callable[[Path], Callable[[], Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluate, bars = task(tmp_path), []

    @contextmanager
    def followed(description: str, total: int) -> Iterator[Callable[..., None]]:
        steps: list[int] = []
        bars.append((description, total, steps))
        yield lambda by=1, note="": steps.append(by)

    monkeypatch.setattr(terminal, "progress_bar", followed)
    evaluate()
    ((description, total, steps),) = bars
    assert description == "evaluate" and sum(steps) == total
    assert len(steps) > 1
