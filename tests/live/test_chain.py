"""Samples become forecasts: the same however they are cut, and the same as the stages of a whole recording."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.channels import schema
from tacpipe.codecs import tactile
from tacpipe.codecs.codec import breaks
from tacpipe.errors import TacpipeError
from tacpipe.tasks.forward import prediction, tracks
from tacpipe.tasks.forward import training as forward_training
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.live.chain import BLOCKING, Beginning, Cause, Chain, Forecast
from tacpipe.tasks.forward.predictors import forecasts
from tests.fake_recordings import FakeRecording, dataset
from tests.live import rigs
from tests.live.rigs import MS, T0, Made
from tests.stage_params import fitting
from tests.tasks.forward.trials import panda

KINDS: dict[str, dict[str, Any]] = {
    "raw": {"actions": "none"},
    "planned": {},
    "latents": {"actions": "none", "codec": "pca"},
    "increments": {"actions": "none", "codec": "pca", "representation": "increments"},
    "logged": {"actions": "none"},
    "fresh": {"actions": "none", "grid": "fresh"},
    "ensemble": {"actions": "none", "members": 2},
}
KINDS |= {
    "planned with quantiles": {"calibrated": True},
    "latents with quantiles": {**KINDS["latents"], "calibrated": True},
    "ensemble with quantiles": {**KINDS["ensemble"], "calibrated": True},
}
QUANTILES = {kind: (10, 95) for kind, values in KINDS.items() if "calibrated" in values}
UNIFORM: dict[str, Any] = {"rate_hz": 50.0}
ROWS: dict[str, dict[str, Any]] = {"logged": {}, "fresh": {}}  # at the stamps of the master
GAPS = ("t_ns", "xela1_gap", "xela2_gap", "robot_gap")
GIVEN = rigs.recording(20, gap_ms=200.0)


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Made]:
    return {
        name: rigs.model(tmp_path_factory.mktemp(name), **ROWS.get(name, UNIFORM), **values)
        for name, values in KINDS.items()
    }


def same(found: Sequence[Forecast], wanted: Sequence[Forecast]) -> bool:
    """Whether forecasts are equal to the last bit."""

    def content(one: Forecast) -> tuple[Any, ...]:
        arrays = (None if values is None else values.tobytes() for values in (one.count, one.now, one.quantiles))
        return (one.t_ns, one.made_from_t_ns, *arrays, one.cause, one.gaps)

    return [content(one) for one in found] == [content(one) for one in wanted]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.long
@settings(max_examples=8, deadline=None)
@given(data=st.data())
def test_any_cut_of_a_recording_gives_the_same_forecasts_to_the_last_bit(
    kind: str, models: dict[str, Made], data: st.DataObject
) -> None:
    asked = QUANTILES.get(kind, ())
    wanted = rigs.whole(models[kind], GIVEN, asked)
    assert sum(one.count is not None for one in wanted) > 30
    assert all((one.quantiles is None) == (one.count is None or not asked) for one in wanted)
    cuts = data.draw(st.lists(st.integers(T0 - 10 * MS, T0 + 3000 * MS), max_size=30))
    order = data.draw(st.permutations(sorted(GIVEN.tables)))
    chunk = data.draw(st.sampled_from([1, 7, 1000]))
    fed, found = rigs.chain(models[kind], GIVEN, asked), []
    for name, table, end in rigs.pieces(GIVEN, cuts, order):
        for batch in table.to_batches(max_chunksize=chunk):
            fed.push(name, batch)
        if name == order[-1]:
            found += fed.advance(end)
    assert same(found, wanted)
    assert not any(fed.late.values())


def offline(kind: str, forecaster: Forecaster) -> Any:
    """The recording after the stages that a model was trained behind, run on the whole of it."""
    values = ROWS.get(kind, UNIFORM) | ({"grid": "fresh"} if kind == "fresh" else {})
    shard = rigs.segmented(GIVEN, **values)
    table = shard.content
    if "codec" in KINDS[kind]:
        codec = forecaster.codec
        latents = codec.encode(tactile.above_rest(table, codec.channels), codec.channels, breaks(tactile.times(table)))
        for index, name in enumerate(codec.latents):
            field = pa.field(name, pa.float32(), metadata={"quantity": "latent"})
            table = table.append_column(field, pa.array(latents[:, index]))
    return type(shard)(shard.name, table, shard.attributes)


@pytest.mark.parametrize("kind", ["raw", "latents", "increments", "logged", "fresh", "ensemble"])
def test_forecasts_are_those_of_the_stages_of_the_whole_recording(kind: str, models: dict[str, Made]) -> None:
    made = models[kind]
    forecaster = Forecaster.load(made[0])
    whole = offline(kind, forecaster)
    track = tracks.track(whole, forecaster.codec, forecaster.pose)
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


@pytest.mark.parametrize("kind", ["latents with quantiles", "ensemble with quantiles"])
def test_quantiles_are_those_of_the_stages_of_the_whole_recording(kind: str, models: dict[str, Made]) -> None:
    forecaster = Forecaster.load(models[kind][0])
    recordings = dataset(offline(kind, forecaster), files=forecaster.codec_files)
    table = prediction.tables(forecaster, recordings, [1, 3], QUANTILES[kind])[GIVEN.name]
    by_time = {one.t_ns: one for one in rigs.whole(models[kind], GIVEN, QUANTILES[kind])}
    rows = [row for row, t_ns in enumerate(table["t_ns"].to_pylist()) if by_time[t_ns].quantiles is not None]
    assert len(rows) > 30
    found = [by_time[table["t_ns"][row].as_py()].quantiles for row in rows]
    for channel, name in enumerate(forecaster.codec.channels):
        for step, at, percent in ((1, 0, 10), (1, 1, 95), (3, 0, 10), (3, 1, 95)):
            wanted = table[f"{name}_t{step}_q{percent}"].to_numpy()[rows]
            own = [one[step - 1, channel, at] for one in found if one is not None]
            np.testing.assert_allclose(own, wanted, rtol=1e-4, atol=0.05)


def test_quantiles_that_a_model_does_not_have_are_refused(models: dict[str, Made]) -> None:
    with pytest.raises(TacpipeError, match="tacpipe calibrate MODEL"):
        rigs.chain(models["planned"], GIVEN, [10])
    with pytest.raises(TacpipeError, match="5,10,50,90,95, not 25"):
        rigs.chain(models["planned with quantiles"], GIVEN, [10, 25])


def test_what_comes_later_changes_no_forecast(models: dict[str, Made]) -> None:
    wanted = rigs.whole(models["planned"], GIVEN)
    half_ns = T0 + 1500 * MS
    cut = {name: table.filter(rigs.until(table, half_ns)) for name, table in GIVEN.tables.items()}
    fed = rigs.chain(models["planned"], GIVEN)
    for name, table in cut.items():
        fed.push(name, table)
    found = fed.advance(half_ns)
    assert len(found) > 60 and same(found, wanted[: len(found)])


def test_a_stream_that_is_silent_ends_forecasts_with_its_name_and_they_come_back(models: dict[str, Made]) -> None:
    every = rigs.whole(models["raw"], GIVEN)
    found = [one for one in every if one.now is not None and one.t_ns < T0 + 2500 * MS]
    silent = [one for one in found if one.cause & Cause.GAP]
    assert {one.gaps for one in silent} == {("xela2",)} and all(one.count is None for one in silent)
    table = GIVEN.tables["xela2"]["t_ns"].to_numpy()
    before_ns = int(table[np.diff(table).argmax()])
    assert silent[0].t_ns - before_ns <= (50 + 20) * MS  # a gap is 50 ms, a period 20
    after = [one for one in found if one.t_ns > silent[-1].t_ns]
    assert [one.cause for one in after[:4]] == [Cause.CONTEXT] * 3 + [Cause.NONE]


def test_under_overload_the_newest_grid_point_alone_is_predicted_and_the_others_stay_context(
    models: dict[str, Made],
) -> None:
    wanted = {one.t_ns: one for one in rigs.whole(models["raw"], GIVEN)}
    fed, found = rigs.chain(models["raw"], GIVEN), []
    cuts = [T0 + ms * MS for ms in range(0, 3000, 70)]
    for name, table, end in rigs.pieces(GIVEN, cuts, sorted(GIVEN.tables)):
        fed.push(name, table)
        if name == max(GIVEN.tables):
            found += fed.advance(end, newest_only=True)
    predicted = [one for one in found if one.count is not None]
    skipped = [one for one in found if one.cause is Cause.SKIPPED]
    assert len(skipped) > len(predicted) > 20
    assert same(predicted, [wanted[one.t_ns] for one in predicted])
    assert all(wanted[one.t_ns].count is not None for one in skipped)


def test_samples_that_come_after_their_grid_point_are_counted_and_read_from_then_on(models: dict[str, Made]) -> None:
    fed = rigs.chain(models["raw"], GIVEN)
    at_ns = T0 + 1000 * MS
    for name, table in GIVEN.tables.items():
        fed.push(name, table.filter(rigs.until(table, at_ns - (100 * MS if name == "xela1" else 0))))
    fed.advance(at_ns)
    rest = GIVEN.tables["xela1"]
    late = rest.filter(rigs.until(rest, at_ns)).slice(rest.filter(rigs.until(rest, at_ns - 100 * MS)).num_rows)
    fed.push("xela1", late)
    assert fed.late["xela1"] == late.num_rows > 1
    fed.push("xela1", late.slice(0, 1))  # which runs backwards
    assert fed.late["xela1"] == late.num_rows + 1


def test_a_plan_is_read_from_its_arrival_and_replaces_the_plan_before(models: dict[str, Made]) -> None:
    at_ns = T0 + 1000 * MS

    def found(plans: Sequence[tuple[int, float]]) -> dict[int, Forecast]:
        fed = rigs.chain(models["planned"], GIVEN)
        for name, table in GIVEN.tables.items():
            fed.push(name, table)
        for arrived_ns, far_m in plans:
            t_ns = arrived_ns + np.arange(3) * 500 * MS
            poses = np.column_stack([np.linspace(0.5, 0.5 + far_m, 3), np.zeros(3), np.full(3, 0.3)])
            fed.plan(arrived_ns, t_ns, poses)
        return {one.t_ns: one for one in fed.advance(T0 + 2990 * MS) if one.count is not None}

    without, once, twice = found([]), found([(at_ns, 0.5)]), found([(at_ns, 0.5), (at_ns + 300 * MS, -0.5)])
    assert all(one.cause is Cause.NO_PLAN for one in without.values())
    for t_ns, one in once.items():
        if t_ns < at_ns:
            assert same([one], [without[t_ns]])
        else:
            assert one.cause == (Cause.PLAN_ENDED if t_ns + 60 * MS > at_ns + 1000 * MS else Cause.NONE)
            assert not same([dataclasses.replace(one, cause=Cause.NO_PLAN)], [without[t_ns]])
        if t_ns < at_ns + 1000 * MS:  # after the end of both plans the hand stays where it is
            assert same([one], [twice[t_ns]]) == (t_ns < at_ns + 300 * MS)


def swinging(seed: int, period_ms: int) -> FakeRecording:
    """A rig whose streams share their stamps: two uSkins that feel a Panda swing, and the arm with its joints."""
    rng = np.random.default_rng(seed)
    pose, joints = panda(120)
    t_ns = T0 + np.arange(len(pose)) * period_ms * MS
    felt = np.hstack([pose[:, :3], np.diff(pose[:, :3], axis=0, prepend=pose[:1, :3])]) * 40_000
    touch = [np.round(30_000 + felt * (t_ns > T0 + 300 * MS)[:, None] + rng.normal(0, 2, felt.shape)) for _ in range(2)]
    angles, speeds = schema.joint_fields()
    streams = {
        f"xela{n + 1}": schema.stream(t_ns, values.T.astype(np.uint16), schema.uskin_fields(2))
        for n, values in enumerate(touch)
    }
    arm = [*joints.values(), *pose.T]
    streams["robot"] = schema.stream(t_ns, arm, [*angles, *speeds, *schema.pose_fields()])
    return FakeRecording(streams, f"swing-{seed:03d}")


def test_the_recorded_motion_as_a_plan_gives_the_forecasts_of_evaluate_at_any_rate(tmp_path: Path) -> None:
    """The arm's joints state other velocities than its poses, and the rows are slower than those of training."""
    training = [rigs.segmented(swinging(seed, 20)) for seed in range(3)]
    params = fitting("train.forward", {**rigs.SMALL, "epochs": 8})
    files = forward_training.train(params, dataset(*training[:2]), dataset(training[2]), tmp_path)
    recording = swinging(3, 30)
    forecaster = Forecaster.load(files)
    track = forecaster.track(rigs.segmented(recording))  # type: ignore[arg-type]
    assert np.abs(track.arm - track.planned(np.arange(120)))[1:, 7:10].max() > 0.05
    fed = rigs.chain((files, [rigs.step("synchronize"), rigs.step("segment.contacts")]), recording)
    for name, table in recording.tables.items():
        fed.push(name, table)
    pose = panda(120)[0]
    for row in range(119):
        fed.plan(int(track.t_ns[row]), track.t_ns[row : row + 5], pose[row : row + 5])
    live = {forecast.t_ns: forecast for forecast in fed.advance(int(track.t_ns[-1])) if forecast.count is not None}
    (batch,) = forecasts(forecaster, track, track.starts(forecaster.context, forecaster.horizon))
    at_ns = track.t_ns[batch.now].tolist()
    compared = [(live[t_ns], count) for t_ns, count in zip(at_ns, batch.count, strict=True) if t_ns in live]
    farthest = 0.0
    for forecast, count in compared:
        assert forecast.cause is Cause.NONE and forecast.count is not None and forecast.now is not None
        np.testing.assert_allclose(forecast.count, count, rtol=1e-4, atol=0.1)
        farthest = max(farthest, float(np.abs(forecast.count - forecast.now).max()))
    assert len(compared) > 90 and farthest > 20  # hardly persistence


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda streams: {"robot": streams["robot"], "xela1": streams["xela1"]}, "xela2_taxel01_x"),
        (lambda streams: {"xela1": streams["xela1"], "xela2": streams["xela2"]}, "robot_position_x_m"),
        (lambda streams: {**streams, "xela2": streams["xela2"].remove(2)}, "xela2_taxel01_y"),
        (lambda streams: {**streams, "xela2": rigs.more(streams["xela2"])}, "xela2_taxel03_x"),
        (lambda streams: {**streams, "xela2": rigs.unit(streams["xela2"], "kPa")}, "own units"),
    ],
)
def test_a_rig_of_other_streams_than_the_models_is_refused_by_the_name_of_what_differs(
    models: dict[str, Made], change: Any, named: str
) -> None:
    streams = change({name: table.schema for name, table in GIVEN.tables.items()})
    with pytest.raises(TacpipeError, match=named):
        Chain.for_model(*models["planned"], streams)


