"""Run one stream: open its link, read it in a thread, and reopen it after a loss."""

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
from tacpipe.links.link import DATAGRAM_SCHEMES, Link, LinkLostError, OpenLink
from tacpipe.links.opening import NoReplyError
from tacpipe.links.probing import SensorCandidate, recognise
from tacpipe.recording import clock
from tacpipe.recording.pace import CAUGHT_UP, STALLED, WAITED_NS, Pace
from tacpipe.recording.rig import RigStream
from tacpipe.recording.spool import StreamNote
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Sensor

if TYPE_CHECKING:
    from tacpipe.links.probing import SensorCandidate

OPENED, LOST, OVERRUN = "opened", "lost", "overrun"
BEGAN, OVER = "began", "over"  # notes for listeners; the blocks between them belong to the recording
FOREIGN = "foreign"  # cause of packets that other senders sent
REFUSED = "refused"  # cause of packets that the sensor does not accept
DROP_NOTE_S = 1.0  # minimum time between two notes on dropped packets
READ_S = 0.1  # timeout of a read, after which the thread checks whether it should stop
RETRY_S = (0.1, 2.0)  # first and longest pause between two attempts to reopen a lost link
MUTE_S = 4.0  # a datagram device is reopened after this silence, because nothing else reveals its loss
TARE_S = 5.0  # timeout for taring a device
STOP_S = 2.0  # timeout for stopping the thread
REPLY_S = 0.5  # time after which an unanswered request is repeated

Tally = Callable[[int, int, int], None]  # arguments: numbers of chunks and bytes, and time of the last arrival in ns
Listener = Callable[["Chunks | StreamNote"], None]  # receives blocks as they arrive; it must neither block nor raise


