"""Messages have the bytes that they had before their values were declared in one place.

``published_bytes.json`` was written by the code of before: JSON, msgpack, numbers of LSL, JSON schemas, packets and fields
of the recorded streams, for a message with an answer and for a message without one.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from tacpipe.live.messages import Description, Message, packets, reference_page, to_json
from tacpipe.sensors.live import Live
from tacpipe.tasks.forward.live import messages as forward
from tacpipe.tasks.forward.live.alarms import State
from tacpipe.tasks.material.live import messages as material
from tacpipe.tasks.touch.live import messages as touch

EXPECTED: dict[str, Any] = json.loads((Path(__file__).parent / "published_bytes.json").read_text())
T_NS = 10**18
MEASURED: dict[str, Any] = {"latency_ms": 3.25, "compute_ms": 1.0, "skipped": 2, "late": 1}
VALUES = np.array([[0.5, -1.25], [2.0, 1e-3]], np.float32)
STATES = {"load": State(1, 2.5), "slip": State(-1, math.nan)}
Case = tuple[Description, Sequence[Message], dict[str, Live]]


def forecasts(unit: str, levels: tuple[int, ...]) -> Case:
    about = forward.ForecastDescription(("a", "b"), (1, 3), unit, 50.0, "m", levels)
    quantiles = np.stack([VALUES - 1, VALUES + 1]) if levels else None
    cause, flags = ("", 0) if levels else ("why", 64)
    answer = forward.ForecastMessage(
        7, T_NS, VALUES, cause, flags, STATES, T_NS - 5, age_ms=4.5, levels=levels, quantiles=quantiles, **MEASURED
    )
    sizes: dict[str, Any] = {"channels": ("a", "b"), "steps": (1, 3), "quantiles": levels, "unit": unit}
    streams = {
        "forecast": Live(task="forward", output="forecast", **sizes),
        "alarm": Live(task="forward", output="alarm", alarms=("load", "slip")),
    }
    return about, [answer, forward.ForecastMessage(8, T_NS, None, "no", 3, levels=levels)], streams


def materials() -> Case:
    names = ("wood", "wool")
    about = material.MaterialDescription(names, "skin", 50, True, "probability", 10.0, "m")
    likely = np.array([0.25, 0.75], np.float32)
    answer = material.MaterialMessage(
        3, T_NS, names, likely, "sliding", 20, 0.41234567, "", T_NS - 5, slide=2, **MEASURED
    )
    none = material.MaterialMessage(4, T_NS, names, None, cause="no")
    return about, [answer, none], {"material": Live(task="material", output="material", channels=names)}


def rankings() -> Case:
    values = np.arange(2 * len(touch.COLUMNS), dtype=float).reshape(2, -1) + 0.5
    values[0, 1] = math.nan
    levels = np.array([[0.1, math.nan], [0.3, 0.44444444]])
    scores = np.array([0.1, 0.37222])
    answer = touch.TouchMessage(3, T_NS, 12, "contact", values, levels, scores, (2, 1), "", T_NS - 5, **MEASURED)
    none = touch.TouchMessage(4, T_NS, 13, "contact", cause="no")
    about = touch.TouchDescription(("pdc_th", "e_th"), "contact", "m")
    return about, [answer, none], {"touch": Live(task="touch", output="touch", channels=touch.COLUMNS)}


CASES = {
    "forecast": lambda: forecasts("count", ()),
    "quantiles": lambda: forecasts("N", (10, 90)),
    "material": materials,
    "touch": rankings,
}


def fields(sensor: Live) -> list[Any]:
    return [
        [field.name, str(field.type), {key.decode(): value.decode() for key, value in field.metadata.items()}]
        for field in sensor.fields()
    ]


@pytest.mark.parametrize("name", CASES)
def test_every_format_has_the_bytes_of_before(name: str) -> None:
    about, published, streams = CASES[name]()
    streams |= {"latency": Live(task=streams[next(iter(streams))].task)}
    expected = EXPECTED[name]
    assert to_json(about.to_dict()).decode() == expected["description"]
    assert about.schema() == expected["schema"]
    assert [list(column) for column in about.columns()] == expected["columns"]
    assert [to_json(message.to_dict()).decode() for message in published] == expected["json"]
    assert [msgpack.packb(message.to_dict()).hex() for message in published] == expected["msgpack"]
    assert [message.numbers(about).tobytes().hex() for message in published] == expected["numbers"]
    assert [dict(message.states) for message in published] == expected["states"]
    for stream, sensor in streams.items():
        sent = [[packet.hex() for packet in packets(message, sensor, 41)] for message in published]
        assert sent == expected["packets"][stream]
        assert fields(sensor) == expected["fields"][stream]


@pytest.mark.parametrize("name", CASES)
def test_the_reference_page_names_each_field_of_a_message(name: str) -> None:
    about, (message, _), _ = CASES[name]()
    page = reference_page({"a task": about.declaration})
    assert all(f"| `{field}` |" in page for field in message.to_dict() if field not in ("version", "kind"))
