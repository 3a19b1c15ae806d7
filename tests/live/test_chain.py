"""Samples become forecasts: the same however they are cut, and the same as the stages of a whole recording."""

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
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.signals.runs import run_starts
from tacpipe.tasks.forward import prediction, tracks
from tacpipe.tasks.forward import training as forward_training
from tacpipe.tasks.forward.forecaster import Forecaster
from tacpipe.tasks.forward.live.chain import BLOCKING, Cause, GridForecast, LiveChain
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
ROWS: dict[str, dict[str, Any]] = {"logged": {}, "fresh": {}}  # rows at the stamps of the master
GAPS = ("t_ns", "xela1_gap", "xela2_gap", "robot_gap")
GIVEN = rigs.recording(20, gap_ms=200.0)


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Made]:
    return {
        name: rigs.model(tmp_path_factory.mktemp(name), **ROWS.get(name, UNIFORM), **values)
        for name, values in KINDS.items()
    }


def same(forecasts: Sequence[GridForecast], expected: Sequence[GridForecast]) -> bool:
    """Return whether forecasts are equal to the last bit."""

    def content(forecast: GridForecast) -> tuple[Any, ...]:
        arrays = (
            None if values is None else values.tobytes()
            for values in (forecast.count, forecast.now, forecast.quantiles)
        )
        return (forecast.t_ns, forecast.made_from_t_ns, *arrays, forecast.cause, forecast.gaps)

    return [content(forecast) for forecast in forecasts] == [content(forecast) for forecast in expected]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.long
@settings(max_examples=8, deadline=None)
@given(data=st.data())
def test_any_cut_of_a_recording_gives_the_same_forecasts_to_the_last_bit(
    kind: str, models: dict[str, Made], data: st.DataObject
) -> None:
    levels = QUANTILES.get(kind, ())
    expected = rigs.all_forecasts(models[kind], GIVEN, levels)
    assert sum(forecast.count is not None for forecast in expected) > 30
    assert all((forecast.quantiles is None) == (forecast.count is None or not levels) for forecast in expected)
    cuts = data.draw(st.lists(st.integers(T0 - 10 * MS, T0 + 3000 * MS), max_size=30))
    order = data.draw(st.permutations(sorted(GIVEN.tables)))
    chunk = data.draw(st.sampled_from([1, 7, 1000]))
    fed, forecasts = rigs.chain(models[kind], GIVEN, levels), []
    for name, table, end in rigs.pieces(GIVEN, cuts, order):
        for batch in table.to_batches(max_chunksize=chunk):
            fed.push(name, batch)
        if name == order[-1]:
            forecasts += fed.advance(end)
    assert same(forecasts, expected)
    assert not any(fed.late.values())


def offline(kind: str, forecaster: Forecaster) -> Any:
    """The recording after the stages that a model was trained behind, run on the whole of it."""
    values = ROWS.get(kind, UNIFORM) | ({"grid": "fresh"} if kind == "fresh" else {})
    shard = rigs.segmented(GIVEN, **values)
    table = shard.content
    if "codec" in KINDS[kind]:
        codec = forecaster.codec
        latents = codec.encode(
            tactile.above_rest(table, codec.channels), codec.channels, run_starts(tactile.times(table))
        )
        for index, name in enumerate(codec.latents):
            field = pa.field(name, pa.float32(), metadata={"quantity": "latent"})
            table = table.append_column(field, pa.array(latents[:, index]))
    return type(shard)(shard.name, table, shard.attributes)


