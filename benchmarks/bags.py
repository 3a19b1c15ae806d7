"""A bag read as streams, beside rosbags: its own iteration over raw messages, and its deserialization of each.

python -m benchmarks.bags [--seconds 60]

Writes a bag of 48 taxels at 100 Hz, seven joints and a wrench at 1 kHz with rosbags' writer, in MCAP and in SQLite, and
prints the best of three runs of each reader.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from tacpipe.formats.bags import container

START_NS, STEP_NS, RUNS = 1_700_000_000_000_000_000, 1_000_000, 3


def write(path: Path, storage: StoragePlugin, seconds: int) -> float:
    """Write the bag; return its size in MB."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    make: dict[str, Any] = types.types
    rng = np.random.default_rng(0)
    skin_type, joint_type, wrench_type = (
        "std_msgs/msg/Float32MultiArray",
        "sensor_msgs/msg/JointState",
        "geometry_msgs/msg/WrenchStamped",
    )
    names = [f"panda_joint{joint}" for joint in range(1, 8)]
    vector = make["geometry_msgs/msg/Vector3"]
    layout = make["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    with Writer(path, version=9, storage_plugin=storage) as writer:
        skin, joints, wrench = (
            writer.add_connection(topic, kind, typestore=types)
            for topic, kind in (("/skin", skin_type), ("/joint_states", joint_type), ("/wrench", wrench_type))
        )
        for step in range(seconds * 1000):
            t_ns = START_NS + step * STEP_NS
            stamp = make["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
            header = make["std_msgs/msg/Header"](stamp=stamp, frame_id="base")
            values = rng.normal(size=27)
            state = make[joint_type](header, names, values[:7], values[7:14], values[14:21])
            load = make["geometry_msgs/msg/Wrench"](vector(*values[21:24]), vector(*values[24:27]))
            writer.write(joints, t_ns + 50_000, types.serialize_cdr(state, joint_type))
            writer.write(wrench, t_ns + 60_000, types.serialize_cdr(make[wrench_type](header, load), wrench_type))
            if step % 10 == 0:
                taxels = make[skin_type](layout, rng.normal(size=48).astype(np.float32))
                writer.write(skin, t_ns + 70_000, types.serialize_cdr(taxels, skin_type))
    return sum(file.stat().st_size for file in path.iterdir()) / 1e6


def streams(path: Path) -> int:
    """Read the bag as tacpipe does; return how many rows there are."""
    contents = container.open_bag(path).read(None, None)
    return sum(one.table.num_rows for one in contents.streams)


def raw(path: Path) -> int:
    """Iterate over the raw messages with rosbags; return how many there are."""
    with Reader(path) as reader:
        return sum(1 for _ in reader.messages())


def deserialized(path: Path) -> int:
    """Deserialize each message with rosbags; return how many there are."""
    count = 0
    with AnyReader([path]) as reader:
        for connection, _, content in reader.messages():
            reader.deserialize(content, connection.msgtype)
            count += 1
    return count


def best_s(read: Callable[[Path], int], path: Path) -> tuple[float, int]:
    """Return the seconds of the fastest run, and what it counted."""
    found = []
    for _ in range(RUNS):
        start_s = time.perf_counter()
        count = read(path)
        found.append(time.perf_counter() - start_s)
    return min(found), count


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seconds", type=int, default=60)
    given = parser.parse_args()
    print("| storage | reader | messages | s | MB/s |\n| --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        for storage in (StoragePlugin.MCAP, StoragePlugin.SQLITE3):
            path = Path(folder, storage.name.lower())
            size_mb = write(path, storage, given.seconds)
            for read, name in (
                (streams, "tacpipe, columns"),
                (raw, "rosbags, raw messages"),
                (deserialized, "rosbags, deserialized"),
            ):
                seconds, count = best_s(read, path)
                print(f"| {storage.name.lower()} | {name} | {count} | {seconds:.2f} | {size_mb / seconds:.0f} |")


if __name__ == "__main__":
    main()
