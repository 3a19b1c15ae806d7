"""A rig whose devices state some of their options themselves: these are taken when a recording begins.

They are written into the rig's text, which goes along with what is recorded: a recording that a crash cut off is sealed
without the device.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace

from tacpipe.errors import DeviceError
from tacpipe.links import opening
from tacpipe.recording import clock, rig_text
from tacpipe.recording import rig as rigs
from tacpipe.recording.rig import Rig, Stream
from tacpipe.sensors import variants
from tacpipe.sensors.framing import Chunks

STATED_S = 5.0  # in which a device must have stated its options


def completed(rig: Rig) -> Rig:
    """Return a rig with the options that its devices state; those in the rig file stand.

    Raises `DeviceError` for a device that is not there or states nothing.
    """
    if not any(stream.sensor.incomplete for stream in rig.streams.values()):
        return rig
    streams = {name: _completed(stream) if stream.sensor.incomplete else stream for name, stream in rig.streams.items()}
    made = replace(rig, streams=streams)
    return replace(made, text=rig_text.of(made))


def _completed(stream: Stream) -> Stream:
    options = {**_stated(stream), **stream.options}
    sensor = rigs.make(stream.kind, options, f"stream {stream.name}")
    return replace(stream, options=options, sensor=sensor)


def _stated(stream: Stream) -> variants.Options:
    came: list[tuple[int, bytes]] = []
    until_s = clock.now_s() + STATED_S
    with closing(opening.open_link(stream.address, stream.sensor, stream.name)) as link:
        while clock.now_s() < until_s:
            came += link.read(0.1)
            found = variants.of(stream.kind, Chunks.of(came)) if came else []
            if found:
                return found[0]
    raise DeviceError(
        f"Stream {stream.name} ({stream.address}): the device did not state its options within {STATED_S:g} s; "
        "write them into the rig file."
    )
