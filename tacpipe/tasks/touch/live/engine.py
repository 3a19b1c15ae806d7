"""A live session's logic for models of touch: requests with a cloud and candidate grasps in, rankings out."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from tacpipe.clouds.cloud import Cloud
from tacpipe.errors import TacpipeError
from tacpipe.live import wire
from tacpipe.recording.spool_blocks import Note
from tacpipe.recording.station import BEGAN
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.grasps import Grasps, parsed
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.touch.live import ranking as touch_ranking
from tacpipe.tasks.touch.live import requests as touch_requests
from tacpipe.tasks.touch.live.messages import TouchDescription, TouchMessage
from tacpipe.tasks.touch.live.ranking import Criterion
from tacpipe.tasks.touch.predictor import Predictor, Touch

WAITING = 16  # requests that wait; of more the oldest are answered no more
IDLE_NS = 5_000_000


class TouchEngine:
    """One live session of a model of touch."""

    beginning = None  # a process that is started anew needs nothing of the one before

    def __init__(self, sensors: Mapping[str, Sensor], predictor: Predictor, criterion: Criterion) -> None:
        """Take the rig's sensors. Raises `TacpipeError` where none gives requests, or the model predicts too little."""
        self.requests = {name: sensor for name, sensor in sensors.items() if isinstance(sensor, Grasps)}
        if not self.requests:
            raise TacpipeError(
                "The rig has no stream of the sensor grasps, by which candidates come; add one, as in docs/howto/live.md."
            )
        fingers = {target.rpartition("_")[2] for target in predictor.targets}
        if len(fingers) < criterion.fingers:
            raise TacpipeError(
                f"--rank {criterion.text} compares both fingers, and the model predicts {', '.join(predictor.targets)}."
            )
        self.skipped = self.overflows = self.late = self._seq = 0
        self.offset_ns: int | None = None
        self._predictor, self._criterion = predictor, criterion
        self._framers = {name: sensor.framer() for name, sensor in self.requests.items()}
        self._begun: set[str] = set()
        self._waiting: deque[tuple[int, str, bytes]] = deque()  # arrival, stream, request
        self._clouds: dict[str, Cloud] = {}  # the last one of each stream

    @property
    def running(self) -> bool:
        """Whether a recording has begun."""
        return self.offset_ns is not None

    def about(self, model: str) -> TouchDescription:
        """Return what its messages are."""
        return TouchDescription(self._predictor.targets, self._criterion.text, model)

    def ready(self) -> dict[str, Any]:
        """Return what is predicted; there are no alarms."""
        return {"targets": list(self._predictor.targets), "alarms": {}}

    def take(self, stream: str, block: Chunks | Note) -> None:
        """Take a block of a stream, or a note on all (``stream`` is empty)."""
        if isinstance(block, Note):
            if block.what == wire.BEGIN:
                self.offset_ns, self._begun = int(block.detail), set()
            elif block.what == wire.END:
                self.offset_ns = None
                self._waiting.clear()
            elif block.what == wire.OVERFLOW:
                self.overflows += 1
            elif block.what == BEGAN:
                self._begun.add(stream)
            return
        if stream not in self.requests or stream not in self._begun or self.offset_ns is None:
            return
        runs, _ = self._framers[stream].feed(block)
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
        if not self._waiting or self.offset_ns is None:
            return []
        t_ns, stream, text = self._waiting.popleft()
        return [self._answered(t_ns + self.offset_ns, stream, parsed(text))]

    def finish(self) -> list[TouchMessage]:
        """Return the messages that are left when the session is over: none."""
        return []

    def published(self, message: TouchMessage, now_ns: int) -> None:
        """Write into a message how long it took, when it is about to go out."""
        if self.offset_ns is not None and message.answers:
            message.latency_ms = (now_ns + self.offset_ns - message.made_from_t_ns) / 1e6

    def _answered(self, t_ns: int, stream: str, record: Any) -> TouchMessage:
        began_s = time.perf_counter()
        self._seq += 1
        about = (self._seq, t_ns, int(record["request"]), self._criterion.text)
        try:
            cloud = touch_requests.cloud(record, self.requests[stream].folder, self._clouds.get(stream))
            self._clouds[stream] = cloud
            touches = self._predictor.predict_all(cloud, touch_requests.grasps(record))
        except TacpipeError as error:
            return TouchMessage(*about, cause=str(error), skipped=self.skipped)
        levels = touch_ranking.levels(touches)
        scores = self._criterion.score(levels)
        ranks = tuple(touch_ranking.ranks(scores))
        found = TouchMessage(*about, values(touches), levels, scores, ranks, made_from_t_ns=t_ns, skipped=self.skipped)
        found.compute_ms = (time.perf_counter() - began_s) * 1e3
        return found


def values(touches: list[Touch]) -> Any:
    """Return touches as `touch_messages.COLUMNS` (grasp, value)."""
    return np.array([[one.pdc_th, one.pdc_mf, *one.e_th, *one.e_mf] for one in touches], np.float64)
