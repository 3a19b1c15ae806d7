import numpy as np
import pyarrow as pa
import pytest

from tacpipe.formats.table import preview
from tacpipe.formats.table.preview import Steps


@pytest.mark.parametrize("count", [0, 1, 2, 5, 1000])
def test_steps_that_are_counted_have_the_median_of_all(count: int) -> None:
    values = np.random.default_rng(count).integers(0, 300, count)
    result = Steps()
    for part in np.array_split(values, 3):
        result.add(part)
    assert result.median_ns() == (np.median(values) if count else 0)
    assert result.longer(100) == (values > 100).sum() and result.longest_ns() == values.max(initial=0)


def test_steps_that_all_differ_are_counted_in_bounded_memory() -> None:
    values = np.random.default_rng(0).normal(1e9, 1e7, 2 * preview.MAX_DIFFERENT).astype(np.int64)
    result = Steps()
    for part in np.array_split(values, 50):
        result.add(part)
    assert len(result._steps) <= preview.MAX_DIFFERENT
    assert abs(result.median_ns() - np.median(values)) < 300
    assert result.longest_ns() == values.max()


def test_a_preview_of_batches_is_that_of_their_table() -> None:
    rng = np.random.default_rng(0)
    t_ns = np.cumsum(rng.choice([10, 11, 50], 1000, p=[0.6, 0.39, 0.01]))
    fx = rng.normal(size=1000)
    fx[100:300] = np.nan
    table = pa.table({"t_ns": t_ns, "fx": fx, "on": rng.random(1000) > 0.5, "note": ["x"] * 1000})
    batches = pa.RecordBatchReader.from_batches(table.schema, iter(table.to_batches(max_chunksize=7)))
    result = preview.summarize_stream(batches)
    assert result == preview.summarize_stream(table)
    assert (result.rows, result.rate_hz, result.gaps) == (1000, 1e9 / 10, int((np.diff(t_ns) > 30).sum()))
    assert result.columns["fx"][3:] == (np.nanmin(fx), np.nanmax(fx))
    assert result.first.equals(table.slice(0, preview.SHOWN_ROWS))
