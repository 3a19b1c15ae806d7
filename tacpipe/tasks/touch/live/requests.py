"""Read requests for rankings, whose clouds and grasps are untrusted, and rank the candidate grasps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.channels import biotac_sp
from tacpipe.clouds import files
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.printable import excerpt
from tacpipe.tasks.touch.predictor import PredictedReading

NPZ = ".npz"
LARGEST_BYTES = 1 << 28  # limit of an NPZ file


def grasps(record: Any) -> list[Grasp]:
    """Return the candidates of a request. Raises `TacpipeError` where one cannot be, with its number."""
    candidates = []
    for number, grasp in enumerate(record["grasps"]):
        wrist = None if grasp.get("wrist") is None else np.array(grasp["wrist"], np.float64)
        try:
            candidates.append(Grasp(np.array(grasp["g1"], np.float64), np.array(grasp["g2"], np.float64), wrist))
        except TacpipeError as error:
            raise TacpipeError(f"Grasp {number}: {error}") from error
    return candidates


def cloud(record: Any, folder: str, before: Cloud | None) -> Cloud:
    """Return the cloud of a request: its points, those of a file within ``folder``, or of the request before.

    Raises `TacpipeError` where there is none, or it cannot be read.
    """
    points_or_file = record.get("cloud")
    if points_or_file is None:
        if before is None:
            raise TacpipeError("The request has no cloud, and no request before had one.")
        return before
    if isinstance(points_or_file, str):
        return _file(points_or_file, folder)
    points = np.array(points_or_file, np.float64)
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
    cloud_in_file = Cloud(points, colours)
    files.require_metres(path, cloud_in_file)
    return cloud_in_file


CONTACT, BALANCE, LEVEL = "contact", "balance", "level"


class Criterion(NamedTuple):
    """A criterion of a ranking: the higher the score, the better the grasp."""

    text: str  # the criterion as the user gave it
    score: Callable[[Floats], Floats]  # function of levels (grasp, finger) that returns scores (grasp,)
    fingers: int  # fingers whose touch must be predicted


def criterion(text: str) -> Criterion:
    """Return the criterion that an option names. Raises `UsageError` for one that is none.

    ``contact`` is the mean of both fingers' levels, ``balance`` how little they differ, and ``level:0.4`` how near their
    mean is to 0.4.
    """
    name, colon, value = text.partition(":")
    if name == CONTACT and not colon:
        return Criterion(text, lambda levels: np.nanmean(levels, axis=1), 1)
    if name == BALANCE and not colon:
        return Criterion(text, lambda levels: -np.abs(levels[:, 0] - levels[:, 1]), 2)
    try:
        level = float(value) if name == LEVEL else np.nan
    except ValueError:
        level = np.nan
    if not np.isfinite(level):
        raise UsageError(
            f"--rank {excerpt(text)} is not a criterion; give contact, balance, or level:0.4 with a number."
        )
    return Criterion(text, lambda levels: -np.abs(np.nanmean(levels, axis=1) - level), 1)


def levels(touches: Sequence[PredictedReading]) -> Floats:
    """Return how much each finger is touched (grasp, finger), thumb first: the mean of two fractions of fixed ranges.

    They are how far the pressure rises within its range, and how far the electrodes fall within theirs, on average; 0 to 1
    within the ranges of `tacpipe.channels.biotac_sp.RANGES`. What the model does not predict is left out; NaN for nothing.
    """
    by_finger = np.full((len(touches), 2), np.nan)
    for row, touch in enumerate(touches):
        for column, finger in enumerate(("th", "mf")):
            pressed = biotac_sp.normalised(f"pdc_{finger}", np.array([getattr(touch, f"pdc_{finger}")]))
            fallen = 1 - biotac_sp.normalised(f"e_{finger}", getattr(touch, f"e_{finger}"))
            parts = np.array([pressed.mean(), fallen.mean()])
            finite = np.isfinite(parts)
            by_finger[row, column] = parts[finite].mean() if finite.any() else np.nan
    return by_finger


def ranks(scores: Floats) -> list[int]:
    """Return the place of each grasp, 1 for the highest score; of equal scores the first comes first.

    >>> ranks(np.array([0.2, 0.9, 0.2]))
    [2, 1, 3]
    """
    order = np.argsort(-scores, kind="stable")
    places = np.empty(len(scores), np.int64)
    places[order] = np.arange(1, len(scores) + 1)
    return places.tolist()
