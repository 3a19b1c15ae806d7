"""Run the stages of a model's chain without a store, read their params, and compute tactile channels of cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.datasets.dataset import Dataset, Recording
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io.columns import Columns
from tacpipe.io.hashing import digest
from tacpipe.io.parquet import to_parquet
from tacpipe.plugins import params, registry
from tacpipe.plugins.stage import Attribute
from tacpipe.sensors.live import LATENCY
from tacpipe.store.records import Step
from tacpipe.synchronization.placement import are_arrivals, equal_fraction
from tacpipe.video.channels import DifferenceChannels, FrameChannels, LiveChannels, MarkerChannels
from tacpipe.video.depth import DepthChannels
from tacpipe.video.stream import read_format

SYNCHRONIZE = "synchronize"
MODEL = "live_model"  # attribute of a recording: the digest of the model that its session ran
DIGITS = 12  # digits of a digest in a message, as `tacpipe show` prints it
PIECE_NS = 1_000_000_000  # duration of the pieces in which a recording is replayed
CHANNELS: Mapping[str, Callable[[Any, str], FrameChannels]] = {
    "extract.difference": lambda params, place: DifferenceChannels(
        params.rows, params.columns, params.reference_frames, place
    ),
    "extract.markers": lambda params, place: MarkerChannels(
        params.rows, params.columns, params.pitch_mm, params.reference_frames, params.polarity, place
    ),
    "extract.depth": DepthChannels.from_params,
}  # channels by stage, of its params and the name of the stream


def stage_params(step: Step) -> Any:
    """Return the params of a stage of a chain. Raises `UsageError` if the stage now has another version."""
    name = step["stage"]
    stage = registry.load(name)
    if step["version"] != stage.version:
        command = f"tacpipe {name.replace('.', ' ')}"
        raise UsageError(
            f"The model was trained behind version {step['version']} of {name}; version {stage.version} returns other rows. "
            f"Run `{command}` and the stages after it again, and then `tacpipe train` with the options that `tacpipe show` "
            "prints for the model."
        )
    return params.from_json(stage, step["params"])


def refuse_look_ahead(config: Mapping[str, Any], steps: Sequence[Step]) -> None:
    """Raise `TacpipeError` for a model that was trained on rows that look ahead.

    ``config`` is the model's configuration, ``steps`` are its preprocessing stages.
    """
    look_ahead = config.get("look_ahead")
    if look_ahead is None:  # the recordings lack this information
        interpolated = [
            step for step in steps if step["stage"] == SYNCHRONIZE and stage_params(step).values == "interpolate"
        ]
        text = "their values are interpolated" if interpolated else ""
    else:
        text = (
            f"{look_ahead['mean_ms']:g} ms on average, at most {look_ahead['max_ms']:g} ms"
            if look_ahead["max_ms"]
            else ""
        )
    if text:
        raise TacpipeError(
            f"The model was trained on rows that look ahead ({text}), and a live session has no later samples. Train it on "
            f"rows of `tacpipe synchronize` without --values interpolate, or give --allow-look-ahead."
        )


@dataclass(frozen=True)
class RecordingInMemory:
    """A recording as a stage reads it, with its tables in memory."""

    name: str
    tables: Mapping[str, pa.Table]
    attributes: Mapping[str, Attribute] = field(default_factory=dict)

    @property
    def streams(self) -> tuple[str, ...]:
        """The names of its streams."""
        return tuple(sorted(self.tables))

    @property
    def digest(self) -> str:
        """A digest that no stored recording has."""
        return digest(["in memory", self.name])

    def table(self, stream: str = "", columns: Sequence[str] | None = None) -> pa.Table:
        """Return a stream."""
        return self.tables[stream] if columns is None else self.tables[stream].select(list(columns))

    def columns(self, stream: str = "") -> Columns:
        """Return the columns of a stream, as those of a stored recording."""
        return Columns(to_parquet(self.tables[stream]))


def streams_as_recorded(recording: Recording) -> dict[str, pa.Table]:
    """Return the streams of a recording. Raises `UsageError` if a stage has already processed it."""
    if set(recording.streams) == {""}:
        raise UsageError(
            "this recording already went through a stage, so the arrival of its samples is unknown. Give the "
            "original recordings; the model's own stages run on them."
        )
    return {name: recording.table(name) for name in recording.streams}


def require_sessions(digest: str, recordings: Dataset, stream: str) -> None:
    """Raise `UsageError` unless all recordings are of sessions that published ``stream`` with the model of this digest.

    The messages of another model describe nothing of this model and differ from its predictions in every row.
    """
    for name, recording in sorted(recordings.recordings.items()):
        if stream not in recording.streams or LATENCY not in recording.streams:
            raise UsageError(
                f"{name} is not a recording of a live session with this model: it has no stream {stream}. Give what "
                f"`tacpipe live -o` recorded, or leave --live out."
            )
        ran = recording.attributes.get(MODEL, digest)  # missing in recordings of other programs
        if ran != digest:
            raise UsageError(
                f"The session of {name} ran the model {str(ran)[:DIGITS]}, and this one is {digest[:DIGITS]}. Its published "
                f"values are of that model. Give the model that the session ran, or leave --live out to evaluate this one "
                f"on the same recordings."
            )


def arrival_streams(recording: Recording, tables: Mapping[str, pa.Table]) -> list[str]:
    """Return the names of the streams ``tables`` of a recording whose times are arrivals."""
    return [
        name
        for name, table in tables.items()
        if table.num_rows and are_arrivals(table.schema.field("t_ns"), recording.attributes, equal_fraction(table))
    ]


def pieces_by_arrival(tables: Mapping[str, pa.Table], master: str) -> Iterator[tuple[int, dict[str, pa.Table]]]:
    """Yield recorded streams in pieces of `PIECE_NS` in the order of arrival, up to the last sample of ``master``.

    Each piece has the time up to which it contains samples, and the new rows of each stream that has rows.
    """
    stamps = {name: table.column("t_ns").to_numpy() for name, table in tables.items() if table.num_rows}
    if master not in stamps:
        return
    begins, last = min(int(t_ns[0]) for t_ns in stamps.values()), int(stamps[master][-1])
    passed = dict.fromkeys(stamps, 0)
    for until_ns in (*range(begins, last, PIECE_NS), last):
        stops = {name: int(np.searchsorted(t_ns, until_ns, side="right")) for name, t_ns in stamps.items()}
        yield until_ns, {name: tables[name].slice(passed[name], stop - passed[name]) for name, stop in stops.items()}
        passed = stops


def live_channels(steps: Sequence[Step], layouts: Mapping[str, pa.Schema]) -> dict[str, LiveChannels]:
    """Return the channels of each camera in the streams ``layouts``, if one of the model's stages is `CHANNELS`."""
    step = next((step for step in steps if step["stage"] in CHANNELS), None)
    if step is None:
        return {}
    settings = stage_params(step)
    formats = {name: read_format(schema) for name, schema in layouts.items()}
    return {
        name: LiveChannels(CHANNELS[step["stage"]](settings, f"Stream {name}"), layouts[name], video_format)
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