@pytest.mark.parametrize("kind", ["raw", "latents", "increments", "logged", "fresh", "ensemble"])
def test_forecasts_are_those_of_the_stages_of_the_whole_recording(kind: str, models: dict[str, Made]) -> None:
    model = models[kind]
    forecaster = Forecaster.load(model[0])
    offline_rows = offline(kind, forecaster)
    track = tracks.track(offline_rows, forecaster.codec, forecaster.pose)
    by_time = {forecast.t_ns: forecast for forecast in rigs.all_forecasts(model, GIVEN)}
    last_ns = int(track.t_ns[-1])  # rows of a session go on after the master's last sample
    known_ns = sorted(t_ns for t_ns, forecast in by_time.items() if forecast.now is not None and t_ns <= last_ns)
    assert known_ns == track.t_ns[-len(known_ns) :].tolist()
    for row, t_ns in enumerate(track.t_ns.tolist()):
        forecast = by_time[t_ns]
        if forecast.now is not None:
            assert forecast.now.tobytes() == track.tactile[row].astype(np.float32).tobytes()
            assert bool(forecast.cause & (Cause.GAP | Cause.VALUE)) != bool(track.usable[row])
    starts = track.starts(forecaster.context, forecaster.horizon)
    compared = 0
    for batch in forecasts(forecaster, track, starts):
        for row, count in zip(batch.now, batch.count, strict=True):
            forecast = by_time[int(track.t_ns[row])]
            if forecast.cause is Cause.START:
                continue
            assert forecast.count is not None
            np.testing.assert_allclose(forecast.count, count, rtol=1e-5, atol=1e-4 * np.abs(count).max())
            compared += 1
    assert compared > 30
    assert all((forecast.count is None) == bool(forecast.cause & BLOCKING) for forecast in by_time.values())


@pytest.mark.parametrize("kind", ["latents with quantiles", "ensemble with quantiles"])
def test_quantiles_are_those_of_the_stages_of_the_whole_recording(kind: str, models: dict[str, Made]) -> None:
    forecaster = Forecaster.load(models[kind][0])
    recordings = dataset(offline(kind, forecaster), files=forecaster.codec_files)
    table = prediction.tables(forecaster, recordings, [1, 3], QUANTILES[kind])[GIVEN.name]
    by_time = {forecast.t_ns: forecast for forecast in rigs.all_forecasts(models[kind], GIVEN, QUANTILES[kind])}
    rows = [row for row, t_ns in enumerate(table["t_ns"].to_pylist()) if by_time[t_ns].quantiles is not None]
    assert len(rows) > 30
    live_quantiles = [by_time[table["t_ns"][row].as_py()].quantiles for row in rows]
    for channel, name in enumerate(forecaster.codec.channels):
        for step, at, percent in ((1, 0, 10), (1, 1, 95), (3, 0, 10), (3, 1, 95)):
            expected = table[f"{name}_t{step}_q{percent}"].to_numpy()[rows]
            published = [values[step - 1, channel, at] for values in live_quantiles if values is not None]
            np.testing.assert_allclose(published, expected, rtol=1e-4, atol=0.05)


def test_quantiles_that_a_model_does_not_have_are_refused(models: dict[str, Made]) -> None:
    with pytest.raises(TacpipeError, match="tacpipe calibrate MODEL"):
        rigs.chain(models["planned"], GIVEN, [10])
    with pytest.raises(TacpipeError, match="5,10,50,90,95, not 25"):
        rigs.chain(models["planned with quantiles"], GIVEN, [10, 25])


def test_what_comes_later_changes_no_forecast(models: dict[str, Made]) -> None:
    expected = rigs.all_forecasts(models["planned"], GIVEN)
    half_ns = T0 + 1500 * MS
    cut = {name: table.filter(rigs.until(table, half_ns)) for name, table in GIVEN.tables.items()}
    fed = rigs.chain(models["planned"], GIVEN)
    for name, table in cut.items():
        fed.push(name, table)
    forecasts = fed.advance(half_ns)
    assert len(forecasts) > 60 and same(forecasts, expected[: len(forecasts)])


