"""Grasps of a Shadow hand, measured by two BioTac SP after a camera saw the object: yayaneath/vision2tactile (RA-L 2020).

A grasp is a folder named after its Unix time, in the folder of its object. It contains the object's point cloud
(``cloud-object.pcd``), the two target points of the fingers (``best-grasp.txt``), and one reading of both fingers after
closing (``tactile.tac``).
"""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tacpipe.errors import TacpipeError
from tacpipe.formats import published
from tacpipe.formats.faults import explaining
from tacpipe.formats.published import by_object, require
from tacpipe.io import regular
from tacpipe.io.hashing import remembered_file_digest
from tacpipe.plugins.constraints import NonNegativeFloat, Unit
from tacpipe.plugins.stage import Discovery, Files, RecordingOutput, stage
from tacpipe.plugins.stream_selection import StreamSelection

if TYPE_CHECKING:
    from tacpipe.clouds.cloud import Cloud
    from tacpipe.clouds.grasp import Grasp

CLOUD, GRASP, READING = NAMES = ("cloud-object.pcd", "best-grasp.txt", "tactile.tac")
TWIN = "duplicate_of="  # prefix of the name of an earlier grasp's file with the same reading
UNIX_TIME = re.compile(r"[1-9]\d{9}")  # Unix time in seconds, from 2001 onwards
VALUES = 58  # values per reading: 29 of the middle finger, then 29 of the thumb
MAX_COUNT = 4095  # counts of a 12-bit converter
# numbers per grasp: two points, optionally followed by the wrist's rotation matrix, row by row
POINTS, WITH_WRIST = 6, 15


@dataclass(frozen=True)
class Params(StreamSelection):
    """Requirements for a grasp and its cloud."""

    # maximum distance of a grasp point from the nearest point of the cloud
    beside_mm: Annotated[NonNegativeFloat, Unit("mm")] = 20.0


def discover(params: Params, source: Path) -> dict[str, dict[str, Path]]:
    """Return the files of each grasp below ``source`` by recording name, ``bleach-1561629162`` for ``bleach/1561629162/``.

    Files keep their relative names, ``bleach/1561629162/tactile.tac``, so that object and time are part of a key. If an
    earlier grasp has an identical reading, its file is added under ``duplicate_of=`` and its recording name, because a
    key may not depend on other recordings. Raises `TacpipeError` if ``source`` is not a folder, contains no grasp, or
    contains one twice.
    """
    files_by_grasp = by_object(source, NAMES, "grasp", example="bleach", described=NAMES)
    _add_twins(files_by_grasp)
    return files_by_grasp


@stage(version=2, source=Discovery(discover))
def vision2tactile(params: Params, files: Files) -> RecordingOutput:
    """Read published grasps with a point cloud and BioTac SPs.

    Each recording has the streams cloud, grasp and reading; grasps with the reading of an earlier grasp are marked.
    """
    import numpy as np

    from tacpipe.channels import biotac_sp, schema
    from tacpipe.clouds import point_files
    from tacpipe.clouds.files import require_metres

    grasp_files = {Path(name).name: path for name, path in files.items() if not name.startswith(TWIN)}
    label, time_s, _ = next(name for name in files if not name.startswith(TWIN)).split("/")
    require(grasp_files, NAMES)
    if not UNIX_TIME.fullmatch(time_s):
        raise TacpipeError(
            f"{grasp_files[CLOUD].parent} is named {time_s!r}; a grasp's folder must be named after its time, ten digits of "
            f"unix seconds. Give it the name that it was published under."
        )
    cloud, grasp = point_files.read(grasp_files[CLOUD]), _read_grasp(grasp_files[GRASP])
    require_metres(grasp_files[CLOUD], cloud)
    _check_distance(grasp_files[GRASP], cloud, grasp, params.beside_mm)
    t_ns = int(time_s) * 10**9
    reading = schema.stream(
        np.array([t_ns]), [[value] for value in _read_counts(grasp_files[READING])], biotac_sp.fields()
    )
    twins = [name.removeprefix(TWIN) for name in files if name.startswith(TWIN)]
    return RecordingOutput(
        {"cloud": cloud.table(), "grasp": grasp.table(t_ns), "reading": reading},
        {
            "sensor": "biotac-sp",
            "object": label,
            "session": session(label, int(time_s)),
            **published.published_attribute("vision2tactile", t_ns),
            **({"duplicate_of": twins[0]} if twins else {}),
        },
        rows={},
    )


def session(label: str, time_s: int) -> str:
    """Return the session of a grasp: all grasps of one object on one day (UTC).

    Published grasps of different days are at least 18 hours apart, those of one day less than two hours. So a grasp's
    own time determines its session.

    >>> session("bleach", 1561629162)
    'bleach-2019-06-27'
    """
    return f"{label}-{datetime.fromtimestamp(time_s, UTC).date()}"