@pytest.mark.parametrize(
    ("steps", "named"),
    [
        ([rigs.step("segment.contacts")], "synchronize"),
        ([rigs.step("synchronize"), rigs.step("segment.contacts", rest="lowest")], "lowest"),
        ([rigs.step("synchronize"), rigs.step("segment.slips"), rigs.step("segment.contacts")], "segment slips"),
        ([{**rigs.step("synchronize"), "version": 1}, rigs.step("segment.contacts")], "version 1"),
    ],
)
def test_a_model_behind_stages_that_look_ahead_is_refused_by_their_name(
    models: dict[str, Made], steps: Any, named: str
) -> None:
    with pytest.raises(TacpipeError, match=named):
        Chain.for_model(models["raw"][0], steps, {name: table.schema for name, table in GIVEN.tables.items()})


def test_a_model_of_rows_that_look_ahead_is_refused_unless_that_is_allowed(tmp_path: Path) -> None:
    interpolated = rigs.model(tmp_path, **UNIFORM, values="interpolate")
    schemas = {name: table.schema for name, table in GIVEN.tables.items()}
    stated = json.loads(interpolated[0]["config.json"])["look_ahead"]
    assert 0 < stated["mean_ms"] < stated["max_ms"]
    with pytest.raises(TacpipeError, match=f"at most {stated['max_ms']:g} ms.*--allow-look-ahead"):
        Chain.for_model(*interpolated, schemas)
    assert Chain.for_model(*interpolated, schemas, allow_look_ahead=True).rate_hz == 50.0
    older = json.loads(interpolated[0]["config.json"])
    del older["look_ahead"]
    step = {"stage": "synchronize", "version": 2, "params": {"grid": "logged", "rate_hz": 50.0}, "fitted": None}
    files = {**interpolated[0], "config.json": json.dumps(older).encode()}
    contacts = rigs.step("segment.contacts")
    with pytest.raises(TacpipeError, match="interpolated"):
        Chain.for_model(files, [step, contacts], schemas)
    held = {**step, "params": {"grid": "logged", "rate_hz": 50.0, "causal": True}}
    assert Chain.for_model(files, [held, contacts], schemas).streams


