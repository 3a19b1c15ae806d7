"""Compress tactile channels to a few latents, fitted on the training recordings alone.

The latents are added as columns ``z00``, ``z01``, …; all other columns stay. Channels are those whose field metadata
says ``quantity=tactile``; their rest level is taken off before. ``codec.json`` and ``codec.safetensors`` hold what is
needed to go back to counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.stage import stage

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.dataset import Dataset, Shard
    from tacpipe.stage import Fitted, Result


@dataclass(frozen=True)
class Params:
    """How many latents to keep."""

    components: int = 20  # latents to keep, at most the number of channels; the paper kept 20
    variance: float = 0.0  # keep as many latents as hold this share of the variance instead; 0 counts components


@stage(version=1)
def fit(params: Params, train: Dataset) -> Result:
    """Return the codec fitted on all rows of the training recordings that no gap touches."""
    import numpy as np

    from tacpipe.codecs import pca, tactile
    from tacpipe.codecs.codec import check_channels
    from tacpipe.errors import TacpipeError
    from tacpipe.stage import Result

    if not train.shards:
        raise TacpipeError("There is no training recording to fit a codec on. Make a split that has some.")
    values, channels, layout = [], None, []
    for name, shard in sorted(train.shards.items()):
        table = shard.table()
        found = tactile.columns(table.schema, "tactile")
        if channels is None:
            channels, layout = found, tactile.layout(table.schema, found)
        try:
            check_channels(channels, found)
            counts = tactile.above_rest(table, channels)
        except TacpipeError as error:
            raise TacpipeError(f"{name}: {error}") from error
        values.append(counts[~tactile.gaps(table) & np.isfinite(counts).all(axis=1)])
    if not channels:
        raise TacpipeError("The recordings have no tactile channel (field metadata quantity=tactile) to compress.")
    codec = pca.fit(np.concatenate(values), channels, layout, components=params.components, variance=params.variance)
    return Result(files=codec.to_files())


@stage(version=1, fit=fit)
def pca(params: Params, recording: Shard, codec: Fitted) -> pa.Table:
    """Add the principal components of the tactile channels as columns ``z00``, ``z01``, ….

    Raises `TacpipeError` where the recording's channels are not those the codec was fitted on.
    """
    import pyarrow as pa

    from tacpipe.codecs import codec as codecs
    from tacpipe.codecs import tactile
    from tacpipe.errors import TacpipeError

    fitted, table = codecs.load(codec), recording.table()
    channels = tactile.columns(table.schema, "tactile")
    try:
        codecs.check_channels(fitted.channels, channels)
        latents = fitted.encode(tactile.above_rest(table, channels), channels)  # (time, latent)
    except TacpipeError as error:
        raise TacpipeError(f"{recording.name}: {error}") from error
    for index, name in enumerate(fitted.latents):
        field = pa.field(name, pa.float32(), metadata={"quantity": "latent", "unit": "1"})
        table = table.append_column(field, pa.array(latents[:, index]))
    return table
