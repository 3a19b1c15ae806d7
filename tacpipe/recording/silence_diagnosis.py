"""Why a stream gives no sample, as a sentence: nothing comes, or what comes is of something else."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields, replace
from typing import Any

from tacpipe.errors import TacpipeError
from tacpipe.recording.rig import Stream
from tacpipe.sensors.framing import Chunks

UNTOLD = ("rate_hz", "baud")  # options that make no difference to what a frame looks like


def sentence(stream: Stream, awaited: str, heard: Iterable[Chunks], *, reply: bool = False) -> str:
    """Return which device, what is wrong and what to do, for a stream on which ``awaited`` did not come.

    ``heard`` is what came instead; with ``reply`` a reply was awaited, so that frames of the sensor itself state something.
    """
    joined = Chunks.joined(list(heard))
    about = f"Stream {stream.name} ({stream.address}): {awaited}"
    probe = f"`tacpipe sensors probe {stream.address}`"
    serial = stream.address.scheme == "serial"
    if not joined.data:
        rate = f", set to {stream.sensor.baud} baud as we are" if serial else ""
        end = f"; {probe} tries all rates" if serial else ""
        described = f"{about}, but nothing came. Check power and cable, and that it is {stream.kind}{rate}{end}."
        return f"{described} {stream.sensor.exclusive}".strip()
    about += f", but {len(joined.data):,} bytes came that hold none."
    known = _known(stream, joined, reply=reply)
    if known:
        return f"{about} {known}"
    at = f"is set to another rate than {stream.sensor.baud} baud, or " if serial else ""
    return f"{about} Either the device {at}speaks another protocol; {probe} tries what is known."


def _known(stream: Stream, heard: Chunks, *, reply: bool) -> str:
    """Return what speaks, if it is known; empty if not."""
    from tacpipe.links.recognition import Candidate, recognise

    scheme, own = stream.address.scheme, Candidate(stream.kind, stream.sensor)
    if reply and recognise(heard, scheme, [own]):
        return (
            f"They are frames of {own}, so the device does not hear us or is another model: check the wire that we send on, "
            f"and the model in the rig file."
        )
    found = recognise(heard, scheme)
    if not found:
        return ""
    best = found[0].candidate
    if best.kind == stream.kind:
        nearer = recognise(heard, scheme, _nearer(own, best))
        best = nearer[0].candidate if nearer else best
        return f"They are frames of {best}: set that among the options in the rig file."
    return f"They are frames of {best}: name that in the rig file, or plug in the other device."


def _nearer(own: Any, found: Any) -> list[Any]:
    """Return the sensor of the rig file with each option, one at a time, that another of its kind has otherwise."""
    from tacpipe.links.recognition import Candidate

    several = []
    for option in fields(own.sensor):
        value = getattr(found.sensor, option.name)
        if option.name in UNTOLD or value == getattr(own.sensor, option.name):
            continue
        try:
            several.append(Candidate(own.kind, replace(own.sensor, **{option.name: value}), {option.name: value}))
        except TacpipeError:  # these options go together in no product
            continue
    return several
