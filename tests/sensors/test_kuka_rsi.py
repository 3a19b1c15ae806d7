"""Test RSI texts as a controller sends them, and with rsipi as server and as parser."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tacpipe.errors import UsageError
from tacpipe.recording.reading import LINK, LinkReader
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.kuka_rsi import KukaRsi
from tacpipe.sensors.sensor import Samples

TEXT = (
    b'<Rob Type="KUKA"><RIst X="1620.0008" Y="-10.5" Z="1910.0" A="30.0" B="-20.0" C="170.0"/>'
    b'<AIPos A1="0.0" A2="-90.0" A3="90.0" A4="45.0" A5="180.0" A6="-1.0"/><Delay D="2"/><Tech C11="1.5" C12="0.0"/>'
    b"<DiL>7</DiL><Ok>TRUE</Ok><IPOC>%d</IPOC></Rob>"
)
EVERY = ("RIst", "RSol", "AIPos", "ASPos", "MACur", "Delay.D", "Tech.C11", "DiL")


def random_samples(rows: int, seed: int) -> Samples:
    """Return samples of `EVERY` output, numbers that four digits hold in mm and degrees."""
    rng = np.random.default_rng(seed)
    blocks = []
    for name in EVERY:
        if name in ("RIst", "RSol"):
            turned = Rotation.from_euler("ZYX", rng.uniform((-180, -80, -180), (180, 80, 180), (rows, 3)), degrees=True)
            blocks.append(np.hstack([rng.uniform(-2, 2, (rows, 3)), turned.as_quat()]))
        else:
            wide = 6 if name in ("AIPos", "ASPos", "MACur") else 1
            blocks.append(rng.uniform(-3, 3, (rows, wide)))
    ipoc = rng.integers(0, 1 << 32, rows)
    return Samples(tuple(blocks), seq=ipoc, t_device_ns=ipoc * 1_000_000)


def test_a_controllers_text_is_read_in_metres_and_rad() -> None:
    sensor = KukaRsi(outputs=("RIst", "AIPos", "Delay.D", "Tech.C11", "DiL", "Ok"))

    samples = sensor.decode([TEXT % 4208163634])

    turned = Rotation.from_euler("ZYX", [30.0, -20.0, 170.0], degrees=True).as_quat()
    pose = samples.values[0][0]
    assert pose[:3].tolist() == pytest.approx([1.6200008, -0.0105, 1.91])
    assert abs(pose[3:] @ turned) == pytest.approx(1)
    np.testing.assert_allclose(np.degrees(samples.values[1][0]), [0, -90, 90, 45, 180, -1])
    assert [block[0, 0] for block in samples.values[2:]] == [2, 1.5, 7, 1]
    assert samples.seq is not None and samples.t_device_ns is not None
    assert (samples.seq.tolist(), samples.t_device_ns.tolist()) == ([4208163634], [4208163634 * 1_000_000])
    names = [field.name for field in sensor.fields()]
    assert (names[0], names[7], names[13:]) == ("position_x_m", "joint1_rad", ["delay_d", "tech_c11", "dil", "ok"])


@pytest.mark.parametrize(("rate_hz", "step"), [(250.0, 4), (1000 / 12, 12), (83.33, 12)])
def test_ipoc_grows_by_the_cycle_and_a_gap_is_a_lost_text(rate_hz: float, step: int) -> None:
    reading = LinkReader(KukaRsi(rate_hz=rate_hz))

    batch = reading.feed(Chunks.from_pairs([(step * 1_000_000 * n, TEXT % (1000 + step * n)) for n in (1, 2, 3, 5, 6)]))

    assert [(event.cause, event.frames) for event in batch.events] == [(LINK, 1)]
    assert np.diff(batch.seq if batch.seq is not None else []).tolist() == [1, 1, 2, 1]


@pytest.mark.parametrize(
    "packet",
    [
        b"",
        b"\xff\xff",
        TEXT[:-1],
        TEXT.replace(b"Rob", b"Sen") % 1,
        TEXT.replace(b"<IPOC>%d</IPOC>", b""),
        TEXT % -4,
        TEXT.replace(b'A6="-1.0"', b"") % 1,
        TEXT.replace(b"-90.0", b"nan") % 1,
        TEXT.replace(b"-90.0", b"ninety") % 1,
    ],
)
def test_what_is_no_text_of_the_controller_is_malformed(packet: bytes) -> None:
    runs, losses = KukaRsi().framer().feed(Chunks.from_pairs([(1, packet)]))

    assert not runs
    assert [loss.cause for loss in losses] == ["malformed"]


def test_a_text_is_answered_with_its_ipoc_unless_the_controller_only_sends() -> None:
    assert KukaRsi().answer(TEXT % 123456) == b'<Sen Type="ImFree"><IPOC>123456</IPOC></Sen>'
    assert KukaRsi(sen_type="Lab").answer(TEXT % 4).startswith(b'<Sen Type="Lab">')
    assert KukaRsi(only_send=True).answer(TEXT % 123456) == b""
    assert KukaRsi().answer(b"noise") == b""


@pytest.fixture
def rsipi(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The package's server without a network, its controller's configuration, and what it sends."""
    import logging

    monkeypatch.chdir(tmp_path)  # the server writes a log where it is imported
    monkeypatch.setattr(logging, "basicConfig", lambda **_: None)
    rsi_echo_server = pytest.importorskip("RSIPI.rsi_echo_server", reason="rsipi is not installed")

    sent: list[bytes] = []

    class Wire:
        def __init__(self, *_: object) -> None:
            pass

        def bind(self, address: object) -> None:
            pass

        def sendto(self, data: bytes, address: object) -> None:
            sent.append(data)

    server_socket = type("Sockets", (), {"AF_INET": 0, "SOCK_DGRAM": 0, "socket": Wire})
    monkeypatch.setattr(rsi_echo_server, "socket", server_socket)
    monkeypatch.setattr(rsi_echo_server.EchoServer, "_local_target_ip", staticmethod(lambda ip: ip))
    folder = Path(sys.modules["RSIPI"].__path__[0]) / "contexts"
    server = rsi_echo_server.EchoServer(str(folder / "RSI_EthernetConfig_Joints.xml"))
    return server, sent


