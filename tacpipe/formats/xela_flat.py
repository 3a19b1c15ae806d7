"""Trials of two XELA uSkin on a Franka arm that grasps, lifts and moves household objects (RSS 2022).

Published as imanlab/tactile_prediction_flat_dataset. A trial is a folder of CSV files with one row per callback and no
clock: only the mean rate is known, so timestamps are computed from it and marked as such. Robot and marker files may
lack one row. The published columns ``ee_state_orientation_x`` to ``_w`` contain the quaternion as w, x, y, z: only in
this order does the hand turn with the last link of the arm. The marker columns contain x, y, z, w as named: only in
this order are the two markers rigid to each other, in 36 of 37 trials that show both. In the other, they turn by less
than a degree.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.formats.published import Params, trials
from tacpipe.plugins.stage import Discovery, Files, RecordingOutput, stage

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import Floats

ROBOT, MARKER = "robot_state.csv", "marker.csv"
NAMES = ("xela_sensor1.csv", "xela_sensor2.csv", ROBOT, MARKER, "meta_data.csv")
MADE = "from mean rate"


def discover(params: Params, source: Path) -> dict[str, dict[str, Path]]:
    """Return the files of each trial below ``source`` by recording name. Raises `TacpipeError` if there is no trial."""
    return trials(source, NAMES)


@stage(version=3, source=Discovery(discover))
def xela_flat(params: Params, files: Files) -> RecordingOutput:
    """Read published trials of two XELA uSkin, flat folder.

    Each recording has the streams xela1, xela2, robot, marker1 and marker2; a marker that was not visible is NaN.
    """
    import numpy as np

    from tacpipe.channels import schema
    from tacpipe.formats import published, xela
    from tacpipe.signals.resampling import uniform_grid

    trial = published.require(files, NAMES)
    meta = xela.TrialMeta(files[xela.META])
    rate_hz = meta.number("frequency_hz")
    tactile = {stream: xela.read_uskin(files[name]) for stream, name in xela.SENSORS.items()}
    joints = [f"panda_joint{n}" for n in range(1, 8)]
    robot = xela.read_floats(
        files[ROBOT],
        [f"position_{joint}" for joint in joints]
        + ["position_panda_finger"]
        + [f"velocity_{joint}" for joint in joints]
        + [f"ee_state_position_{axis}" for axis in schema.AXES]
        + [f"ee_state_orientation_{part}" for part in schema.COMPONENTS],
    )  # (time, 22)
    xela.require_unit(files[ROBOT], robot[:, -4:], "ee_state_orientation")
    robot[:, -4:] = _reorder_quaternions(robot[:, :7], robot[:, -4:])
    markers = {name: xela.read_marker(files[MARKER], name) for name in ("marker1", "marker2")}
    rows = {name: len(tactile[stream][0]) for stream, name in xela.SENSORS.items()}
    xela.check_rows(trial, rows, "xela_sensor1.csv", missing_allowed=0)
    rows |= {ROBOT: len(robot), MARKER: len(markers["marker1"][0])}
    xela.check_rows(trial, rows, "xela_sensor1.csv", missing_allowed=1)

    last_ns = round((rows["xela_sensor1.csv"] - 1) * 1e9 / rate_hz)
    t_ns = np.int64(meta.utc_ns("start_time")) + uniform_grid(0, last_ns, rate_hz)
    angles, speeds = schema.joint_fields()
    finger = schema.float_field("finger_m", "m", "finger_width")
    fields = [*angles, finger, *speeds, *schema.pose_fields()]
    streams: dict[str, pa.Table] = xela.tactile_streams(tactile, t_ns, MADE)
    streams["robot"] = schema.stream(t_ns[: len(robot)], robot.T, fields, MADE)
    for name, (pose, _) in markers.items():
        streams[name] = schema.stream(t_ns[: len(pose)], pose.T, schema.pose_fields(), MADE)
    return RecordingOutput(
        streams,
        {
            "sensor": "xela-uskin",
            "object": meta.text("object_name"),
            "object_class": meta.text("object_class"),
            "seen": meta.flag("seen"),
            "dropped": meta.flag("dropped"),
            "covering": meta.text("sensor_type"),
            "rate_hz": rate_hz,
            "trial": trial,
            **{f"{name}_unseen_ratio": round(unseen, 4) for name, (_, unseen) in markers.items()},
            **published.published_attribute("xela-flat", meta.utc_ns("start_time")),
            **xela.authors_role(params.authors_role),
        },
        rows={},
    )


def _reorder_quaternions(joint_rad: Floats, quaternions: Floats) -> Floats:
    """Return quaternions x, y, z, w (time, 4), reordered if the joints (time, 7) show that the columns are w, x, y, z."""
    import numpy as np

    from tacpipe.signals.kinematics import PANDA, rotates_with_hand

    w_last = np.roll(quaternions, -1, axis=1)
    return (
        w_last
        if not rotates_with_hand(PANDA, joint_rad, quaternions) and rotates_with_hand(PANDA, joint_rad, w_last)
        else quaternions
    )
