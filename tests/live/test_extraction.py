"""Channels of a live camera equal those that `tacpipe extract` computes of the recording."""

from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.live.stages import extracted_streams, live_channels
from tacpipe.video.encoding import encode_images, jpeg_format
from tacpipe.video.files import packet_stream
from tests.fake_recordings import FakeRecording
from tests.stage_params import build_params
from tests.stages.test_extract import extract
from tests.video import gels

COUNT = 40
STEP_NS = 40_000_000


@pytest.fixture(scope="module")
def frames() -> pa.Table:
    """The stream of a camera that looks at a gel that is pressed and released."""
    depths = np.abs(np.sin(np.linspace(0, np.pi, COUNT)))
    images = [gels.image(gels.press(gels.places(), depth), seed) for seed, depth in enumerate(depths)]
    video_format = jpeg_format(gels.WIDTH, gels.HEIGHT, None)
    ticks = np.arange(COUNT)
    clocks = (ticks, ticks, np.ones(COUNT, bool))
    return packet_stream(
        video_format, encode_images(video_format, images), clocks, STEP_NS * ticks, ticks, None
    ).read_all()


def step(name: str) -> Any:
    from tacpipe.plugins import params, registry

    stage = registry.load(name)
    return {"stage": name, "version": stage.version, "params": params.to_json(build_params(name)), "fitted": None}


@pytest.mark.parametrize("name", ["extract.markers", "extract.difference"])
@pytest.mark.parametrize("size", [1, 7])
def test_batches_of_any_size_give_the_values_of_the_stage(frames: pa.Table, name: str, size: int) -> None:
    cameras = live_channels([step(name)], {"gel": frames.schema, "arm": pa.schema([("t_ns", pa.int64())])})
    assert set(cameras) == {"gel"}
    batches = [cameras["gel"].push(frames.slice(start, size)) for start in range(0, COUNT, size)]
    expected = extract({"gel": frames}, name)["gel"]
    actual = pa.concat_tables(batches)
    assert actual.schema.equals(expected.schema, check_metadata=True)
    for column in expected.column_names:
        np.testing.assert_array_equal(actual.column(column).to_numpy(), expected.column(column).to_numpy())
    assert np.abs(expected.column(1).to_numpy()).max() > 0


def test_a_damaged_frame_has_no_row(frames: pa.Table) -> None:
    (camera,) = live_channels([step("extract.difference")], {"gel": frames.schema}).values()
    packets = frames.column("packet").to_pylist()
    packets[3] = b"\xff\xd8damaged\xff\xd9"
    at = frames.schema.get_field_index("packet")
    damaged = frames.set_column(at, frames.schema.field(at), pa.array(packets, pa.binary()))
    assert camera.push(damaged).column("seq").to_pylist() == [row for row in range(COUNT) if row != 3]


def test_a_recording_is_extracted_as_the_model_s_stage_does_it(frames: pa.Table) -> None:
    arm = pa.table({"t_ns": [0, 1], "x": [0.5, 1.5]})
    tables = {"gel": frames, "arm": arm}
    recording: Any = FakeRecording(tables)
    streams = extracted_streams(recording, [step("extract.markers")], tables)
    assert streams["gel"].equals(extract({"gel": frames}, "extract.markers")["gel"])
    assert streams["arm"].equals(arm)
    assert extracted_streams(recording, [], tables) == tables
