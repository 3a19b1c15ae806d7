"""The latents of a recording, which a fitted codec gives: what `tacpipe compress` adds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pyarrow as pa

from tacpipe.codecs import codec as codecs
from tacpipe.codecs import frame_stacking, stored, tactile
from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Recording
    from tacpipe.plugins.stage import Fitted


def added(recording: Recording, fitted: Fitted) -> pa.Table:
    """Return the recording's table with its latents, float32 columns, by the codec whose files were ``fitted``.

    Raises `TacpipeError` where the recording's channels are not those the codec was fitted on.
    """
    codec, table = stored.load(fitted), recording.table()
    channels = tactile.columns(table.schema, "tactile")
    try:
        codecs.check_channels(codec.channels, channels)
        begins = frame_stacking.breaks(tactile.times(table))
        latents = codec.encode(tactile.above_rest(table, channels), channels, begins)  # (time, latent)
        stored.check_latents(codec, latents, table.num_rows)
    except TacpipeError as error:
        raise TacpipeError(f"{recording.name}: {error}") from error
    for index, name in enumerate(codec.latents):
        field = pa.field(name, pa.float32(), metadata={"quantity": "latent", "unit": "1"})
        table = table.append_column(field, pa.array(latents[:, index], pa.float32()))
    return table
