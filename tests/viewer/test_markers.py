"""Markers of a gel in the frames of its camera, at the places where the gel was drawn."""

from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.viewer import contents
from tacpipe.viewer.markers import track_markers
from tests.fake_recordings import FakeRecording
from tests.stages.test_extract import extract, frames_of
from tests.video import gels, videos

DEPTHS = np.linspace(0, 1, 12)
PITCH_MM = 1.5


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> pa.Table:
    images = np.array([gels.image(gels.press(gels.places(), depth), seed) for seed, depth in enumerate(DEPTHS)])
    return frames_of(videos.write_images(tmp_path_factory.mktemp("gel") / "gel.mkv", "ffv1", images))


@pytest.mark.parametrize("pitch_mm", [0.0, PITCH_MM])
def test_markers_lie_where_they_were_drawn(frames: pa.Table, pitch_mm: float) -> None:
    params = {"rows": 7, "columns": 9, "pitch_mm": pitch_mm}
    table = extract({"gel": frames}, "extract.markers", **params)["gel"]
    video: Any = FakeRecording({"gel": frames})
    chain: Any = [{"stage": "extract.markers", "params": params}]
    track = track_markers("gel", table, video, chain)
    assert track is not None
    assert np.abs(track.rest_px - gels.places()).max() < 0.5
    for depth, positions_px in zip(DEPTHS, track.positions_px, strict=True):
        assert np.nanmax(np.abs(positions_px - gels.press(gels.places(), depth))) < 0.7


def test_a_recording_is_drawn_with_the_frames_of_the_other_dataset(frames: pa.Table) -> None:
    table = extract({"gel": frames}, "extract.markers")["gel"]
    recording, video = FakeRecording({"gel": table}), FakeRecording({"gel": frames})
    drawn: Any = contents.collect
    collected = drawn(recording, video=video)
    assert [camera.stream for camera in collected.frames] == ["gel"]
    assert [track.stream for track in collected.markers] == ["gel"]
    assert not drawn(recording).markers


def test_a_skin_has_no_markers(frames: pa.Table) -> None:
    taxels = pa.field("taxel01_x", pa.float32(), metadata={"quantity": "tactile", "unit": "count", "axis": "x"})
    skin = pa.table([pa.array([0, 1]), pa.array([0.0, 1.0], pa.float32())], pa.schema([("t_ns", pa.int64()), taxels]))
    video: Any = FakeRecording({"gel": frames})
    assert track_markers("gel", skin, video, []) is None
