"""The page that the publisher serves at its own address, as a browser shows it."""

import urllib.error
import urllib.request
from collections.abc import Iterator

import numpy as np
import pytest

from tacpipe.live.messages import Message
from tacpipe.live.websocket import TOKEN, WebsocketPublisher
from tacpipe.sensors.live import OFF, ON
from tacpipe.tasks.forward.live.messages import ForecastDescription, ForecastMessage
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


def show(
    chromium: Browser, about: SlipDescription | ForecastDescription, messages: list[Message]
) -> WebsocketPublisher:
    """Return a publisher whose page a browser shows, once it has drawn the messages."""
    port = free_port()
    publisher = WebsocketPublisher(f"127.0.0.1:{port}", about)
    chromium.visit(f"http://127.0.0.1:{port}/")
    awaited(lambda: publisher.subscribers == 1)
    for message in messages:
        publisher.publish(message)
    awaited(lambda: chromium.run("messages") == len(messages))
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
    assert chromium.run("document.getElementById('title').textContent") == "tacpipe live: models/slip"
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
