"""A live session's logic for models of touch: requests with a cloud and candidate grasps in, rankings out."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from tacpipe.clouds.cloud import Cloud
from tacpipe.errors import TacpipeError
from tacpipe.live.engine import Engine
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.grasps import GraspRequests, parsed
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.touch.live import requests as touch_ranking
from tacpipe.tasks.touch.live import requests as touch_requests
from tacpipe.tasks.touch.live.messages import TouchDescription, TouchMessage
from tacpipe.tasks.touch.live.requests import Criterion
from tacpipe.tasks.touch.predictor import PredictedReading, Predictor

WAITING = 16  # requests that wait; of more the oldest are answered no more
IDLE_NS = 5_000_000


class TouchEngine(Engine):
    """One live session of a model of touch."""

    def __init__(self, sensors: Mapping[str, Sensor], predictor: Predictor, criterion: Criterion) -> None:
        """Take the rig's sensors. Raises `TacpipeError` where none gives requests, or the model predicts too little."""
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
        self._waiting: deque[tuple[int, str, bytes]] = deque()  # arrival, stream, request
        self._clouds: dict[str, Cloud] = {}  # the last one of each stream

    def describe(self, model: str) -> TouchDescription:
        """Return what its messages are."""
        return TouchDescription(self._predictor.targets, self._criterion.text, model)

    def ready(self) -> dict[str, Any]:
        """Return what is predicted; there are no alarms."""
        return {"targets": list(self._predictor.targets), "alarms": {}}

    def begin_recording(self, offset_ns: int) -> None:
        """Await the streams of requests."""
        self._recorded_streams = set()

    def end_recording(self) -> None:
        """Drop the requests that wait."""
        super().end_recording()
        self._waiting.clear()

    def begin_stream(self, stream: str) -> None:
        """Answer requests of a stream from now on."""
        self._recorded_streams.add(stream)

    def take_chunks(self, stream: str, chunks: Chunks) -> None:
        """Keep the requests of a stream; of more than `WAITING` the oldest are dropped."""
        if stream not in self.requests or stream not in self._recorded_streams or not self.running:
            return
        runs, _ = self._framers[stream].feed(chunks)
        for run in runs:
            self._waiting.extend((t_ns, stream, text) for t_ns, text in zip(run.t_ns.tolist(), run.frames, strict=True))
        while len(self._waiting) > WAITING:
            self._waiting.popleft()
            self.skipped += 1

    def due_ns(self, now_ns: int) -> int:
        """Return when `step` is to be called next, on the monotonic clock."""
        return now_ns if self._waiting else now_ns + IDLE_NS

    def step(self, now_ns: int) -> list[TouchMessage]:
        """Return the answer to the request that has waited longest."""
        if not self._waiting or self._offset_ns is None:
            return []
        t_ns, stream, text = self._waiting.popleft()
        return [self._answered(t_ns + self._offset_ns, stream, parsed(text))]

    def _answered(self, t_ns: int, stream: str, record: Any) -> TouchMessage:
        began_s = time.perf_counter()
        about = (self.next_seq(), t_ns, int(record["request"]), self._criterion.text)
        try:
            cloud = touch_requests.cloud(record, self.requests[stream].folder, self._clouds.get(stream))
            self._clouds[stream] = cloud
            touches = self._predictor.predict_all(cloud, touch_requests.grasps(record))
        except TacpipeError as error:
            return TouchMessage(*about, cause=str(error), skipped=self.skipped)
        levels = touch_ranking.levels(touches)
        scores = self._criterion.score(levels)
        ranks = tuple(touch_ranking.ranks(scores))
        message = TouchMessage(
            *about, values(touches), levels, scores, ranks, made_from_t_ns=t_ns, skipped=self.skipped
        )
        message.compute_ms = (time.perf_counter() - began_s) * 1e3
        return message


def values(touches: list[PredictedReading]) -> Any:
    """Return touches as `touch_messages.COLUMNS` (grasp, value)."""
    return np.array([[touch.pdc_th, touch.pdc_mf, *touch.e_th, *touch.e_mf] for touch in touches], np.float64)
