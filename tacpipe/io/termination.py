"""End a command with one sentence, within a second of Ctrl-C, SIGTERM or SIGHUP, whatever it is doing.

Python handles a signal only between bytecode instructions, so not during a long call in C. So a thread is also
notified, and ends the process if `KeyboardInterrupt` has not. That is safe at any point, because nothing in a store is
ever partly written.

SIGHUP is sent when a terminal or an ssh connection closes: by the kernel, and often again by the shell or systemd. It
never counts as a second request. Standard output and error may be disconnected, so writing to them may fail.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import signal
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any, NoReturn

from tacpipe import printable
from tacpipe.errors import INTERRUPTED
from tacpipe.io import terminal

GRACE_S = 0.7  # time allowed for ending in order
TWICE_S = 0.25  # `timeout` signals a process and then its group: a signal this soon after a request is the same request
SENTENCE = "tacpipe: interrupted; what was finished is kept."
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class _Requests:
    """Distinguishes requests from repeated signals for the same request."""

    def __init__(self) -> None:
        self._last_s = -TWICE_S

    def is_new_request(self) -> bool:
        """Return whether the latest signal is a new request."""
        now_s = time.monotonic()
        if now_s - self._last_s <= TWICE_S:
            return False
        self._last_s = now_s
        return True


class _Program:
    """The state of this process's termination requests; there is one instance."""

    def __init__(self) -> None:
        self.by_main_thread = _Requests()
        self.by_listener = _Requests()
        self.ending = False
        self.installed = False  # whether the handlers are installed, which only the process of a command does
        self.deferred = False  # whether `KeyboardInterrupt` is postponed
        self.own_way = False  # whether the command itself handles the next request
        self.sentence = SENTENCE
        self.reported = False
        self.code: int | None = None  # exit code of a finished command
        self.restore: Callable[[], None] = lambda: None  # resets the terminal

    def handle_signal(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal: raise `KeyboardInterrupt` for the first request, and end the program at the second.

        While `deferred`, the first request is only noted. Repeats of a request are ignored, as is SIGHUP while ending.
        """
        hung_up = number == signal.SIGHUP
        if hung_up:
            drop_closed_streams()
        if hung_up and self.ending:
            return
        if not self.by_main_thread.is_new_request():
            return
        if self.ending or self.code is not None:
            self.end()
        self.ending = True
        if not self.deferred:
            raise KeyboardInterrupt

    def listen(self, wakeups: int) -> None:
        """End the process soon after a request; run by a thread that is woken by signals from C."""
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
        """End the process immediately."""
        self.restore()
        if self.code is None and not self.reported and self.sentence:
            self.reported = True
            with contextlib.suppress(OSError):
                os.write(2, f"{printable.shown(self.sentence)}\n".encode(errors="backslashreplace"))
        os._exit(INTERRUPTED if self.code is None else self.code)


_program = _Program()


def install_handlers() -> None:
    """Handle termination requests from now on: first `KeyboardInterrupt`, then the end of the process.

    A signal that was ignored when this process started, for example by ``nohup``, stays ignored.
    """
    for number in _SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _program.handle_signal)
    wakeups, wakes = os.pipe()
    os.set_blocking(wakes, False)
    signal.set_wakeup_fd(wakes, warn_on_full_buffer=False)
    threading.Thread(target=_program.listen, args=(wakeups,), daemon=True).start()
    _program.installed = True
    _program.restore = _terminal_restorer()
    unraisable = sys.unraisablehook  # the listener ends the process if an interrupt occurs in code that cannot raise
    sys.unraisablehook = lambda reported: None if reported.exc_type is KeyboardInterrupt else unraisable(reported)


def requested() -> bool:
    """Return whether the process is ending on request; errors then imply nothing about the command."""
    return _program.installed and _program.ending


def report() -> None:
    """Report that the command was interrupted, and what was saved."""
    sentence, _program.sentence, _program.reported = _program.sentence, SENTENCE, True
    if sentence:
        terminal.note(sentence)


def finish(code: int) -> int:
    """Return the exit code of a finished command; termination requests from now on end it with this code.

    An interrupted process ends here, because unloading torch and other libraries would take another second.
    """
    if code == INTERRUPTED:
        with contextlib.suppress(OSError, ValueError):  # the reader of the output has closed it
            sys.stdout.flush()
        _program.end()
    _program.code = code
    return code


@contextlib.contextmanager
def reporting(sentence: str) -> Iterator[None]:
    """Report an interrupt in the block with this sentence, which should state what was saved."""
    before, _program.sentence = _program.sentence, sentence
    try:
        yield
    except KeyboardInterrupt:
        raise  # an outer block reports it
    except BaseException:
        _program.sentence = before
        raise
    _program.sentence = before


@contextlib.contextmanager
def deferred() -> Iterator[None]:
    """Postpone `KeyboardInterrupt` until the end of the block, which is short and must not be left half done."""
    before, _program.deferred = _program.ending, True
    try:
        yield
    finally:
        _program.deferred = False
        if _program.ending and not before:
            raise KeyboardInterrupt


class EndRequest:
    """A request to end: the first lets the running work finish and keeps it, the second interrupts.

    ``number`` is the signal of the request, or None before it.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self._requested = threading.Event()
        self._heard = _Requests()

    def __enter__(self) -> EndRequest:
        """Install the handlers, so that requests set this object instead of ending the command."""
        self._before: dict[signal.Signals, Any] = {}
        for number in _SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._ask)
        _program.own_way = True
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the handlers."""
        _program.own_way = False
        if self.number == signal.SIGHUP:
            drop_closed_streams()  # processes at the other end of a pipe may have ended since
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        """Return whether the end was requested."""
        return self._requested.is_set()

    def wait(self, timeout_s: float | None) -> None:
        """Wait until the end is requested, or for ``timeout_s``."""
        self._requested.wait(timeout_s)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        """Note the first request; raise `KeyboardInterrupt` for the second."""
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
    """Redirect standard output and error to /dev/null if their terminal or pipe is closed.

    Otherwise every write would raise and end the remaining work.
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
    """Return a function that restores the terminal's present state, which a killed process cannot do."""
    settings: list[tuple[int, Any]] = []
    with contextlib.suppress(ImportError, OSError):
        settings = [(0, termios.tcgetattr(0))] if os.isatty(0) else []
    show_cursor = b"\r\x1b[2K\x1b[?25h" if os.isatty(2) and os.environ.get("TERM", "dumb") != "dumb" else b""

    def restore() -> None:
        with contextlib.suppress(Exception):
            for handle, state in settings:
                if (
                    os.tcgetpgrp(handle) == os.getpgrp()
                ):  # a background process would be stopped for changing the terminal
                    termios.tcsetattr(handle, termios.TCSANOW, state)
            os.write(2, show_cursor)

    return restore


def end_with(pipe: int) -> None:
    """End this process as soon as the other end of a pipe is closed, which happens when the process there ends.

    The kernel reports it by a signal, which also ends a long call in C.
    """
    signal.signal(signal.SIGIO, signal.SIG_DFL)
    fcntl.fcntl(pipe, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(pipe, fcntl.F_SETFL, os.O_ASYNC)
