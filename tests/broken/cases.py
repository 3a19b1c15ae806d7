"""Inputs with one fault each, built from scratch, and what a right reading of each is."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tests.formats.bags import writers
from tests.formats.lerobot import files as lerobot
from tests.formats.xdf_writer import Writer

ROWS, START = 200, 1_718_000_000.0
LAYOUT = """[streams.s]
files = "{trial}/s.csv"
time = { column = "time", unit = "%s"%s }
columns = [{ match = "T{taxel}", quantity = "tactile", unit = "count" }]
"""
ARRAYS = """[streams.s]
files = "{trial}/tactile.npy"
time = { file = "{trial}/timestamps.npy", unit = "s" }
columns = [{ match = "tactile_*", quantity = "tactile", unit = "count", shape = [4, 1], axes = ["z"] }]
"""
TABLE = ("ingest table data --layout layout.toml -o rec", "synchronize rec -o sync")
Times = Any  # times in s (time,) of each recording, by name


@dataclass(frozen=True)
class Case:
    """An input in the folder ``data``, the commands that read it with tacpipe, and what is right."""

    fault: str
    build: Callable[[Path], None]
    tools: tuple[str, ...]  # other tools that read such files
    right: Callable[[Any], bool]  # of what a function of `tests.broken.tools` returns
    commands: Sequence[str] = TABLE
    layout: str = LAYOUT % ("s", "")
    words: str = ""  # regular expression for notes that name the fault


def samples(seed: int = 0, rows: int = ROWS) -> Any:
    """Return counts (time, taxel); taxel k is near 1000 k."""
    return np.random.default_rng(seed).integers(-9, 9, (rows, 4)) + 1000 * np.arange(1, 5)


def write_csv(path: Path, times: Sequence[Any], values: Any, names: Sequence[str] = ("T1", "T2", "T3", "T4")) -> None:
    path.parent.mkdir(parents=True)
    rows = [
        ",".join([f"{t:.6f}" if isinstance(t, float) else str(t), *map(str, row)])
        for t, row in zip(times, values, strict=True)
    ]
    path.write_text("\n".join([",".join(["time", *names]), *rows, ""]))


def even(rows: int = ROWS) -> list[float]:
    return [START + i / 100 for i in range(rows)]


def batched(data: Path) -> None:
    write_csv(data / "t1/s.csv", [START + i // 10 / 10 for i in range(ROWS)], samples())


def missing_column(data: Path) -> None:
    for trial in range(6):
        columns = [0, 1, 3] if trial in (1, 4) else [0, 1, 2, 3]
        write_csv(
            data / f"t{trial}/s.csv", even(), samples(trial)[:, columns], [f"T{column + 1}" for column in columns]
        )


def other_order(data: Path) -> None:
    for trial in range(6):
        columns = [3, 2, 1, 0] if trial in (1, 4) else [0, 1, 2, 3]
        write_csv(
            data / f"t{trial}/s.csv", even(), samples(trial)[:, columns], [f"T{column + 1}" for column in columns]
        )


def repeated_hour(data: Path) -> None:
    begin = datetime(2024, 10, 27, 2, 59, 59)
    times = [begin + timedelta(milliseconds=10 * i) - timedelta(hours=i >= 100) for i in range(ROWS)]
    write_csv(data / "t1/s.csv", times, samples())


def copies(data: Path) -> None:
    for trial in range(16):
        write_csv(data / f"t{trial:02d}/s.csv", even(), samples(trial % 12))


def year_1970(data: Path) -> None:
    write_csv(data / "t1/s.csv", [0.0, *even()[1:]], samples())


def arrays(times: Any, values: Any) -> Callable[[Path], None]:
    def build(data: Path) -> None:
        (data / "t1").mkdir(parents=True)
        np.save(data / "t1/tactile.npy", values.reshape(len(values), 4, 1))
        np.save(data / "t1/timestamps.npy", times)

    return build


def unequal_lengths(data: Path) -> None:
    data.mkdir()
    with h5py.File(data / "a.hdf5", "w") as file:
        for name, rows in (("states", 250), ("actions", 200)):
            group = file.create_group(f"data/demo_0/{name}")
            group.attrs["rate_hz"] = 50.0
            group["values"] = np.random.default_rng(rows).normal(size=(rows, 3))


def label_spellings(data: Path) -> None:
    for trial, text in enumerate(("cork", "Cork", '"cork "', "CORK", "foam", "foam", "no", "010", "12:30:45", "3.10")):
        write_csv(data / f"t{trial}/s.csv", even(), samples(trial))
        (data / f"t{trial}/meta.yaml").write_text(f"material: {text}\n")


def other_fps(data: Path) -> None:
    lerobot.write_v3(data / "lr", fps=3 * lerobot.FPS)


def skewed_clocks(data: Path) -> None:
    types, sent = writers.store(), []
    for i in range(400):
        t_ns = 1_718_000_000 * 10**9 + i * 10_000_000
        joint = writers.build(
            types, "sensor_msgs/msg/JointState", header=writers.header(types, t_ns), name=["j"], position=[i / 9]
        )
        force = {"force": {"x": i / 7}}
        wrench = writers.build(
            types, "geometry_msgs/msg/WrenchStamped", header=writers.header(types, t_ns - 2 * 10**9), wrench=force
        )
        sent += [
            ("/joint_states", "sensor_msgs/msg/JointState", t_ns, joint),
            ("/ft", "geometry_msgs/msg/WrenchStamped", t_ns, wrench),
        ]
    data.mkdir()
    writers.ros2(data / "bag", sent, "sqlite3")


def write_xdf(data: Path, streams: Sequence[Any]) -> None:
    data.mkdir()
    writer = Writer()
    for number, stamps in enumerate(streams, 1):
        writer.stream(number, "Skin", "float32", 4)
        writer.numbers(number, "float32", list(stamps), samples(number, len(stamps)))
        writer.footer(number, len(stamps))
    writer.write(data / "s.xdf")


def jump_of_clock(data: Path) -> None:
    stamps = 5000 + np.arange(1000) / 100
    stamps[400:700] += 200_000
    write_xdf(data, [stamps])


def restarted_outlet(data: Path) -> None:
    write_xdf(data, [5000 + np.arange(500) / 100, 5007 + np.arange(500) / 100])


def increase(times: Any) -> bool:
    """Return whether the only recording has all rows, at increasing times within 3 s."""
    (only,) = times.values()
    return len(only) == ROWS and bool((np.diff(only) > 0).all()) and only[-1] - only[0] < 3


def steps_of_10_ms(times: Any) -> bool:
    (only,) = times.values()
    return len(only) == ROWS and bool(np.allclose(np.diff(only), 0.01, atol=1e-5))


TICKS = np.uint64(2**63 + 1001) + samples().astype(np.uint64)
CSV, ARRAY = ("pandas", "polars"), ("pandas", "polars")
CASES = [
    Case("stamps come in batches of ten", batched, CSV, increase, words="stamp"),
    Case("a column is missing in two of six files", missing_column, CSV, lambda times: False, words="T3"),
    Case(
        "columns have another order in two files",
        other_order,
        CSV,
        lambda means: all(abs(m - 1000) < 99 for m in means),
    ),
    Case(
        "an hour that summer time repeats",
        repeated_hour,
        CSV,
        steps_of_10_ms,
        layout=LAYOUT % ("iso8601", ', zone = "Europe/Berlin"'),
        words="time",
    ),
    Case(
        "four recordings are copies, in a split",
        copies,
        CSV,
        lambda roles: all(roles[f"t{i:02d}"] == roles[f"t{i + 12:02d}"] for i in range(4)),
        (*TABLE, "split sync -o split --test 0.3"),
        words="content",
    ),
    Case("the first stamp is of 1970", year_1970, CSV, increase, words="1970|first|days|drop_first"),
    Case(
        "stamps are 32-bit floats",
        arrays(np.array(even(), np.float32), samples()),
        ARRAY,
        increase,
        layout=ARRAYS,
        words="stamp",
    ),
    Case(
        "arrays of one demonstration have 250 and 200 rows",
        unequal_lengths,
        (),
        lambda times: False,
        ("ingest hdf5 data -o rec",),
        words="250",
    ),
    Case(
        "labels in four spellings, and no, 010, 12:30:45",
        label_spellings,
        CSV,
        lambda labels: all(isinstance(value, str) for value in labels) and len(set(labels)) == 6,
        layout=LAYOUT % ("s", "") + '\n[[labels]]\nfile = "{trial}/meta.yaml"\n',
        words="cork|differ",
    ),
    Case(
        "a LeRobot dataset states thrice its rate",
        other_fps,
        CSV,
        lambda times: False,
        ("ingest lerobot data -o rec",),
        words="fps",
    ),
    Case(
        "two topics of a bag are on clocks 2 s apart",
        skewed_clocks,
        ("rosbags",),
        lambda times: False,
        ("ingest rosbag data -o rec",),
        words="clock|log time",
    ),
    Case(
        "unsigned ticks beyond 2^63",
        arrays(np.array(even()), TICKS),
        ARRAY,
        lambda values: np.array_equal(values, TICKS),
        layout=ARRAYS,
        words="uint64",
    ),
    Case(
        "the clock of an XDF stream jumps for 300 samples",
        jump_of_clock,
        ("pyxdf",),
        lambda times: sum(len(t) for t in times.values()) == 1000 and all(np.ptp(t) < 11 for t in times.values()),
        ("ingest xdf data -o rec",),
        words="stamps",
    ),
    Case(
        "an LSL outlet restarts",
        restarted_outlet,
        ("pyxdf",),
        lambda times: [len(t) for t in times.values()] == [1000],
        ("ingest xdf data -o rec",),
        words="outlet|restart",
    ),
]


def build(case: Case, folder: Path) -> None:
    """Write the input of a case and its layout into a folder."""
    case.build(folder / "data")
    if case.commands[0].startswith("ingest table"):
        (folder / "layout.toml").write_text(case.layout)
