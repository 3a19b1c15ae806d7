"""The page that the publisher serves at its own address, as a browser shows it."""

import urllib.error
import urllib.request
from collections.abc import Iterator

import numpy as np
import pytest

from tacpipe.live.messages import Description, Message
from tacpipe.live.websocket import TOKEN, WebsocketPublisher
from tacpipe.sensors.live import OFF, ON
from tacpipe.tasks.forward.live.messages import ForecastDescription, ForecastMessage
from tacpipe.tasks.learning.live.messages import EstimateDescription, EstimateMessage
from tacpipe.tasks.slip.live.messages import SlipDescription, SlipMessage
from tests.live.test_publishers import free_port
from tests.recording.live import awaited
from tests.report import browser
from tests.report.browser import Browser

SLIPS = SlipDescription("models/slip", 50.0, 1.0, "1", {"left": [[0, 0], [0, 1], [1, 0], [1, 1]]})
FORECASTS = ForecastDescription(
    ("left_taxel01_x", "left_taxel01_y", "left_taxel02_x", "left_taxel02_y"), (1, 5), "count", 50.0, "models/forward"
)
# How many pixels of a canvas are not empty
PAINTED = "[...document.getElementById('{}').getContext('2d').getImageData(0, 0, {}, {}).data].filter(Boolean).length"


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if browser.PROGRAM is None:
        pytest.skip("Chromium is missing; `make test` installs Debian's package chromium")
    with browser.browser(tmp_path_factory.mktemp("chromium")) as opened:
        yield opened


def visit(chromium: Browser, about: Description, max_age_ms: int) -> WebsocketPublisher:
    """Return a publisher whose page a browser shows, with the maximum age of its messages."""
    port = free_port()
    publisher = WebsocketPublisher(f"127.0.0.1:{port}", about)
    chromium.visit(f"http://127.0.0.1:{port}/?max_age_ms={max_age_ms}")
    awaited(lambda: publisher.subscribers == 1)
    return publisher


def show(chromium: Browser, about: Description, messages: list[Message]) -> WebsocketPublisher:
    """Return a publisher whose page a browser shows, once it has drawn the messages, which it keeps for minutes."""
    publisher = visit(chromium, about, 600_000)
    for number, message in enumerate(messages, start=1):
        publisher.publish(message)
        awaited(lambda number=number: chromium.run("messages") == number)  # type: ignore[misc]
    chromium.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))")
    return publisher


def left(chromium: Browser, publisher: WebsocketPublisher) -> None:
    """Have the browser leave the page, and end the publisher once it has."""
    chromium.visit("about:blank")
    awaited(lambda: publisher.subscribers == 0)
    publisher.close()


def test_the_page_draws_the_skins_the_probability_and_the_alarm(chromium: Browser) -> None:
    touch = {"left": [0.0, 1.0, 2.0, 3.0]}
    messages: list[Message] = [
        SlipMessage(number, number * 20_000_000, number / 10, 0.0, ON if number == 9 else OFF, touch)
        for number in range(1, 10)
    ]
    publisher = show(chromium, SLIPS, messages)
    assert chromium.run("document.getElementById('title').textContent") == "slip · tacpipe live"
    assert chromium.run("document.getElementById('answer').textContent") == "0.90"
    assert chromium.run("document.getElementById('state').textContent") == "alarm on"
    assert chromium.run("document.body.classList.contains('alarm')") is True
    assert chromium.run(PAINTED.format("skin-left", 60, 60)) > 1000
    assert chromium.run(PAINTED.format("history", 900, 220)) > 1000
    publisher.publish(SlipMessage(10, 200_000_000, cause="no sample comes from left"))
    awaited(lambda: chromium.run("document.getElementById('state').textContent") == "no sample comes from left")
    assert chromium.run("document.body.classList.contains('alarm')") is False
    left(chromium, publisher)


def test_the_page_draws_the_skins_and_the_forecast_of_a_session_of_forecasts(chromium: Browser) -> None:
    values = np.array([[3.0, 4.0, 0.0, 0.0], [6.0, 8.0, 0.0, 0.0]], np.float32)  # rms 2.5 and 5
    publisher = show(chromium, FORECASTS, [ForecastMessage(1, 20_000_000, values)])
    assert chromium.run("ahead.map((row) => row[1])") == [2.5, 5.0]
    assert chromium.run("about.touch") == {"left": [5.0, 0.0]}
    assert chromium.run(PAINTED.format("history", 900, 220)) > 1000
    assert chromium.run("document.getElementById('answer').textContent") == "5"
    assert "count, size of the touch in 0.10 s" in chromium.run("document.getElementById('what').textContent")
    publisher.publish(ForecastMessage(2, 40_000_000, None, cause="no sample comes from left"))
    awaited(lambda: chromium.run("messages") == 2)
    assert chromium.run("document.getElementById('answer').textContent") == "–"
    events = chromium.run("[...document.getElementById('events').children].map((item) => item.textContent.slice(-25))")
    assert events[0] == "no sample comes from left"
    left(chromium, publisher)


def test_the_page_shows_each_target_of_a_session_of_estimates_with_its_unit(chromium: Browser) -> None:
    about = EstimateDescription("models/force", ("fz", "fx"), ("N", "N"), 50.0)
    publisher = show(
        chromium, about, [EstimateMessage(1, 20_000_000, ("fz", "fx"), np.array([1.25, -0.5]), band=np.zeros((2, 2)))]
    )
    assert chromium.run("document.getElementById('answer').textContent") == "1.25 N · -0.5 N"
    assert chromium.run("rows.map((row) => row[1])") == [1.25]
    left(chromium, publisher)


def test_the_page_shows_no_alarm_that_is_no_longer_known_to_be_true(chromium: Browser) -> None:
    publisher = visit(chromium, SLIPS, 500)
    publisher.publish(SlipMessage(1, 20_000_000, 0.9, 0.0, ON))
    awaited(lambda: chromium.run("messages") == 1)
    awaited(lambda: chromium.run("document.getElementById('state').textContent") == "no message for 500 ms")
    assert chromium.run("document.body.classList.contains('alarm')") is False
    assert chromium.run("document.getElementById('answer').textContent") == "–"
    left(chromium, publisher)


def test_the_page_does_not_show_a_message_that_arrives_too_old(chromium: Browser) -> None:
    publisher = show(chromium, SLIPS, [])
    heard_ms, asked_ms = 5_000_000, 10.0
    for measured_ms, is_shown in ((heard_ms - 700_000, False), (heard_ms, True)):
        stamps = f"heard_ns: {heard_ms}e6, sampled_ns: {measured_ms}e6, asked_ns: {asked_ms}e6"
        chromium.run(f"(receive({{kind: 'slip', probability: 0.5, alarm: 'on', {stamps}}}), true)")
        assert chromium.run("document.body.classList.contains('alarm')") is is_shown
    assert chromium.run("tooOld") == 1 and chromium.run("messages") == 1
    left(chromium, publisher)


def test_the_page_needs_the_token_where_one_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(TOKEN, "open sesame")
    port = free_port()
    publisher = WebsocketPublisher(f"127.0.0.1:{port}", SLIPS)
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/?token=open%20sesame") as answer:
        assert answer.headers["Content-Type"] == "text/html; charset=utf-8"
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
        assert b"new WebSocket" in answer.read()
    with pytest.raises(urllib.error.HTTPError, match="401"):
        urllib.request.urlopen(f"http://127.0.0.1:{port}/")
    publisher.close()
