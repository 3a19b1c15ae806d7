"""Bytes are traced to the sensor that speaks, by frames and rate, and noise to none."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from tacpipe.links.probing import CERTAIN, recognise
from tacpipe.plugins import registry
from tacpipe.recording import rig
from tacpipe.sensors.encoding import split_frames
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Samples, Sensor
from tests.sensors import made

RNG = np.random.default_rng(5)


def taxels(count: int, full_scale: int, kind: str) -> np.ndarray[Any, Any]:
    """Return smooth readings (frame, taxel) of 60 frames, which hold more structure than noise does."""
    time = np.arange(60)[:, None] / 60
    values = full_scale / 2 * (1 + np.sin(2 * np.pi * (time + np.linspace(0, 1, count))))
    return np.asarray(values + RNG.normal(0, full_scale / 200, values.shape)).clip(0, full_scale - 1).astype(kind)


def stream(sensor: Sensor, samples: Samples) -> Chunks:
    """Return the frames of samples at the sensor's rate, cut into chunks as a port might give them, begun in a frame."""
    frames = sensor.encode(samples)
    period_ns = int(1e9 / sensor.rate_hz)
    stamped_frames = [(number * period_ns, bytes(frame)) for number, frame in enumerate(frames)]
    return Chunks.from_pairs([(stamped_frames[0][0], stamped_frames[0][1][5:]), *stamped_frames[1:]])


def rigged(kind: str, options: Mapping[str, Any]) -> Sensor:
    return rig.build_sensor(kind, options, "test")


def optoforce(axes: int) -> Chunks:
    sensor = rigged("optoforce", {"axes": axes})
    counts = taxels(axes, 2000, "int16")
    return stream(sensor, Samples((np.zeros((60, 1), np.uint16), counts), seq=np.arange(60)))


def test_a_driver_is_found_with_its_options_and_its_evidence_is_a_sentence() -> None:
    first, *_ = recognise(optoforce(3), "serial")

    assert (first.name, dict(first.candidate.options)) == ("optoforce", {"axes": 3})
    assert first.evidence >= CERTAIN
    assert first.rate_hz == pytest.approx(1000)
    assert str(first) == "optoforce (axes = 3): 59 frames at 1000 Hz, 98.8 % of 955 bytes (0.0 % by chance)"


@pytest.mark.parametrize(("rows", "columns"), [(12, 32), (16, 16)])
def test_the_grid_of_a_board_without_sums_is_told_from_how_its_mark_repeats(rows: int, columns: int) -> None:
    options = {"rows": rows, "columns": columns}
    sensor = rigged("flexitac", options)

    first, *_ = recognise(stream(sensor, Samples((taxels(rows * columns, 250, "uint8"),))), "serial")

    assert (first.name, dict(first.candidate.options)) == ("flexitac", options)


@pytest.mark.parametrize(
    "options",
    [
        {"magnetometers": 5},
        {"magnetometers": 2, "mode": "ascii"},
    ],
)
def test_the_number_of_magnetometers_is_told_from_the_size_of_frames_or_lines(options: dict[str, Any]) -> None:
    sensor = rigged("anyskin", options)
    flux = RNG.normal(20, 5, (60, 4 * options["magnetometers"])).astype(np.float32)

    first, *_ = recognise(stream(sensor, Samples((flux,))), "serial")

    assert first.name == "anyskin"
    assert first.candidate.sensor == sensor


def test_the_channels_of_a_board_that_sends_plain_floats_are_counted() -> None:
    sensor = rigged("justfloat", {"channels": 7})

    first, *_ = recognise(stream(sensor, Samples((RNG.normal(0, 1, (60, 7)).astype(np.float32),))), "serial")

    assert (first.name, dict(first.candidate.options)) == ("justfloat", {"channels": 7})


def test_a_board_of_whole_numbers_with_spaces_is_not_taken_for_an_anyskin() -> None:
    text = "".join(" ".join(map(str, row)) + "\r\n" for row in taxels(8, 1024, "uint16").tolist())
    first, *_ = recognise(Chunks.from_pairs([(0, text.encode())]), "serial")
    assert (first.name, first.candidate.options["separator"]) == ("lines", " ")


def test_noise_silence_and_text_of_a_boot_are_no_sensor() -> None:
    noise = RNG.integers(0, 256, 20_000, dtype=np.uint8).tobytes()
    boot = b"ets Jun  8 2016 00:22:57\r\nrst:0x1 (POWERON_RESET),boot:0x13\r\nconfigsip: 0, SPIWP:0xee\r\n" * 20

    assert recognise(Chunks.from_pairs([]), "serial") == []
    assert recognise(Chunks.from_pairs([(0, noise)]), "serial") == []
    assert recognise(Chunks.from_pairs([(0, boot)]), "serial") == []


def test_packets_are_told_by_their_size_and_marks() -> None:
    sensor = rigged("rawhid", {})
    samples = Samples((taxels(12, 4096, "uint16"),), seq=np.arange(60))
    data = Chunks.from_pairs([(number, bytes(frame)) for number, frame in enumerate(sensor.encode(samples))])

    assert next(iter(recognise(data, "hid"))).name == "rawhid"


@pytest.mark.parametrize("kind", [kind for kind in registry.sensors() if kind not in ("generic", "lsl")])
def test_every_driver_comes_first_for_its_own_frames(kind: str) -> None:
    sensor = rigged(kind, made.OPTIONS.get(kind, {}))
    pieces = split_frames(sensor, sensor.encode(made.samples(kind, sensor, 200)))
    period_ns = int(1e9 / (sensor.rate_hz or 100) * 200 / len(pieces))  # a sample may be several packets
    data = Chunks.from_pairs([(number * period_ns, piece) for number, piece in enumerate(pieces)])

    for scheme in sensor.links:
        assert next(iter(recognise(data, scheme))).name == kind


def test_frames_of_a_board_of_ones_own_are_taken_for_no_product() -> None:
    sensor = rigged("generic", made.OPTIONS["generic"])
    pieces = split_frames(sensor, sensor.encode(made.samples("generic", sensor, 200)))

    assert (
        recognise(Chunks.from_pairs([(number * 10**6, piece) for number, piece in enumerate(pieces)]), "serial") == []
    )
