"""Candidate grasps on a cloud, which `tacpipe live` ranks with a touch model. Each packet or file is one request in JSON.

A request::

    {"version": 1, "request": 7, "cloud": "cup.ply" | [[X, Y, Z], …] | [[X, Y, Z, R, G, B], …] | null,
     "grasps": [{"g1": [X, Y, Z], "g2": [X, Y, Z], "wrist": [[…], […], […]] | null}, …]}

Positions are in metres in one coordinate frame; colours are 0 to 255. A path refers to a PLY or PCD file, or an NPZ file
with ``points_m`` and ``colours``, within the option ``folder``; ``null`` is the cloud of the previous request. ``wrist``
is a rotation matrix with the columns approach, closing and third axis. Grasps are recorded; clouds are not.
"""

from __future__ import annotations

import functools
import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypedDict

import numpy as np
import pyarrow as pa

from tacpipe.channels import schema
from tacpipe.sensors.byte_framer import TextFramer
from tacpipe.sensors.framing import Framer
from tacpipe.sensors.sensor import Samples, Sensor

VERSION = 1
MAX_GRASPS, MAX_POINTS = 1000, 1_000_000  # maximum numbers of grasps, and of points, per request
MAX_NUMBER = 1 << 62
POINTS = tuple(f"{point}_{axis}_m" for point in ("g1", "g2") for axis in "xyz")
WRIST = tuple(f"wrist_{row}_{column}" for row in range(3) for column in range(3))
CACHED = 4  # number of cached requests, because the framer and the decoder parse the same requests


@dataclass(frozen=True)
class GraspRequests(Sensor):
    """Requests of a grasp planner. A sample is one candidate; candidates of one request have the same arrival."""

    summary: ClassVar[str] = "Candidate grasps on a cloud, which `tacpipe live` ranks."
    links: ClassVar[tuple[str, ...]] = ("udp", "ws", "folder")
    listens: ClassVar[bool] = True
    steady: ClassVar[bool] = False

    folder: str = ""  # folder with the cloud files of requests; empty: requests must contain their clouds
    rate_hz: float = 0.0  # requests per second; 0: irregular

    def fields(self) -> list[pa.Field]:
        """Return the fields of request number, grasp number, both contact points, and the wrist's rotation row by row."""
        numbers = [
            pa.field(name, pa.int64(), metadata={"unit": "1", "quantity": "plan"}) for name in ("request", "grasp")
        ]
        axes = [schema.float_field(name, "m" if name in POINTS else "1", "plan") for name in (*POINTS, *WRIST)]
        return [*numbers, *axes]

    def accepts(self, packet: bytes) -> bool:
        """Return whether a packet is a request. Any program may send packets to the port."""
        return is_request(packet)

    def framer(self) -> Framer:
        """Return a framer for packets that are requests."""
        return TextFramer(is_request)

    def decode(self, frames: Sequence[bytes]) -> Samples:
        """Return one sample per grasp of each request. A missing wrist is NaN."""
        requests = [parse_request(frame) for frame in frames]
        rows = [len(request["grasps"]) for request in requests]
        numbers = [[request["request"], grasp] for request in requests for grasp in range(len(request["grasps"]))]
        positions = [
            [*grasp["g1"], *grasp["g2"], *itertools.chain.from_iterable(grasp.get("wrist") or [[math.nan] * 3] * 3)]
            for request in requests
            for grasp in request["grasps"]
        ]
        return Samples(
            (
                np.array(numbers, dtype=np.int64).reshape(-1, 2),
                np.array(positions, dtype=np.float64).reshape(-1, len(POINTS) + len(WRIST)),
            ),
            rows=np.repeat(np.arange(len(requests)), rows).astype(np.int64),
        )

    def encode(self, samples: Samples) -> list[bytes]:
        """Return one request without a cloud for each run of samples whose grasp numbers start with 0."""
        numbers, positions = samples.values
        requests: list[GraspRequest] = []
        for (request, grasp), position in zip(numbers.tolist(), positions, strict=True):
            if not grasp or not requests:
                requests.append({"version": VERSION, "request": request, "cloud": None, "grasps": []})
            wrist = position[6:].reshape(3, 3).tolist() if np.isfinite(position[6:]).all() else None
            requests[-1]["grasps"].append({"g1": position[:3].tolist(), "g2": position[3:6].tolist(), "wrist": wrist})
        return [json.dumps(request).encode() for request in requests]


class GraspPlace(TypedDict):
    """Where a requested grasp touches the object, and the orientation of the wrist."""

    g1: list[float]
    g2: list[float]
    wrist: list[list[float]] | None  # rotation matrix of the wrist, row by row


class GraspRequest(TypedDict):
    """A request to predict grasps."""

    version: int
    request: int
    cloud: None
    grasps: list[GraspPlace]


def is_request(text: bytes) -> bool:
    """Return whether a packet is a valid request."""
    return parse_request(text) is not None


@functools.lru_cache(maxsize=CACHED)
def parse_request(text: bytes) -> Any:
    """Return the request in a packet, or None if it is invalid.

    A request has the right version, 1 to 1000 grasps with finite numbers, and a cloud, a path, or null.
    """
    try:
        record = json.loads(text.decode())
        grasps, cloud, request = record["grasps"], record.get("cloud"), record["request"]
        if record["version"] != VERSION or type(request) is not int or abs(request) > MAX_NUMBER:
            return None
        is_valid = 0 < len(grasps) <= MAX_GRASPS and all(map(_is_grasp, grasps)) and _is_cloud(cloud)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError):
        return None
    return record if is_valid else None


def _is_grasp(grasp: Any) -> bool:
    wrist = grasp.get("wrist")
    rows = [grasp["g1"], grasp["g2"], *([] if wrist is None else wrist)]
    return (wrist is None or len(wrist) == len("xyz")) and all(_are_numbers(row, 3) for row in rows)


def _is_cloud(cloud: Any) -> bool:
    if cloud is None or isinstance(cloud, str):
        return True
    widths = {len(point) for point in cloud}
    return 0 < len(cloud) <= MAX_POINTS and widths in ({3}, {6}) and all(_are_numbers(row, len(row)) for row in cloud)


def _are_numbers(row: Any, count: int) -> bool:
    """Return whether a JSON value is a list of ``count`` finite numbers."""
    return (
        type(row) is list
        and len(row) == count
        and all(type(number) in (int, float) and math.isfinite(number) for number in row)
    )
