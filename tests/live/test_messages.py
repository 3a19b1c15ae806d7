"""Test that published messages contain the predictions, in every format."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from tacpipe.arrays import Float32s
from tacpipe.errors import UsageError
from tacpipe.live import messages
from tacpipe.live.messages import Description, Message, packets, reference_page, to_json
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.live import LATENCIES, Live
from tacpipe.sensors.plan import Plan, is_plan, packet
from tacpipe.tasks.forward.live import messages as forward
from tacpipe.tasks.forward.live.messages import ForecastDescription, ForecastMessage
from tacpipe.tasks.material.live import messages as material
from tacpipe.tasks.touch.live import messages as touch

VALUES = np.random.default_rng(0).normal(0, 1000, (3, 5)).astype(np.float32)
CHANNELS = tuple(f"c{number}" for number in range(5))


def message(values: Float32s | None = VALUES) -> ForecastMessage:
    return ForecastMessage(7, 10**18, values, cause="why", flags=4, age_ms=4.5, **MEASURED)


def test_json_holds_each_value_to_the_bit_and_null_where_nothing_is_known() -> None:
    content = json.loads(messages.to_json(message().to_dict()))
    assert np.array_equal(np.array(content["values"], dtype=np.float32), VALUES)
    assert (content["version"], content["seq"], content["t_ns"], content["cause"]) == (1, 7, 10**18, "why")
    assert json.loads(messages.to_json(message(None).to_dict()))["values"] is None


def test_quantiles_are_in_messages_of_sessions_that_publish_them_alone() -> None:
    about = ForecastDescription(CHANNELS, (1, 2, 3), "count", 50.0, "m")
    assert not {"quantiles"} & {*message().to_dict(), *about.to_dict(), *about.schema()}
    plain, about = message(), replace(about, quantiles=(10, 90))
    with_quantiles = replace(plain, levels=(10, 90), quantiles=np.stack([VALUES - 1, VALUES + 1]))
    sent = json.loads(messages.to_json(with_quantiles.to_dict()))
    assert list(sent["quantiles"]) == ["10", "90"] and sent.pop("quantiles")["90"] == (VALUES + 1).tolist()
    assert sent == json.loads(messages.to_json(plain.to_dict()))
    assert replace(message(None), levels=(10, 90)).to_dict()["quantiles"] is None
    assert about.to_dict()["quantiles"] == [10, 90] and set(about.schema()) == set(with_quantiles.to_dict())
    columns = dict(zip([name for name, _ in about.columns()], with_quantiles.numbers(about).tolist(), strict=True))
    assert columns["c4_t3"] == VALUES[2, 4] and columns["c4_t3_q10"] == VALUES[2, 4] - 1
    sensor = Live(task="forward", output="forecast", channels=CHANNELS, steps=(1, 2, 3), quantiles=(10, 90))
    (packet,) = messages.packets(with_quantiles, sensor, 41)
    values = [number for block in decoded(sensor, packet)[0] for number in block]
    by_column = dict(zip([field.name for field in sensor.fields()], values, strict=True))
    assert by_column == columns
    assert sensor.fields()[-1].metadata[b"quantile"] == b"0.9"


def decoded(sensor: Live, sent: bytes) -> tuple[list[list[float]], int, int]:
    runs, losses = sensor.framer().feed(Chunks.from_pairs([(0, sent)]))
    assert not losses
    samples = sensor.decode(runs[0].frames)
    assert samples.seq is not None and samples.t_device_ns is not None
    return [block[0].tolist() for block in samples.values], int(samples.seq[0]), int(samples.t_device_ns[0])


def test_packets_hold_each_value_to_the_bit_with_number_and_time() -> None:
    sensor = Live(task="forward", output="forecast", channels=CHANNELS, steps=(1, 2, 3))
    (sent,) = messages.packets(message(), sensor, 41)
    assert sent is not None
    assert decoded(sensor, sent) == ([VALUES.ravel().tolist()], 41, 10**18)
    names = [field.name for field in sensor.fields()]
    assert names[:6] == ["c0_t1", "c1_t1", "c2_t1", "c3_t1", "c4_t1", "c0_t2"]


def test_latencies_have_packets_too_and_a_missing_forecast_has_none() -> None:
    (latency,) = messages.packets(message(None), Live(), 3)
    assert latency is not None
    assert dict(zip(LATENCIES, decoded(Live(), latency)[0][0], strict=True)) == {
        **{"latency_ms": 3.25, "age_ms": 4.5, "compute_ms": 1.0, "cause": 4.0, "skipped": 2.0, "late": 1.0}
    }
    assert (
        messages.packets(message(None), Live(task="forward", output="forecast", channels=CHANNELS, steps=(1, 2, 3)), 3)
        == []
    )


def test_packets_of_another_output_or_version_are_refused() -> None:
    sensor = Live(task="forward", output="forecast", channels=CHANNELS, steps=(1, 2, 3))
    (sent,) = messages.packets(message(), sensor, 3)
    assert sent is not None
    other_version = sent[:4] + b"\x02" + sent[5:]
    for wrong in (other_version, sent[:-1], b"x" + sent[1:]):
        assert sensor.framer().feed(Chunks.from_pairs([(0, wrong)]))[0] == []


def test_a_forecast_that_is_too_large_for_a_packet_is_refused_with_what_to_do() -> None:
    with pytest.raises(UsageError, match="--steps"):
        Live(task="forward", output="forecast", channels=tuple(f"c{n}" for n in range(1000)), steps=tuple(range(1, 20)))


def test_a_plan_is_a_sample_a_point_with_the_arrival_of_its_packet() -> None:
    poses = [[0.1, 0.2, 0.3, 0, 0, 0, 1], [0.2, 0.2, 0.3, 0, 0, 0, 1.0]]
    samples = Plan().decode([packet([100, 200], poses), packet([300], poses[:1])])
    assert samples.rows is not None and samples.rows.tolist() == [0, 0, 1]
    assert samples.values[0][:, 0].tolist() == [100, 200, 300] and samples.values[1][1].tolist() == poses[1]


@pytest.mark.parametrize(
    "wrong",
    [
        b"",
        b"[]",
        b'{"version": 2, "points": [[1, 0, 0, 0, 0, 0, 0, 1]]}',
        b'{"version": 1, "points": []}',
        b'{"version": 1, "points": [[1, 0, 0, 0, 0, 0, 0]]}',
        b'{"version": 1, "points": [[1, 0, 0, 0, 0, 0, 0, 0]]}',
        b'{"version": 1, "points": [[1, 0, 0, NaN, 0, 0, 0, 1]]}',
        b'{"version": 1, "points": [[1.5, 0, 0, 0, 0, 0, 0, 1]]}',
        b'{"version": 1, "points": [[2, 0, 0, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 0, 0, 1]]}',
        b'{"version": 1, "points": [[4611686018427387905, 0, 0, 0, 0, 0, 0, 1]]}',
    ],
)
def test_what_is_no_plan_is_refused(wrong: bytes) -> None:
    assert not is_plan(wrong)


EXPECTED: dict[str, Any] = json.loads((Path(__file__).parent / "published_bytes.json").read_text())
T_NS = 10**18
MEASURED: dict[str, Any] = {"latency_ms": 3.25, "compute_ms": 1.0, "skipped": 2, "late": 1}
PUBLISHED_VALUES = np.array([[0.5, -1.25], [2.0, 1e-3]], np.float32)
Case = tuple[Description, Sequence[Message], dict[str, Live]]


def forecasts(unit: str, levels: tuple[int, ...]) -> Case:
    about = forward.ForecastDescription(("a", "b"), (1, 3), unit, 50.0, "m", levels)
    quantiles = np.stack([PUBLISHED_VALUES - 1, PUBLISHED_VALUES + 1]) if levels else None
    cause, flags = ("", 0) if levels else ("why", 64)
    answer = forward.ForecastMessage(
        7,
        T_NS,
        PUBLISHED_VALUES,
        cause=cause,
        flags=flags,
        made_from_t_ns=T_NS - 5,
        age_ms=4.5,
        levels=levels,
        quantiles=quantiles,
        **MEASURED,
    )
    sizes: dict[str, Any] = {"channels": ("a", "b"), "steps": (1, 3), "quantiles": levels, "unit": unit}
    streams = {"forecast": Live(task="forward", output="forecast", **sizes)}
    return about, [answer, forward.ForecastMessage(8, T_NS, None, cause="no", flags=3, levels=levels)], streams


def materials() -> Case:
    names = ("wood", "wool")
    about = material.MaterialDescription(names, "skin", 50, True, "probability", 10.0, "m")
    likely = np.array([0.25, 0.75], np.float32)
    answer = material.MaterialMessage(
        3, T_NS, names, likely, "sliding", 20, 0.41234567, made_from_t_ns=T_NS - 5, slide=2, **MEASURED
    )
    none = material.MaterialMessage(4, T_NS, names, None, cause="no")
    return about, [answer, none], {"material": Live(task="material", output="material", channels=names)}


def rankings() -> Case:
    values = np.arange(2 * len(touch.COLUMNS), dtype=float).reshape(2, -1) + 0.5
    values[0, 1] = math.nan
    levels = np.array([[0.1, math.nan], [0.3, 0.44444444]])
    scores = np.array([0.1, 0.37222])
    answer = touch.TouchMessage(
        3, T_NS, 12, "contact", values, levels, scores, (2, 1), made_from_t_ns=T_NS - 5, **MEASURED
    )
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
