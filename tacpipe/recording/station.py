"""Run one stream: open its link, read it in a thread, and open it again after a loss."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

from tacpipe.errors import DeviceError, TacpipeError
from tacpipe.links import opening
from tacpipe.links.link import Link, LinkLostError, Opened
from tacpipe.links.opening import NoReplyError
from tacpipe.recording import clock
from tacpipe.recording.pace import CAUGHT_UP, STALLED, WAITED_NS, Pace
from tacpipe.recording.rig import RigStream
from tacpipe.recording.spool import StreamNote
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Sensor

if TYPE_CHECKING:
    from tacpipe.links.probing import SensorCandidate

TALKING = ("udp", "tcp+udp")
OPENED, LOST, OVERRUN = "opened", "lost", "overrun"
BEGAN, OVER = "began", "over"  # notes for listeners; the blocks between them are part of the recording
FOREIGN = "foreign"  # packets of other senders
REFUSED = "refused"  # packets that the sensor does not accept
LEFT_OUT_S = 1.0  # smallest time between two notes on packets that were left out
READ_S = 0.1  # timeout of a read, after which the thread checks whether it should end
AGAIN_S = (0.1, 2.0)  # first and longest pause between two tries to open a lost link
MUTE_S = 4.0  # a datagram device that is silent for so long is opened again: nothing else reports its loss
TARE_S = 5.0  # limit for taring a device
STOP_S = 2.0  # limit for ending the thread
REPLY_S = 0.5  # a device that sends on request is asked again after so long

Tally = Callable[[int, int, int], None]  # chunks, bytes, last arrival
Listener = Callable[["Chunks | StreamNote"], None]  # receives blocks as they arrive; it must neither wait nor raise


class Station:
    """A stream whose link is open, or is tried again after a loss until it is back.

    `take` returns the blocks since the last call, which are not decoded here.
    """

    def __init__(self, stream: RigStream) -> None:
        self.stream = stream
        self.error: TacpipeError | None = None  # the reason while the link is lost
        self.listener: Listener | None = None  # called by the thread that reads
        self._tally: Tally | None = None
        self._link: Link | None = None
        self._entries: deque[tuple[int, bytes]] = deque()
        self._notes: deque[StreamNote] = deque()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name=stream.name, daemon=True)
        self._keeping = threading.Lock()
        self._orders: deque[Callable[[Link], None]] = deque()  # the thread runs these between two reads
        self._chunks = self._bytes = self._overruns = self._foreign = self._refused = 0
        self._left_out_s = 0.0  # time of the last note on packets that were left out
        self._empty_ns = 0  # when the link was last known to be empty
        self._wait_s = AGAIN_S[0]

    def start(self) -> None:
        """Open the link and start the reading thread. Raises `DeviceError` if that fails."""
        try:
            self._open()
        except NoReplyError as error:
            heard = [Chunks.of(error.heard)] if error.heard else []
            raise DeviceError(explain_silence(self.stream, error.awaited, heard, reply=True)) from error
        self._thread.start()

    def take(self) -> list[Chunks | StreamNote]:
        """Return the bytes and notes since the last call, in their order."""
        with self._keeping:
            return self._take_blocks()

    def begin(self, tally: Tally, early: list[Chunks | StreamNote] | None) -> list[Chunks | StreamNote]:
        """Return the blocks since the last call, and report the totals of later blocks to ``tally``.

        ``early`` has earlier blocks that are recorded too; they and the returned blocks then count. With None
        neither counts.
        The listener gets the note `BEGAN`, followed by all blocks that count.
        """
        with self._keeping:
            pending = self._take_blocks()
            counted = [] if early is None else [block for block in (*early, *pending) if isinstance(block, Chunks)]
            self._chunks = sum(len(block.size) for block in counted)
            self._bytes = sum(len(block.data) for block in counted)
            self._tally = tally
            self._foreign = 0 if self._link is None else self._link.foreign  # earlier packets are not recorded
            self._refused = 0
            for block in (
                StreamNote(clock.now_ns(), self.stream.name, BEGAN),
                *(() if early is None else (*early, *pending)),
            ):
                self._inform(block)
            return pending

    def end(self) -> list[Chunks | StreamNote]:
        """Return the blocks since the last call, and stop the tally. The listener gets the note `OVER`."""
        with self._keeping:
            self._tally = None
            self._inform(StreamNote(clock.now_ns(), self.stream.name, OVER))
            self._note_left_out(self._link)
            return self._take_blocks()

    def drained(self, since_ns: int) -> bool:
        """Return whether the link was read empty since ``since_ns``. True while the link is lost."""
        return self._link is None or self._empty_ns >= since_ns

    def tare(self) -> bool:
        """Have the device take its present reading as zero. Return False if it has no such command.

        Raises `DeviceError` if the link is lost or the device does not reply.
        """
        sensor, name = self.stream.sensor, self.stream.name
        if type(sensor).taring is Sensor.taring:
            return False
        finished, failed = threading.Event(), []

        def order(link: Link) -> None:
            try:
                self._keep(opening.run_dialogue(link, sensor.taring(), name))
            except DeviceError as error:
                failed.append(error)
            finished.set()

        self._orders.append(order)
        if not finished.wait(TARE_S):
            raise DeviceError(f"Stream {name} could not be tared, because its link is lost. Wait until it returns.")
        if failed:
            raise failed[0]
        return True

    def stop(self) -> None:
        """End the thread, send the device its closing request, and close the link."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join(timeout=STOP_S)
        link, self._link = self._link, None
        if link is not None:
            with contextlib.suppress(Exception):  # an error of one device must not keep the others open
                answer = self.stream.sensor.closing()
                if answer:
                    link.write(answer)
            with contextlib.suppress(Exception):
                link.close()

    def _open(self) -> None:
        sensor = self.stream.sensor
        link = opening.open_link(self.stream.address, sensor, self.stream.name)
        try:
            early = opening.run_dialogue(link, sensor.opening(link.local), self.stream.name)
        except BaseException:
            link.close()
            raise
        if self.listener is not None and isinstance(link, Opened):
            link.hasten()
        self._overruns, self._foreign = link.overruns, link.foreign
        self._notes.append(StreamNote(time.monotonic_ns() if not early else early[0][0], self.stream.name, OPENED))
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
            except Exception as error:  # a driver's error is reported as a loss, and the other streams continue
                self._lose(DeviceError(f"Stream {self.stream.name} failed: {type(error).__name__}: {error}"))

    def _lose(self, error: TacpipeError) -> None:
        link, self._link = self._link, None
        self.error = error
        if link is not None:
            note = StreamNote(time.monotonic_ns(), self.stream.name, LOST, str(error))
            self._notes.append(note)
            with self._keeping:
                self._inform(note)
            self._wait_s = AGAIN_S[0]
            with contextlib.suppress(Exception):  # the device is gone, and nothing may end this thread
                link.close()
        self._ending.wait(self._wait_s)
        self._wait_s = min(2 * self._wait_s, AGAIN_S[1])

    def _read(self) -> None:
        """Read the link until it is lost or the thread is to end."""
        link, sensor = self._link, self.stream.sensor
        assert link is not None
        request, answers = sensor.request(), type(sensor).answer is not Sensor.answer
        pace = Pace(clock.now_ns(), clock.suspended_ns())
        if request:
            self._poll(link, request, pace)
            return
        heard_s = time.monotonic()
        while not self._ending.is_set():
            packets = self._paced(link, READ_S, pace)
            heard_s = self._heard(heard_s, packets)
            self._obey(link, pace)
            if answers:
                for _, chunk in packets:
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
        """Read the link, keep and return the packets.

        Notes mark where this program was delayed, and where the packets no longer had to wait.
        """
        began_ns = clock.now_ns()
        packets = link.read(timeout_s)
        ended_ns = clock.now_ns()
        stall = pace.read(began_ns, ended_ns, round(timeout_s * 1e9), clock.suspended_ns())
        at_ns = packets[0][0] if packets else ended_ns
        if stall is not None:
            late_ns = 0 if link.kernel_stamped else stall.late_ns
            self._notes.append(StreamNote(at_ns, self.stream.name, STALLED, replace(stall, late_ns=late_ns).detail))
        elif pace.caught_up(began_ns, ended_ns):
            self._notes.append(StreamNote(at_ns, self.stream.name, CAUGHT_UP))
        self._keep(packets)
        if not packets or ended_ns - began_ns > WAITED_NS:
            self._empty_ns = began_ns
        return packets

    def _heard(self, before_s: float, packets: list[tuple[int, bytes]]) -> float:
        """Return when the device was heard last. Raises `LinkLostError` where only silence reports the loss of a device."""
        sensor, address, now_s = self.stream.sensor, self.stream.address, time.monotonic()
        if packets or address.scheme not in TALKING or sensor.listens or not sensor.awaited:
            return now_s
        if now_s - before_s > MUTE_S:
            described = (
                f"Stream {self.stream.name} ({address}) is lost: nothing came for {MUTE_S:g} s. {sensor.exclusive}"
            )
            raise LinkLostError(described.strip())
        return before_s

    def _poll(self, link: Link, request: bytes, pace: Pace) -> None:
        """Read a device that sends one frame per request, at the sensor's rate and never before it replied."""
        period_s = 1.0 / self.stream.sensor.rate_hz
        due_s = time.monotonic()
        while not self._ending.is_set():
            link.write(request)
            pace.resume(clock.now_ns())
            self._paced(link, REPLY_S, pace)
            self._obey(link, pace)
            due_s = max(due_s + period_s, time.monotonic() - period_s)
            while not self._ending.is_set() and (left_s := due_s - time.monotonic()) > 0:
                self._paced(link, min(left_s, READ_S), pace)  # remaining parts of a reply

    def _obey(self, link: Link, pace: Pace) -> None:
        while self._orders:
            self._orders.popleft()(link)
            pace.resume(clock.now_ns())

    def _note_left_out(self, link: Link | None) -> None:
        """Note how many packets were left out since the last note. The caller has the lock."""
        self._left_out_s = time.monotonic()
        if link is not None and link.foreign > self._foreign:
            described = f"{link.foreign - self._foreign} packets of other senders were left out"
            self._notes.append(StreamNote(clock.now_ns(), self.stream.name, FOREIGN, described))
            self._foreign = link.foreign
        if self._refused:
            described = f"{self._refused} packets that {self.stream.kind} does not accept were left out"
            self._notes.append(StreamNote(clock.now_ns(), self.stream.name, REFUSED, described))
            self._refused = 0

    def _overran(self, overruns: int) -> None:
        self._notes.append(StreamNote(time.monotonic_ns(), self.stream.name, OVERRUN, str(overruns - self._overruns)))
        self._overruns = overruns

    def _keep(self, packets: list[tuple[int, bytes]]) -> None:
        """Keep the packets that the sensor accepts, count them and pass them on."""
        accepted = [packet for packet in packets if self.stream.sensor.accepts(packet[1])]
        with self._keeping:
            self._refused += len(packets) - len(accepted)
            packets = accepted
            if not packets:
                return
            self._entries.extend(packets)
            if self._tally is not None:
                self._chunks += len(packets)
                self._bytes += sum(len(data) for _, data in packets)
                self._tally(self._chunks, self._bytes, packets[-1][0])
            if self.listener is not None:
                self._inform(Chunks.of(packets))

    def _inform(self, block: Chunks | StreamNote) -> None:
        if self.listener is not None:
            self.listener(block)

    def _take_blocks(self) -> list[Chunks | StreamNote]:
        blocks: list[Chunks | StreamNote] = []
        while self._notes:
            note = self._notes.popleft()
            blocks += [*_chunks(self._entries, note.t_ns), note]
        return blocks + _chunks(self._entries, None)


