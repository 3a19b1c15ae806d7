"""Rank the candidate grasps of untrusted live requests with a touch model."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.channels import biotac_sp
from tacpipe.clouds import files
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.live.engine import Engine
from tacpipe.printable import excerpt
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.grasps import GraspRequests, parse_request
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.touch.live.messages import TouchDescription, TouchMessage
from tacpipe.tasks.touch.predictor import PredictedReading, Predictor

NPZ = ".npz"
MAX_NPZ_BYTES = 1 << 28  # maximum size of an NPZ file


def requested_grasps(record: Any) -> list[Grasp]:
    """Return the candidate grasps of a request. Raises `TacpipeError` with the index of an invalid candidate."""
    candidates = []
    for number, grasp in enumerate(record["grasps"]):
        wrist = None if grasp.get("wrist") is None else np.array(grasp["wrist"], np.float64)
        try:
            candidates.append(Grasp(np.array(grasp["g1"], np.float64), np.array(grasp["g2"], np.float64), wrist))
        except TacpipeError as error:
            raise TacpipeError(f"Grasp {number}: {error}") from error
    return candidates


def requested_cloud(record: Any, folder: str, previous: Cloud | None) -> Cloud:
    """Return the cloud of a request: its inline points, a file in ``folder``, or ``previous``, the previous request's cloud.

    Raises `TacpipeError` if there is no cloud or it cannot be read.
    """
    points_or_file = record.get("cloud")
    if points_or_file is None:
        if previous is None:
            raise TacpipeError("The request has no cloud, and no request before had one.")
        return previous
    if isinstance(points_or_file, str):
        return _read_file(points_or_file, folder)
    points = np.array(points_or_file, np.float64)
    if points.shape[1] == len("xyz"):
        return Cloud(points.astype(np.float32))
    colours = points[:, 3:]
    if ((colours < 0) | (colours > 255)).any():
        raise TacpipeError("A colour of the cloud is not between 0 and 255.")
    return Cloud(points[:, :3].astype(np.float32), np.rint(colours).astype(np.uint8))


def _read_file(name: str, folder: str) -> Cloud:
    """Return the cloud in a file of the ``folder``. Raises `TacpipeError` if it is outside, or no cloud."""
    if not folder:
        raise TacpipeError(
            f"The request names the file {excerpt(name)}, but files are read only from the folder in the option folder "
            "of the sensor grasps. Set it in the rig file, or send the points."
        )
    inside = Path(folder).resolve()
    path = (inside / name).resolve()
    if not path.is_relative_to(inside):
        raise TacpipeError(f"The file {excerpt(name)} is not within {inside}.")
    return _read_npz(path) if path.suffix.lower() == NPZ else files.read(path)


def _read_npz(path: Path) -> Cloud:
    """Return the cloud in an NPZ file. Raises `TacpipeError` if it is too large, invalid or not in metres."""
    try:
        if path.stat().st_size > MAX_NPZ_BYTES:
            raise TacpipeError(f"{path} is larger than {MAX_NPZ_BYTES >> 20} MiB.")
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
    """A ranking criterion; higher scores are better."""

    text: str  # criterion as entered by the user
    score: Callable[[Floats], Floats]  # maps levels (grasp, finger) to scores (grasp,)
    fingers: int  # number of fingers whose touch must be predicted


def criterion(text: str) -> Criterion:
    """Return the criterion of an option value. Raises `UsageError` if it is unknown.

    ``contact`` is the mean of both fingers' levels, ``balance`` the negative absolute difference between them, and
    ``level:0.4`` the negative distance of their mean from 0.4.
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


def criterion_levels(touches: Sequence[PredictedReading]) -> Floats:
    """Return each finger's contact level (grasp, finger), thumb first: the mean of two fractions of fixed ranges.

    These are the rise of the pressure and the mean fall of the electrodes, 0 to 1 within
    `tacpipe.channels.biotac_sp.RANGES`. Values that the model does not predict are skipped; NaN if it predicts none.
    """
    by_finger = np.full((len(touches), 2), np.nan)
    for row, touch in enumerate(touches):
        for column, finger in enumerate(("th", "mf")):
            pressure = biotac_sp.normalise(f"pdc_{finger}", np.array([getattr(touch, f"pdc_{finger}")]))
            contact = 1 - biotac_sp.normalise(f"e_{finger}", getattr(touch, f"e_{finger}"))
            parts = np.array([pressure.mean(), contact.mean()])
            finite = np.isfinite(parts)
            by_finger[row, column] = parts[finite].mean() if finite.any() else np.nan
    return by_finger


