"""A host that opens a stream, and the device's side that it talks to, without a link between them."""

from tacpipe.sensors.sensor import Ask, Device, Dialogue, LocalAddress, Sensor


def carried_out(dialogue: Dialogue, device: Device, greeting: bytes = b"") -> bytes:
    """Carry out a dialogue; ``greeting`` came before any reply. Return what came that was no reply."""
    incoming, unrelated, reply = greeting, b"", None
    while True:
        try:
            ask = dialogue.send(reply) if reply is not None else next(dialogue)
        except StopIteration:
            return unrelated + incoming
        incoming += b"".join(device.hear(ask.send))
        if ask.until is None:
            reply = b""
            continue
        span = ask.find_reply(incoming)
        assert span is not None, f"no reply to {ask.send.hex(' ')}, only {incoming.hex(' ')}"
        unrelated += incoming[: span[0]]
        reply, incoming = incoming[slice(*span)], incoming[span[1] :]


def reply_of(ask: Ask, incoming: bytes) -> bytes:
    """Return the reply that a question finds in what came."""
    span = ask.find_reply(incoming)
    assert span is not None
    return incoming[slice(*span)]


def opened(sensor: Sensor, local: LocalAddress | None = None, greeting: bytes = b"") -> Device:
    """Return the device of a sensor after the stream was opened."""
    device = sensor.device()
    assert carried_out(sensor.opening(local or {}), device, greeting) == greeting
    return device
