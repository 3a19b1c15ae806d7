"""A recording of a hand: two fingers, an arm and a camera, whose values a test knows."""

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Floats
from tacpipe.channels import schema
from tests.fake_recordings import FakeRecording

START_NS, SKIN_HZ, ARM_HZ, SECONDS = 1_700_000_000_000_000_000, 50, 1000, 4
REST = 16_000
PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000010000000108060000001f15c4890000000d49444154789c6360606060000000050001a5f645400000000049454e44ae426082"
)  # a pixel


def times(rate_hz: int) -> np.ndarray:
    return START_NS + np.arange(SECONDS * rate_hz) * (1_000_000_000 // rate_hz)


def pressed() -> Floats:
    """Return the counts above rest of 16 taxels (time, taxel, axis): nothing for a second, then more by each taxel."""
    change = np.zeros((SECONDS * SKIN_HZ, 16, 3))
    change[SKIN_HZ:, :, 2] = 100 * np.arange(1, 17)
    change[SKIN_HZ:, :, 0] = 30
    return change


def finger(change: Floats) -> pa.Table:
    return schema.stream(times(SKIN_HZ), (REST + change).reshape(len(change), -1).T, schema.uskin_fields())


def arm() -> pa.Table:
    seconds = np.arange(SECONDS * ARM_HZ) / ARM_HZ
    position = [seconds / 10, np.zeros_like(seconds), 0.5 + 0 * seconds]
    turned = [np.zeros_like(seconds)] * 3 + [np.ones_like(seconds)]
    return schema.stream(times(ARM_HZ), [*position, *turned], schema.pose_fields())


def labels() -> pa.Table:
    """Return labels of the rows: a contact from 1 s to 3 s, and a slip in its last half second."""
    seconds = np.arange(SECONDS * SKIN_HZ) / SKIN_HZ
    contact = np.where((seconds >= 1) & (seconds < 3), 0, -1)
    slip = (seconds >= 2.5) & (seconds < 3)
    fields = [schema.label_field("contact"), schema.label_field("slip")]
    return schema.stream(times(SKIN_HZ), [contact, slip], fields)


def camera() -> pa.Table:
    return pa.table({"t_ns": times(SKIN_HZ)[::10], "data": pa.array([PNG] * 20, pa.binary())})


def events() -> pa.Table:
    rows = {"t_ns": [START_NS + 2_000_000_000], "stream": ["xela1"], "cause": ["cut"], "frames": [1], "bytes": [7]}
    return pa.table({**rows, "detail": [""]})


def recording(**extra_streams: pa.Table) -> FakeRecording:
    """Return the recording with ``extra_streams``."""
    tables = {"xela1": finger(pressed()), "xela2": finger(0.5 * pressed()), "robot": arm(), "marks": labels()}
    return FakeRecording(
        {**tables, "events": events(), "camera": camera(), **extra_streams}, "trial-000", {"object": "cup"}
    )
