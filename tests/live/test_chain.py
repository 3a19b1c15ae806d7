"""Samples become forecasts: the same however they are cut, and the same as the stages of a whole recording."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.codecs import tactile
from tacpipe.codecs.frame_stacking import breaks
from tacpipe.live.chain import BLOCKING, Cause, Forecast
from tacpipe.tasks.forward import tracks
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.predictors import forecasts
from tests.live import rigs
from tests.live.rigs import MS, T0, Made

KINDS: dict[str, dict[str, Any]] = {
    "raw": {"actions": "none"},
    "planned": {},
    "latents": {"actions": "none", "codec": "pca"},
    "increments": {"actions": "none", "codec": "pca", "representation": "increments"},
    "logged": {"actions": "none", "grid": "logged"},
    "fresh": {"actions": "none", "grid": "fresh"},
}
GIVEN = rigs.recording(20, gap_ms=200.0)


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Made]:
    return {name: rigs.model(tmp_path_factory.mktemp(name), causal=True, **values) for name, values in KINDS.items()}


def same(found: Sequence[Forecast], wanted: Sequence[Forecast]) -> bool:
    """Whether forecasts are equal to the last bit."""

    def content(one: Forecast) -> tuple[Any, ...]:
        arrays = (None if values is None else values.tobytes() for values in (one.count, one.now))
        return (one.t_ns, one.made_from_t_ns, *arrays, one.cause, one.gaps)

    return [content(one) for one in found] == [content(one) for one in wanted]


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=8, deadline=None)
@given(data=st.data())
def test_any_cut_of_a_recording_gives_the_same_forecasts_to_the_last_bit(
    kind: str, models: dict[str, Made], data: st.DataObject
) -> None:
    wanted = rigs.whole(models[kind], GIVEN)
    assert sum(one.count is not None for one in wanted) > 30
    cuts = data.draw(st.lists(st.integers(T0 - 10 * MS, T0 + 3000 * MS), max_size=30))
    order = data.draw(st.permutations(sorted(GIVEN.tables)))
    chunk = data.draw(st.sampled_from([1, 7, 1000]))
    fed, found = rigs.chain(models[kind], GIVEN), []
    for name, table, end in rigs.pieces(GIVEN, cuts, order):
        for batch in table.to_batches(max_chunksize=chunk):
            fed.push(name, batch)
        if name == order[-1]:
            found += fed.advance(end)
    assert same(found, wanted)
    assert not any(fed.late.values())


@pytest.mark.parametrize("kind", ["raw", "latents", "increments", "logged", "fresh"])
def test_forecasts_are_those_of_the_stages_of_the_whole_recording(kind: str, models: dict[str, Made]) -> None:
    made = models[kind]
    values = {"causal": True, **{name: KINDS[kind][name] for name in ("grid",) if name in KINDS[kind]}}
    shard = rigs.segmented(GIVEN, **values)
    forecaster = Forecaster.load(made[0])
    table = shard.content
    if "codec" in KINDS[kind]:
        codec = forecaster.codec
        latents = codec.encode(tactile.above_rest(table, codec.channels), codec.channels, breaks(tactile.times(table)))
        for index, name in enumerate(codec.latents):
            field = rigs.pa.field(name, rigs.pa.float32(), metadata={"quantity": "latent"})
            table = table.append_column(field, rigs.pa.array(latents[:, index]))
    track = tracks.track(type(shard)(shard.name, table, shard.attributes), forecaster.codec, forecaster.pose)
    by_time = {one.t_ns: one for one in rigs.whole(made, GIVEN)}
    known = sorted(t_ns for t_ns, one in by_time.items() if one.now is not None)
    assert known == track.t_ns[-len(known) :].tolist()
    for row, t_ns in enumerate(track.t_ns.tolist()):
        one = by_time[t_ns]
        if one.now is not None:
            assert one.now.tobytes() == track.tactile[row].astype(np.float32).tobytes()
            assert bool(one.cause & (Cause.GAP | Cause.VALUE)) != bool(track.usable[row])
    starts = track.starts(forecaster.context, forecaster.horizon)
    compared = 0
    for some in forecasts(forecaster, track, starts):
        for row, count in zip(some.now, some.count, strict=True):
            one = by_time[int(track.t_ns[row])]
            if one.cause is Cause.START:
                continue
            assert one.count is not None
            np.testing.assert_allclose(one.count, count, rtol=1e-5, atol=1e-4 * np.abs(count).max())
            compared += 1
    assert compared > 30
    assert all((one.count is None) == bool(one.cause & BLOCKING) for one in by_time.values())
