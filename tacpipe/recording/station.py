"""One stream at work: its link is opened, read by a thread of its own, and opened anew when it was lost."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from tacpipe.errors import DeviceError, TacpipeError
from tacpipe.links import dialogue, opening
from tacpipe.links.dialogue import NoReplyError
from tacpipe.links.link import Link, LinkLostError, Opened
from tacpipe.recording import clock, silence_diagnosis
from tacpipe.recording.pace import WAITED_NS, Pace
from tacpipe.recording.rig import Stream
from tacpipe.recording.spool_blocks import Note
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Sensor

TALKING = ("udp", "tcp+udp")
OPENED, LOST, OVERRUN = "opened", "lost", "overrun"
BEGAN, OVER = "began", "over"  # for listeners: what comes between is part of the recording
FOREIGN = "foreign"  # packets of other senders than the one that counts
REFUSED = "refused"  # packets that the sensor does not accept
LEFT_OUT_S = 1.0  # least time from one note on packets left out to the next
STALLED, CAUGHT_UP = (
    "recorder_stalled",
    "caught_up",
)  # this program was held up; from here on arrivals are certain again
READ_S = 0.1  # longest wait of a read, after which the thread looks whether it should end
AGAIN_S = (0.1, 2.0)  # between two tries to open a lost link: first, and at most
MUTE_S = 4.0  # after which a device that should send datagrams and does not is asked anew: nothing else states its loss
TARE_S = 5.0  # in which a device must have tared
STOP_S = 2.0  # in which a thread must have ended
REPLY_S = 0.5  # after which a device that is asked for each frame is asked once more

Tally = Callable[[int, int, int], None]  # chunks, bytes, last arrival
Listener = Callable[["Chunks | Note"], None]  # is given what came as it comes; it must neither wait nor raise


class Station:
    """A stream whose link is open, or was lost and is tried again until it is back.

    `take` gives what came since; nothing of it is looked at here.
    """

    def __init__(self, stream: Stream) -> None:
        self.stream = stream
        self.error: TacpipeError | None = None  # why the link is lost, while it is
        self.listener: Listener | None = None  # called by the thread that reads
        self._tally: Tally | None = None
        self._link: Link | None = None
        self._came: deque[tuple[int, bytes]] = deque()
        self._notes: deque[Note] = deque()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name=stream.name, daemon=True)
        self._keeping = threading.Lock()
        self._orders: deque[Callable[[Link], None]] = deque()  # carried out by the thread, between two reads
        self._chunks = self._bytes = self._overruns = self._foreign = self._refused = 0
        self._left_out_s = 0.0  # when packets that were left out were noted last
        self._empty_ns = 0  # when the link was last known to hold nothing that waits to be read
        self._wait_s = AGAIN_S[0]

    def start(self) -> None:
        """Open the link and begin to read it. Raises `DeviceError` if that fails."""
        try:
            self._open()
        except NoReplyError as error:
            heard = [Chunks.of(error.heard)] if error.heard else []
            raise DeviceError(silence_diagnosis.sentence(self.stream, error.awaited, heard, reply=True)) from error
        self._thread.start()

    def take(self) -> list[Chunks | Note]:
        """Return what came since the last call, bytes and notes in their order."""
        with self._keeping:
            return self._taken()

    def begin(self, tally: Tally, early: list[Chunks | Note] | None) -> list[Chunks | Note]:
        """Return what came since the last call, and state ``tally`` from now on how much came after that.

        ``early`` is what came before and is recorded too: it counts, and with it what this returns. None: neither. The
        listener gets the note `BEGAN`, and behind it all that counts.
        """
        with self._keeping:
            found = self._taken()
            counted = [] if early is None else [block for block in (*early, *found) if isinstance(block, Chunks)]
            self._chunks = sum(len(block.size) for block in counted)
            self._bytes = sum(len(block.data) for block in counted)
            self._tally = tally
            self._foreign = (
                self._link.foreign if self._link is not None else 0
            )  # what came before is not of this recording
            self._refused = 0
            for block in (Note(clock.now_ns(), self.stream.name, BEGAN), *(() if early is None else (*early, *found))):
                self._inform(block)
            return found

    def end(self) -> list[Chunks | Note]:
        """Return what came since the last call, and state no tally any more. The listener gets the note `OVER`."""
        with self._keeping:
            self._tally = None
            self._inform(Note(clock.now_ns(), self.stream.name, OVER))
            self._note_left_out(self._link)
            return self._taken()

    def drained(self, since_ns: int) -> bool:
        """Return whether all that waited in the link at that moment was read; True while the link is lost."""
        return self._link is None or self._empty_ns >= since_ns

    def tare(self) -> bool:
        """Have the device take its present reading for zero; return False if it has no such command.

        Raises `DeviceError` if the link is lost or the device does not reply.
        """
        sensor, name = self.stream.sensor, self.stream.name
        if type(sensor).taring is Sensor.taring:
            return False
        done, failed = threading.Event(), []

        def order(link: Link) -> None:
            try:
                self._keep(dialogue.run_dialogue(link, sensor.taring(), name))
            except DeviceError as error:
                failed.append(error)
            done.set()

        self._orders.append(order)
        if not done.wait(TARE_S):
            raise DeviceError(f"Stream {name} could not be tared: its link is lost. Wait until it is back.")
        if failed:
            raise failed[0]
        return True

    def stop(self) -> None:
        """End the thread, state the device to stop, close the link."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join(timeout=STOP_S)
        link, self._link = self._link, None
        if link is not None:
            with contextlib.suppress(Exception):  # whatever a device states to its end, the others are to be closed too
                answer = self.stream.sensor.closing()
                if answer:
                    link.write(answer)
            with contextlib.suppress(Exception):
                link.close()

    def _open(self) -> None:
        sensor = self.stream.sensor
        link = opening.open_link(self.stream.address, sensor, self.stream.name)
        try:
            early = dialogue.run_dialogue(link, sensor.opening(link.local), self.stream.name)
        except BaseException:
            link.close()
            raise
        if self.listener is not None and isinstance(link, Opened):
            link.hasten()
        self._overruns, self._foreign = link.overruns, link.foreign
        self._notes.append(Note(time.monotonic_ns() if not early else early[0][0], self.stream.name, OPENED))
        self._link, self.error = link, None
        self._keep(early)

    def _run(self) -> None:
        while not self._ending.is_set():
            try:
                if self._link is None:
                    self._open()
                self._read()
            except TacpipeError as error:
                self._lose(error)
            except Exception as error:  # of a driver: stated as a loss, and no other stream suffers
                self._lose(DeviceError(f"Stream {self.stream.name} failed: {type(error).__name__}: {error}"))

    def _lose(self, error: TacpipeError) -> None:
        link, self._link = self._link, None
        self.error = error
        if link is not None:
            note = Note(time.monotonic_ns(), self.stream.name, LOST, str(error))
            self._notes.append(note)
            with self._keeping:
                self._inform(note)
            self._wait_s = AGAIN_S[0]
            with contextlib.suppress(Exception):  # of a device that is gone; nothing may end this thread
                link.close()
        self._ending.wait(self._wait_s)
        self._wait_s = min(2 * self._wait_s, AGAIN_S[1])

    def _read(self) -> None:
        """Read the link until it is lost or the thread is to end."""
        link, sensor = self._link, self.stream.sensor
        assert link is not None
        asked, answers = sensor.request(), type(sensor).answer is not Sensor.answer
        pace = Pace(clock.now_ns(), clock.suspended_ns())
        if asked:
            self._ask(link, asked, pace)
            return
        heard_s = time.monotonic()
        while not self._ending.is_set():
            came = self._paced(link, READ_S, pace)
            heard_s = self._heard(heard_s, came)
            self._obey(link, pace)
            if answers:
                for _, chunk in came:
                    answer = sensor.answer(chunk)
                    if answer:
                        link.write(answer)
                        pace.resume(clock.now_ns())
            if link.overruns != self._overruns:
                self._overran(link.overruns)
            if time.monotonic() - self._left_out_s > LEFT_OUT_S:
                with self._keeping:
                    self._note_left_out(link)

    def _paced(self, link: Link, timeout_s: float, pace: Pace) -> list[tuple[int, bytes]]:
        """Keep and return what came.

        Where this program was held up before it is noted, and where what is read no longer waited.
        """
        began_ns = clock.now_ns()
        came = link.read(timeout_s)
        ended_ns = clock.now_ns()
        stall = pace.read(began_ns, ended_ns, round(timeout_s * 1e9), clock.suspended_ns())
        at_ns = came[0][0] if came else ended_ns
        if stall is not None:
            late_ns = 0 if link.kernel_stamped else stall.late_ns
            self._notes.append(Note(at_ns, self.stream.name, STALLED, replace(stall, late_ns=late_ns).detail))
        elif pace.caught_up(began_ns, ended_ns):
            self._notes.append(Note(at_ns, self.stream.name, CAUGHT_UP))
        self._keep(came)
        if not came or ended_ns - began_ns > WAITED_NS:
            self._empty_ns = began_ns
        return came

    def _heard(self, before_s: float, came: list[tuple[int, bytes]]) -> float:
        """Return when the device was heard last. Raises `LinkLostError` for one that is mute, where silence alone states."""
        sensor, address, now_s = self.stream.sensor, self.stream.address, time.monotonic()
        if came or address.scheme not in TALKING or sensor.listens or not sensor.awaited:
            return now_s
        if now_s - before_s > MUTE_S:
            described = (
                f"Stream {self.stream.name} ({address}) is lost: nothing came for {MUTE_S:g} s. {sensor.exclusive}"
            )
            raise LinkLostError(described.strip())
        return before_s

    def _ask(self, link: Link, asked: bytes, pace: Pace) -> None:
        """Read a device that sends a frame when it is asked: at the sensor's rate, never before it replied."""
        period_s = 1.0 / self.stream.sensor.rate_hz
        due_s = time.monotonic()
        while not self._ending.is_set():
            link.write(asked)
            pace.resume(clock.now_ns())
            self._paced(link, REPLY_S, pace)
            self._obey(link, pace)
            due_s = max(due_s + period_s, time.monotonic() - period_s)
            while not self._ending.is_set() and (left_s := due_s - time.monotonic()) > 0:
                self._paced(link, min(left_s, READ_S), pace)  # the rest of a reply that came in pieces

    def _obey(self, link: Link, pace: Pace) -> None:
        while self._orders:
            self._orders.popleft()(link)
            pace.resume(clock.now_ns())

    def _note_left_out(self, link: Link | None) -> None:
        """Note how many packets were left out since the last note. Called with the lock."""
        self._left_out_s = time.monotonic()
        if link is not None and link.foreign > self._foreign:
            described = f"{link.foreign - self._foreign} packets of other senders were left out"
            self._notes.append(Note(clock.now_ns(), self.stream.name, FOREIGN, described))
            self._foreign = link.foreign
        if self._refused:
            described = f"{self._refused} packets that {self.stream.kind} does not accept were left out"
            self._notes.append(Note(clock.now_ns(), self.stream.name, REFUSED, described))
            self._refused = 0

    def _overran(self, overruns: int) -> None:
        self._notes.append(Note(time.monotonic_ns(), self.stream.name, OVERRUN, str(overruns - self._overruns)))
        self._overruns = overruns

    def _keep(self, packets: list[tuple[int, bytes]]) -> None:
        """Keep what came and is recorded, and hand it on."""
        accepted = [packet for packet in packets if self.stream.sensor.accepts(packet[1])]
        with self._keeping:
            self._refused += len(packets) - len(accepted)
            packets = accepted
            if not packets:
                return
            self._came.extend(packets)
            if self._tally is not None:
                self._chunks += len(packets)
                self._bytes += sum(len(data) for _, data in packets)
                self._tally(self._chunks, self._bytes, packets[-1][0])
            if self.listener is not None:
                self._inform(Chunks.of(packets))

    def _inform(self, block: Chunks | Note) -> None:
        if self.listener is not None:
            self.listener(block)

    def _taken(self) -> list[Chunks | Note]:
        found: list[Chunks | Note] = []
        while self._notes:
            note = self._notes.popleft()
            found += [*_chunks(self._came, note.t_ns), note]
        return found + _chunks(self._came, None)


def _chunks(came: deque[tuple[int, bytes]], before_ns: int | None) -> list[Chunks]:
    """Return what came before a moment, taken from the front of the queue."""
    taken = []
    while came and (before_ns is None or came[0][0] < before_ns):
        taken.append(came.popleft())
    return [Chunks.of(taken)] if taken else []
