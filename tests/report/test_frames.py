"""Frames of right and wrong predictions on the page of results."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.comparison.runs import RecordingOutcome as Outcome
from tacpipe.report import page
from tacpipe.report.blocks import ImageRow, Section
from tacpipe.report.frames import SHOWN, frame_folds, holds_cameras
from tests.exports.test_lerobot import decoded
from tests.fake_recordings import FakeRecording
from tests.stages.test_extract import frames_of
from tests.video import videos

COUNT = 30


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return videos.write(tmp_path_factory.mktemp("gel") / "gel.mp4", "libx264", COUNT)


def dataset(tables: dict[str, pa.Table], names: str) -> Any:
    return SimpleNamespace(recordings={name: FakeRecording(tables, name=name) for name in names})


def show(fold: Any) -> dict[str, list[str]]:
    """Return the texts of the pictures by title."""
    return {
        block.title: [picture.text for picture in block.pictures]
        for block in fold.blocks
        if isinstance(block, ImageRow)
    }


def test_right_and_wrong_predictions_have_frames_with_the_label(path: Path) -> None:
    cameras = dataset({"gel": frames_of(path)}, "abc")
    outcomes = [
        Outcome("a", "cup", "cup", True),
        Outcome("b", "cup", "box", False),
        Outcome("x", "cup", "cup", True),
    ]
    (fold,) = frame_folds(outcomes, [cameras])
    assert show(fold) == {"Right": ["cup"], "Wrong": ["box, and it is cup"]}
    assert fold.about == "1 of 2 are right"


def test_a_frame_is_in_the_middle_of_the_part_that_the_model_read(path: Path) -> None:
    cameras = dataset({"gel": frames_of(path)}, "a")
    part = dataset({"": pa.table({"t_ns": [20 * 40_000_000, 24 * 40_000_000], "x": [0.0, 1.0]})}, "a")
    for datasets, row in (([cameras], 15), ([cameras, part], 22)):
        (fold,) = frame_folds([Outcome("a", "cup", "cup", True)], datasets)
        (picture,) = fold.blocks[0].pictures  # type: ignore[union-attr]
        (image,) = decoded("mjpeg", [picture.content])
        assert np.abs(image.astype(int) - videos.decoded(path)[row]).mean() < 6
        assert picture.below == f"a, gel, {row * 0.04:.2f} s"


def test_at_most_a_few_of_many_predictions_are_shown(path: Path) -> None:
    names = "abcdefgh"
    cameras = dataset({"gel": frames_of(path)}, names)
    (fold,) = frame_folds([Outcome(name, name, name, True) for name in names], [cameras])
    assert len(show(fold)["Right"]) == SHOWN


def test_without_cameras_there_is_no_fold() -> None:
    other = dataset({"arm": pa.table({"t_ns": [0, 1], "x": [0.0, 1.0]})}, "a")
    assert not holds_cameras(other)
    assert frame_folds([Outcome("a", "cup", "cup", True)], [other]) == []


def test_the_page_contains_the_images(path: Path) -> None:
    folds = frame_folds([Outcome("a", "cup", "cup", True)], [dataset({"gel": frames_of(path)}, "a")])
    text = page.page([Section("material", "Material", "", folds=folds)], "Results").decode()
    assert '<img src="data:image/jpeg;base64,' in text and "<small>a, gel, 0.60 s</small>" in text