def _chunks(entries: deque[tuple[int, bytes]], before_ns: int | None) -> list[Chunks]:
    """Take the entries before ``before_ns``, or all, from the front of the queue and return them."""
    front = []
    while entries and (before_ns is None or entries[0][0] < before_ns):
        front.append(entries.popleft())
    return [Chunks.of(front)] if front else []


INVISIBLE_OPTIONS = ("rate_hz", "baud")  # options that do not change the frames


def explain_silence(stream: RigStream, awaited: str, heard: Iterable[Chunks], *, reply: bool = False) -> str:
    """Return a sentence with the device, the problem and what to do, for a stream on which ``awaited`` did not come.

    ``heard`` has the bytes that came instead. With ``reply`` a reply was awaited, and frames of the sensor itself are
    evidence.
    """
    joined = Chunks.joined(list(heard))
    about = f"Stream {stream.name} ({stream.address}): {awaited}"
    probe = f"`tacpipe sensors probe {stream.address}`"
    serial = stream.address.scheme == "serial"
    if not joined.data:
        rate = f", set to {stream.sensor.baud} baud as we are" if serial else ""
        end = f"; {probe} tries all rates" if serial else ""
        described = f"{about}, but nothing came. Check power and cable, and that it is {stream.kind}{rate}{end}."
        return f"{described} {stream.sensor.exclusive}".strip()
    about += f", but {len(joined.data):,} bytes came that hold none."
    recognised = _explain_bytes(stream, joined, reply=reply)
    if recognised:
        return f"{about} {recognised}"
    at = f"is set to another rate than {stream.sensor.baud} baud, or " if serial else ""
    return f"{about} Either the device {at}speaks another protocol; {probe} tries what is known."


