"""The logic of a live session, over bytes that a test wrote and a clock that it turns."""

import functools
import json
from typing import Any

import numpy as np
import pytest

from tacpipe.live import wire
from tacpipe.live.decoding import likely_schema
from tacpipe.live.rows import EARLY_NS
from tacpipe.recording import rig as rigs
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import BEGAN, LOST
from tacpipe.sensors.encoding import split_frames
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.forward.live.chain import Cause
from tacpipe.tasks.forward.live.engine import ForecastEngine
from tacpipe.tasks.forward.live.messages import ForecastMessage
from tests.live.persistent import CHANNELS, HORIZON, PERIOD_NS, Persistence
from tests.sensors import made

START_NS = 10**12
OFFSET_NS = 5 * 10**17
SETTLE_NS = 2_000_000


class Session:
    """An engine with one skin, and the frames that it sends."""

    def __init__(self, count: int = 200) -> None:
        self.sensor: Sensor = rigs.build_sensor("xela", {"rate_hz": 50}, "skin")
        opened: Any = functools.partial(Persistence, {"skin": likely_schema(self.sensor)})
        self.engine = ForecastEngine({"skin": self.sensor}, opened, settle_ns=SETTLE_NS)
        self.engine.resting_ns = 0
        samples = made.samples("xela", self.sensor, count, 1)
        self.values = np.hstack(samples.values).astype(np.float32)
        self.packets = split_frames(self.sensor, self.sensor.encode(samples))

    def begin(self) -> None:
        """Begin a recording."""
        self.engine.take("", StreamNote(START_NS, "", wire.BEGIN, str(OFFSET_NS)))
        self.engine.take("skin", StreamNote(START_NS, "skin", BEGAN))

    def send(self, first: int, last: int) -> None:
        """Have frames arrive, one each period after the start."""
        self.engine.take(
            "skin", Chunks.from_pairs([(START_NS + n * PERIOD_NS, self.packets[n]) for n in range(first, last)])
        )

    def at(self, periods: float) -> list[ForecastMessage]:
        """Return what is published so long after the start, once what belongs to it has settled."""
        messages: Any = self.engine.step(START_NS + round(periods * PERIOD_NS) + SETTLE_NS)
        return list(messages)


@pytest.fixture
def session() -> Session:
    started = Session()
    started.begin()
    return started


def test_each_row_is_predicted_from_the_newest_sample_at_every_step(session: Session) -> None:
    for row in range(20):
        session.send(row, row + 1)
        (message,) = session.at(row)
        assert message.t_ns == START_NS + OFFSET_NS + row * PERIOD_NS
        assert message.values is not None and message.values.shape == (HORIZON, len(CHANNELS))
        assert (message.values == session.values[row]).all() and message.values.dtype == np.float32
        assert message.seq == row + 1 and message.skipped == 0


def test_nothing_is_published_before_what_belongs_to_a_row_has_settled(session: Session) -> None:
    session.send(0, 2)
    assert len(session.engine.step(START_NS + SETTLE_NS)) == 1
    assert session.engine.step(START_NS + PERIOD_NS + SETTLE_NS - 1) == []
    due_ns = START_NS + PERIOD_NS + SETTLE_NS
    assert session.engine.due_ns(START_NS + SETTLE_NS) == due_ns - EARLY_NS  # samples that came by then are decoded
    assert session.engine.step(due_ns - EARLY_NS) == []
    assert session.engine.due_ns(due_ns - EARLY_NS) == due_ns


def test_a_session_that_fell_behind_publishes_the_newest_row_and_counts_the_others(session: Session) -> None:
    session.send(0, 8)
    (message,) = session.at(7)
    assert message.values is not None and (message.values == session.values[7]).all()
    assert message.skipped == session.engine.skipped == 7


def test_quantiles_that_were_asked_for_are_published_at_the_steps_that_are() -> None:
    session = Session()
    opened: Any = functools.partial(Persistence, {"skin": likely_schema(session.sensor)}, quantiles=(10, 90))
    engine = ForecastEngine({"skin": session.sensor}, opened, (1, 3), quantiles=(10, 90))
    session.engine, engine.resting_ns = engine, 0
    session.begin()
    session.send(0, 1)
    (message,) = session.at(0)
    assert message.levels == (10, 90) and message.quantiles is not None and message.values is not None
    assert message.quantiles.shape == (2, 2, len(CHANNELS)) and message.quantiles.flags["C_CONTIGUOUS"]
    assert (message.quantiles[1] == message.values + 40).all()
    messages = [later for periods in range(1, 10) for later in session.at(periods)]
    assert any(later.values is None for later in messages)
    assert all(later.levels == (10, 90) and (later.quantiles is None) == (later.values is None) for later in messages)
    assert engine.describe("m").quantiles == (10, 90)


