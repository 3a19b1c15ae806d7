"""Load the grasps of a dataset as arrays: clouds, grasps and readings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Floats, Times
from tacpipe.channels import biotac_sp
from tacpipe.clouds.cloud import Cloud, require_columns
from tacpipe.clouds.grasp import Grasp
from tacpipe.datasets.dataset import Dataset, Recording
from tacpipe.datasets.overview import describe_streams
from tacpipe.errors import TacpipeError
from tacpipe.plugins.rows import RowCounts, count_rows

STREAMS = ("cloud", "grasp")
READING = "reading"
MIN_POINTS = 3  # minimum number of points; fewer have no surface and no main axis
FARTHEST_M = 0.1  # maximum distance of a contact point, possibly on a hidden side, from its object's cloud


@dataclass(frozen=True)
class Grasps:
    """Grasps with their clouds and, if available, the readings of both fingers."""

    names: tuple[str, ...]
    objects: tuple[str, ...]  # empty string if unlabelled
    sessions: tuple[str, ...]
    t_ns: Times  # (grasp,)
    clouds: tuple[Cloud, ...]
    grasps: tuple[Grasp, ...]
    readings: Mapping[str, Floats]  # target -> (grasp, value), device counts; empty without readings
    digests: tuple[str, ...]  # digests of the recordings

    def __len__(self) -> int:
        """Return the number of grasps."""
        return len(self.names)

    def joined(self, appended: Grasps) -> Grasps:
        """Return these grasps followed by the ``appended`` ones."""
        return Grasps(
            self.names + appended.names,
            self.objects + appended.objects,
            self.sessions + appended.sessions,
            np.concatenate([self.t_ns, appended.t_ns]),
            self.clouds + appended.clouds,
            self.grasps + appended.grasps,
            {target: np.concatenate([values, appended.readings[target]]) for target, values in self.readings.items()},
            self.digests + appended.digests,
        )


def read(recordings: Dataset, *, with_readings: bool = True, advance: Callable[..., None] | None = None) -> Grasps:
    """Return the grasps of a dataset, ordered by recording name.

    With ``with_readings`` every grasp must have a reading. ``advance`` is called after each grasp.

    Raises `TacpipeError` if a recording lacks a stream or column, a value is not finite, a cloud has too few points, or
    a grasp is far from its cloud.
    """
    names = sorted(recordings.recordings)
    shards = [recordings.recordings[name] for name in names]
    clouds, grasps, t_ns = [], [], []
    readings: dict[str, list[Floats]] = {target: [] for target in biotac_sp.TARGETS}
    for shard in shards:
        cloud, grasp, stamp = _read_geometry(shard)
        clouds.append(cloud)
        grasps.append(grasp)
        t_ns.append(stamp)
        if with_readings:
            for target, values in _read_targets(shard).items():
                readings[target].append(values)
        if advance is not None:
            advance(note=shard.name)
    return Grasps(
        tuple(names),
        tuple(str(shard.attributes.get("object") or "") for shard in shards),
        tuple(str(shard.attributes.get("session") or "") for shard in shards),
        np.array(t_ns, np.int64),
        tuple(clouds),
        tuple(grasps),
        {target: np.array(values, np.float64) for target, values in readings.items()} if with_readings else {},
        tuple(shard.digest for shard in shards),
    )


def check(name: str, cloud: Cloud, grasp: Grasp) -> None:
    """Raise `TacpipeError` if a cloud has fewer than 3 points or a contact point is more than 10 cm away from it."""
    if len(cloud) < MIN_POINTS:
        raise TacpipeError(
            f"{name} has a cloud of {len(cloud)} points; at least {MIN_POINTS} are needed. Segment it again or leave it out."
        )
    for point, position_m in (("g1", grasp.g1_m), ("g2", grasp.g2_m)):
        nearest_m = float(np.linalg.norm(cloud.points_m - position_m, axis=1).min())
        if nearest_m > FARTHEST_M:
            raise TacpipeError(
                f"{name}: grasp point {point} lies {nearest_m * 1000:.0f} mm from the nearest point of the cloud; the two "
                f"must be in one frame, in metres, no more than {FARTHEST_M * 1000:.0f} mm apart. Check the grasp's frame."
            )


def _read_geometry(shard: Recording) -> tuple[Cloud, Grasp, int]:
    """Return the cloud, the grasp and its time in ns.

    Raises `TacpipeError` if a stream or column is missing or invalid.
    """
    missing = [stream for stream in STREAMS if stream not in shard.streams]
    if missing:
        raise TacpipeError(
            f"Recording {shard.name} {describe_streams(shard.streams)}; a grasp has the streams {', '.join(STREAMS)}. Give "
            f"grasps of `tacpipe ingest vision2tactile`; a camera's whole view goes through `tacpipe segment grasps` first."
        )
    table, points = shard.table("grasp"), shard.table("cloud")
    try:
        require_columns(table, ["t_ns"])
        cloud, grasp = Cloud.from_table(points), Grasp.from_table(table)
    except TacpipeError as error:
        raise TacpipeError(f"Recording {shard.name}: {error}") from None
    check(f"Recording {shard.name}", cloud, grasp)
    for stream, counted in (("grasp", table), ("cloud", points)):
        count_rows(shard.name, stream, RowCounts.all_used(counted.num_rows))
    return cloud, grasp, int(table.column("t_ns")[0].as_py())


def _read_targets(shard: Recording) -> dict[str, Floats]:
    """Return the values of each target in a grasp's reading. Raises `TacpipeError` if it is missing or not finite."""
    if READING not in shard.streams:
        raise TacpipeError(
            f"Recording {shard.name} has no tactile reading to learn from or to evaluate with. `tacpipe predict` needs none."
        )
    table = shard.table(READING)
    if table.num_rows != 1:
        raise TacpipeError(
            f"Recording {shard.name} has {table.num_rows} readings; a grasp has one. `tacpipe segment grasps` picks the one "
            f"at contact out of a stream."
        )
    count_rows(shard.name, READING, RowCounts.all_used(1))
    readings = {}
    for target in biotac_sp.TARGETS:
        columns = biotac_sp.columns(target)
        try:
            require_columns(table, columns)
        except TacpipeError as error:
            raise TacpipeError(f"Recording {shard.name}: {error}") from None
        readings[target] = np.array([table.column(name)[0].as_py() for name in columns], np.float64)  # null becomes NaN
        if not np.isfinite(readings[target]).all():
            column = columns[int(np.argmin(np.isfinite(readings[target])))]
            raise TacpipeError(f"Recording {shard.name} has no finite reading in the column {column}. Leave it out.")
    return readings
