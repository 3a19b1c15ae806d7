"""Test that `tacpipe predict --causal` reproduces the messages of a live session and reads no later sample."""

from typing import Any

import pyarrow as pa
import pytest

import tacpipe
from tacpipe.tasks.forward.live.chain import LiveChain
from tests.conftest import Lab
from tests.live.sessions import CALIBRATED, TRAINED

MS = 1_000_000


QUANTILES = (10, 90)


@pytest.mark.long
def test_what_a_session_published_is_what_predict_causal_writes_to_the_last_bit(lab: Lab) -> None:
    for command in (*TRAINED, CALIBRATED):
        lab.run(command)
    ran = lab.run("predict models/g data/r -o data/p --steps 1,2 --causal --quantiles 90,10")
    assert "plan" in ran.err
    predictions = tacpipe.open("data/p")
    for recording in tacpipe.open("data/r"):
        published = session({name: recording.table(name) for name in recording.streams})
        table = predictions[recording.name].table()
        assert table["t_ns"].to_pylist() == [forecast.t_ns for forecast in published] != []
        for step in (1, 2):
            for index, name in enumerate(table.schema.names[1::6]):
                name = f"{name.removesuffix('_t1')}_t{step}"
                assert table[name].to_numpy().tobytes() == b"".join(
                    forecast.count[step - 1, index] for forecast in published
                )
                for at, level in enumerate(QUANTILES):
                    expected = b"".join(forecast.quantiles[step - 1, index, at] for forecast in published)
                    assert table[f"{name}_q{level}"].to_numpy().tobytes() == expected
        assert predictions[recording.name].attributes["forecast_no_plan"] == len(published)
    ran = lab.call("predict models/f data/c -o data/after --causal")
    assert ran.code == 2 and "trial-000" in ran.err  # arrivals cannot be seen after a stage
    ran = lab.call("predict models/f data/r -o data/without --causal --quantiles 10")
    assert ran.code == 2 and "tacpipe calibrate MODEL" in ran.err
    lab.run("predict models/f data/r -o data/without --steps 1,2 --causal")
    name = next(iter(predictions.recordings))
    without = tacpipe.open("data/without")[name].table()
    assert predictions[name].table().select(without.column_names).equals(without)


def session(tables: dict[str, pa.Table]) -> list[Any]:
    """The forecasts of a session in which each sample came alone, two milliseconds late."""
    model = tacpipe.open("models/g")
    schemas = {name: table.schema for name, table in tables.items()}
    chain = LiveChain.for_model(model.files, model.source.chain, schemas, quantiles=QUANTILES)
    arrivals = sorted(
        (t_ns, name, row)
        for name, table in tables.items()
        if name in chain.streams
        for row, t_ns in enumerate(table["t_ns"].to_pylist())
    )
    forecasts = []
    for t_ns, name, row in arrivals:
        forecasts += chain.advance(t_ns - 2 * MS)
        chain.push(name, tables[name].slice(row, 1).to_batches()[0])
    forecasts += chain.advance(arrivals[-1][0])
    return [forecast for forecast in forecasts if forecast.count is not None]
