"""Test that acquired scenes and grasps are segmented like those that were never sent."""

import json
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.channels import schema
from tacpipe.clouds import point_files
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp, estimate_wrist
from tacpipe.plugins.registry import load
from tacpipe.recording.reading import LinkReader
from tacpipe.sensors.clouds import Clouds
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Sensor
from tacpipe.sensors.tap import Tap
from tests.clouds.scene_fakes import scene
from tests.fake_recordings import FakeRecording


def acquire(sensor: Sensor, chunk: bytes) -> pa.Table:
    """Return the table of a stream of which one chunk came."""
    reading = LinkReader(sensor)
    batch = reading.feed(Chunks.from_pairs([(5, chunk)]))
    assert not reading.account.lost
    columns = [column for block in batch.values for column in block.T]
    return schema.stream(batch.t_ns, columns, sensor.fields())


@pytest.mark.parametrize("kind", ["points", "wrist"])
def test_segment_grasps_takes_what_a_folder_and_a_tap_gave(kind: Any) -> None:
    full_scene, stage = scene(), load("segment.grasps")
    assert full_scene.cloud.colours is not None
    wrist = estimate_wrist(full_scene.grasp)
    grasp = Grasp(full_scene.grasp.g1_m, full_scene.grasp.g2_m, wrist if kind == "wrist" else None)
    record = {"g1": grasp.g1_m.tolist(), "g2": grasp.g2_m.tolist(), "R": wrist.tolist()}

    acquired_streams = {
        "scene": acquire(Clouds(), point_files.pack_ply(full_scene.cloud.points_m, full_scene.cloud.colours)),
        "grasp": acquire(Tap(grasp=kind), json.dumps({"grasp": record}).encode()),
    }

    expected_streams = {"scene": full_scene.cloud.table(), "grasp": grasp.table(5)}
    segmented, expected = (
        stage(stage.params(), FakeRecording(streams)).streams for streams in (acquired_streams, expected_streams)
    )
    np.testing.assert_array_equal(
        Cloud.from_table(segmented["cloud"]).points_m, Cloud.from_table(expected["cloud"]).points_m
    )
    assert segmented["grasp"].equals(expected["grasp"])