class Station:
    """A stream whose link is reopened after a loss. `take` returns the undecoded blocks since the last call."""

    def __init__(self, stream: RigStream) -> None:
        self.stream = stream
        self.error: TacpipeError | None = None  # the reason why the link is lost, None while it is open
        self.listener: Listener | None = None  # called by the reading thread
        self._tally: Tally | None = None
        self._link: Link | None = None
        self._entries: deque[tuple[int, bytes]] = deque()
        self._notes: deque[StreamNote] = deque()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=stream.name, daemon=True)
        self._lock = threading.Lock()
        self._commands: deque[Callable[[Link], None]] = deque()  # run by the reading thread between two reads
        self._chunks = self._bytes = self._overruns = self._foreign = self._refused = 0
        self._drop_note_s = 0.0  # time of the last note on dropped packets
        self._empty_ns = 0  # last time at which the link was empty
        self._retry_s = RETRY_S[0]

    def start(self) -> None:
        """Open the link and start the reading thread. Raises `DeviceError` if that fails."""
        try:
            self._open()
        except NoReplyError as error:
            heard = [Chunks.from_pairs(error.heard)] if error.heard else []
            raise DeviceError(explain_silence(self.stream, error.awaited, heard, reply=True)) from error
        self._thread.start()

    def take(self) -> list[Chunks | StreamNote]:
        """Return the bytes and notes since the last call, in order."""
        with self._lock:
            return self._take_blocks()

    def start_recording(self, tally: Tally, preroll: list[Chunks | StreamNote] | None) -> list[Chunks | StreamNote]:
        """Start reporting totals to ``tally``, and return the blocks since the last call.

        ``preroll`` has earlier blocks that belong to the recording. They and the returned blocks are then included in the
        totals; if it is None, neither is. The listener receives the note `BEGAN`, then the included blocks.
        """
        with self._lock:
            pending = self._take_blocks()
            counted = [] if preroll is None else [block for block in (*preroll, *pending) if isinstance(block, Chunks)]
            self._chunks = sum(len(block.size) for block in counted)
            self._bytes = sum(len(block.data) for block in counted)
            self._tally = tally
            self._foreign = 0 if self._link is None else self._link.foreign  # earlier packets are not recorded
            self._refused = 0
            for block in (
                StreamNote(clock.now_ns(), self.stream.name, BEGAN),
                *(() if preroll is None else (*preroll, *pending)),
            ):
                self._notify(block)
            return pending

    def end_recording(self) -> list[Chunks | StreamNote]:
        """Stop reporting totals, and return the blocks since the last call. The listener receives the note `OVER`."""
        with self._lock:
            self._tally = None
            self._notify(StreamNote(clock.now_ns(), self.stream.name, OVER))
            self._note_dropped(self._link)
            return self._take_blocks()

    def is_drained(self, since_ns: int) -> bool:
        """Return whether the link was read empty after ``since_ns``. Returns True if the link is lost."""
        return self._link is None or self._empty_ns >= since_ns

    def tare(self) -> bool:
        """Zero the device at its present reading; return whether it has a command for that.

        Raises `DeviceError` if the link is lost or the device does not reply.
        """
        sensor, name = self.stream.sensor, self.stream.name
        if type(sensor).taring is Sensor.taring:
            return False
        finished, errors = threading.Event(), []

        def run_command(link: Link) -> None:
            try:
                self._add_packets(opening.run_dialogue(link, sensor.taring(), name))
            except DeviceError as error:
                errors.append(error)
            finished.set()

        self._commands.append(run_command)
        if not finished.wait(TARE_S):
            raise DeviceError(
                f"Stream {name} could not be tared, because its link is lost. Wait until it is open again."
            )
        if errors:
            raise errors[0]
        return True

    def stop(self) -> None:
        """Stop the thread, send the device its closing request, and close the link."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(timeout=STOP_S)
        link, self._link = self._link, None
        if link is not None:
            with contextlib.suppress(Exception):  # an error of one device must not prevent closing the others
                request = self.stream.sensor.closing()
                if request:
                    link.write(request)
            with contextlib.suppress(Exception):
                link.close()

    def _open(self) -> None:
        """Open the link and complete the sensor's opening dialogue. Raises `DeviceError` if that fails."""
        sensor = self.stream.sensor
        link = opening.open_link(self.stream.address, sensor, self.stream.name)
        try:
            packets = opening.run_dialogue(link, sensor.opening(link.local), self.stream.name)
        except BaseException:
            link.close()
            raise
        if self.listener is not None and isinstance(link, OpenLink):
            link.reduce_latency()
        self._overruns, self._foreign = link.overruns, link.foreign
        self._notes.append(StreamNote(time.monotonic_ns() if not packets else packets[0][0], self.stream.name, OPENED))
        self._link, self.error = link, None
        self._add_packets(packets)

    def _run(self) -> None:
        """Read the link, and reopen it after each loss, until the station stops."""
        while not self._stopping.is_set():
            try:
                if self._link is None:
                    self._open()
                self._read()
            except TacpipeError as error:
                self._handle_loss(error)
            except Exception as error:  # a driver's error counts as a loss; the other streams continue
                self._handle_loss(DeviceError(f"Stream {self.stream.name} failed: {type(error).__name__}: {error}"))

    def _handle_loss(self, error: TacpipeError) -> None:
        """Close the link, report the loss, and wait before the next attempt, each time twice as long."""
        link, self._link = self._link, None
        self.error = error
        if link is not None:
            note = StreamNote(time.monotonic_ns(), self.stream.name, LOST, str(error))
            self._notes.append(note)
            with self._lock:
                self._notify(note)
            self._retry_s = RETRY_S[0]
            with contextlib.suppress(Exception):  # the device is gone, and no error may end this thread
                link.close()
        self._stopping.wait(self._retry_s)
        self._retry_s = min(2 * self._retry_s, RETRY_S[1])

    def _read(self) -> None:
        """Read the link until it is lost or the thread should stop."""
        link, sensor = self._link, self.stream.sensor
        assert link is not None
        request, answers = sensor.request(), type(sensor).answer is not Sensor.answer
        pace = Pace(clock.now_ns(), clock.suspended_ns())
        if request:
            self._poll(link, request, pace)
            return
        last_s = time.monotonic()
        while not self._stopping.is_set():
            packets = self._read_packets(link, READ_S, pace)
            last_s = self._last_arrival_s(last_s, packets)
            self._run_commands(link, pace)
            if answers:
                for _, chunk in packets:
                    answer = sensor.answer(chunk)
                    if answer:
                        link.write(answer)
                        pace.resume(clock.now_ns())
            if link.overruns != self._overruns:
                self._note_overruns(link.overruns)
            if time.monotonic() - self._drop_note_s > DROP_NOTE_S:
                with self._lock:
                    self._note_dropped(link)

    def _read_packets(self, link: Link, timeout_s: float, pace: Pace) -> list[tuple[int, bytes]]:
        """Read the link, and store and return the packets.

        Notes mark a delay of this program, and the time after which arrivals are reliable again.
        """
        start_ns = clock.now_ns()
        packets = link.read(timeout_s)
        stop_ns = clock.now_ns()
        stall = pace.add_read(start_ns, stop_ns, round(timeout_s * 1e9), clock.suspended_ns())
        at_ns = packets[0][0] if packets else stop_ns
        if stall is not None:
            late_ns = 0 if link.kernel_stamped else stall.late_ns
            self._notes.append(StreamNote(at_ns, self.stream.name, STALLED, replace(stall, late_ns=late_ns).detail))
        elif pace.has_caught_up(start_ns, stop_ns):
            self._notes.append(StreamNote(at_ns, self.stream.name, CAUGHT_UP))
        self._add_packets(packets)
        if not packets:
            self._empty_ns = start_ns + round(min(timeout_s * 1e9, stop_ns - start_ns))
        elif stop_ns - start_ns > WAITED_NS:
            self._empty_ns = start_ns
        return packets

    def _last_arrival_s(self, previous_s: float, packets: list[tuple[int, bytes]]) -> float:
        """Return the time of the last packet in s.

        Raises `LinkLostError` after `MUTE_S` without a packet if nothing else would reveal the loss of the device.
        """
        sensor, address, now_s = self.stream.sensor, self.stream.address, time.monotonic()
        if packets or address.scheme not in DATAGRAM_SCHEMES or sensor.listens or not sensor.awaited:
            return now_s
        if now_s - previous_s > MUTE_S:
            message = f"Stream {self.stream.name} ({address}) is lost: nothing was received for {MUTE_S:g} s."
            raise LinkLostError(f"{message} {sensor.exclusive}".strip())
        return previous_s

    def _poll(self, link: Link, request: bytes, pace: Pace) -> None:
        """Read a device that sends one frame per request, at the sensor's rate.

        Each request waits for the previous reply.
        """
        period_s = 1.0 / self.stream.sensor.rate_hz
        due_s = time.monotonic()
        while not self._stopping.is_set():
            link.write(request)
            pace.resume(clock.now_ns())
            self._read_packets(link, REPLY_S, pace)
            self._run_commands(link, pace)
            due_s = max(due_s + period_s, time.monotonic() - period_s)
            while not self._stopping.is_set() and (left_s := due_s - time.monotonic()) > 0:
                self._read_packets(link, min(left_s, READ_S), pace)  # remaining parts of a reply

    def _run_commands(self, link: Link, pace: Pace) -> None:
        while self._commands:
            self._commands.popleft()(link)
            pace.resume(clock.now_ns())

    def _note_dropped(self, link: Link | None) -> None:
        """Add notes on the packets that were dropped since the last note. The caller holds the lock."""
        self._drop_note_s = time.monotonic()
        if link is not None and link.foreign > self._foreign:
            described = f"{link.foreign - self._foreign} packets of other senders were left out"
            self._notes.append(StreamNote(clock.now_ns(), self.stream.name, FOREIGN, described))
            self._foreign = link.foreign
        if self._refused:
            described = f"{self._refused} packets that {self.stream.kind} does not accept were left out"
            self._notes.append(StreamNote(clock.now_ns(), self.stream.name, REFUSED, described))
            self._refused = 0

    def _note_overruns(self, overruns: int) -> None:
        self._notes.append(StreamNote(time.monotonic_ns(), self.stream.name, OVERRUN, str(overruns - self._overruns)))
        self._overruns = overruns

    def _add_packets(self, packets: list[tuple[int, bytes]]) -> None:
        """Store and count the packets that the sensor accepts, and pass them to the listener."""
        accepted = [packet for packet in packets if self.stream.sensor.accepts(packet[1])]
        with self._lock:
            self._refused += len(packets) - len(accepted)
            if not accepted:
                return
            self._entries.extend(accepted)
            if self._tally is not None:
                self._chunks += len(accepted)
                self._bytes += sum(len(data) for _, data in accepted)
                self._tally(self._chunks, self._bytes, accepted[-1][0])
            if self.listener is not None:
                self._notify(Chunks.from_pairs(accepted))

    def _notify(self, block: Chunks | StreamNote) -> None:
        if self.listener is not None:
            self.listener(block)

    def _take_blocks(self) -> list[Chunks | StreamNote]:
        """Remove and return all stored packets and notes, in order of time."""
        blocks: list[Chunks | StreamNote] = []
        while self._notes:
            note = self._notes.popleft()
            blocks += [*_pop_chunks(self._entries, note.t_ns), note]
        return blocks + _pop_chunks(self._entries, None)


