"""Messages that a sensor writes to its device in a dialogue that the device answers."""

from tacpipe.sensors.sensor import Device, Dialogue
from tests.sensors import talking


def hold(dialogue: Dialogue, device: Device, before: bytes = b"") -> list[bytes]:
    """Carry out a dialogue and return the messages sent; ``before`` is what the device was still sending."""
    sent_messages: list[bytes] = []

    def noted() -> Dialogue:
        reply = None
        while True:
            try:
                ask = next(dialogue) if reply is None else dialogue.send(reply)
            except StopIteration:
                return
            sent_messages.append(ask.send)
            reply = yield ask

    talking.carried_out(noted(), device, before)
    return sent_messages
