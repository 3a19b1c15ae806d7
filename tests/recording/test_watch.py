"""Test the display while a rig records: lines with rates and losses, and on a terminal a table with a taxel map."""

import http.client
import io
import re
from collections.abc import Iterator
from urllib.parse import urlsplit

import numpy as np
import pytest
from rich.console import Console

from tacpipe.errors import UsageError
from tacpipe.links.link import Address, parse
from tacpipe.recording import clock, rig
from tacpipe.recording import watch as view_of
from tacpipe.recording.pace import CAUGHT_UP, STALLED, Stall
from tacpipe.recording.pictures import serve_pictures
from tacpipe.recording.rig import RigStream, build_sensor
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import LOST, OPENED, OVERRUN, REFUSED
from tacpipe.recording.watch import RigView, Watch
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.optoforce import OptoForce
from tests.recording.test_reading import frames

TAXELS = 20
NUMBERS = {"name": "taxel", "type": "u16", "count": TAXELS, "unit": "count", "quantity": "tactile"}


@pytest.fixture
def force(monkeypatch: pytest.MonkeyPatch) -> Watch:
    """A force sensor of 1 kHz of which 7 samples of 400 were lost, at the end of these 0.4 s."""
    watch = Watch(RigStream("force", "optoforce", OptoForce(axes=3), Address("serial", "/dev/ttyACM0")))
    sent = list(enumerate(frames(400)))
    watch.feed([Chunks.from_pairs([(row * 1_000_000, frame) for row, frame in sent[:100] + sent[107:]])])
    monkeypatch.setattr(clock, "now_ns", lambda: 400_000_000)
    return watch


def pad(touched: int | None = None) -> Watch:
    """Return a pad that was at rest for a second, then had a taxel pressed."""
    sensor = rig.build_sensor("generic", {"rate_hz": 100, "packets": True, "numbers": [NUMBERS]}, "here")
    watch = Watch(RigStream("pad", "generic", sensor, Address("udp", ":4000")))
    idle = np.full(TAXELS, 100, "<u2")
    for tick in range(20):
        watch.feed([Chunks.from_pairs([(tick * 10_000_000, idle.tobytes())])])
    pressed = idle.copy()
    if touched is not None:
        pressed[touched] = 900
    watch.feed([Chunks.from_pairs([(200_000_000, pressed.tobytes())])])
    return watch


def render(view: RigView, watches: dict[str, Watch], *, colours: bool = False) -> str:
    """Return what the view draws on a terminal."""
    console = Console(file=io.StringIO(), width=100, force_terminal=colours, color_system="256" if colours else None)
    figures = {name: watch.figures(clock.now_ns()) for name, watch in watches.items()}
    console.print(view._render("recording one, 3 s", figures))
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    return text


