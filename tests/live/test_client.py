"""Test that the client on the page about live sessions works as described."""

import subprocess
import sys
from pathlib import Path

import pytest

from tacpipe.live.websocket import WebsocketPublisher
from tacpipe.tasks.slip.live.messages import SlipDescription, SlipMessage
from tests.live.test_publishers import free_port
from tests.recording.live import ROOT, awaited

PAGE = ROOT / "docs" / "howto" / "subscribe.md"


def client() -> str:
    """Return the program that the page prints."""
    _, _, after_title = PAGE.read_text().partition('```python title="client.py"\n')
    return after_title.partition("```")[0]


def test_the_client_is_short() -> None:
    assert 20 < len(client().splitlines()) <= 35


@pytest.mark.rig
def test_the_client_reports_a_slip_that_is_predicted(tmp_path: Path) -> None:
    (tmp_path / "client.py").write_text(client().replace("TIMEOUT_S = 0.04", "TIMEOUT_S = 60"))
    port = free_port()
    publisher = WebsocketPublisher(f"127.0.0.1:{port}", SlipDescription("model", 50.0, 0.3, "1", {}))
    words = [sys.executable, "client.py", f"ws://127.0.0.1:{port}", "4"]
    with subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as process:
        awaited(lambda: publisher.subscribers == 1)
        for seq, (state, cause) in enumerate([(0, ""), (1, ""), (1, ""), (-1, "nothing new comes from xela1")]):
            publisher.publish(SlipMessage(seq, seq, 0.5, 0.0, state, cause=cause))
        out, _ = process.communicate(timeout=600)
    publisher.close()
    first, *changes = out.splitlines()
    assert first == "probability of a slip within 0.3 s"
    assert [line.split(" ", 1)[1].strip() for line in changes] == [
        "slip: off",
        "slip: on",
        "slip: unknown nothing new comes from xela1",
    ]
