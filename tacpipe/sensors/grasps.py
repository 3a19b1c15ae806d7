"""Candidate grasps on a cloud, which `tacpipe live` ranks with a model of touch: sent as JSON, a request a packet or file.

A request::

    {"version": 1, "request": 7, "cloud": "cup.ply" | [[X, Y, Z], …] | [[X, Y, Z, R, G, B], …] | null,
     "grasps": [{"g1": [X, Y, Z], "g2": [X, Y, Z], "wrist": [[…], […], […]] | null}, …]}

Lengths are in metres and one frame, colours 0 to 255. A path is of a PLY or PCD file, or of an NPZ file with ``points_m``
and ``colours``, within the option ``folder``; ``null`` is the cloud of the request before. ``wrist`` is the rotation whose
columns are approach, closing and third axis. The recording holds the grasps; clouds are not kept.
"""

from __future__ import annotations

import functools
import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, TypedDict

import numpy as np

from tacpipe.sensors.byte_framer import TextFramer
from tacpipe.sensors.framing import Framer
from tacpipe.sensors.sensor import Samples, Sensor

if TYPE_CHECKING:
    import pyarrow as pa

VERSION = 1
MOST_GRASPS, MOST_POINTS = 1000, 1_000_000  # limits of a request
LARGEST = 1 << 62
POINTS = tuple(f"{point}_{axis}_m" for point in ("g1", "g2") for axis in "xyz")
WRIST = tuple(f"wrist_{row}_{column}" for row in range(3) for column in range(3))
AT_HAND = 4  # requests that are kept between the framer's look at them and their decoding


@dataclass(frozen=True)
class GraspRequests(Sensor):
    """Requests of a planner of grasps; a sample is one candidate, those of one request have the same arrival."""

    summary: ClassVar[str] = "Candidate grasps on a cloud, to be ranked by `tacpipe live`."
    links: ClassVar[tuple[str, ...]] = ("udp", "ws", "folder")
    listens: ClassVar[bool] = True
    steady: ClassVar[bool] = False

    folder: str = ""  # folder of the files of clouds that requests name; empty: requests must contain their clouds
    rate_hz: float = 0.0  # requests a second; 0: they come when they come

    def fields(self) -> list[pa.Field]:
        """Return number of the request and of the grasp in it, both points, and the wrist's rotation row by row."""
        import pyarrow as pa

        def number(name: str) -> pa.Field:
            metadata = {"unit": "m" if name.endswith("_m") else "1", "quantity": "plan"}
            return pa.field(name, pa.float64(), metadata=metadata)

        numbers = [
            pa.field(name, pa.int64(), metadata={"unit": "1", "quantity": "plan"}) for name in ("request", "grasp")
        ]
        return [*numbers, *map(number, (*POINTS, *WRIST))]

    def accepts(self, packet: bytes) -> bool:
        """Return whether a packet is a request: any program that reaches the port may send there."""
        return is_request(packet)

    def framer(self) -> Framer:
        """Return a framer that takes packets that are requests."""
        return TextFramer(is_request)

    def decode(self, frames: Sequence[bytes]) -> Samples:
        """Return a sample for each grasp of each request; the wrist is NaN where it is not given."""
        requests = [parsed(frame) for frame in frames]
        rows = [len(request["grasps"]) for request in requests]
        numbers = [[request["request"], place] for request in requests for place in range(len(request["grasps"]))]
        places = [
            [*grasp["g1"], *grasp["g2"], *itertools.chain.from_iterable(grasp.get("wrist") or [[math.nan] * 3] * 3)]
            for request in requests
            for grasp in request["grasps"]
        ]
        return Samples(
            (
                np.array(numbers, dtype=np.int64).reshape(-1, 2),
                np.array(places, dtype=np.float64).reshape(-1, len(POINTS) + len(WRIST)),
            ),
            rows=np.repeat(np.arange(len(requests)), rows).astype(np.int64),
        )

    def encode(self, samples: Samples) -> list[bytes]:
        """Return a request without a cloud for each run of samples whose grasps are counted from 0."""
        numbers, places = samples.values
        requests: list[GraspRequest] = []
        for (request, grasp), place in zip(numbers.tolist(), places, strict=True):
            if not grasp or not requests:
                requests.append({"version": VERSION, "request": request, "cloud": None, "grasps": []})
            wrist = place[6:].reshape(3, 3).tolist() if np.isfinite(place[6:]).all() else None
            requests[-1]["grasps"].append({"g1": place[:3].tolist(), "g2": place[3:6].tolist(), "wrist": wrist})
        return [json.dumps(request).encode() for request in requests]


class GraspPlace(TypedDict):
    """Where a requested grasp touches the object, and the orientation of the wrist."""

    g1: list[float]
    g2: list[float]
    wrist: list[list[float]] | None  # rotation matrix


class GraspRequest(TypedDict):
    """A request to predict grasps."""

    version: int
    request: int
    cloud: None
    grasps: list[GraspPlace]


def is_request(text: bytes) -> bool:
    """Return whether a packet is a request: its version, 1 to 1000 grasps of finite numbers, a cloud of a known form."""
    return parsed(text) is not None


@functools.lru_cache(maxsize=AT_HAND)
def parsed(text: bytes) -> Any:
    """Return the request in a packet, None where it is none."""
    try:
        record = json.loads(text.decode())
        grasps, cloud, request = record["grasps"], record.get("cloud"), record["request"]
        if record["version"] != VERSION or type(request) is not int or abs(request) > LARGEST:
            return None
        good = 0 < len(grasps) <= MOST_GRASPS and all(map(_is_grasp, grasps)) and _is_cloud(cloud)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError):
        return None
    return record if good else None


def _is_grasp(grasp: Any) -> bool:
    wrist = grasp.get("wrist")
    rows = [grasp["g1"], grasp["g2"], *([] if wrist is None else wrist)]
    return (wrist is None or len(wrist) == len("xyz")) and all(_are_numbers(row, 3) for row in rows)


def _is_cloud(cloud: Any) -> bool:
    if cloud is None or isinstance(cloud, str):
        return True
    widths = {len(point) for point in cloud}
    return 0 < len(cloud) <= MOST_POINTS and widths in ({3}, {6}) and all(_are_numbers(row, len(row)) for row in cloud)


def _are_numbers(row: Any, count: int) -> bool:
    return (
        type(row) is list
        and len(row) == count
        and all(type(number) in (int, float) and math.isfinite(number) for number in row)
    )
