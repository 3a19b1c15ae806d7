"""All that reads what others wrote, each as a function of bytes with valid examples: what hypothesis and atheris try.

A function returns, or raises a `TacpipeError`; anything else is a defect. A format, a sensor or a kind of cloud that is
registered is here by itself, or a test says that it is missing.
"""

import atexit
import contextlib
import functools
import io
import json
import os
import re
import shutil
import sqlite3
import tempfile
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tacpipe.clouds import files as cloud_files
from tacpipe.clouds import point_files
from tacpipe.clouds.cloud import DepthFrame
from tacpipe.codecs import codec
from tacpipe.codecs.measures import Moments
from tacpipe.codecs.pca import fit
from tacpipe.datasets import manifest
from tacpipe.io.hashing import digest
from tacpipe.io.parquet import from_parquet, to_parquet
from tacpipe.links import hid
from tacpipe.plugins import given_params, registry
from tacpipe.plugins.stage import Source
from tacpipe.recording import rig, spool, spool_folders
from tacpipe.recording.spool_folders import SpoolHeader
from tacpipe.sensors.framing import Chunks
from tacpipe.store.records import Content, RecordingEntry, Shard, Step
from tests.conftest import Lab, Ran
from tests.formats import grasp_files, slide_files, video_files, xdf_writer, xela_files
from tests.formats.arrays import files as array_files
from tests.formats.bags import writers
from tests.formats.lerobot import files as lerobot_files
from tests.promises import decoding
from tests.sensors.test_every_sensor import CASES

HERE = Path(__file__).parents[2]
NAMED = Path("given")


@dataclass(frozen=True)
class Target:
    """Something that reads bytes."""

    name: str
    run: Callable[[bytes], object]  # raises a TacpipeError for what it cannot read
    examples: Callable[[], Sequence[bytes]]  # Examples that it can read.
    slow: bool = False  # a try takes more than a few milliseconds


def targets() -> dict[str, Target]:
    """Return all of them by name."""
    all_targets = [
        Target("parquet", from_parquet, _parquets),
        Target("manifest", lambda data: manifest.parse(data, "given"), _manifests),
        Target("params", _params, lambda: [(HERE / "params.yaml").read_bytes(), b"synchronize: {rate_hz: 50}\n"]),
        Target("rig", _rig, lambda: [path.read_bytes() for path in sorted((HERE / "rigs").glob("*.toml"))]),
        Target("spool", _spool, _spools),
        Target("pcd", lambda data: point_files.parse_pcd(NAMED, data), _pcds),
        Target("ply", lambda data: point_files.parse_ply(NAMED, data), _plys),
        Target("depth-frame", lambda data: DepthFrame.from_bytes(data).points(), _frames),
        Target("report-descriptor", hid.parse_report_descriptor, _descriptors),
        Target("codec", _codec, lambda: _parts(_codec_files())),
    ]
    partial = functools.partial
    all_targets += [
        Target(f"cloud{end}", partial(_cloud, end), partial(_clouds, end), True) for end in cloud_files.SUFFIXES
    ]
    all_targets += [Target(f"format {name}", partial(_format, name), partial(_trees, name), True) for name in TREES]
    all_targets += [
        Target(f"sensor {case}", partial(decoding.run, case), partial(decoding.examples, case)) for case in CASES
    ]
    return {re.sub(r"[^a-z0-9.]+", "-", target.name): target for target in all_targets}


@functools.cache
def _folder() -> Path:
    """Return a folder of this process."""
    return _temporary("fuzz")