def _explain_bytes(stream: RigStream, heard: Chunks, *, reply: bool) -> str:
    """Return a sentence on the sensor that the bytes are of, empty if none is recognised."""
    from tacpipe.links.probing import SensorCandidate, recognise

    scheme, expected = stream.address.scheme, SensorCandidate(stream.kind, stream.sensor)
    if reply and recognise(heard, scheme, [expected]):
        return (
            f"They are frames of {expected}, so the device does not hear us or is another model: check the wire that we "
            f"send on, and the model in the rig file."
        )
    findings = recognise(heard, scheme)
    if not findings:
        return ""
    best = findings[0].candidate
    if best.kind == stream.kind:
        nearer = recognise(heard, scheme, _nearer(expected, best))
        best = nearer[0].candidate if nearer else best
        return f"They are frames of {best}: set that among the options in the rig file."
    return f"They are frames of {best}: name that in the rig file, or plug in the other device."


def _nearer(expected: SensorCandidate, recognised: SensorCandidate) -> list[SensorCandidate]:
    """Return variants of the rig file's sensor, each with one option of another sensor of the same kind."""
    from tacpipe.links.probing import SensorCandidate

    sensor: Any = expected.sensor
    variants = []
    for option in fields(sensor):
        value = getattr(recognised.sensor, option.name)
        if option.name in INVISIBLE_OPTIONS or value == getattr(sensor, option.name):
            continue
        try:
            variant = replace(sensor, **{option.name: value})
            variants.append(SensorCandidate(expected.kind, variant, {option.name: value}))
        except TacpipeError:  # no product has these options together
            continue
    return variants