@pytest.mark.parametrize("cut", [1, 3, 7, 50])
def test_how_the_bytes_were_cut_changes_no_forecast(cut: int) -> None:
    whole, cut_session = Session(), Session()
    published: list[list[ForecastMessage]] = []
    for running, size in ((whole, 1), (cut_session, cut)):
        running.begin()
        messages = []
        for row in range(0, 100 // size * size, size):
            running.send(row, row + size)
            messages += running.at(row + size - 1)
        published.append(messages)
    by_time = {message.t_ns: message.values for message in published[0]}
    assert published[1]
    for later in published[1]:
        assert np.array_equal(by_time[later.t_ns], later.values)  # type: ignore[arg-type]


def test_what_came_before_the_recording_is_not_part_of_it() -> None:
    session = Session()
    session.send(0, 5)
    assert session.at(5) == []
    session.begin()
    session.send(9, 10)
    (message,) = session.at(9)
    assert message.t_ns == START_NS + OFFSET_NS + 9 * PERIOD_NS  # the grid begins with the recording's first sample


def test_a_stream_that_stalls_is_named_within_two_periods(session: Session) -> None:
    session.send(0, 10)
    session.at(9)
    messages = [message for tenths in range(91, 131) for message in session.at(tenths / 10)]
    unknown = next(message for message in messages if message.values is None)
    due = START_NS + OFFSET_NS + 10 * PERIOD_NS  # when the sample that is missing should have come
    assert unknown.t_ns - due <= 2 * PERIOD_NS
    assert "skin" in unknown.cause and Cause.GAP in Cause(unknown.flags)
    session.send(14, 15)
    (message,) = session.at(14)
    assert message.values is not None and not message.cause


def test_where_no_row_can_be_made_at_all_that_is_reported_with_the_silent_stream(session: Session) -> None:
    assert session.at(0) == []
    messages = [message for periods in range(1, 10) for message in session.at(periods)]
    assert messages and all(message.values is None and "skin" in message.cause for message in messages)
    assert messages[0].t_ns - (START_NS + OFFSET_NS) <= 4 * PERIOD_NS


def test_a_link_that_is_lost_and_back_goes_on_without_a_new_session(session: Session) -> None:
    session.send(0, 5)
    session.at(4)
    session.engine.take("skin", StreamNote(START_NS + 5 * PERIOD_NS, "skin", LOST, "unplugged"))
    session.at(12)
    session.send(20, 21)
    (message,) = session.at(20)
    assert message.values is not None and (message.values == session.values[20]).all()


def test_after_blocks_were_thrown_away_a_new_chain_begins_and_the_cause_is_reported(session: Session) -> None:
    session.send(0, 5)
    session.at(4)
    before = session.engine.rows
    session.engine.take("", StreamNote(START_NS, "", wire.OVERFLOW))
    assert session.engine.rows is not before and session.engine.overflows == 1
    messages = [message for periods in range(5, 10) for message in session.at(periods)]
    assert messages and "overload" in messages[0].cause and messages[0].values is None
    session.send(10, 11)
    assert session.at(10)[0].values is not None


def test_a_sample_that_comes_after_its_row_is_counted(session: Session) -> None:
    session.send(0, 2)
    session.at(5)
    assert session.engine.late == 0
    session.send(3, 4)
    session.at(6)
    assert session.engine.late == 1


def test_the_latency_is_from_the_arrival_of_the_newest_sample(session: Session) -> None:
    session.send(0, 1)
    (message,) = session.at(0.5)
    session.engine.published(message, START_NS + 13_000_000)
    assert (message.latency_ms, message.age_ms) == (13.0, 13.0)


def test_bytes_that_are_no_frame_cost_no_forecast(session: Session) -> None:
    session.send(0, 1)
    session.engine.take("skin", Chunks.from_pairs([(START_NS + PERIOD_NS, b"\xff not a frame")]))
    session.send(2, 3)
    (message,) = session.at(2)
    assert message.values is not None and (message.values == session.values[2]).all()


def test_after_the_recording_nothing_is_predicted_until_the_next_one_begins(session: Session) -> None:
    session.send(0, 1)
    assert len(session.at(0)) == 1
    session.engine.take("", StreamNote(START_NS + PERIOD_NS, "", wire.END))
    session.send(1, 3)
    assert session.at(3) == []
    session.begin()
    session.send(4, 5)
    assert len(session.at(4)) == 1


def test_after_blocks_were_thrown_away_and_after_a_process_that_ended_the_grid_is_continued(session: Session) -> None:
    session.send(0, 5)
    session.at(4)
    beginning = session.engine.rows.beginning
    assert beginning is not None and beginning["origin_ns"] == START_NS + OFFSET_NS
    session.engine.take("", StreamNote(START_NS, "", wire.OVERFLOW))
    assert session.engine.rows.beginning == beginning
    restarted = Session()
    restarted.engine.take("", StreamNote(START_NS, "", wire.CONTINUE, json.dumps(beginning)))
    restarted.begin()
    late = START_NS + 7 * PERIOD_NS + PERIOD_NS // 3
    restarted.engine.take("skin", Chunks.from_pairs([(late, restarted.packets[7])]))
    (message,) = restarted.at(8)
    assert message.t_ns == START_NS + OFFSET_NS + 8 * PERIOD_NS and message.values is not None
    restarted.begin()  # another recording has a grid of its own
    assert restarted.engine.rows.beginning is None