def test_a_stream_that_is_silent_ends_forecasts_with_its_name_and_they_come_back(models: dict[str, Made]) -> None:
    all_forecasts = rigs.all_forecasts(models["raw"], GIVEN)
    forecasts = [forecast for forecast in all_forecasts if forecast.now is not None and forecast.t_ns < T0 + 2500 * MS]
    silent = [forecast for forecast in forecasts if forecast.cause & Cause.GAP]
    assert {forecast.gaps for forecast in silent} == {("xela2",)} and all(forecast.count is None for forecast in silent)
    table = GIVEN.tables["xela2"]["t_ns"].to_numpy()
    before_ns = int(table[np.diff(table).argmax()])
    assert silent[0].t_ns - before_ns <= (50 + 20) * MS  # a gap is 50 ms, a period 20
    after = [forecast for forecast in forecasts if forecast.t_ns > silent[-1].t_ns]
    assert [forecast.cause for forecast in after[:4]] == [Cause.CONTEXT] * 3 + [Cause.NONE]


def test_under_overload_the_newest_grid_point_alone_is_predicted_and_the_others_stay_context(
    models: dict[str, Made],
) -> None:
    expected = {forecast.t_ns: forecast for forecast in rigs.all_forecasts(models["raw"], GIVEN)}
    fed, forecasts = rigs.chain(models["raw"], GIVEN), []
    cuts = [T0 + ms * MS for ms in range(0, 3000, 70)]
    for name, table, end in rigs.pieces(GIVEN, cuts, sorted(GIVEN.tables)):
        fed.push(name, table)
        if name == max(GIVEN.tables):
            forecasts += fed.advance(end, newest_only=True)
    predicted = [forecast for forecast in forecasts if forecast.count is not None]
    skipped = [forecast for forecast in forecasts if forecast.cause is Cause.SKIPPED]
    assert len(skipped) > len(predicted) > 20
    assert same(predicted, [expected[forecast.t_ns] for forecast in predicted])
    assert all(expected[forecast.t_ns].count is not None for forecast in skipped)


def test_samples_that_come_after_their_grid_point_are_counted_and_read_from_then_on(models: dict[str, Made]) -> None:
    fed = rigs.chain(models["raw"], GIVEN)
    at_ns = T0 + 1000 * MS
    for name, table in GIVEN.tables.items():
        fed.push(name, table.filter(rigs.until(table, at_ns - (100 * MS if name == "xela1" else 0))))
    fed.advance(at_ns)
    xela1 = GIVEN.tables["xela1"]
    late = xela1.filter(rigs.until(xela1, at_ns)).slice(xela1.filter(rigs.until(xela1, at_ns - 100 * MS)).num_rows)
    fed.push("xela1", late)
    assert fed.late["xela1"] == late.num_rows > 1
    fed.push("xela1", late.slice(0, 1))  # time runs backwards
    assert fed.late["xela1"] == late.num_rows + 1


