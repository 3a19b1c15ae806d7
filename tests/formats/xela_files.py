"""Trials in the layouts of the published sets of uSkin sensors, small and made up."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

TAXELS = [f"txl{taxel}_{axis}" for taxel in range(1, 17) for axis in "xyz"]
MARKER = ["position_x", "position_y", "position_z", *(f"quaternion_{part}" for part in "xyzw")]
ROWS = 6


def write(path: Path, names: list[str], rows: np.ndarray) -> None:
    """Write a table of numbers as text."""
    lines = [",".join(names), *(",".join(map(repr, row)) for row in np.asarray(rows, dtype=np.float64).tolist())]
    path.write_text("\n".join(lines) + "\n")


def counts(seed: int) -> np.ndarray:
    """Return what a sensor counts, (time, channel)."""
    return np.random.default_rng(seed).integers(0, 65_536, (ROWS, 48))


def poses(seed: int, rows: int = ROWS) -> np.ndarray:
    """Return positions and quaternions, (time, 7)."""
    turned = Rotation.random(rows, rng=np.random.default_rng(seed))
    return np.column_stack([np.arange(3 * rows).reshape(rows, 3) / 10, turned.as_quat(canonical=True)])


def write_flat(folder: Path) -> Path:
    """Write a trial as the set of flat objects has it; the robot file is a row shorter. Returns its folder."""
    folder.mkdir(parents=True)
    for sensor in (1, 2):
        write(folder / f"xela_sensor{sensor}.csv", TAXELS, counts(sensor))
    joints = [f"panda_joint{n}" for n in range(1, 8)]
    names = [f"position_{joint}" for joint in joints] + ["position_panda_finger"]
    names += [f"velocity_{joint}" for joint in joints]
    names += [f"ee_state_position_{axis}" for axis in "xyz"] + [f"ee_state_orientation_{part}" for part in "xyzw"]
    moving = np.arange(15 * (ROWS - 1)).reshape(ROWS - 1, 15)
    write(folder / "robot_state.csv", names, np.column_stack([moving, poses(0)[:-1]]))
    markers = np.column_stack([poses(1), poses(2)])
    markers[2, 7:] = 10.0
    write(folder / "marker.csv", [f"marker{n}_{name}" for n in (1, 2) for name in MARKER], markers)
    (folder / "meta_data.csv").write_text(
        "object_name,object_class,seen,dropped,sensor_type,frequency_hz,start_time,stop_time\n"
        "7,box,1,0,xela_2fingers_noglove,40.0,2021-11-24 15:19:09.142171,2021-11-24 15:19:34.621693\n"
    )
    return folder


def write_psc(folder: Path) -> Path:
    """Write a trial as the slip control set has it. Returns its folder."""
    folder.mkdir(parents=True)
    for sensor in (1, 2):
        write(folder / f"xela_sensor{sensor}.csv", TAXELS, counts(sensor))
    names = [f"position_joint{n}" for n in range(1, 8)] + [f"velocity_joint{n}" for n in range(1, 8)]
    names += [f"ee_T_{row}{column}" for column in range(4) for row in range(4)] + ["v_x", "v_y", "time"]
    transforms = np.tile(np.eye(4), (ROWS, 1, 1))
    transforms[:, :3, :3] = Rotation.from_quat(poses(0)[:, 3:]).as_matrix()
    transforms[:, :3, 3] = poses(0)[:, :3]
    by_column = transforms.transpose(0, 2, 1).reshape(ROWS, 16)
    time_s = np.array([0.0, 0.01, 0.01, 0.03, 0.045, 0.06])
    values = np.column_stack([np.arange(14 * ROWS).reshape(ROWS, 14), by_column, -time_s, 2 * time_s, time_s])
    write(folder / "robot_state.csv", names, values)
    write(folder / "marker.csv", [f"marker_{name}" for name in MARKER], poses(1))
    write(folder / "slip_label.csv", ["slip", "fail"], np.array([[0, 0], [0, 0], [1, 0], [1, 0], [0, 1], [0, 1]]))
    (folder / "meta_data.csv").write_text(
        "dropped,notes,sensor_type,frequency_hz,start_time,stop_time\n"
        "0,0,xela_2fingers_glove,59.75,2022-02-21 09:58:40.837657,2022-02-21 09:58:49.791116\n"
    )
    return folder