def _add_twins(files_by_grasp: dict[str, dict[str, Path]]) -> None:
    """Add to each grasp the file of the earliest other grasp with the same reading."""
    same_reading: dict[str, list[tuple[str, str, Path]]] = defaultdict(list)  # (time, recording, file) by digest
    for recording, files in files_by_grasp.items():
        for name, path in files.items():
            if name.endswith(READING):
                same_reading[remembered_file_digest(path)].append((name.split("/")[1], recording, path))
    for twins in same_reading.values():
        (_, first, path), *duplicates = sorted(twins)
        for _, recording, _ in duplicates:
            files_by_grasp[recording][f"{TWIN}{first}"] = path


def _read_lines(path: Path) -> list[str]:
    """Return the lines of a small text file. Raises `TacpipeError` if it is empty or not text."""
    content = regular.source(path)
    with explaining(UnicodeDecodeError, f"{path} cannot be read as text: ", ". Copy it again from its source."):
        lines = content.decode("ascii").splitlines()
    while lines and not lines[-1].strip():
        lines.pop()
    if not lines:
        raise TacpipeError(f"{path} is empty. Copy it again from its source, or leave the grasp out.")
    return lines


def _read_grasp(path: Path) -> Grasp:
    """Return the grasp in a file: six numbers in metres on one line, or fifteen with the wrist's rotation.

    Raises `TacpipeError` for anything else.
    """
    import numpy as np

    from tacpipe.clouds.grasp import Grasp

    lines = _read_lines(path)
    cells = lines[0].split(",")
    if len(lines) > 1 or len(cells) not in (POINTS, WITH_WRIST):
        raise TacpipeError(
            f"{path} has {len(lines)} lines, the first of {len(cells)} numbers; it must be one line of {POINTS} numbers, "
            f"two points in metres, or of {WITH_WRIST}, these and the wrist's rotation row by row. Copy it again."
        )
    with explaining(ValueError, f"{path}, row 1: ", f"; all {len(cells)} cells must be numbers. Copy it again."):
        values = np.array([float(cell) for cell in cells])
    try:
        return Grasp(values[:3], values[3:6], values[6:].reshape(3, 3) if len(cells) == WITH_WRIST else None)
    except TacpipeError as error:
        raise TacpipeError(f"{path}: {error}") from error


def _check_distance(path: Path, cloud: Cloud, grasp: Grasp, beside_mm: float) -> None:
    """Raise `TacpipeError` if a grasp point is far from the cloud.

    Cloud and grasp then belong to different frames or grasps.
    """
    import numpy as np

    for name, point_m in (("first", grasp.g1_m), ("second", grasp.g2_m)):
        distance_mm = 1e3 * float(np.linalg.norm(cloud.points_m - point_m, axis=1).min())
        if not distance_mm <= beside_mm:
            raise TacpipeError(
                f"{path}: the {name} point lies {distance_mm:.1f} mm from the nearest point of {CLOUD}; it must be "
                f"{beside_mm:g} mm or less, in one frame and in metres. Copy both files again, or allow more with "
                f"--beside-mm."
            )


def _read_counts(path: Path) -> list[int]:
    """Return the 58 counts of a reading's file. Raises `TacpipeError` unless it is a single valid line.

    The line starts with a comma.
    """
    lines = _read_lines(path)
    if len(lines) != 1:
        raise TacpipeError(
            f"{path} has {len(lines)} rows; a grasp has one reading, in one row. Keep the one that was taken in the grasp."
        )
    first, *cells = lines[0].split(",")
    if first.strip() or len(cells) != VALUES:
        readings_text = (
            f", as many as {len(cells) // VALUES} readings" if len(cells) > VALUES and not len(cells) % VALUES else ""
        )
        empty = "an empty first one" if not first.strip() else f"{first[:20]!r} as the first one"
        raise TacpipeError(
            f"{path}, row 1: there are {len(cells) + 1} fields with {empty}{readings_text}; there must be {VALUES + 1}, "
            f"the first empty, then {VALUES // 2} counts of the middle finger and {VALUES // 2} of the thumb. Copy it again."
        )
    values = []
    for index, cell in enumerate(cells, start=2):
        count = cell.strip()
        if not (count.isascii() and count.isdigit() and len(count) <= 4 and int(count) <= MAX_COUNT):
            raise TacpipeError(
                f"{path}, row 1, field {index}: {count[:20]!r} is not a count; it must be a whole number from 0 to "
                f"{MAX_COUNT} (12 bits). Copy it again."
            )
        values.append(int(count))
    return values
