"""Cut out the grasped object and the tactile reading.

Converts ``scene``, ``grasp`` and ``biotac_sp`` to ``cloud``, the object's points, and ``reading``, one row: the median
of each channel once the pressure has settled, with the time stamp of the first settled row; ``contact_ns`` is the time
when both fingers first touched. Other streams of one row stay, such as ``grasp`` and the truth of a simulated grasp. A
grasp that already has ``cloud`` and ``grasp`` stays unchanged; a planned grasp has no ``biotac_sp``, and gets no
``reading``.

Example: tacpipe segment grasps data/pinched -o data/grasps
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tacpipe.errors import TacpipeError
from tacpipe.plugins.constraints import Fraction, NonNegativeFloat, PositiveFloat, PositiveInt, Seed, StoredAs, Unit
from tacpipe.plugins.rows import UNNEEDED, RowCounts
from tacpipe.plugins.stage import RecordingOutput, stage
from tacpipe.plugins.stream_selection import StreamSelection

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Recording

FINISHED = ("cloud", "grasp")


@dataclass(frozen=True)
class Params(StreamSelection):
    """Criteria for the grasped object in a camera's view and for contact in the readings of two BioTac SP.

    Lengths are for a depth camera about a metre above a table, where its noise is 2 mm.
    """

    # maximum distance of points from the plane of the table that belong to it; larger for a noisy table
    plane_mm: Annotated[PositiveFloat, Unit("mm")] = 6.0
    # fraction of the scene's points that the table must contain
    plane_fraction: Annotated[Fraction, StoredAs("plane_share")] = 0.2
    plane_trials: PositiveInt = 1000  # number of random samples for finding a plane
    seed: Seed = 0  # random seed of the samples for planes
    # maximum distance between neighbouring points of one object
    cluster_mm: Annotated[PositiveFloat, Unit("mm")] = 12.0
    cluster_points: PositiveInt = 6  # minimum number of neighbours within cluster_mm; points with fewer are stray
    object_points: PositiveInt = 50  # minimum number of points of an object; fewer are noise of the table
    # maximum distance of the object from the line between the fingers, or from its sight line
    near_mm: Annotated[PositiveFloat, Unit("mm")] = 20.0
    # number of nearest points whose mean distance identifies stray points at the object's rim
    outlier_neighbours: PositiveInt = 20
    # standard deviations of that distance above its mean beyond which a point is stray
    outlier_deviations: PositiveFloat = 5.0
    # duration at the start whose median is each finger's pressure without load
    rest_s: Annotated[PositiveFloat, Unit("s")] = 0.5
    # pressure above rest at which a finger is in contact; noise is 0.25
    on_count: Annotated[PositiveFloat, Unit("count")] = 20.0
    # time for which both fingers must press, and over which the reading is the median
    settle_s: Annotated[PositiveFloat, Unit("s")] = 0.2
    settled_count: Annotated[NonNegativeFloat, Unit("count")] = 3.0  # maximum variation of the pressure in settle_s


@stage(version=2)
def grasps(params: Params, recording: Recording) -> RecordingOutput:
    """Return the object and the reading of a grasp."""
    from tacpipe.clouds.cloud import Cloud
    from tacpipe.clouds.grasp import Grasp
    from tacpipe.clouds.segmentation import SegmentationLimits, object_rows

    streams = {name: recording.table(name) for name in recording.streams}
    rows_by_stream = {name: RowCounts.all_used(table.num_rows) for name, table in streams.items()}
    if set(FINISHED) <= set(streams) and "biotac_sp" not in streams:
        return RecordingOutput(streams)
    missing = [
        name for name in ("scene", "grasp") if name not in streams and not (name == "scene" and "cloud" in streams)
    ]
    if missing:
        raise TacpipeError(
            f"Recording {recording.name} has no {' and no '.join(missing)}; a grasp has the streams scene and grasp, and "
            f"biotac_sp once it was made, or {', '.join(FINISHED)} if its object is cut out already. Give such recordings."
        )
    limits = SegmentationLimits(
        plane_m=params.plane_mm / 1e3,
        plane_fraction=params.plane_fraction,
        plane_trials=params.plane_trials,
        cluster_m=params.cluster_mm / 1e3,
        cluster_points=params.cluster_points,
        object_points=params.object_points,
        near_m=params.near_mm / 1e3,
        outlier_neighbours=params.outlier_neighbours,
        outlier_deviations=params.outlier_deviations,
    )
    reading: dict[str, pa.Table] = {}
    attributes: dict[str, int] = {}
    try:
        if "scene" in streams:
            scene = Cloud.from_table(streams.pop("scene"))
            rows = object_rows(scene, Grasp.from_table(streams["grasp"]), limits, params.seed)
            colours = None if scene.colours is None else scene.colours[rows]
            streams["cloud"] = Cloud(scene.points_m[rows], colours).table()
            rows_by_stream["scene"] = RowCounts.some_used(len(scene), len(streams["cloud"]), "not of the object")
        if "biotac_sp" in streams:
            samples = streams.pop("biotac_sp")
            reading["reading"], attributes["contact_ns"], used = _reading_at_touch(params, samples)
            rows_by_stream["biotac_sp"] = RowCounts.some_used(samples.num_rows, used, "outside the reading")
    except TacpipeError as error:
        raise TacpipeError(f"Recording {recording.name}: {error}") from error
    output_streams = {name: table for name, table in streams.items() if table.num_rows == 1 or name == "cloud"}
    for name in streams.keys() - output_streams.keys():
        rows_by_stream[name] = RowCounts.some_used(streams[name].num_rows, 0, UNNEEDED)
    return RecordingOutput({**output_streams, **reading}, attributes, rows=rows_by_stream)


def _reading_at_touch(params: Params, stream: pa.Table) -> tuple[pa.Table, int, int]:
    """Return the settled reading of both fingers as one row, the time in ns of the first touch, and the rows of the reading.

    Raises `TacpipeError` if columns or values are missing, or the fingers never press or settle.
    """
    import numpy as np

    from tacpipe.channels import biotac_sp, schema
    from tacpipe.signals.contact import ContactLimits, contact_row, settled_rows

    fields = biotac_sp.fields()
    missing = [field.name for field in fields if field.name not in stream.column_names]
    if missing:
        raise TacpipeError(
            f"The stream biotac_sp lacks {len(missing)} of {len(fields)} columns, as {missing[0]}. Record both "
            f"fingers whole."
        )
    limits = ContactLimits(params.rest_s, params.on_count, params.settle_s, params.settled_count)
    t_ns = stream.column("t_ns").to_numpy()  # (time,)
    names = [column for target in biotac_sp.TARGETS if target.startswith("pdc") for column in biotac_sp.columns(target)]
    pressure = np.column_stack([stream.column(name).to_numpy() for name in names]).astype(np.float64)  # (time, finger)
    contact = contact_row(pressure, t_ns, limits)
    rows = settled_rows(pressure, t_ns, contact, limits)
    medians = []
    for field in fields:
        values = stream.column(field.name).to_numpy()[rows].astype(np.float64)
        if not np.isfinite(values).any():
            raise TacpipeError(
                f"The column {field.name} of biotac_sp holds no value in the {params.settle_s:g} s of the reading. Leave "
                f"the grasp out."
            )
        medians.append(np.rint(np.nanmedian(values, keepdims=True)))
    return schema.stream(t_ns[rows.start : rows.start + 1], medians, fields), int(t_ns[contact]), rows.stop - rows.start
