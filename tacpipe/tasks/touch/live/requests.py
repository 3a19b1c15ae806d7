"""A request for a ranking, as clouds and grasps: what the sensor ``grasps`` lets through is untrusted still."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tacpipe.clouds import files
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.errors import TacpipeError
from tacpipe.printable import excerpt

NPZ = ".npz"
LARGEST_BYTES = 1 << 28  # of an NPZ file


def grasps(record: Any) -> list[Grasp]:
    """Return the candidates of a request. Raises `TacpipeError` where one cannot be, with its number."""
    found = []
    for number, one in enumerate(record["grasps"]):
        wrist = None if one.get("wrist") is None else np.array(one["wrist"], np.float64)
        try:
            found.append(Grasp(np.array(one["g1"], np.float64), np.array(one["g2"], np.float64), wrist))
        except TacpipeError as error:
            raise TacpipeError(f"Grasp {number}: {error}") from error
    return found


def cloud(record: Any, folder: str, before: Cloud | None) -> Cloud:
    """Return the cloud of a request: its points, those of a file within ``folder``, or of the request before.

    Raises `TacpipeError` where there is none, or it cannot be read.
    """
    given = record.get("cloud")
    if given is None:
        if before is None:
            raise TacpipeError("The request has no cloud, and no request before had one.")
        return before
    if isinstance(given, str):
        return _file(given, folder)
    points = np.array(given, np.float64)
    if points.shape[1] == len("xyz"):
        return Cloud(points.astype(np.float32))
    colours = points[:, 3:]
    if ((colours < 0) | (colours > 255)).any():
        raise TacpipeError("A colour of the cloud is not between 0 and 255.")
    return Cloud(points[:, :3].astype(np.float32), np.rint(colours).astype(np.uint8))


def _file(name: str, folder: str) -> Cloud:
    if not folder:
        raise TacpipeError(
            f"The request names the file {excerpt(name)}, and files are read from the option folder of the sensor grasps "
            f"alone. Set it in the rig file, or send the points."
        )
    inside = Path(folder).resolve()
    path = (inside / name).resolve()
    if not path.is_relative_to(inside):
        raise TacpipeError(f"The file {excerpt(name)} is not within {inside}.")
    return _npz(path) if path.suffix.lower() == NPZ else files.read(path)


def _npz(path: Path) -> Cloud:
    try:
        if path.stat().st_size > LARGEST_BYTES:
            raise TacpipeError(f"{path} is larger than {LARGEST_BYTES >> 20} MiB.")
        with np.load(path, allow_pickle=False) as content:
            points = np.asarray(content["points_m"], np.float32)
            colours = np.asarray(content["colours"]) if "colours" in content else None
    except (OSError, ValueError, KeyError) as error:
        raise TacpipeError(f"{path} is not an NPZ file with points_m (point, 3): {error}.") from error
    if colours is not None and colours.dtype != np.uint8:
        raise TacpipeError(f"{path}: colours are {colours.dtype}; they must be uint8, 0 to 255.")
    found = Cloud(points, colours)
    files.require_metres(path, found)
    return found
