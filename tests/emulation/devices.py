"""Find the emulated device of a sensor, which answers like the real one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tacpipe.sensors.ati_netft import AtiNetFT
from tacpipe.sensors.contactile import Contactile
from tacpipe.sensors.franka import Franka
from tacpipe.sensors.generic import Generic
from tacpipe.sensors.icub_skin import IcubSkin
from tacpipe.sensors.justfloat import JustFloat
from tacpipe.sensors.lines import Lines
from tacpipe.sensors.modbus_tactile import ModbusTactile
from tacpipe.sensors.optoforce import OptoForce
from tacpipe.sensors.paxini import Paxini
from tacpipe.sensors.robotiq import Robotiq
from tacpipe.sensors.sensor import Sensor
from tacpipe.sensors.teraranger import TeraRanger
from tacpipe.sensors.tfmini import TfMini
from tacpipe.sensors.ur_rtde import UrRtde
from tacpipe.sensors.weiss_wts import WeissWts
from tacpipe.testing.dialogues import Device
from tests.emulation import commanded_devices as commanded
from tests.emulation import replying_devices as replying

DEVICES: dict[type[Sensor], Callable[[Any], Device]] = {
    AtiNetFT: lambda sensor: commanded.Box(streaming=False),
    Contactile: lambda sensor: commanded.ContactileController(),
    Franka: lambda sensor: replying.Arm(streaming=False),
    Generic: lambda sensor: board(bytes.fromhex(sensor.start), bytes.fromhex(sensor.stop)),
    IcubSkin: commanded.IcubBoard,
    JustFloat: lambda sensor: (
        Device() if sensor.model == "any" else commanded.Bridge(model=sensor.model, streaming=False)
    ),
    Lines: lambda sensor: board(sensor.start.encode(), sensor.stop.encode()),
    ModbusTactile: replying.module,
    OptoForce: lambda sensor: commanded.Daq(streaming=False),
    Paxini: replying.register_board,
    Robotiq: lambda sensor: commanded.Fingertips(streaming=False),
    TeraRanger: lambda sensor: commanded.Evo(streaming=False),
    TfMini: lambda sensor: Device() if sensor.model == "original" else replying.TfMiniDevice(),
    UrRtde: replying.RtdeController,
    WeissWts: replying.Wts,
}


def device_for(sensor: Sensor) -> Device:
    """Return a new emulated device; one that ignores requests for sensors that send none."""
    return DEVICES.get(type(sensor), lambda sensor: Device())(sensor)


def board(start: bytes, stop: bytes) -> commanded.Board:
    """Return a board that streams from the start, or between the commands ``start`` and ``stop``."""
    return commanded.Board(streaming=not start, start=start, stop=stop)
