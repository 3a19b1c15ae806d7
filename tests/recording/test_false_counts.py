"""Test recordings of datagrams with a false count and of datagrams from undeclared senders."""

import json
from pathlib import Path

import pytest

from tacpipe.recording import rig as rig_of
from tacpipe.recording import sealing, station
from tacpipe.recording.spool import Spool, Spooled, StreamNote
from tacpipe.recording.station import Station
from tests.conftest import Lab
from tests.recording import live
from tests.recording.scripted import Script
from tests.recording.test_failing import Link

COUNTED = live.stream("program", "tap", "udp::4011", '{ numbers = ["width:m"], counted = true }')


@pytest.mark.parametrize("false", [999_999_999_999, 1_000_000, 0])
def test_a_datagram_with_a_false_count_is_a_reset_and_costs_nothing(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, false: int
) -> None:
    script = Script(monkeypatch)
    records = [{"seq": 700 + row, "width": float(row)} for row in range(400) if row != 200]  # one is lost
    records[100]["seq"] = false
    script.send("program", [json.dumps(record).encode() for record in records], 100)
    (lab.folder / "rig.toml").write_text(COUNTED)
    lab.run("acquire rig.toml -o rec --duration-s 3")
    shard = live.only(lab.folder)
    table = shard.table("program")

    assert shard.attributes["program_lost"] == 1
    assert [cause for cause, _ in live.events(shard, "program")] == ["counter_reset", "counter_reset", "link"]
    seq = table.column("seq").to_pylist()
    assert seq[-1] - seq[0] == len(seq) and live.missing(shard, "program") == 1
    width = table.column("width").to_pylist()
    assert width == [record["width"] for record in records[int(width[0]) :][: len(width)]]


class Crowded(Link):
    """A link at which others send too."""

    foreign = 0

    def read(self, timeout_s: float) -> list[tuple[int, bytes]]:
        """Return what the device sent; with each chunk three datagrams of others came."""
        chunks = super().read(timeout_s)
        self.foreign += 3 * len(chunks)
        return chunks


def test_packets_of_other_senders_are_reported_once_a_second_and_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = rig_of.parse(COUNTED)
    reader = Station(rig.streams["program"])
    link = Crowded([json.dumps({"seq": row, "width": 1.0}).encode() for row in range(200)])
    reader._link = link
    spool = Spool(tmp_path, {"rig": ""}, ["program"])
    reader.start_recording(lambda *_: None, None)
    reader._thread.start()
    live.awaited(lambda: not link.incoming)
    live.awaited(lambda: link.foreign == 600)
    for block in reader.end_recording():
        spool.note(block) if isinstance(block, StreamNote) else spool.append("program", block)
    reader.stop()
    spool.close()
    sealed = sealing.seal_stream(Spooled(spool.folder), rig, "program")
    details = [event.detail for event in sealed.events if event.cause == station.FOREIGN]

    assert sum(int(detail.split()[0]) for detail in details) == 600
    assert all(detail.endswith(" packets of other senders were left out") for detail in details)
    assert sealed.table.num_rows == 200 and sealed.lost == 0
