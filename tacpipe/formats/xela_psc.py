"""Trials of two XELA uSkin on a Franka arm that moves a held object along a line, with slip labels (CoRL 2022).

Published as imanlab/proactive-slip-control (MIT). A trial is a folder of CSV files with one row per callback.
Timestamps are the seconds in robot_state.csv. Trials start and end in the grasp.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.errors import TacpipeError
from tacpipe.formats.published import Params, trials
from tacpipe.plugins.stage import Discovery, Files, RecordingOutput, stage

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from tacpipe.arrays import Floats, Int64s

ROBOT, MARKER, LABELS = "robot_state.csv", "marker.csv", "slip_label.csv"
NAMES = ("xela_sensor1.csv", "xela_sensor2.csv", ROBOT, MARKER, LABELS, "meta_data.csv")
ORTHONORMAL_TOLERANCE = 1e-3  # largest accepted entry of R Rᵀ - 1; published recordings have less than 1e-5


def discover(params: Params, source: Path) -> dict[str, dict[str, Path]]:
    """Return the files of each trial below ``source`` by recording name. Raises `TacpipeError` if there is no trial."""
    return trials(source, NAMES)


@stage(version=1, source=Discovery(discover))
def xela_psc(params: Params, files: Files) -> RecordingOutput:
    """Read published trials of two XELA uSkin, with slip.

    Each recording has the streams xela1, xela2, robot, marker and slip; a marker that was not visible is NaN.
    """
    import numpy as np
    import pyarrow as pa

    from tacpipe.channels import schema
    from tacpipe.formats import published, xela
    from tacpipe.formats.csv_table import read_csv
    from tacpipe.signals.repairs import mean_rate_hz

    trial = published.require(files, NAMES)
    meta = xela.TrialMeta(files[xela.META])
    tactile = {stream: xela.read_uskin(files[name]) for stream, name in xela.SENSORS.items()}
    joints = [f"joint{n}" for n in range(1, 8)]
    joint_columns = [f"position_{joint}" for joint in joints] + [f"velocity_{joint}" for joint in joints]
    robot = xela.read_floats(files[ROBOT], [*joint_columns, "v_x", "v_y", "time"])  # (time, 17)
    pose = _read_poses(files[ROBOT])  # (time, 7)
    marker, unseen = xela.read_marker(files[MARKER], "marker")
    labels = read_csv(files[LABELS], ["slip", "fail"], integers=pa.int8())
    rows = {name: len(tactile[stream][0]) for stream, name in xela.SENSORS.items()}
    rows |= {ROBOT: len(robot), MARKER: len(marker), LABELS: labels.num_rows}
    xela.check_rows(trial, rows, ROBOT, missing_allowed=1)

    t_ns = np.int64(meta.utc_ns("start_time")) + _stamps_ns(files[ROBOT], robot[:, -1])
    angles, speeds = schema.joint_fields()
    command_fields = [
        schema.float_field(f"commanded_velocity_{axis}_m_s", "m/s", "velocity", axis) for axis in schema.AXES[:2]
    ]
    streams = xela.tactile_streams(tactile, t_ns, None)
    streams["robot"] = schema.stream(
        t_ns,
        [*robot[:, :14].T, *pose.T, *robot[:, 14:16].T],
        [*angles, *speeds, *schema.pose_fields(), *command_fields],
    )
    streams["marker"] = schema.stream(t_ns[: len(marker)], marker.T, schema.pose_fields())
    labels_by_column = [labels.column(name).to_numpy() for name in labels.column_names]
    _require_flags(files[LABELS], labels.column_names, labels_by_column)
    fields = [schema.label_field(name) for name in labels.column_names]
    streams["slip"] = schema.stream(t_ns[: labels.num_rows], labels_by_column, fields)
    return RecordingOutput(
        streams,
        {
            "sensor": "xela-uskin",
            "dropped": meta.flag("dropped"),
            "slipped": bool(labels_by_column[0].any()),
            "failed": bool(labels_by_column[1].any()),
            "covering": meta.text("sensor_type"),
            "rate_hz": round(mean_rate_hz(t_ns), 6),
            "trial": trial,
            "marker_unseen_ratio": round(unseen, 4),
            **xela.authors_role(params.authors_role),
        },
        rows={},
    )


def _read_poses(path: Path) -> Floats:
    """Return position and quaternion (time, 7) from the 4x4 transforms in a file, which are in column-major order.

    Raises `TacpipeError` if a transform is not rigid.
    """
    import numpy as np

    from tacpipe.formats import xela
    from tacpipe.formats.csv_table import place
    from tacpipe.signals.kinematics import make_continuous, matrices_to_quaternions

    entries = [f"ee_T_{row}{column}" for row in range(4) for column in range(4)]  # named by row and column
    transforms = xela.read_floats(path, entries).reshape(-1, 4, 4)
    rotations, positions = transforms[:, :3, :3], transforms[:, :3, 3]
    error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))  # (time,)
    error = np.maximum(error, np.abs(np.linalg.det(rotations) - 1))
    error = np.maximum(error, np.abs(transforms[:, 3] - [0, 0, 0, 1]).max(axis=1))
    if (error > ORTHONORMAL_TOLERANCE).any():
        row = int((error > ORTHONORMAL_TOLERANCE).argmax())
        raise TacpipeError(
            f"{path}, {place(path, row)}: ee_T is not a rigid transform; it is off by {error[row]:.3g}, "
            f"{ORTHONORMAL_TOLERANCE} is allowed. Check that ee_T_03, ee_T_13 and ee_T_23 hold the position."
        )
    return np.column_stack([positions, make_continuous(matrices_to_quaternions(rotations))])


def _stamps_ns(path: Path, time_s: Floats) -> Int64s:
    """Return seconds as integer nanoseconds (time,). Raises `TacpipeError` if they decrease."""
    import numpy as np

    from tacpipe.formats.csv_table import place

    goes_back = np.diff(time_s) < 0
    if goes_back.any():
        row = int(goes_back.argmax()) + 1
        raise TacpipeError(
            f"{path}, {place(path, row)}: time runs backwards from {time_s[row - 1]:.9g} s to "
            f"{time_s[row]:.9g} s. Put the rows in order or leave the trial out."
        )
    return np.rint(time_s * 1e9).astype(np.int64)


def _require_flags(path: Path, names: list[str], marks: list[NDArray[np.int8]]) -> None:
    """Raise `TacpipeError` if a label column has a value other than 0 and 1."""
    from tacpipe.formats.csv_table import place

    for name, values in zip(names, marks, strict=True):
        bad = (values < 0) | (values > 1)
        if bad.any():
            row = int(bad.argmax())
            raise TacpipeError(f"{path}, {place(path, row)}, column {name} holds {values[row]}; it must be 0 or 1.")