@pytest.mark.parametrize("kind", ["raw", "latents", "logged"])
def test_a_chain_that_continues_a_session_predicts_the_same_once_it_has_its_context(
    kind: str, models: dict[str, Made]
) -> None:
    calm = rigs.recording(21, wraps=False)
    wanted = {one.t_ns: one for one in rigs.whole(models[kind], calm)}
    first = rigs.chain(models[kind], calm)
    half_ns = T0 + 1400 * MS
    for name, table in calm.tables.items():
        first.push(name, table.filter(rigs.until(table, half_ns)))
    assert first.beginning is None
    first.advance(half_ns)
    schemas = {name: table.schema for name, table in calm.tables.items()}
    second = Chain.for_model(*models[kind], schemas, beginning=first.beginning)
    for name, table in calm.tables.items():
        second.push(name, table.slice(table.filter(rigs.until(table, half_ns)).num_rows))
    found = [one for one in second.advance(T0 + 2900 * MS) if one.count is not None]
    assert len(found) > 40 and found[0].t_ns < half_ns + 250 * MS
    assert same(found, [wanted[one.t_ns] for one in found])


def test_counts_that_had_run_over_their_end_are_continued_at_the_turn_that_is_nearest_to_the_rest(
    models: dict[str, Made],
) -> None:
    given = rigs.recording(21)  # whose counts run over 65,535 and back
    wanted = {one.t_ns: one for one in rigs.whole(models["raw"], given)}
    first = rigs.chain(models["raw"], given)
    half_ns = T0 + 1400 * MS
    for name, table in given.tables.items():
        first.push(name, table.filter(rigs.until(table, half_ns)))
    first.advance(half_ns)
    schemas = {name: table.schema for name, table in given.tables.items()}
    beginning = first.beginning
    assert beginning is not None
    assert Beginning.from_json(json.loads(json.dumps(beginning.to_json()))) == beginning
    second = Chain.for_model(*models["raw"], schemas, beginning=beginning)
    for name, table in given.tables.items():
        second.push(name, table.slice(table.filter(rigs.until(table, half_ns)).num_rows))
    found = [one for one in second.advance(T0 + 2900 * MS) if one.count is not None]
    assert len(found) > 40 and same(found, [wanted[one.t_ns] for one in found])


