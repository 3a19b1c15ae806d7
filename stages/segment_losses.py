"""Mark when a held object leaves the fingers.

This stage is for recordings in which nothing is touched at the end, such as published trials that state only whether
the object slipped (label ``slip``). The last rows show the untouched sensor. Adds two labels to each tactile stream.
``contact`` is 0 in rows that differ from the end, else -1. ``slip`` is 1 in recordings with ``slip=true`` from the
start of the motion that ends the last contact up to its end; it is -1 in all rows if no contact is seen, so that the
time is unknown. In recordings with ``slip=false``, the object was released: ``slip`` is 0, and ``contact`` is -1 from
the start of the release.

Example: tacpipe segment losses data/difference -o data/losses
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tacpipe.errors import TacpipeError
from tacpipe.plugins.constraints import Fraction, NonNegativeFloat, PositiveFloat, PositiveInt, Unit
from tacpipe.plugins.stage import RecordingOutput, stage
from tacpipe.plugins.stream_selection import StreamSelection

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import Floats, Times
    from tacpipe.datasets.dataset import Recording


@dataclass(frozen=True)
class Params(StreamSelection):
    """Criteria for contact and motion, in the unit of the tactile channels."""

    end_rows: PositiveInt = 8  # number of last rows whose median shows the untouched sensor
    # root mean square difference from the end, over the channels of a stream, above which an object is touched
    contact_level: PositiveFloat = 1.0
    # the same as a fraction of the 90th percentile of the recording
    contact_fraction: Fraction = 0.15
    # minimum duration of the contact before a loss
    contact_s: Annotated[NonNegativeFloat, Unit("s")] = 0.5
    # root mean square change between two rows above which the object moves
    motion_level: PositiveFloat = 0.6
    # duration without motion that separates the loss from earlier motion
    quiet_s: Annotated[PositiveFloat, Unit("s")] = 0.2


@stage(version=1, reads=("slip",))
def losses(params: Params, recording: Recording) -> RecordingOutput:
    """Return the recording with the labels of contact and slip."""
    import numpy as np
    import pyarrow as pa

    from tacpipe.channels import schema as schemas
    from tacpipe.codecs import tactile
    from tacpipe.signals.slip import TouchLimits, loss_of_contact

    slipped = recording.attributes.get("slip")
    if not isinstance(slipped, bool):
        value = "no label slip" if slipped is None else f"the label slip {slipped!r}"
        raise TacpipeError(
            f"Recording {recording.name} has {value}; it must be true (the object slipped out) or false. Set it with "
            f"`tacpipe label DATASET {recording.name} --label slip=true`."
        )
    tables = {stream: recording.table(stream) for stream in recording.streams}
    channels = {stream: tactile.columns(table.schema, "tactile") for stream, table in tables.items()}
    touches = {
        stream: _read_touch(recording.name, tables[stream], names) for stream, names in channels.items() if names
    }
    if not touches:
        raise TacpipeError(
            f"Recording {recording.name} has no tactile channel. Run `tacpipe extract difference` on videos of gels first."
        )
    limits = TouchLimits(
        params.end_rows,
        params.contact_level,
        params.contact_fraction,
        params.contact_s,
        params.motion_level,
        params.quiet_s,
    )
    touch = loss_of_contact(list(touches.values()), limits)

    def add_labels(stream: str, table: pa.Table) -> pa.Table:
        t_ns: Times = table["t_ns"].to_numpy()
        rows = np.clip(np.searchsorted(touch.t_ns, t_ns, side="right") - 1, 0, len(touch.t_ns) - 1)
        contact = np.where(touch.touched[rows], 0, -1).astype(np.int8)
        if touch.loss is not None and not slipped:
            contact[t_ns >= touch.loss.begin_ns] = -1
        slip = np.full(len(t_ns), -1 if slipped and touch.loss is None else 0, np.int8)
        if slipped and touch.loss is not None:
            slip[(t_ns >= touch.loss.begin_ns) & (t_ns <= touch.loss.end_ns)] = 1
        for name, values in (("contact", contact), ("slip", slip)):
            if name in table.column_names:
                raise TacpipeError(
                    f"Recording {recording.name} has a column {name} in {stream or 'its rows'} already. Give the recordings "
                    f"before that label was added."
                )
            table = table.append_column(schemas.label_field(name), pa.array(values))
        return table

    return RecordingOutput(
        {name: add_labels(name, table) if name in touches else table for name, table in tables.items()}
    )


def _read_touch(name: str, table: pa.Table, channels: Sequence[str]) -> tuple[Times, Floats]:
    """Return times and tactile channels (time, channel) of a stream, with NaN as 0.

    Raises `TacpipeError` below two rows.
    """
    import numpy as np

    from tacpipe.codecs import tactile

    if table.num_rows < 2:
        raise TacpipeError(f"Recording {name} has {table.num_rows} rows; a loss shows in two or more. Leave it out.")
    return table["t_ns"].to_numpy(), np.nan_to_num(tactile.matrix(table, channels))
