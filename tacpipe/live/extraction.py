"""Compute the tactile channels of cameras, as `tacpipe extract` does, on recordings and while a rig runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from tacpipe.live.stages import RecordingInMemory, stage_params
from tacpipe.plugins import registry
from tacpipe.video.channels import DifferenceChannels, FrameChannels, LiveChannels, MarkerChannels
from tacpipe.video.stream import read_format

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Recording
    from tacpipe.store.records import Step

CHANNELS: Mapping[str, Callable[[Any, str], FrameChannels]] = {
    "extract.difference": lambda params, place: DifferenceChannels(
        params.rows, params.columns, params.reference_frames
    ),
    "extract.markers": lambda params, place: MarkerChannels(params.rows, params.columns, params.pitch_mm, place),
}  # channels by stage, of its params and the name of the stream


def live_channels(steps: Sequence[Step], layouts: Mapping[str, pa.Schema]) -> dict[str, LiveChannels]:
    """Return the channels of each camera in the streams ``layouts``, if one of the model's stages is `CHANNELS`."""
    step = next((step for step in steps if step["stage"] in CHANNELS), None)
    if step is None:
        return {}
    params = stage_params(step)
    formats = {name: read_format(schema) for name, schema in layouts.items()}
    return {
        name: LiveChannels(CHANNELS[step["stage"]](params, f"Stream {name}"), layouts[name], video_format)
        for name, video_format in formats.items()
        if video_format is not None
    }


def extracted_streams(
    recording: Recording, steps: Sequence[Step], tables: Mapping[str, pa.Table]
) -> dict[str, pa.Table]:
    """Return the streams of a recording; cameras are replaced by their channels, as the model's stage computes them.

    Without such a stage or a camera, the streams are unchanged.
    """
    step = next((step for step in steps if step["stage"] in CHANNELS), None)
    if step is None or all(read_format(table) is None for table in tables.values()):
        return dict(tables)
    stage = registry.load(step["stage"])
    output = stage(stage_params(step), RecordingInMemory(recording.name, tables, recording.attributes))
    return {name: table.read_all() if hasattr(table, "read_all") else table for name, table in output.streams.items()}
