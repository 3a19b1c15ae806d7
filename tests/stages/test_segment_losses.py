"""Test that `segment losses` marks when an object leaves the fingers."""

import dataclasses
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.plugins import registry
from tests.fake_recordings import FakeRecording, column
from tests.stage_params import build_params

RATE_HZ = 25


def gel(*, slip: bool, moves_s: float = 5.5, leaves_s: float = 6.0, level: float = 5.0) -> FakeRecording:
    """Return 10 s of two gels that are touched from 1 s on; the object moves, and leaves at ``leaves_s``."""
    at_s = np.arange(10 * RATE_HZ) / RATE_HZ
    touched = (at_s >= 1) & (at_s < leaves_s)
    moved = np.cumsum(np.where((at_s >= moves_s) & (at_s < leaves_s), 1.0, 0.0))
    streams = {}
    for name in ("gel0", "gel2"):
        fields = [pa.field("t_ns", pa.int64())]
        columns = [pa.array((at_s * 1e9).astype(np.int64))]
        for number in range(4):
            fields.append(pa.field(f"cell{number}", pa.float32(), metadata={"quantity": "tactile", "unit": "count"}))
            columns.append(pa.array((np.where(touched, level + moved, 0.0)).astype(np.float32)))
        streams[name] = pa.Table.from_arrays(columns, schema=pa.schema(fields))
    return FakeRecording(streams, "trial", {"slip": slip})


def segment(recording: FakeRecording, stream: str = "gel0") -> dict[str, list[float]]:
    """Return first and last time of contact and slip of a stream, in seconds."""
    output = registry.load("segment.losses")(build_params("segment.losses"), recording)
    table = output.streams[stream]
    at_s = column(table, "t_ns") / 1e9
    marked = {"contact": column(table, "contact") >= 0, "slip": column(table, "slip") > 0}
    return {name: [at_s[rows][0], at_s[rows][-1]] if rows.any() else [] for name, rows in marked.items()}


@pytest.mark.parametrize("stream", ["gel0", "gel2"])
def test_a_slip_lasts_from_the_start_of_the_motion_to_the_last_contact(stream: str) -> None:
    labels = segment(gel(slip=True), stream)
    assert labels["contact"] == pytest.approx([1.0, 5.96])
    assert labels["slip"] == pytest.approx([5.48, 5.96], abs=0.05)


def test_a_release_is_no_slip_and_its_motion_is_no_contact() -> None:
    labels = segment(gel(slip=False))
    assert labels["slip"] == []
    assert labels["contact"] == pytest.approx([1.0, 5.44], abs=0.05)


def test_a_slip_whose_contact_is_not_seen_has_no_known_time() -> None:
    output = registry.load("segment.losses")(build_params("segment.losses"), gel(slip=True, level=0.1, moves_s=6.0))
    assert set(column(output.streams["gel0"], "slip").tolist()) == {-1}


@pytest.mark.parametrize(("labels", "message"), [({}, "has no label slip"), ({"slip": 1.0}, "has the label slip 1.0")])
def test_a_recording_that_does_not_state_whether_the_object_slipped_is_refused(labels: Any, message: str) -> None:
    recording = dataclasses.replace(gel(slip=True), attributes=labels)
    with pytest.raises(TacpipeError, match=f"{message}; it must be true"):
        registry.load("segment.losses")(build_params("segment.losses"), recording)


def test_a_recording_without_touch_is_refused() -> None:
    tables = {"arm": pa.table({"t_ns": pa.array([0, 1], pa.int64())})}
    with pytest.raises(TacpipeError, match="no tactile channel"):
        registry.load("segment.losses")(build_params("segment.losses"), FakeRecording(tables, "trial", {"slip": True}))