def test_rsipis_server_takes_our_answers_and_we_read_its_texts(rsipi: Any) -> None:
    server, sent = rsipi
    sensor = KukaRsi(outputs=("RIst", "RSol", "AIPos", "ASPos", "Delay.D"))
    server.state["RIst"]["X"], server.state["AIPos"]["A3"] = 1234.5, 45.0
    reading = LinkReader(sensor)

    accepted = []
    for number in range(20):
        server.send_once()
        accepted.append(server.process_reply(sensor.answer(sent[-1]).decode()))
        batch = reading.feed(Chunks.from_pairs([(4_000_000 * number, sent[-1])]))

    assert accepted == [True] * 20
    assert server.faulty_packets == 0
    assert reading.lost == reading.account.lost == 0
    assert batch.values[0][0, 0] == pytest.approx(1.2345)
    assert batch.values[2][0, 2] == pytest.approx(np.pi / 4)


def test_rsipis_parser_reads_what_we_encode() -> None:
    xml_handler = pytest.importorskip("RSIPI.xml_handler", reason="rsipi is not installed")
    sensor, samples = KukaRsi(outputs=EVERY), random_samples(5, 0)
    blank: dict[str, Any] = {name: dict.fromkeys("XYZABC", 0.0) for name in ("RIst", "RSol")}
    blank |= {name: {f"A{axis}": 0.0 for axis in range(1, 7)} for name in ("AIPos", "ASPos", "MACur")}
    blank |= {"Delay": {"D": 0.0}, "Tech": {"C11": 0.0}, "DiL": "", "IPOC": 0}

    for row, frame in enumerate(sensor.encode(samples)):
        parsed: dict[str, Any] = {
            name: dict(value) if isinstance(value, dict) else value for name, value in blank.items()
        }
        xml_handler.FastXMLParser(blank).parse(frame.decode(), parsed)

        assert parsed["IPOC"] == samples.seq[row]  # type: ignore[index]
        np.testing.assert_allclose(
            [parsed["RIst"][axis] for axis in "XYZ"], samples.values[0][row, :3] * 1000, atol=1e-4
        )
        angles = Rotation.from_quat(samples.values[0][row, 3:]).as_euler("ZYX", degrees=True)
        np.testing.assert_allclose([parsed["RIst"][axis] for axis in "ABC"], angles, atol=1e-3)
        np.testing.assert_allclose(list(parsed["AIPos"].values()), np.degrees(samples.values[2][row]), atol=1e-4)
        assert float(parsed["DiL"]) == pytest.approx(samples.values[7][row, 0], abs=1e-4)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 8))
def test_what_is_encoded_is_decoded_to_the_four_digits_of_a_controller(seed: int, rows: int) -> None:
    sensor, samples = KukaRsi(outputs=EVERY), random_samples(rows, seed)

    frames = sensor.encode(samples)
    decoded = sensor.decode(frames)

    assert not sensor.framer().feed(Chunks.from_pairs(list(enumerate(frames))))[1]
    np.testing.assert_array_equal(decoded.seq, samples.seq)
    for name, block, expected in zip(EVERY, decoded.values, samples.values, strict=True):
        if name in ("RIst", "RSol"):
            np.testing.assert_allclose(block[:, :3], expected[:, :3], atol=1e-7)
            np.testing.assert_allclose(np.abs((block[:, 3:] * expected[:, 3:]).sum(axis=1)), 1, atol=1e-9)
        else:
            np.testing.assert_allclose(block, expected, atol=1e-6 if name in ("AIPos", "ASPos") else 1e-4)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"rate_hz": 100.0}, r"rate_hz.*\b100\b"),
        ({"rate_hz": 0.0}, r"rate_hz.*\b0\b"),
        ({"outputs": ()}, "outputs"),
        ({"outputs": ("IPOC",)}, "IPOC"),
        ({"outputs": ("Tech.C11.x",)}, r"Tech\.C11"),
        ({"sen_type": '"'}, "SENTYPE"),
    ],
)
def test_options_that_no_controller_has_are_refused(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        KukaRsi(**options)
