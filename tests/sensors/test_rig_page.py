"""Test that the pages on rigs describe the sensors correctly, and that their examples work."""

import json
import re
import socket
from pathlib import Path
from typing import Any

import pytest

from tacpipe.plugins import registry
from tacpipe.recording import rig
from tacpipe.recording.reading import LinkReader
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.tap import Tap

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "rig.md").read_text(encoding="utf-8")
PAGES = ("rig.md", "howto/programs.md", "howto/board.md", "tutorials/rig.md", "extending/sensor.md")


def blocks(language: str) -> list[str]:
    """Return the fenced blocks of a language on the pages about rigs."""
    text = "\n".join((DOCS / name).read_text(encoding="utf-8") for name in PAGES)
    contents: list[str] = re.findall(rf"^```{language}[^\n]*\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    return contents


def table() -> dict[str, list[str]]:
    """Return the cells of the table of sensors, by name."""
    lines = PAGE.split("\n## The sensors\n")[1].split("\n## ")[0].splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| `")]
    return {row[0].strip("`"): row[1:] for row in rows}


def built_in() -> dict[str, Any]:
    targets = {name: target for name, target in registry.sensors().items() if target.startswith("tacpipe.sensors.")}
    return {name: registry.load_sensor(name) for name in targets}


def test_the_table_has_every_sensor_once_in_order() -> None:
    assert list(table()) == sorted(built_in())


@pytest.mark.parametrize("name", sorted(built_in()))
def test_the_table_says_of_a_sensor_what_its_class_does(name: str) -> None:
    links, rate, counts, _, _, exclusive = table()[name]
    kind = built_in()[name]

    assert links.split(", ") == list(kind.links)
    assert exclusive == ("yes" if kind.exclusive else "no")
    if name not in ("generic", "lines", "tap"):
        assert (counts != "no") == (kind.counter is not None)
    if name not in ("generic", "lines"):
        assert float(rate or 0) == kind.rate_hz


def test_the_rig_files_are_rigs() -> None:
    texts = [block for block in blocks("toml") if "[[stream]]" in block and "pulse" not in block]
    kinds = {stream.kind for text in texts for stream in rig.parse(text).streams.values()}

    assert kinds == {"xela", "ati-netft", "tap", "lsl", "lines", "generic"}


def test_three_lines_of_python_send_what_a_tap_takes() -> None:
    code = next(block for block in blocks("python") if "sendto" in block)
    assert len([line for line in code.splitlines() if line]) == 3
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(5)
        space: dict[str, Any] = {}
        exec(code.replace("4010", str(listener.getsockname()[1])), space)
        packet = listener.recv(4096)
        space["tap"].close()

    batch = LinkReader(Tap(numbers=("width_m:m",), counted=True)).feed(Chunks.from_pairs([(1, packet)]))

    assert batch.values[1].tolist() == [[0.031]]
    assert json.loads(batch.values[0][0, 1])["phase"] == "lift"
