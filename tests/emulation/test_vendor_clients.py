"""Test that vendors' clients read from the emulator what its ledger records as sent."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from anyskin import AnySkinBase
from flexitac import FlexiTacSensor
from optoforce import OptoForce16, OptoForce22, OptoForce34
from optoforce.reading import FX_SCALE
from paxini_sdk import HighSpeedHandBoard
from pyrobotiqtactile import RobotiqTactileSensor
from tactile_sdk import TactilePressureSDK

from tacpipe.arrays import AnyArray
from tacpipe.recording.rig import Rig
from tacpipe.sensors.sensor import Samples
from tests.emulation.emulator import Emulator
from tests.emulation.rigs import in_order, one_stream_rig

pytestmark = pytest.mark.rig

FRAMES = 20


def read(requested_rig: Rig, client: Callable[[str], list[Any]]) -> tuple[AnyArray, Samples]:
    """Return the readings of a client on the emulated port (frame, …), and the samples that were sent."""
    with Emulator(requested_rig) as emulator:
        readings = client(emulator.rig.streams["load"].address.target)
    return np.array(readings), emulator.ledger["load"].samples()


@pytest.mark.parametrize(("kind", "axes"), [(OptoForce16, 3), (OptoForce22, 6), (OptoForce34, 12)])
def test_optoforce_reads_counters_and_first_axis(kind: Any, axes: int) -> None:
    def client(port: str) -> list[Any]:
        with kind(port, speed_hz=333) as sensor:
            readings = [sensor.read(only_latest_data=False) for _ in range(FRAMES)]
        assert all(reading.valid_checksum for reading in readings)
        return [(reading.count, round(reading[2] / (FX_SCALE if axes != 6 else 1))) for reading in readings]

    received, sent = read(one_stream_rig("optoforce", options=f"{{ axes = {axes} }}"), client)
    assert sent.seq is not None
    first = sent.values[1][:, 0] if axes != 6 else np.zeros(len(sent), int)
    if axes == 6:
        received[:, 1] = 0  # scaled by the sheet of one specimen
    assert in_order(received, np.column_stack([sent.seq, first]))


def test_flexitac_reads_the_taxels() -> None:
    def client(port: str) -> list[Any]:
        with FlexiTacSensor(port, baseline=0.0) as sensor:
            return [sensor.read().raw.ravel() for _ in range(FRAMES)]

    received, sent = read(one_stream_rig("flexitac"), client)
    assert received.max() > 0
    assert in_order(received[2:], sent.values[0])  # The first frames may begin at a marker within a frame.


def test_anyskin_reads_the_flux() -> None:
    def client(port: str) -> list[Any]:
        sensor = AnySkinBase(num_mags=5, port=port, temp_filtered=False)
        try:
            return [sensor.get_sample()[1] for _ in range(FRAMES)]
        finally:
            sensor.close()

    received, sent = read(one_stream_rig("anyskin"), client)
    assert in_order(received[2:].astype(np.float32), sent.values[0])


def test_robotiq_reads_the_taxels_of_both_fingers() -> None:
    def client(port: str) -> list[Any]:
        sensor = RobotiqTactileSensor(port=port)
        sensor.connect()
        try:
            sensor.configure(update_period_ms=10)
            return [sensor.read_frame(timeout=2.0).pressure.ravel() for _ in range(FRAMES)]
        finally:
            sensor.close()

    received, sent = read(one_stream_rig("robotiq"), client)
    sent_rows = {tuple(row) for row in sent.values[0].tolist()}
    assert {
        tuple(row) for row in received[2:].tolist()
    } <= sent_rows  # Frames have no number, so one that is read twice looks like two.
    assert len(received) == FRAMES


def test_paxini_reads_the_points() -> None:
    def client(port: str) -> list[Any]:
        with HighSpeedHandBoard(port) as board:
            frames = list(board.stream_auto_push(max_frames=FRAMES))
        return [next(iter(frame.distributed_forces.values())) for frame in frames]

    received, sent = read(one_stream_rig("paxini"), client)
    assert received.shape[2] == 3
    _, signed, along = sent.values
    planes = signed[:, 2:].reshape(len(sent), -1, 2).astype(int)
    points = np.concatenate([planes, along[:, 1:, None].astype(int)], axis=2)
    assert in_order(received, points)


def test_the_modbus_client_polls_the_points() -> None:
    def client(port: str) -> list[Any]:
        with TactilePressureSDK(port) as sdk:
            return [sdk.pressure.read_fast() for _ in range(FRAMES)]

    received, sent = read(one_stream_rig("modbus-tactile"), client)
    assert np.array_equal(received, sent.values[0])