def _pop_chunks(entries: deque[tuple[int, bytes]], before_ns: int | None) -> list[Chunks]:
    """Remove and return the entries before ``before_ns``, or all entries if it is None."""
    removed = []
    while entries and (before_ns is None or entries[0][0] < before_ns):
        removed.append(entries.popleft())
    return [Chunks.from_pairs(removed)] if removed else []


INVISIBLE_OPTIONS = ("rate_hz", "baud")  # options that do not change the frames


def explain_silence(stream: RigStream, awaited: str, heard: Iterable[Chunks], *, reply: bool = False) -> str:
    """Return an error for a stream that did not receive ``awaited``: the device, the problem, and what to do.

    ``heard`` has the bytes that were received instead. With ``reply``, a reply was awaited: frames of the sensor then
    show that the device does not receive requests.
    """
    joined = Chunks.concatenate(list(heard))
    about = f"Stream {stream.name} ({stream.address}): {awaited}"
    probe = f"`tacpipe sensors probe {stream.address}`"
    serial = stream.address.scheme == "serial"
    if not joined.data:
        rate = f", set to {stream.sensor.baud} baud" if serial else ""
        end = f"; {probe} tries all rates" if serial else ""
        message = f"{about}, but nothing was received. Check power and cable, and that it is {stream.kind}{rate}{end}."
        return f"{message} {stream.sensor.exclusive}".strip()
    about += f", but the {len(joined.data):,} bytes received contain none."
    explanation = _explain_bytes(stream, joined, reply=reply)
    if explanation:
        return f"{about} {explanation}"
    setting = f"is set to another rate than {stream.sensor.baud} baud, or " if serial else ""
    return f"{about} The device {setting}uses another protocol; {probe} tries all supported sensors."


def _explain_bytes(stream: RigStream, heard: Chunks, *, reply: bool) -> str:
    """Return a sentence on the sensor that sent the bytes, or an empty text if none is recognised."""
    scheme, expected = stream.address.scheme, SensorCandidate(stream.kind, stream.sensor)
    if reply and recognise(heard, scheme, [expected]):
        return (
            f"They are frames of {expected}, so the device does not receive our requests or is another model: check the "
            f"transmit wire, and the model in the rig file."
        )
    findings = recognise(heard, scheme)
    if not findings:
        return ""
    best = findings[0].candidate
    if best.kind == stream.kind:
        variants = recognise(heard, scheme, _single_option_variants(expected, best))
        best = variants[0].candidate if variants else best
        return f"They are frames of {best}: set these options in the rig file."
    return f"They are frames of {best}: set that sensor in the rig file, or plug in the other device."


def _single_option_variants(expected: SensorCandidate, recognised: SensorCandidate) -> list[SensorCandidate]:
    """Return variants of the rig file's sensor, each with one option of the recognised sensor of the same kind."""
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
