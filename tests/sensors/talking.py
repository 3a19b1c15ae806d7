"""A host that opens a stream, and the device that it talks to, without a link between them."""

from tacpipe.sensors.sensor import Ask, LocalAddress, Sensor
from tacpipe.testing.dialogues import Device, find_reply, hold_dialogue
from tests.emulation.devices import device_for


def reply_of(ask: Ask, incoming: bytes) -> bytes:
    """Return the reply to a request in bytes from the device."""
    start, stop = find_reply(ask, incoming)
    return incoming[start:stop]


def opened(sensor: Sensor, local: LocalAddress | None = None, greeting: bytes = b"") -> Device:
    """Return the device of a sensor after the stream was opened."""
    device = device_for(sensor)
    assert hold_dialogue(sensor.opening(local or {}), device, greeting).unclaimed == greeting
    return device
