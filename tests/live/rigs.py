"""The recording of a small rig with two sensors and an arm, and models with preprocessing stages."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.channels import schema
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.plugins.stage import RecordingOutput
from tacpipe.sensors import plan
from tacpipe.store.records import Step
from tacpipe.tasks.forward import calibration as forward_calibration
from tacpipe.tasks.forward import training as forward_training
from tacpipe.tasks.forward.live.chain import GridForecast, LiveChain
from tacpipe.tasks.task import CalibrationRequest
from tests.fake_recordings import FakeRecording, FakeShard, dataset
from tests.stage_params import fitting

T0 = 1_700_000_000_000_000_000
MS = 1_000_000
# the defaults of `tacpipe calibrate`
ASKED = CalibrationRequest((5, 10, 50, 90, 95), promise=False, false_unknown=0.05, seed=0)
# Four epochs of small batches: with fewer steps the weight of the forecast is 0, and every forecast is persistence.
SMALL = {"architecture": "gru", "hidden": 8, "epochs": 4, "batch": 16, "context": 4, "horizon": 3}
Made = tuple[Mapping[str, bytes], Sequence[Step]]


def recording(seed: int, seconds: float = 3.0, gap_ms: float = 0.0, *, wraps: bool = True) -> FakeRecording:
    """Two uSkins at about 45 Hz and an arm at about 100 Hz, each with stamps of its own; counts wrap around, or not.

    For ``gap_ms`` in the middle the second uSkin is silent.
    """
    rng = np.random.default_rng(seed)
    streams = {}
    for number, (period_ms, fields) in enumerate(
        [(22.0, schema.uskin_fields(2)), (22.0, schema.uskin_fields(2)), (10.0, schema.pose_fields())]
    ):
        t_ms = np.cumsum(rng.gamma(20.0, period_ms / 20.0, int(seconds * 1e3 / period_ms)))
        if number == 1 and gap_ms:
            t_ms = t_ms[(t_ms < 500 * seconds) | (t_ms > 500 * seconds + gap_ms)]
        t_ns = T0 + (t_ms * MS).astype(np.int64)
        x = 0.1 * np.sin(t_ms / 300)
        if number < 2:
            touch = (65_400 if wraps else 30_000) + 4000 * x[:, None] * np.linspace(0.2, 1.0, 6) * (t_ms > 600)[:, None]
            values = np.round(touch + rng.normal(0, 2, (len(t_ms), 6))) % 65_536
            streams[f"xela{number + 1}"] = schema.stream(t_ns, values.T, fields)
        else:
            half = 0.3 * np.sin(t_ms / 500)
            zero = np.zeros_like(x)
            pose = [0.5 + x, zero, 0.3 + x / 2, zero, zero, np.sin(half), np.cos(half)]
            streams["robot"] = schema.stream(t_ns, np.array(pose) * np.sign(half + 10)[None], fields)
    return FakeRecording(streams, f"trial-{seed:03d}")


def plan_table(arrived_ns: int, t_ns: Any, poses: Any) -> pa.Table:
    """Return a plan as its stream has it, from ``poses`` (point, 3 or 7) at times ``t_ns`` (point,)."""
    rows = np.full((len(poses), plan.NUMBERS), np.nan)
    rows[:, : np.shape(poses)[1]] = poses
    arrays = [np.full(len(t_ns), arrived_ns, np.int64), np.asarray(t_ns, np.int64), *rows.T]
    return pa.Table.from_arrays(
        list(map(pa.array, arrays)), schema=pa.schema([schema.time_field(), *plan.Plan().fields()])
    )


def stage(name: str, recording: Any, **values: Any) -> FakeShard:
    """A recording after a map stage."""
    output = registry.load(name)(registry.load(name).params(**values), recording)
    assert isinstance(output, RecordingOutput)
    return FakeShard(recording.name, output.streams[""], {**recording.attributes, **output.attributes})


def segmented(recording: FakeRecording, **values: Any) -> FakeShard:
    """A recording after `synchronize` and `segment contacts`."""
    return stage("segment.contacts", stage("synchronize", recording, **values))


def step(name: str, **values: Any) -> Step:
    """A link of a chain as manifests have it."""
    loaded_stage = registry.load(name)
    params = params_of.to_json(loaded_stage.params(**values))
    return {"stage": name, "version": loaded_stage.version, "params": params, "fitted": None}


def model(
    folder: Path, codec: str = "raw", representation: str = "levels", *, calibrated: bool = False, **values: Any
) -> Made:
    """The files of a small model, and the chain that it was trained behind; ``values`` are params of both."""
    names = {"grid", "rate_hz", "gap_ms", "unwrap", "values", "master"}
    sync = {name: value for name, value in values.items() if name in names}
    shards = [segmented(recording(seed), **sync) for seed in range(4)]
    steps = [step("synchronize", **sync), step("segment.contacts")]
    parts = [dataset(*shards[:2]), *map(dataset, shards[2:])]
    if codec == "pca":
        compress = registry.load("compress.pca")
        compression = compress.params(components=3, representation=representation)
        assert compress.fit is not None
        files = dict(compress.fit(compression, parts[0]).files)
        compressed = [FakeShard(shard.name, compress(compression, shard, files), shard.attributes) for shard in shards]
        parts = [dataset(*compressed[:2], files=files), *(dataset(shard, files=files) for shard in compressed[2:])]
        steps.append(step("compress.pca", components=3, representation=representation))
    trained = {name: value for name, value in values.items() if name not in names}
    params = fitting("train.forward", {**SMALL, **trained})
    files = forward_training.train(params, parts[0], parts[1], folder)
    return (forward_calibration.calibrate(files, ASKED, parts[0], parts[2]) if calibrated else files), steps


def chain(files_and_steps: Made, recording: FakeRecording, quantiles: Sequence[int] = ()) -> LiveChain:
    """The chain of a model, for the streams of a recording."""
    return LiveChain.for_model(
        *files_and_steps, {name: table.schema for name, table in recording.tables.items()}, quantiles=quantiles
    )


def all_forecasts(files_and_steps: Made, recording: FakeRecording, quantiles: Sequence[int] = ()) -> list[GridForecast]:
    """The forecasts of a recording that is given whole."""
    fed = chain(files_and_steps, recording, quantiles)
    for name, table in recording.tables.items():
        fed.push(name, table)
    return fed.advance(max(int(table["t_ns"][-1].as_py()) for table in recording.tables.values()))


def pieces(
    recording: FakeRecording, cuts_ns: Sequence[int], order: Sequence[str]
) -> Iterator[tuple[str, pa.Table, int]]:
    """Yield stream, table and end of the pieces between times, those of one time in an ``order`` of streams."""
    last = max(int(table["t_ns"][-1].as_py()) for table in recording.tables.values())
    before = 0
    for cut in [*sorted({cut for cut in cuts_ns if cut < last}), last]:
        for name in order:
            t_ns = recording.tables[name]["t_ns"].to_numpy()
            first, stop = np.searchsorted(t_ns, [before, cut], side="right").tolist()
            yield name, recording.tables[name].slice(first, stop - first), cut
        before = cut


def until(table: pa.Table, t_ns: int) -> pa.Array:
    """Return which rows of a stream had arrived by a time."""
    return pa.array(table["t_ns"].to_numpy() <= t_ns)


def with_another_taxel(schema_fields: pa.Schema) -> pa.Schema:
    """The schema of a uSkin with another taxel."""
    return schema_fields.append(schema.uskin_fields(3)[6])


def with_unit(stream_schema: pa.Schema, unit_name: str) -> pa.Schema:
    """The schema of a stream whose first channel is in another unit."""
    field = stream_schema.field(1)
    return stream_schema.set(1, field.with_metadata({**field.metadata, b"unit": unit_name.encode()}))
