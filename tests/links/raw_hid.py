"""The reference board on raw HID, byte by byte: what devices that are played by tests send and say of themselves."""

# usage page FFAB, usage 0200, a collection with 64 bytes in and 64 bytes out, as Teensy's RawHID has it
DESCRIPTOR = bytes.fromhex("06abff 0a0002 a101 7508 1500 26ff00 9540 0901 8102 9540 0902 9102 c0")


def report(number: int) -> bytes:
    """Return the reference report: marker, twelve readings, zeros, a counter."""
    readings = b"".join(((number * 7 + channel) % 4096).to_bytes(2, "big") for channel in range(12))
    return b"\xab\xcd" + readings + bytes(36) + (number % 65536).to_bytes(2, "big")