def rank_grasps(scores: Floats) -> list[int]:
    """Return the rank of each grasp, 1 for the highest score; ties are ranked in input order.

    >>> rank_grasps(np.array([0.2, 0.9, 0.2]))
    [2, 1, 3]
    """
    order = np.argsort(-scores, kind="stable")
    ranks = np.empty(len(scores), np.int64)
    ranks[order] = np.arange(1, len(scores) + 1)
    return ranks.tolist()


WAITING = 16  # maximum number of queued requests; older ones are dropped
IDLE_NS = 5_000_000


class TouchEngine(Engine):
    """A live session with a touch model."""

    def __init__(self, sensors: Mapping[str, Sensor], predictor: Predictor, criterion: Criterion) -> None:
        """Store the rig's sensors.

        Raises `TacpipeError` if no sensor sends requests, or the model lacks a target that the criterion needs.
        """
        super().__init__(sensors)
        self.requests = {name: sensor for name, sensor in sensors.items() if isinstance(sensor, GraspRequests)}
        if not self.requests:
            raise TacpipeError(
                "The rig has no stream of the sensor grasps for requests. Add one, as in docs/howto/live-grasps.md."
            )
        fingers = {target.rpartition("_")[2] for target in predictor.targets}
        if len(fingers) < criterion.fingers:
            raise TacpipeError(
                f"--rank {criterion.text} compares both fingers, and the model predicts {', '.join(predictor.targets)}."
            )
        self._predictor, self._criterion = predictor, criterion
        self._framers = {name: sensor.framer() for name, sensor in self.requests.items()}
        self._recorded_streams: set[str] = set()
        self._waiting: deque[tuple[int, str, bytes]] = deque()  # arrival, stream and request
        self._clouds: dict[str, Cloud] = {}  # latest cloud of each stream

    def describe(self, model: str) -> TouchDescription:
        """Return the description of the session's messages."""
        return TouchDescription(self._predictor.targets, self._criterion.text, model)

    def begin_recording(self, offset_ns: int) -> None:
        """Expect request streams."""
        self._recorded_streams = set()

    def end_recording(self) -> None:
        """Drop queued requests."""
        super().end_recording()
        self._waiting.clear()

    def begin_stream(self, stream: str) -> None:
        """Start to answer the requests of a stream."""
        self._recorded_streams.add(stream)

    def take_chunks(self, stream: str, chunks: Chunks) -> None:
        """Queue the requests in chunks of a stream; beyond `WAITING`, the oldest are dropped and counted."""
        if stream not in self.requests or stream not in self._recorded_streams or not self.running:
            return
        runs, _ = self._framers[stream].feed(chunks)
        for run in runs:
            self._waiting.extend((t_ns, stream, text) for t_ns, text in zip(run.t_ns.tolist(), run.frames, strict=True))
        while len(self._waiting) > WAITING:
            self._waiting.popleft()
            self.skipped += 1

    def due_ns(self, now_ns: int) -> int:
        """Return the monotonic time of the next call of `step`."""
        return now_ns if self._waiting else now_ns + IDLE_NS

    def step(self, now_ns: int) -> list[TouchMessage]:
        """Return the response to the oldest queued request, or nothing if there is none."""
        if not self._waiting or self._offset_ns is None:
            return []
        t_ns, stream, text = self._waiting.popleft()
        return [self._answer_request(t_ns + self._offset_ns, stream, parse_request(text))]

    def _answer_request(self, t_ns: int, stream: str, record: Any) -> TouchMessage:
        """Return the ranking of a request that arrived at ``t_ns``, or why there is none."""
        began_s = time.perf_counter()
        header = (self.next_seq(), t_ns, int(record["request"]), self._criterion.text)
        try:
            cloud = requested_cloud(record, self.requests[stream].folder, self._clouds.get(stream))
            self._clouds[stream] = cloud
            touches = self._predictor.predict_all(cloud, requested_grasps(record))
        except TacpipeError as error:
            return TouchMessage(*header, cause=str(error), skipped=self.skipped)
        levels = criterion_levels(touches)
        scores = self._criterion.score(levels)
        ranks = tuple(rank_grasps(scores))
        message = TouchMessage(
            *header, values(touches), levels, scores, ranks, made_from_t_ns=t_ns, skipped=self.skipped
        )
        message.compute_ms = (time.perf_counter() - began_s) * 1e3
        return message


def values(touches: list[PredictedReading]) -> Any:
    """Return predicted readings as an array (grasp, value) with the columns `touch_messages.COLUMNS`."""
    return np.array([[touch.pdc_th, touch.pdc_mf, *touch.e_th, *touch.e_mf] for touch in touches], np.float64)
