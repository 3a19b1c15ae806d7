"""End a command within a second of Ctrl-C, SIGTERM or SIGHUP, whatever it is doing, with one sentence.

Python hears of a signal between two of its own steps, and a long call in C has none. So a thread hears of it too, and ends
the process where `KeyboardInterrupt` has not. That is safe at any point: nothing in a store is ever half written.

SIGHUP comes when a terminal or an ssh connection closes: from the kernel, and often again from the shell or from systemd. It
never counts as a second request. What was connected to standard output and error may be gone, so writing there may fail.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any, NoReturn

from tacpipe import printable
from tacpipe.errors import INTERRUPTED
from tacpipe.io import terminal

GRACE_S = 0.7  # time to end in good order
TWICE_S = 0.25  # `timeout` signals a process and then its group: what comes so soon after a request is the same one
SENTENCE = "tacpipe: interrupted; what was finished is kept."
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class _Requests:
    """Distinguishes requests apart from their echoes."""

    def __init__(self) -> None:
        self._last_s = -TWICE_S

    def is_new_request(self) -> bool:
        """Return whether the signal that has just come is a request of its own."""
        now_s = time.monotonic()
        if now_s - self._last_s <= TWICE_S:
            return False
        self._last_s = now_s
        return True


class _Program:
    """The state of termination requests of this process; one instance exists."""

    def __init__(self) -> None:
        self.by_main_thread = _Requests()
        self.by_listener = _Requests()
        self.ending = False
        self.installed = False  # it is a command's own process
        self.deferred = False  # `KeyboardInterrupt` waits
        self.own_way = False  # the next request is the command's own business
        self.sentence = SENTENCE
        self.reported = False
        self.code: int | None = None  # exit code of a command that is done
        self.restore: Callable[[], None] = lambda: None  # resets the terminal

    def ask(self, number: int, frame: FrameType | None) -> None:
        """Raise `KeyboardInterrupt` for the first request, end at once for the second: the handler of all signals."""
        hung_up = number == signal.SIGHUP
        if hung_up:
            drop_closed_streams()
        if not self.by_main_thread.is_new_request() or (hung_up and self.ending):
            return
        if self.ending or self.code is not None:
            self.end()
        self.ending = True
        if not self.deferred:
            raise KeyboardInterrupt

    def listen(self, wakeups: int) -> None:
        """See to it that the process ends soon after a request: run by a thread that hears of signals from C."""
        expected = requested_before = False
        while True:
            (number,) = os.read(wakeups, 1)
            if (
                number not in _SIGNALS
                or not self.by_listener.is_new_request()
                or (number == signal.SIGHUP and requested_before)
            ):
                continue
            requested_before = True
            if self.own_way:
                self.own_way = False
            elif expected:
                self.end()
            else:
                expected = True
                threading.Thread(target=self.end_soon, daemon=True).start()

    def end_soon(self) -> None:
        time.sleep(GRACE_S)
        self.end()

    def end(self) -> NoReturn:
        """End the process without another step of what it was doing."""
        self.restore()
        if self.code is None and not self.reported and self.sentence:
            self.reported = True
            with contextlib.suppress(OSError):
                os.write(2, f"{printable.shown(self.sentence)}\n".encode(errors="backslashreplace"))
        os._exit(INTERRUPTED if self.code is None else self.code)


_program = _Program()


def install_handlers() -> None:
    """Handle termination requests from now on: `KeyboardInterrupt` first, the end of the process soon after.

    A signal that this process was started to ignore, as by ``nohup``, is ignored further.
    """
    for number in _SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _program.ask)
    wakeups, wakes = os.pipe()
    os.set_blocking(wakes, False)
    signal.set_wakeup_fd(wakes, warn_on_full_buffer=False)
    threading.Thread(target=_program.listen, args=(wakeups,), daemon=True).start()
    _program.installed = True
    _program.restore = _terminal_restorer()
    unraisable = sys.unraisablehook  # the listener ends the process if an interrupt meets code that cannot raise
    sys.unraisablehook = lambda reported: None if reported.exc_type is KeyboardInterrupt else unraisable(reported)


def requested() -> bool:
    """Return whether the process is about to end because somebody requested it: errors then state nothing of the command."""
    return _program.installed and _program.ending


def report() -> None:
    """Report that the command was interrupted, and what is kept."""
    sentence, _program.sentence, _program.reported = _program.sentence, SENTENCE, True
    if sentence:
        terminal.note(sentence)


def finish(code: int) -> int:
    """Return the exit code of a command that is done: whoever requests it to end from now on gets this code.

    An interrupted process ends here: taking down torch and the like would need another second.
    """
    if code == INTERRUPTED:
        with contextlib.suppress(OSError, ValueError):  # nobody reads what was printed
            sys.stdout.flush()
        _program.end()
    _program.code = code
    return code


@contextlib.contextmanager
def reporting(sentence: str) -> Iterator[None]:
    """Have an interrupt in the block stated in this sentence, which knows what is kept."""
    before, _program.sentence = _program.sentence, sentence
    try:
        yield
    except KeyboardInterrupt:
        raise  # it is reported further out
    except BaseException:
        _program.sentence = before
        raise
    _program.sentence = before


@contextlib.contextmanager
def deferred() -> Iterator[None]:
    """Have `KeyboardInterrupt` wait for the end of the block, which is short and must not be left half done."""
    before, _program.deferred = _program.ending, True
    try:
        yield
    finally:
        _program.deferred = False
        if _program.ending and not before:
            raise KeyboardInterrupt


class EndRequest:
    """A request to end: the first lets the running work finish in its own way and keeps it, the second interrupts.

    ``number`` is the signal that asked, None before.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self._requested = threading.Event()
        self._heard = _Requests()

    def __enter__(self) -> EndRequest:
        self._before: dict[signal.Signals, Any] = {}
        for number in _SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._ask)
        _program.own_way = True
        return self

    def __exit__(self, *_: object) -> None:
        _program.own_way = False
        if self.number == signal.SIGHUP:
            drop_closed_streams()  # those at the other end of a pipe may have ended after this process heard of it
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        """Return whether somebody did."""
        return self._requested.is_set()

    def wait(self, timeout_s: float | None) -> None:
        """Wait until somebody does, or for so long."""
        self._requested.wait(timeout_s)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGHUP:
            drop_closed_streams()
        if not self._heard.is_new_request() or (number == signal.SIGHUP and self._requested.is_set()):
            return
        if self._requested.is_set():
            _program.ending = True
            raise KeyboardInterrupt
        self.number = number
        self._requested.set()


