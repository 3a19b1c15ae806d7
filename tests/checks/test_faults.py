"""Test that `tacpipe check` finds each injected fault, and nothing in recordings without faults."""

import json
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

import tacpipe
from tacpipe.channels import schema
from tests.conftest import Lab
from tests.fake_recordings import write_dataset

Streams = dict[str, pa.Table]
Recordings = dict[str, tuple[Streams, dict[str, Any]]]
Fault = Callable[[Recordings], None]
CLEAN = {
    "forward": "--trials 8 --duration-s 4",
    "material": "--trials 16 --arm-every 0",
    "touch": "--trials 12",
    "gel": "--trials 4 --duration-s 4",
}


@pytest.mark.parametrize("task", CLEAN)
def test_simulated_recordings_of_each_task_have_no_finding(task: str, lab: Lab) -> None:
    lab.run(f"simulate {task} -o recordings {CLEAN[task]}")
    ran = lab.call("check recordings")
    assert (ran.code, ran.out.splitlines()[0].partition(" in ")[0]) == (0, "0 findings"), ran.out


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Recordings]:
    """Recordings of the arm and two skins without faults; stamps are sampling times."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("simulated"))
        tacpipe.run("simulate.forward", output="recordings", trials=8, duration_s=6, drop_probability=0.0, jobs=1)
        recordings: Recordings = {}
        for recording in tacpipe.open("recordings"):
            streams = {name: recording.table(name) for name in ("robot", "xela1", "xela2")}
            recordings[recording.name] = (
                {name: evenly_stamped(table) for name, table in streams.items()},
                {"object": ("cup", "box")[len(recordings) % 2]},
            )
        yield recordings


def evenly_stamped(table: pa.Table) -> pa.Table:
    """Return a stream with even stamps, without counter and device clock."""
    rate_hz = 50 if table.num_rows < 1000 else 1000
    t_ns = np.arange(table.num_rows) * (10**9 // rate_hz)
    return with_times(table.drop_columns(["seq", "t_device_ns"]), t_ns)


def with_times(table: pa.Table, t_ns: Any) -> pa.Table:
    return replaced(table, "t_ns", np.asarray(t_ns))


def replaced(table: pa.Table, name: str, values: Any) -> pa.Table:
    field = table.schema.field(name)
    return table.set_column(table.column_names.index(name), field, pa.array(values, field.type))


def change(stream: str, column: str, change_values: Callable[[Any], Any], *names: str) -> Fault:
    """Return a fault that changes one column of a stream in the first recording or in those named."""

    def inject(recordings: Recordings) -> None:
        for name in names or ["trial-000"]:
            table = recordings[name][0][stream]
            values = change_values(table[column].to_numpy().copy())
            recordings[name][0][stream] = replaced(table, column, values)

    return inject


def put(rows: Any, value: Any) -> Callable[[Any], Any]:
    def set_values(values: Any) -> Any:
        values[rows] = value
        return values

    return set_values


def drop_rows(stream: str, first: int, stop: int) -> Fault:
    def inject(recordings: Recordings) -> None:
        streams = recordings["trial-000"][0]
        table = streams[stream]
        streams[stream] = pa.concat_tables([table.slice(0, first), table.slice(stop)])

    return inject


def swap_columns(recordings: Recordings) -> None:
    streams = recordings["trial-000"][0]
    table = streams["xela1"]
    first, second = table["taxel01_x"].to_numpy(), table["taxel07_z"].to_numpy()
    streams["xela1"] = replaced(replaced(table, "taxel01_x", second), "taxel07_z", first)


def freeze(recordings: Recordings) -> None:
    streams = recordings["trial-000"][0]
    table = streams["xela1"]
    rows = np.arange(table.num_rows)
    rows[100:180] = 100
    streams["xela1"] = replaced(table.take(rows), "t_ns", table["t_ns"].to_numpy())


def hold(recordings: Recordings) -> None:
    for streams, _ in recordings.values():
        table = streams["xela1"]
        streams["xela1"] = replaced(table.take(np.arange(table.num_rows) // 4 * 4), "t_ns", table["t_ns"].to_numpy())


def reorder(recordings: Recordings) -> None:
    streams = recordings["trial-002"][0]
    streams["xela1"] = streams["xela1"].select(streams["xela1"].column_names[:1] + streams["xela1"].column_names[:0:-1])


def lack_column(recordings: Recordings) -> None:
    streams = recordings["trial-002"][0]
    streams["xela1"] = streams["xela1"].drop_columns(["taxel05_y"])


def lack_stream(recordings: Recordings) -> None:
    del recordings["trial-002"][0]["xela2"]


def shift(stream: str, seconds: float) -> Fault:
    def inject(recordings: Recordings) -> None:
        for streams, _ in recordings.values():
            streams[stream] = with_times(streams[stream], streams[stream]["t_ns"].to_numpy() + round(seconds * 1e9))

    return inject


def copy_with(change_rows: Callable[[pa.Table], pa.Table]) -> Fault:
    def inject(recordings: Recordings) -> None:
        streams, labels = recordings["trial-003"]
        copied = {
            name: change_rows(with_times(table, table["t_ns"].to_numpy() + 10**12)) for name, table in streams.items()
        }
        recordings["other-name"] = (copied, labels)

    return inject


def without_some_rows(table: pa.Table) -> pa.Table:
    return table.take(np.flatnonzero(np.random.default_rng(1).random(table.num_rows) > 0.02))


def copy_stream(recordings: Recordings) -> None:
    streams = recordings["trial-003"][0]
    streams["xela2"] = streams["xela1"]


def cut_end(recordings: Recordings) -> None:
    """End every recording at rest, but the first under load."""
    for name, (streams, _) in recordings.items():
        for stream in ("xela1", "xela2"):
            table = streams[stream]
            half = np.concatenate([np.arange(table.num_rows), np.arange(table.num_rows)[::-1]])
            times = np.arange(len(half)) * 20_000_000
            noisy = replaced(table.take(half), "t_ns", times)
            rows = noisy.num_rows if name != "trial-000" else noisy.num_rows * 6 // 10
            streams[stream] = noisy.slice(0, rows)
        streams.pop("robot")


def logged(delay_ns: Callable[[Any], Any]) -> Fault:
    """Return a fault that adds log times to all streams, those of the robot with the delay of each stamp."""

    def inject(recordings: Recordings) -> None:
        for streams, _ in recordings.values():
            for stream, table in streams.items():
                t_ns = table["t_ns"].to_numpy()
                log_ns = t_ns + 2_000_000 + (delay_ns(t_ns) if stream == "robot" else 0)
                field = pa.field("t_log_ns", pa.int64(), metadata={"quantity": "time", "unit": "ns"})
                streams[stream] = table.append_column(field, pa.array(log_ns))

    return inject


def count_back(recordings: Recordings) -> None:
    """Add a counter of 16 bits, which wraps, to a stream."""
    streams = recordings["trial-000"][0]
    field = pa.field("t_device_ns", pa.int64(), metadata={"quantity": "time", "unit": "ns"})
    streams["robot"] = streams["robot"].append_column(field, pa.array(streams["robot"]["t_ns"].to_numpy() % 2**32))


def declare(period_ns: int) -> Fault:
    def inject(recordings: Recordings) -> None:
        for streams, _ in recordings.values():
            table = streams["xela1"]
            field = schema.time_field(period_ns=period_ns)
            streams["xela1"] = table.set_column(0, field, table["t_ns"])

    return inject


def relabel(**labels: Any) -> Fault:
    def inject(recordings: Recordings) -> None:
        recordings["trial-000"][1].update(labels)

    return inject


def decades_away(values: Any) -> Any:
    return values + np.where(np.arange(len(values)) == 0, 0, 1_718_000_000 * 10**9)


FAULTS: dict[str, tuple[Fault, set[str]]] = {
    "log times fit the stamps": (logged(lambda t_ns: 0), set()),
    "header and log are 2 s apart in one stream": (logged(lambda t_ns: 2 * 10**9), {"clock-offset"}),
    "header and log drift": (logged(lambda t_ns: t_ns // 20), {"clock-drift"}),
    "a device's clock wraps": (count_back, {"extra-columns", "steps-back"}),
    "the declared rate is right": (declare(20_000_000), set()),
    "the declared rate is wrong": (declare(30_000_000), {"rate"}),
    "stamps of three rows are equal": (
        change("xela1", "t_ns", lambda t: np.sort(put(slice(50, 53), t[50])(t))),
        {"equal-stamps"},
    ),
    "stamps are whole seconds": (change("xela1", "t_ns", lambda t: t // 10**9 * 10**9), {"resolution"}),
    "stamps come in batches of ten": (
        change("xela1", "t_ns", lambda t: t[np.arange(len(t)) // 10 * 10]),
        {"resolution"},
    ),
    "stamps are rounded to 50 ms": (
        change("xela1", "t_ns", lambda t: t * 3 // 2 // 50_000_000 * 50_000_000),
        {"resolution"},
    ),
    "the first stamp is decades away": (change("robot", "t_ns", decades_away), {"jump", "little-common-time"}),
    "a second is missing": (drop_rows("xela1", 100, 150), {"gap"}),
    "a stream ends early": (drop_rows("xela1", 200, 300), {"little-common-time"}),
    "a stream is faster than declared elsewhere": (
        change("robot", "t_ns", lambda t: t // 1000),
        {"other-rate", "little-common-time"},
    ),
    "values are missing": (change("robot", "position_x_m", put(slice(10, 20), np.nan)), {"missing-values"}),
    "a taxel is dead": (
        change("xela1", "taxel03_z", lambda v: np.full_like(v, 37_000), *(f"trial-00{i}" for i in range(8))),
        {"constant-channel"},
    ),
    "a taxel saturates": (change("xela1", "taxel03_z", put(slice(200, 260), 65_535)), {"saturated"}),
    "a sample jumps": (change("xela1", "taxel03_z", put(120, 9_000)), {"spikes"}),
    "two channels are swapped": (swap_columns, {"swapped-channels"}),
    "a skin stops": (freeze, {"frozen", "repeated-rows"}),
    "rows are held": (hold, {"repeated-rows"}),
    "columns have another order": (reorder, {"column-order"}),
    "a column is missing": (lack_column, {"missing-columns"}),
    "a stream is missing": (lack_stream, {"missing-streams"}),
    "a skin is late": (shift("xela2", 0.5), {"lag"}),
    "a recording is copied with another name and clock": (copy_with(lambda table: table), {"equal-recordings"}),
    "a copy lacks some rows": (copy_with(without_some_rows), {"similar-recordings"}),
    "half a recording is copied": (
        copy_with(lambda table: table.slice(0, table.num_rows // 2)),
        {"similar-recordings", "short"},
    ),
    "a stream is recorded twice": (copy_stream, {"equal-streams"}),
    "an episode is cut": (cut_end, {"ends-under-load"}),
    "labels differ in case": (relabel(object="Cup "), {"label-variants"}),
    "a label is no text": (relabel(object=False), {"label-kinds"}),
}


def kinds(lab: Lab) -> set[str]:
    ran = lab.call("check data --json")
    findings = json.loads(ran.out)["findings"]
    assert ran.code == (1 if findings else 0), ran.err
    return {finding["kind"] for finding in findings}


@pytest.mark.parametrize("fault", FAULTS)
def test_an_injected_fault_is_found_and_nothing_else(fault: str, simulated: Recordings, lab: Lab) -> None:
    recordings = {name: (dict(streams), dict(labels)) for name, (streams, labels) in simulated.items()}
    inject, expected = FAULTS[fault]
    inject(recordings)
    write_dataset(lab.folder / "data", recordings)
    assert kinds(lab) == expected


def test_recordings_without_faults_have_no_finding(simulated: Recordings, lab: Lab) -> None:
    write_dataset(lab.folder / "data", simulated)
    assert kinds(lab) == set()
