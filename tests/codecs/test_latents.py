"""Latents of a long recording are added in pieces, to the values of the whole."""

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.codecs import codec, pca, tactile
from tacpipe.codecs.measures import Moments
from tacpipe.errors import TacpipeError
from tests.any_table import bits
from tests.fake_recordings import FakeShard, decode_few_rows_at_a_time
from tests.stages.learning_fakes import CHANNELS, table

ROWS = 1000


def recording() -> FakeShard:
    """Return a walk of all channels with a row that is not finite, and a break in time."""
    rng = np.random.default_rng(0)
    values = np.cumsum(rng.normal(size=(ROWS, len(CHANNELS))), axis=0) * 10
    values[300, 2] = np.nan
    columns = table(values)
    t_ns = columns.column("t_ns").to_numpy().copy()
    t_ns[640:] += 10**9
    return FakeShard("a", columns.set_column(0, columns.schema.field("t_ns"), pa.array(t_ns)))


@pytest.mark.parametrize("representation", ["levels", "increments"])
@pytest.mark.parametrize("rows", [1, 64, 100, 999])
def test_a_long_recording_gets_the_latents_of_the_whole(
    monkeypatch: pytest.MonkeyPatch, representation: str, rows: int
) -> None:
    shard = recording()
    counts = tactile.above_rest(shard.content, tuple(CHANNELS))
    fitted = pca.fit(
        Moments.from_pieces([counts[:300]], len(CHANNELS)),
        CHANNELS,
        [{}] * len(CHANNELS),
        components=3,
        representation=representation,
    )
    files = codec.to_files(fitted)
    expected = tactile.add_latents(shard, files)  # type: ignore[arg-type]
    assert isinstance(expected, pa.Table) and np.isnan(expected.column("z00").to_numpy()[300])

    monkeypatch.setattr(tactile, "SOME_ROWS", 100)
    decode_few_rows_at_a_time(monkeypatch, rows)
    pieces = tactile.add_latents(shard, files)  # type: ignore[arg-type]
    assert isinstance(pieces, pa.RecordBatchReader)
    streamed = pieces.read_all()
    assert streamed.schema.equals(expected.schema, check_metadata=True)
    assert bits(streamed.drop_columns(list(fitted.latents))) == bits(expected.drop_columns(list(fitted.latents)))
    for name in fitted.latents:
        ours, theirs = streamed.column(name).to_numpy(), expected.column(name).to_numpy()
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6, equal_nan=True)


def test_latents_of_other_channels_are_refused_with_the_name_of_the_recording() -> None:
    counts = tactile.above_rest(recording().content, tuple(CHANNELS))
    fitted = pca.fit(Moments.from_pieces([counts[:300, :5]], 5), CHANNELS[:5], [{}] * 5, components=3)
    with pytest.raises(TacpipeError, match="a: The codec does not fit this table"):
        tactile.add_latents(recording(), codec.to_files(fitted))  # type: ignore[arg-type]