def drop_closed_streams() -> None:
    """Connect standard output and error to /dev/null where their terminal or the other end of their pipe is closed.

    Every write there would raise, and end what is still to be finished.
    """
    for handle in (1, 2):
        with contextlib.suppress(OSError):
            watched = select.poll()
            watched.register(handle, select.POLLOUT)
            if any(state & (select.POLLHUP | select.POLLERR) for _, state in watched.poll(0)):
                null_device = os.open(os.devnull, os.O_WRONLY)
                os.dup2(null_device, handle)
                os.close(null_device)


def _terminal_restorer() -> Callable[[], None]:
    """Return what makes the terminal as it is now: a process that ends at once cannot show the cursor or echo again."""
    settings: list[tuple[int, Any]] = []
    with contextlib.suppress(ImportError, OSError):
        import termios

        settings = [(0, termios.tcgetattr(0))] if os.isatty(0) else []
    show_cursor = b"\r\x1b[2K\x1b[?25h" if os.isatty(2) and os.environ.get("TERM", "dumb") != "dumb" else b""

    def restore() -> None:
        with contextlib.suppress(Exception):
            for handle, state in settings:
                if os.tcgetpgrp(handle) == os.getpgrp():  # another one would be stopped for it
                    termios.tcsetattr(handle, termios.TCSANOW, state)
            os.write(2, show_cursor)

    return restore


def end_with(pipe: int) -> None:
    """Have this process end as soon as the other end of a pipe is closed, which is when the process there ends.

    The kernel reports it by a signal, which ends this process in the middle of a long call in C as well.
    """
    signal.signal(signal.SIGIO, signal.SIG_DFL)
    fcntl.fcntl(pipe, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(pipe, fcntl.F_SETFL, os.O_ASYNC)