def test_a_plan_is_read_from_its_arrival_and_replaces_the_plan_before(models: dict[str, Made]) -> None:
    at_ns = T0 + 1000 * MS

    def forecasts_with(plans: Sequence[tuple[int, float]]) -> dict[int, GridForecast]:
        fed = rigs.chain(models["planned"], GIVEN)
        for name, table in GIVEN.tables.items():
            fed.push(name, table)
        for arrived_ns, far_m in plans:
            t_ns = arrived_ns + np.arange(3) * 500 * MS
            poses = np.column_stack([np.linspace(0.5, 0.5 + far_m, 3), np.zeros(3), np.full(3, 0.3)])
            fed.push("plan", rigs.plan_table(arrived_ns, t_ns, poses))
        return {forecast.t_ns: forecast for forecast in fed.advance(T0 + 2990 * MS) if forecast.count is not None}

    without, once, twice = (
        forecasts_with([]),
        forecasts_with([(at_ns, 0.5)]),
        forecasts_with([(at_ns, 0.5), (at_ns + 300 * MS, -0.5)]),
    )
    assert all(forecast.cause is Cause.NO_PLAN for forecast in without.values())
    for t_ns, forecast in once.items():
        if t_ns < at_ns:
            assert same([forecast], [without[t_ns]])
        else:
            assert forecast.cause == (Cause.PLAN_ENDED if t_ns + 60 * MS > at_ns + 1000 * MS else Cause.NONE)
            assert not same([dataclasses.replace(forecast, cause=Cause.NO_PLAN)], [without[t_ns]])
        if t_ns < at_ns + 1000 * MS:  # the hand stays where it is
            assert same([forecast], [twice[t_ns]]) == (t_ns < at_ns + 300 * MS)


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
    assert np.abs(track.arm - track.planned_arm(np.arange(120)))[1:, 7:10].max() > 0.05
    fed = rigs.chain((files, [rigs.step("synchronize"), rigs.step("segment.contacts")]), recording)
    for name, table in recording.tables.items():
        fed.push(name, table)
    pose = panda(120)[0]
    for row in range(119):
        fed.push("plan", rigs.plan_table(int(track.t_ns[row]), track.t_ns[row : row + 5], pose[row : row + 5]))
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
    ("change", "pattern"),
    [
        (lambda streams: {"robot": streams["robot"], "xela1": streams["xela1"]}, "xela2_taxel01_x"),
        (lambda streams: {"xela1": streams["xela1"], "xela2": streams["xela2"]}, "robot_position_x_m"),
        (lambda streams: {**streams, "xela2": streams["xela2"].remove(2)}, "xela2_taxel01_y"),
        (lambda streams: {**streams, "xela2": rigs.with_another_taxel(streams["xela2"])}, "xela2_taxel03_x"),
        (lambda streams: {**streams, "xela2": rigs.with_unit(streams["xela2"], "kPa")}, "own units"),
    ],
)
def test_a_rig_of_other_streams_than_the_models_is_refused_by_the_name_of_what_differs(
    models: dict[str, Made], change: Any, pattern: str
) -> None:
    streams = change({name: table.schema for name, table in GIVEN.tables.items()})
    with pytest.raises(TacpipeError, match=pattern):
        LiveChain.for_model(*models["planned"], streams)


@pytest.mark.parametrize(
    ("steps", "pattern"),
    [
        ([rigs.step("segment.contacts")], "synchronize"),
        ([rigs.step("synchronize"), rigs.step("segment.contacts", rest="lowest")], "lowest"),
        ([rigs.step("synchronize"), rigs.step("segment.slips"), rigs.step("segment.contacts")], "segment slips"),
        ([{**rigs.step("synchronize"), "version": 1}, rigs.step("segment.contacts")], "version 1"),
    ],
)
def test_a_model_behind_stages_that_look_ahead_is_refused_by_their_name(
    models: dict[str, Made], steps: Any, pattern: str
) -> None:
    with pytest.raises(TacpipeError, match=pattern):
        LiveChain.for_model(models["raw"][0], steps, {name: table.schema for name, table in GIVEN.tables.items()})


def test_a_model_of_rows_that_look_ahead_is_refused_unless_that_is_allowed(tmp_path: Path) -> None:
    interpolated = rigs.model(tmp_path, **UNIFORM, values="interpolate")
    schemas = {name: table.schema for name, table in GIVEN.tables.items()}
    look_ahead = json.loads(interpolated[0]["config.json"])["look_ahead"]
    assert 0 < look_ahead["mean_ms"] < look_ahead["max_ms"]
    with pytest.raises(TacpipeError, match=f"at most {look_ahead['max_ms']:g} ms.*--allow-look-ahead"):
        LiveChain.for_model(*interpolated, schemas)
    assert LiveChain.for_model(*interpolated, schemas, allow_look_ahead=True).rate_hz == 50.0


@pytest.mark.parametrize("version", [2, 3])
def test_a_model_of_rows_of_an_earlier_version_is_refused_with_what_trains_it_again(
    models: dict[str, Made], version: int
) -> None:
    steps: Any = [{**rigs.step("synchronize"), "version": version}, rigs.step("segment.contacts")]
    with pytest.raises(
        UsageError, match=f"version {version} of synchronize.*Run `tacpipe synchronize`.*`tacpipe train`"
    ):
        LiveChain.for_model(models["raw"][0], steps, {name: table.schema for name, table in GIVEN.tables.items()})


