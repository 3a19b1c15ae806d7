"""Slides of a BioTac over twenty materials, moved by a KUKA LBR iiwa 14 (IROS 2020).

Published as dexrob/BioTac_slide_20_50. A slide is a set of CSV files in the folder of its material: the finger
(``mat3_7_bio.csv``) and, if they were recorded, pose, velocity, wrench, joint angles, torques and speeds of the arm,
each with its own timestamps. Rows of the finger's file end with a comma; rows of the arm's files do not.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.formats.published import Params
from tacpipe.io.files import walk
from tacpipe.plugins.stage import Discovery, Files, RecordingOutput, stage

if TYPE_CHECKING:
    import pyarrow as pa

RATE_HZ = 100.0  # nominal rate of the finger; mean rates of published slides are within 0.03 Hz
NAME = re.compile(r"mat(\d+)_(\d+)_(bio|cp|cv|cw|jp|jt|jv)\.csv")
ARM = {  # stream and columns by file name suffix
    "cp": ("pose", ("posx", "posy", "posz", "ox", "oy", "oz", "ow")),
    "cv": ("twist", ("x", "y", "z", "a", "b", "c")),
    "cw": ("wrench", ("fx", "fy", "fz", "tx", "ty", "tz")),
    "jp": ("joint_position", tuple(f"pa{joint}" for joint in range(1, 8))),
    "jt": ("joint_torque", tuple(f"ta{joint}" for joint in range(1, 8))),
    "jv": ("joint_velocity", tuple(f"va{joint}" for joint in range(1, 8))),
}


def discover(params: Params, source: Path) -> dict[str, dict[str, Path]]:
    """Return the files of each slide below ``source`` by recording name, such as ``biotac-m03-t007`` for ``mat3_7_…``.

    Each finger file is a slide; arm files without one are ignored. Raises `TacpipeError` if ``source`` is not a folder
    or contains no slide, and `UsageError` if it contains one twice.
    """
    if not source.is_dir():
        raise TacpipeError(
            f"{source} is not a folder; give the folder that holds the slides, mat1_1_bio.csv and so on."
        )
    files_by_slide: dict[str, dict[str, Path]] = {}
    for folder, _, names in walk(source):
        for name in names:
            match = NAME.fullmatch(name)
            if match is None:
                continue
            files = files_by_slide.setdefault(recording_name(int(match[1]), int(match[2])), {})
            same = next((path for file_name, path in files.items() if file_name.endswith(f"_{match[3]}.csv")), None)
            # the same slide is in two folders, or has two names such as mat3_7_bio.csv and mat03_7_bio.csv
            if same is not None:
                raise UsageError(
                    f"{same} and {Path(folder) / name} are the same slide. Give the folder that holds one of them."
                )
            files[name] = Path(folder) / name
    slides = {
        recording: dict(sorted(files.items()))
        for recording, files in sorted(files_by_slide.items())
        if any(name.endswith("_bio.csv") for name in files)
    }
    if not slides:
        raise TacpipeError(
            f"{source} holds no slide: no file in it is named as mat1_1_bio.csv. Give the folder of the unpacked data set."
        )
    return slides


def recording_name(material: int, trial: int) -> str:
    """Return the name of a slide.

    >>> recording_name(3, 7)
    'biotac-m03-t007'
    """
    return f"biotac-m{material:02d}-t{trial:03d}"


@stage(version=2, source=Discovery(discover))
def biotac_slide(params: Params, files: Files) -> RecordingOutput:
    """Read published slides of a BioTac over materials.

    Each recording has the stream biotac and the recorded streams of the arm. NaN in angular velocity is kept.
    """
    from tacpipe.formats import published, xela

    streams: dict[str, pa.Table] = {}
    material = trial = 0
    for name, path in files.items():
        match = NAME.fullmatch(name)
        assert match is not None
        material, trial = int(match[1]), int(match[2])
        if match[3] == "bio":
            streams["biotac"] = _read_finger(path)
        else:
            stream, columns = ARM[match[3]]
            streams[stream] = _read_arm(path, stream, columns)
    begin = next(iter(streams.values()))["t_ns"]
    mark = published.published_attribute("biotac-slide", begin[0].as_py() if len(begin) else 0)
    # published slides of a material were recorded in one session; of others this is unknown
    session = {"session": f"biotac-m{material:02d}"} if mark else {}
    return RecordingOutput(
        streams,
        {
            "sensor": "biotac",
            "material": material,
            "trial": trial,
            **session,
            "rate_hz": RATE_HZ,
            **mark,
            **xela.authors_role(params.authors_role),
        },
        rows={},
    )


def _read_finger(path: Path) -> pa.Table:
    """Return the stream of the finger: 44 columns of uint16 counts as written, including spikes."""
    import pyarrow as pa

    from tacpipe.channels import schema
    from tacpipe.formats.csv_table import read_csv

    names = ["tdc", "tac", "pdc"]
    names += [f"pac{reading}" for reading in range(1, schema.VIBRATIONS + 1)]
    names += [f"ele{electrode}" for electrode in range(1, schema.ELECTRODES + 1)]
    table = read_csv(path, names, integers=pa.uint16(), trailing_comma=True, seconds="timestamp")
    return _name_channels(path, table, schema.biotac_fields())


def _read_arm(path: Path, stream: str, columns: tuple[str, ...]) -> pa.Table:
    """Return a stream of the arm; ``columns`` are those of the file."""
    from tacpipe.channels import schema
    from tacpipe.formats.csv_table import read_csv

    angles, speeds = schema.joint_fields()
    fields = {
        "pose": schema.pose_fields(),
        "twist": schema.twist_fields(),
        "wrench": schema.wrench_fields(),
        "joint_position": angles,
        "joint_torque": schema.joint_torque_fields(),
        "joint_velocity": speeds,
    }[stream]
    return _name_channels(path, read_csv(path, columns, allow_nan=stream == "twist", seconds="timestamp"), fields)


def _name_channels(path: Path, table: pa.Table, fields: list[pa.Field]) -> pa.Table:
    """Return a table with the names of its channels. Raises `TacpipeError` if timestamps do not increase."""
    import numpy as np
    import pyarrow as pa

    from tacpipe.channels import schema
    from tacpipe.formats.csv_table import place

    t_ns = table.column("t_ns").to_numpy()
    goes_back = np.diff(t_ns) <= 0
    if goes_back.any():
        row = int(goes_back.argmax()) + 1
        raise TacpipeError(
            f"{path}, {place(path, row)}: the timestamp is {(t_ns[row] - t_ns[row - 1]) / 1e6:g} ms after the one "
            f"before; it must be later. Put the rows in order or leave the slide out."
        )
    return pa.Table.from_arrays(table.columns, schema=pa.schema([schema.time_field(), *fields]))