def test_a_chain_takes_from_the_model_how_long_slow_streams_may_pause(tmp_path: Path) -> None:
    """The rows of sensors at 9 Hz follow one another by the gap of the training recordings, not by that of the session."""
    slow = {name: table.take(np.arange(0, table.num_rows, 5)) for name, table in rigs.recording(4, 20.0).tables.items()}
    given = FakeRecording(slow, "slow")
    shards = [rigs.segmented(given) for _ in range(2)]
    stages = [rigs.step("synchronize"), rigs.step("segment.contacts")]
    files = forward_training.train(
        fitting("train.forward", rigs.SMALL), dataset(shards[0]), dataset(shards[1]), tmp_path
    )
    gap_ms = json.loads(files["config.json"])["gap_ms"]
    steps = np.diff(slow["xela1"]["t_ns"].to_numpy()) / MS
    assert gap_ms["xela1"] == pytest.approx(2.5 * np.median(steps)) and gap_ms["robot"] == pytest.approx(50.0, abs=90)
    forecasts = rigs.whole((files, stages), given)
    gaps = {forecast.t_ns: bool(forecast.gaps) for forecast in forecasts if Cause.START not in forecast.cause}
    masks = {
        t_ns: any(row)
        for t_ns, *row in zip(*(shards[0].content[name].to_pylist() for name in GAPS), strict=True)
        if t_ns in gaps
    }
    assert gaps == masks and sum(gaps.values()) < len(gaps) / 10
