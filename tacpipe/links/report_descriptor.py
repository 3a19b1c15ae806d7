"""What a HID device states of its reports: how long those are that it sends, and whether a number leads each.

Source: Device Class Definition for Human Interface Devices (HID), version 1.11, section 6.2.2.
"""

from __future__ import annotations

from dataclasses import dataclass, field

LONG = 0xFE  # prefix of a long item, whose size stands in the byte behind
INPUT, USAGE_PAGE, REPORT_SIZE, REPORT_ID, REPORT_COUNT, PUSH, POP = 0x80, 0x04, 0x74, 0x84, 0x94, 0xA4, 0xB4


@dataclass(frozen=True)
class Reports:
    """The reports that a device sends."""

    usage_page: int = 0  # the first that is named
    bits: dict[int, int] = field(default_factory=dict)  # of each report, by its number; 0 where they have none

    @property
    def numbered(self) -> bool:
        """Whether the first byte of each report is its number."""
        return any(self.bits)

    @property
    def most(self) -> int:
        """Bytes of the longest report with its number, 64 where the device does not state."""
        return max((-(-bits // 8) for bits in self.bits.values()), default=64) + self.numbered


def parse(descriptor: bytes) -> Reports:
    """Return the reports that a descriptor describes.

    >>> parse(bytes.fromhex("06abff 0a0002 a101 7508 1500 26ff00 9540 0901 8102 9540 0902 9102 c0"))
    Reports(usage_page=65451, bits={0: 512})
    """
    bits: dict[int, int] = {}
    now, kept = {USAGE_PAGE: 0, REPORT_SIZE: 0, REPORT_COUNT: 0, REPORT_ID: 0}, []
    first_page, place = 0, 0
    while place < len(descriptor):
        prefix = descriptor[place]
        if prefix == LONG:
            place += 3 + (descriptor[place + 1] if place + 1 < len(descriptor) else 0)
            continue
        size = (0, 1, 2, 4)[prefix & 3]
        value = int.from_bytes(descriptor[place + 1 : place + 1 + size], "little")
        item = prefix & 0xFC
        place += 1 + size
        if item == INPUT:
            number = now[REPORT_ID]
            bits[number] = bits.get(number, 0) + now[REPORT_SIZE] * now[REPORT_COUNT]
        elif item == PUSH:
            kept.append(dict(now))
        elif item == POP and kept:
            now = kept.pop()
        elif item in now:
            now[item] = value
            first_page = first_page or now[USAGE_PAGE]
    return Reports(first_page, bits)