def test_lines_tell_rates_and_losses(
    force: Watch, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(view_of, "LINE_S", 0.0)
    RigView({"force": force}).show("recording one, 3 s")

    # 393 samples in 399 ms; one step of 8 ms among 391 of 1 ms
    jitter_ms = np.std([8.0] + [1.0] * 391)
    rate_hz = 392 / 0.399
    expected = f"force {rate_hz:.1f} Hz, jitter {jitter_ms:.1f} ms, 393 samples, 7 lost"
    assert capsys.readouterr().err == f"recording one, 3 s: {expected}\n"


def test_each_event_of_a_stream_is_one_line_with_its_time_and_none_if_asked(
    force: Watch, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = [0.4]
    monkeypatch.setattr(clock, "now_ns", lambda: round(now_s[0] * 1e9))
    loud, quiet = RigView({"force": force}), RigView({"force": force}, quiet=True)

    def lines(at_s: float, *blocks: Chunks | StreamNote) -> list[str]:
        now_s[0] = at_s
        force.feed(list(blocks))
        quiet.show("recording one")
        loud.show("recording one")
        printed = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("recording one")]
        assert all(re.match(r"\d\d:\d\d:\d\d ", line) for line in printed)
        return [line[9:] for line in printed]

    def note(at_s: float, what: str, detail: str = "") -> StreamNote:
        return StreamNote(round(at_s * 1e9), "force", what, detail)

    def samples(at_s: float) -> Chunks:
        start_ns = round(at_s * 1e9)
        return Chunks.from_pairs([(start_ns + row * 1_000_000, frame) for row, frame in enumerate(frames(10))])

    assert lines(0.5, note(0.1, OPENED)) == []  # the beginning is no event
    assert lines(1.0, note(0.9, LOST, "Stream force is lost: unplugged.")) == ["Stream force is lost: unplugged."]
    assert lines(4.0) == []  # nothing comes from a lost stream
    assert lines(4.5, note(4.4, OPENED), samples(4.4)) == ["Stream force is open again."]
    assert lines(6.0) == []
    assert lines(7.0) == ["Stream force sends nothing from now on, though its link is open."]
    assert lines(8.0) == []
    assert lines(9.0, samples(8.9)) == ["Stream force sends again."]
    stall = note(9.05, STALLED, Stall(250_000_000, 0).detail)
    assert lines(9.1, stall, note(9.1, STALLED, Stall(1, 1).detail), note(9.1, CAUGHT_UP)) == [
        "This program was delayed by 250 ms, so arrival times are late."
    ]
    assert lines(9.2, note(9.2, OVERRUN, "3")) == ["Stream force: 3 overruns of its link, whose data are lost."]
    assert lines(9.3, note(9.3, REFUSED, "7 packets were left out")) == ["Stream force: 7 packets were left out."]


def test_lines_come_now_and_then_and_not_at_all_if_asked(
    force: Watch, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = [100.0]
    monkeypatch.setattr(clock, "now_s", lambda: now_s[0])
    loud, quiet = RigView({"force": force}), RigView({"force": force}, quiet=True)
    for step in range(12):
        now_s[0] = 100.0 + step
        loud.show(f"{step}")
        quiet.show(f"quiet {step}")

    assert re.findall(r"(?m)^(.+?):", capsys.readouterr().err) == ["5", "10"]


def test_the_table_tells_every_stream_and_marks_the_ones_that_lose(force: Watch) -> None:
    watches = {"force": force, "pad": pad()}
    text = render(RigView(watches), watches)

    assert "recording one, 3 s" in text
    (row,) = [line for line in text.splitlines() if line.startswith("│ force")]
    assert [cell.strip() for cell in row.strip("│").split("│")] == [
        "force",
        f"{392 / 0.399:.1f}",
        "0.35",
        "",
        "393",
        "7",
        "0",
    ]
    coloured = render(RigView(watches), watches, colours=True)
    assert re.search(r"\x1b\[31m *force", coloured) and not re.search(r"\x1b\[31m *pad", coloured)


def test_the_map_shows_the_taxel_that_is_pressed(force: Watch) -> None:
    for touched in (0, 5, TAXELS - 1):
        watches = {"pad": pad(touched)}
        text = render(RigView(watches), watches, colours=True)
        cells = re.findall(r"\x1b\[(4[0-7]|48;5;\d+)m((?:  )+)\x1b\[0m", text)
        colours = [colour for colour, blanks in cells for _ in range(len(blanks) // 2)]

        assert len(colours) == TAXELS
        assert [place for place, colour in enumerate(colours) if colour != colours[touched]] == [
            place for place in range(TAXELS) if place != touched
        ]


def test_a_map_has_rows_of_sixteen(force: Watch) -> None:
    watches = {"pad": pad(3)}
    lines = render(RigView(watches), watches).splitlines()
    start = next(number for number, line in enumerate(lines) if line.strip() == "pad")

    assert [len(line) for line in lines[start + 1 :]] == [2 * 16, 2 * (TAXELS - 16)]


def test_a_terminal_shows_the_view_and_is_left_clean(force: Watch, monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(screen, "isatty", lambda: True)
    monkeypatch.setattr("sys.stderr", screen)
    monkeypatch.setattr(view_of, "REFRESH_HZ", 1000.0)
    monkeypatch.setattr("rich.console.Console.is_terminal", True)
    with RigView({"force": force}).open() as view:
        view._shown_s = 0.0
        view.show("recording one, 3 s")

    assert "recording one, 3 s" in screen.getvalue() and "force" in screen.getvalue()


FIRST, SECOND = b"\xff\xd8first\xff\xd9", b"\xff\xd8second\xff\xd9"


def watch(kind: str) -> Watch:
    address = parse("mjpeg:http://127.0.0.1:8080/stream" if kind == "camera" else "udp:127.0.0.1:9000")
    return Watch(RigStream("gel", kind, build_sensor(kind, {}, "stream gel"), address))


@pytest.fixture
def camera() -> Watch:
    return watch("camera")


@pytest.fixture
def address(camera: Watch) -> Iterator[str]:
    with serve_pictures({"gel": camera}, 0) as page:
        yield urlsplit(page).netloc


def get(address: str, path: str, host: str | None = None) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection(address, timeout=60)
    connection.request("GET", path, headers={} if host is None else {"Host": host})
    return connection.getresponse()


def next_frame(response: http.client.HTTPResponse) -> bytes:
    assert response.readline() == b"--tacpipe-frame\r\n"
    assert response.readline() == b"Content-Type: image/jpeg\r\n"
    size = int(response.readline().removeprefix(b"Content-Length: "))
    assert response.readline() == b"\r\n"
    return response.read(size + 2).removesuffix(b"\r\n")


def test_the_page_names_each_camera(address: str) -> None:
    assert b'<img src="/gel" alt=""><figcaption>gel</figcaption>' in get(address, "/").read()


def test_each_new_frame_is_sent_as_it_was_recorded(camera: Watch, address: str) -> None:
    camera.newest_packet = FIRST
    response = get(address, "/gel")
    assert next_frame(response) == FIRST
    camera.newest_packet = SECOND
    frames = [next_frame(response)]
    while frames[-1] != SECOND:
        frames.append(next_frame(response))
    assert set(frames) <= {FIRST, SECOND}


@pytest.mark.parametrize(("path", "host", "status"), [("/other", None, 404), ("/gel", "evil.example:80", 403)])
def test_other_names_and_pages_of_other_sites_get_nothing(address: str, path: str, host: str, status: int) -> None:
    assert get(address, path, host).status == status


def test_a_rig_without_a_camera_is_refused() -> None:
    with pytest.raises(UsageError, match="this rig has none"), serve_pictures({}, 8081):
        pass


def test_without_the_option_nothing_is_served(camera: Watch) -> None:
    with serve_pictures({"gel": camera}, None) as page:
        assert page == ""


def test_a_warning_is_a_line_with_its_time(force: Watch, capsys: pytest.CaptureFixture[str]) -> None:
    RigView({"force": force}).show("recording a", "The disk has room for 9 minutes more.")
    assert re.search(r"^\d\d:\d\d:\d\d The disk has room for 9 minutes more\.$", capsys.readouterr().err, re.MULTILINE)
