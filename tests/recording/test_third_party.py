"""Test that a sensor that a third party installed is used like the built-in ones."""

import pytest

from tests.conftest import Lab
from tests.recording.live import place, recorded, sent, served, shards, stream

PULSE = stream("pulse", "pulse", "serial:/dev/ttyACM0", "{ rate_hz = 200 }")


@pytest.mark.rig
def test_a_third_party_s_sensor_is_listed_emulated_and_recorded(lab: Lab) -> None:
    assert "A board of a third party." in lab.run("sensors list").out

    with served(lab.folder, PULSE) as emulator:
        lab.run("acquire rig.toml -o rec --duration-s 1 --quiet")

    (shard,) = shards(lab.folder).values()
    rows = recorded(shard, "pulse")
    place(rows, sent(emulator, "pulse"))
    assert shard.attributes["pulse_lost"] == 0
    assert shard.attributes["sensor"] == "pulse"