@pytest.mark.parametrize("kind", ["raw", "latents", "logged"])
def test_a_chain_that_continues_a_session_predicts_the_same_once_it_has_its_context(
    kind: str, models: dict[str, Made]
) -> None:
    calm = rigs.recording(21, wraps=False)
    expected = {forecast.t_ns: forecast for forecast in rigs.all_forecasts(models[kind], calm)}
    first = rigs.chain(models[kind], calm)
    half_ns = T0 + 1400 * MS
    for name, table in calm.tables.items():
        first.push(name, table.filter(rigs.until(table, half_ns)))
    assert first.beginning is None
    first.advance(half_ns)
    schemas = {name: table.schema for name, table in calm.tables.items()}
    second = LiveChain.for_model(*models[kind], schemas, beginning=first.beginning)
    for name, table in calm.tables.items():
        second.push(name, table.slice(table.filter(rigs.until(table, half_ns)).num_rows))
    forecasts = [forecast for forecast in second.advance(T0 + 2900 * MS) if forecast.count is not None]
    assert len(forecasts) > 40 and forecasts[0].t_ns < half_ns + 250 * MS
    assert same(forecasts, [expected[forecast.t_ns] for forecast in forecasts])


def test_counts_that_had_run_over_their_end_are_continued_at_the_turn_that_is_nearest_to_the_rest(
    models: dict[str, Made],
) -> None:
    recording = rigs.recording(21)  # its counts run over 65,535 and back
    expected = {forecast.t_ns: forecast for forecast in rigs.all_forecasts(models["raw"], recording)}
    first = rigs.chain(models["raw"], recording)
    half_ns = T0 + 1400 * MS
    for name, table in recording.tables.items():
        first.push(name, table.filter(rigs.until(table, half_ns)))
    first.advance(half_ns)
    schemas = {name: table.schema for name, table in recording.tables.items()}
    beginning = first.beginning
    assert beginning is not None
    assert json.loads(json.dumps(beginning)) == beginning
    second = LiveChain.for_model(*models["raw"], schemas, beginning=beginning)
    for name, table in recording.tables.items():
        second.push(name, table.slice(table.filter(rigs.until(table, half_ns)).num_rows))
    forecasts = [forecast for forecast in second.advance(T0 + 2900 * MS) if forecast.count is not None]
    assert len(forecasts) > 40 and same(forecasts, [expected[forecast.t_ns] for forecast in forecasts])


def test_a_chain_takes_from_the_model_how_long_slow_streams_may_pause(tmp_path: Path) -> None:
    """The rows of sensors at 9 Hz follow one another by the gap of the training recordings, not by that of the session."""
    slow = {name: table.take(np.arange(0, table.num_rows, 5)) for name, table in rigs.recording(4, 20.0).tables.items()}
    recording = FakeRecording(slow, "slow")
    shards = [rigs.segmented(recording) for _ in range(2)]
    stages = [rigs.step("synchronize"), rigs.step("segment.contacts")]
    files = forward_training.train(
        fitting("train.forward", rigs.SMALL), dataset(shards[0]), dataset(shards[1]), tmp_path
    )
    gap_ms = json.loads(files["config.json"])["gap_ms"]
    steps = np.diff(slow["xela1"]["t_ns"].to_numpy()) / MS
    assert gap_ms["xela1"] == pytest.approx(2.5 * np.median(steps)) and gap_ms["robot"] == pytest.approx(50.0, abs=90)
    forecasts = rigs.all_forecasts((files, stages), recording)
    gaps = {forecast.t_ns: bool(forecast.gaps) for forecast in forecasts if Cause.START not in forecast.cause}
    masks = {
        t_ns: any(row)
        for t_ns, *row in zip(*(shards[0].content[name].to_pylist() for name in GAPS), strict=True)
        if t_ns in gaps
    }
    assert gaps == masks and sum(gaps.values()) < len(gaps) / 10
