import numpy as np
import pyarrow as pa
import pytest

from tacpipe.formats.table import preview


@pytest.mark.parametrize("count", [0, 1, 2, 5, 1000])
def test_the_rate_gaps_and_longest_step_of_a_preview_are_those_of_all_steps(count: int) -> None:
    steps_ns = np.random.default_rng(count).integers(0, 300, count)
    t_ns = np.concatenate([[0], np.cumsum(steps_ns)])
    table = pa.table({"t_ns": t_ns})
    result = preview.summarize_stream(pa.RecordBatchReader.from_batches(table.schema, table.to_batches(7)))
    median_ns = np.median(steps_ns) if count else 0
    assert result.rate_hz == (1e9 / median_ns if median_ns else 0)
    assert result.gaps == (steps_ns > 3 * median_ns).sum() and result.longest_s == steps_ns.max(initial=0) / 1e9


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