def _temporary(name: str) -> Path:
    """Return a new folder, which goes when the process ends."""
    folder = tempfile.mkdtemp(prefix=f"tacpipe-{name}-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def _write_input(name: str, data: bytes) -> Path:
    path = _folder() / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    return path


@functools.cache
def _parquets() -> list[bytes]:
    rng = np.random.default_rng(0)
    columns = {
        "t_ns": pa.array(np.arange(50) * 20_000_000),
        "taxel": pa.array(rng.integers(0, 60_000, 50).astype(np.uint16)),
        "force": pa.array(rng.normal(size=50)),
        "event": pa.array(["start", "stop"] * 25),
        "contact": pa.array([True, False] * 25),
    }
    field = pa.field("taxel", pa.uint16(), metadata={"unit": "count"})
    small = pa.table({"taxel": columns["taxel"]}, pa.schema([field]))
    foreign = io.BytesIO()
    pq.write_table(pa.table(columns), foreign)
    return [to_parquet(pa.table(columns)), to_parquet(small), to_parquet(small.slice(0, 0)), foreign.getvalue()]


CHAIN: list[Step] = [{"stage": "ingest.xela-flat", "version": 1, "params": {}, "fitted": None}]


@functools.cache
def _manifests() -> list[bytes]:
    shard: Shard = {"digest": digest("a"), "rows": 5, "bytes": 500}
    file: Content = {"digest": digest("a"), "bytes": 500}
    entry: RecordingEntry = {"attributes": {"material": "cork", "trial": 3}, "shards": {"xela1": shard, "robot": shard}}
    full_manifest = manifest.Manifest(
        "synchronize", 2, {"rate_hz": 50.0}, recordings={"trial-01": entry}, files={"codec.json": file}, chain=CHAIN
    )
    return [full_manifest.content, manifest.Manifest("split", 1).content]


def _params(data: bytes) -> object:
    stage = registry.load("synchronize")
    return given_params.build("synchronize", stage, file=_write_input("params.yaml", data))


def _rig(data: bytes) -> object:
    parsed = rig.read(_write_input("rig.toml", data))
    return [stream.sensor.fields() for stream in parsed.streams.values()]


HEADER: SpoolHeader = {
    "output": "o",
    "recording": "r",
    "attributes": {},
    "rig": "",
    "streams": ["a", "b"],
    "clock": {"monotonic_ns": 1, "utc_ns": 2},
}


def _spool(data: bytes) -> object:
    """Read a spool whose header, or whose blocks are ``data``, as its first byte tells."""
    headed = data[:1] == b"\1"
    _write_input("spool/header.json", data[1:] if headed else json.dumps(HEADER).encode())
    _write_input("spool/bytes", _spools()[0][1:] if headed else data[1:])
    read_spool = spool.Spooled(_folder() / "spool")
    read = list(read_spool.blocks())
    for _, block in read:
        if isinstance(block, Chunks):
            assert sum(map(len, block.packets())) == len(block.data)
    assert sum(damage.bytes for damage in read_spool.damage) <= len(data) + len(_spools()[0])
    spool_folders.check_header(read_spool.header, ["a", "b"])
    return read_spool.tallied()


@functools.cache
def _spools() -> list[bytes]:
    written_spool = spool.Spool(_folder(), HEADER, ["a", "b"])
    for number in range(5):
        written_spool.append("ab"[number % 2], Chunks.from_pairs([(number, bytes([number] * 9)), (number + 1, b"xy")]))
        written_spool.note(spool.StreamNote(number, "a", "lost", "unplugged"))
    written_spool.write()
    content = (written_spool.folder / "bytes").read_bytes()
    written_spool.close()
    return [b"\0" + content, b"\1" + json.dumps(HEADER).encode()]


@functools.cache
def _pcds() -> list[bytes]:
    points, colours = grasp_files.points_m(count=8), grasp_files.colours(count=8)
    rows = "".join(f"{x:g} {y:g} {z:g} 4.2e+06\n" for x, y, z in points.tolist())
    full_file = grasp_files.header(8).encode() + grasp_files.packed(points, colours)
    return [full_file, full_file + bytes(64), (grasp_files.header(8, "ascii") + rows).encode()]


@functools.cache
def _plys() -> list[bytes]:
    points, colours = grasp_files.points_m(count=8), grasp_files.colours(count=8)
    full_file = point_files.pack_ply(points, colours)
    text = full_file[: full_file.index(b"end_header")].replace(b"binary_little_endian", b"ascii") + b"end_header\n"
    rows = "".join(f"{x:g} {y:g} {z:g} {r} {g} {b}\n" for (x, y, z), (r, g, b) in zip(points, colours, strict=True))
    return [full_file, point_files.pack_ply(points, None), text + rows.encode()]


@functools.cache
def _frames() -> list[bytes]:
    depth = np.arange(12, dtype=np.uint16).reshape(3, 4)
    coloured = DepthFrame(depth, (4.0, 4.0), (2.0, 1.5), 0.001, np.zeros((3, 4, 3), np.uint8))
    return [coloured.to_bytes(), DepthFrame(depth, (4.0, 4.0), (2.0, 1.5), 0.001).to_bytes()]


def _descriptors() -> list[bytes]:
    return [bytes.fromhex("06abff 0a0002 a101 7508 1500 26ff00 9540 0901 8102 9540 0902 9102 c0")]


@functools.cache
def _codec_files() -> dict[str, bytes]:
    names = [f"taxel{number}" for number in range(5)]
    rows = np.random.default_rng(0).normal(size=(40, 5))
    return dict(
        sorted(fit(Moments.from_pieces([rows], 5), names, [{"stream": "xela1"}] * 5, components=2).to_files().items())
    )


def _codec(data: bytes) -> object:
    return codec.load(replace_one(_codec_files(), data))


def replace_one(files: dict[str, bytes], data: bytes) -> dict[str, bytes]:
    """Return ``files`` with the content of one of them, as the first byte of ``data`` tells, taken from the rest."""
    names = list(files)
    return files | {names[data[0] % len(names)]: data[1:]} if data else files


def _parts(files: dict[str, bytes]) -> list[bytes]:
    return [bytes([number]) + content for number, content in enumerate(files.values())]


def _cloud(suffix: str, data: bytes) -> object:
    return cloud_files.read(_write_input(f"cloud{suffix}", data))


@functools.cache
def _clouds(suffix: str) -> list[bytes]:
    from tests.clouds.test_files import write

    points, colours = grasp_files.points_m(count=8), grasp_files.colours(count=8)
    ways: list[dict[str, Any]] = [{}]
    ways += [{"write_ascii": True}] if suffix in (".ply", ".pcd") else []
    ways += [{"compressed": True}] if suffix == ".pcd" else []
    normals = "".join(f"{x:g} {y:g} {z:g} 0 0 1\n" for x, y, z in points.tolist()).encode()
    if suffix == ".xyzn":
        return [normals]
    return [write(_folder() / f"made{suffix}", points, colours, **way).read_bytes() for way in ways]


def _biotac(folder: Path) -> None:
    slide_files.write_biotac(folder)


def _roboskin(folder: Path) -> None:
    slide_files.write_roboskin(folder, slide_files.touched(1, 20))


def _grasps(folder: Path) -> None:
    grasp_files.write_grasp(folder)


LAYOUT = """
[streams.skin]
files = "{trial}.csv"
time = { column = "time" }
columns = [{ match = "x", unit = "N" }]
[[labels]]
file = "{trial}.yaml"
"""


def _tables(folder: Path) -> None:
    (folder / "a.csv").write_text("time,x\n0,1.5\n0.01,2\n0.02,-3e2\n")
    (folder / "a.yaml").write_text("material: cork\nforce: 2.5\n")


def _arrays(folder: Path) -> None:
    array_files.lab(folder / "demo.hdf5")


def _stores(folder: Path) -> None:
    array_files.replay(folder / "a.zarr")
    array_files.replay(folder / "b.zarr", zarr_format=3)


def _episodes(folder: Path) -> None:
    lerobot_files.write_v2(folder / "two", episodes=2)
    lerobot_files.write_v3(folder / "three")


def _session(folder: Path) -> None:
    session = xdf_writer.Writer()
    session.stream(1, "force", "int16", 2)
    session.stream(2, "marks", "string", rate_hz=0)
    for start in range(3):
        session.offset(1, float(start), 0.5)
        session.numbers(1, "int16", [start + 0.1, None, start + 0.3], [[start, 1], [2, 3], [4, 5]])
        session.texts(2, [start + 0.2], ["go"])
        session.boundary()
    session.footer(1, 9)
    session.write(folder / "a.xdf")


def _bags(folder: Path) -> None:
    types, types1 = writers.store(), writers.store(ros1=True)
    for name, typestore in (("a", types), ("b", types), ("c.bag", types1)):
        values = {"header": writers.header(typestore, writers.START_NS), "name": ["j"], "position": [1.5]}
        message = writers.build(typestore, "sensor_msgs/msg/JointState", **values)
        sent = [("/j", "sensor_msgs/msg/JointState", writers.START_NS + step, message) for step in range(3)]
        if typestore is types1:
            writers.ros1(folder / name, sent)
        else:
            writers.ros2(folder / name, sent, "mcap" if name == "a" else "sqlite3")
    with contextlib.closing(sqlite3.connect(folder / "b" / "b.db3")) as connection:
        connection.execute("PRAGMA page_size = 512")  # an input of a fuzzer is small
        connection.execute("VACUUM")


def _mcap(folder: Path) -> None:
    sent = [(writers.START_NS + step, {"v": step, "p": {"x": 1.5}}) for step in range(3)]
    writers.mcap_json(folder / "a.mcap", {"/a": sent}, metadata={"material": "cork"})


RATE = '[streams.data]\nsource = "data"\ntime = { rate_hz = 60 }\n'
PARAMS = {  # Params of formats that need some.
    "table": {"layout": json.dumps(tomllib.loads(LAYOUT))},
    "zarr": {"layout": json.dumps(tomllib.loads(RATE))},
}
TREES: dict[str, Callable[[Path], object]] = {  # Functions that write a valid source of each format.
    "biotac-slide": _biotac,
    "hdf5": _arrays,
    "lerobot": _episodes,
    "mcap": _mcap,
    "rosbag": _bags,
    "roboskin": _roboskin,
    "table": _tables,
    "gelsight-slip": video_files.write_gelsight,
    "vision2tactile": _grasps,
    "xdf": _session,
    "xela-flat": lambda folder: xela_files.write_flat(folder / "data_sample_a"),
    "xela-psc": lambda folder: xela_files.write_psc(folder / "data_sample_a"),
    "zarr": _stores,
}


@functools.cache
def tree(name: str) -> tuple[Path, list[Path]]:
    """Return a valid source of a format and the files in it, in order."""
    folder = _temporary(name)
    TREES[name](folder)
    return folder, sorted(path for path in folder.rglob("*") if path.is_file())


def _format(name: str, data: bytes) -> object:
    """Ingest a source one of whose files, as the first byte tells, holds the rest of ``data``."""
    folder, paths = tree(name)
    path = paths[data[0] % len(paths) if data else 0]
    original = path.read_bytes()
    path.write_bytes(data[1:])
    try:
        return ingest_recordings(name, folder)
    finally:
        path.write_bytes(original)


def ingest_recordings(name: str, folder: Path) -> list[Any]:
    """Return the recordings that a format reads in a folder."""
    stage = registry.load(f"ingest.{name}")
    assert stage.source is not None
    params = stage.params(**PARAMS.get(name, {}))
    recordings = []
    for discovered in list(stage.source.discover(params, folder).values())[:3]:
        source = discovered if isinstance(discovered, Source) else Source(discovered)
        values = {"values": source.values} if stage.argument("Values") else {}
        recording = stage(params, files=source.files, **values)
        tables = {
            name: rows if isinstance(rows, pa.Table) else rows.read_all() for name, rows in recording.streams.items()
        }
        recordings.append(replace(recording, tables=tables))
    return recordings


def ingest(lab: Lab, name: str) -> Ran:
    """Run the command that ingests the folder ``source``."""
    (lab.folder / "layout.toml").write_text({"table": LAYOUT, "zarr": RATE}.get(name, ""))
    options = "--layout layout.toml" if name in PARAMS else ""
    return lab.call(f"ingest {name} source -o data {options}")


def _trees(name: str) -> list[bytes]:
    return [bytes([number]) + path.read_bytes() for number, path in enumerate(tree(name)[1])]


class Opened:
    """A pickle of this leaves a folder behind when it is opened."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Any, ...]:
        return (os.mkdir, (str(self.trace),))
