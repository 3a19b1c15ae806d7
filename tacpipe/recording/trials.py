"""One recording after another on an open rig: tared, started and stopped as asked, sealed, appended."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from tacpipe.datasets.paths import NAME_BYTES
from tacpipe.errors import TacpipeError
from tacpipe.io import termination
from tacpipe.io.termination import EndRequest
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt, plain
from tacpipe.recording import appending, clock, header, sealing, triggers
from tacpipe.recording.ending import COMPLETED, INTERRUPTED
from tacpipe.recording.recorder import Recorder
from tacpipe.recording.rig import Rig
from tacpipe.recording.spool import ENDED, Spool
from tacpipe.recording.spool_blocks import Note
from tacpipe.recording.spool_folders import users
from tacpipe.recording.spooled import Spooled
from tacpipe.recording.view import View
from tacpipe.store.store import Store


@dataclass(frozen=True)
class Plan:
    """What is to be recorded, and what starts and stops it."""

    output: Path
    name: str
    duration_s: float | None = None
    trials: int = 1
    start: str = "now"
    stop: str = "duration"
    contact_count: float = 50.0
    tare: bool = False
    keep_spool: bool = False
    attributes: Mapping[str, Attribute] = field(default_factory=dict)

    @property
    def requested(self) -> bool:
        """Whether an end was requested; else the recording lasts until it is interrupted, which completes it."""
        return self.duration_s is not None or self.stop != "duration"

    @property
    def names(self) -> list[str]:
        """The names of its recordings: that which was given, with the number of the trial where there are several."""
        return [self.name] if self.trials == 1 else [f"{self.name}-{trial + 1:03d}" for trial in range(self.trials)]


@dataclass(frozen=True)
class Recorded:
    """One recording, as it was appended."""

    name: str
    seconds: float
    rows: dict[str, int]  # stream to samples
    lost: dict[str, int]  # stream to frames
    ended: str = COMPLETED  # or interrupted, or recovered
    spool: str = ""  # where its spool is kept

    def line(self) -> str:
        """Return it in words."""
        described = ", ".join(
            f"{name} {rows} samples" + (f" ({self.lost[name]} lost)" if self.lost[name] else "")
            for name, rows in self.rows.items()
        )
        kept = f"; its spool is kept in {self.spool}" if self.spool else ""
        return f"{plain(self.name, NAME_BYTES)}: {self.seconds:.1f} s, {described}{kept}"


def run(
    recorder: Recorder, store: Store, plan: Plan, view: View, ended: EndRequest
) -> tuple[list[Recorded], list[str]]:
    """Record what ``plan`` asks for; ``ended`` cuts it short, and so does a stream that was lost and is not back.

    Return what was recorded, and a sentence for each stream that was lost.
    """
    recorded: list[Recorded] = []
    tap = triggers.Tap(recorder.watches) if "tap" in (plan.start, plan.stop) else None
    with _keys(plan) as pressed:
        for trial in range(plan.trials):
            if plan.tare:
                recorder.tare()
            starts, stops = _triggers(recorder, plan, pressed, tap)
            _await(recorder, starts, ended, view, f"trial {trial + 1} of {plan.trials}: waiting for {plan.start}")
            if ended():
                break
            one, lost = _record(recorder, store, plan, trial, stops, view, ended)
            recorded.append(one)
            if lost or ended():
                return recorded, lost
    return recorded, []


def _keys(plan: Plan) -> contextlib.AbstractContextManager[triggers.Keys]:
    """Listen to the keyboard if a key is asked for; else the terminal is left alone, and may be another program's."""
    return triggers.keys() if "key" in (plan.start, plan.stop) else contextlib.nullcontext(lambda *, must=False: False)


def _await(recorder: Recorder, starts: triggers.Trigger, ended: EndRequest, view: View, waiting: str) -> None:
    recorder.run(lambda: ended() or starts(), lambda: view.show(waiting))


def recover(store: Store, folder: Path, opened: Path | None) -> Recorded:
    """Seal what an abandoned spool holds and append it to the dataset that it was recorded for.

    ``opened`` is the dataset that this command was given, None for none. Raises `TacpipeError` with what keeps it from being
    sealed: it is another user's, it names what no dataset can hold, or a dataset elsewhere. It stays as it is then.
    """
    from tacpipe.recording import rig as rig_of

    spooled = Spooled(folder, users(folder.parent, [folder.lstat().st_uid]))
    described = spooled.header.get("rig")
    if not isinstance(described, str):
        raise TacpipeError(f"Its rig file is {excerpt(described)}; it must be a text.")
    rig = rig_of.parse(described, f"The rig file in {folder}")
    header.check(spooled.header, rig.streams)
    return _sealed(store, header.destination(spooled.header, store, opened), spooled, rig)


def _record(
    recorder: Recorder, store: Store, plan: Plan, trial: int, stops: triggers.Trigger, view: View, ended: EndRequest
) -> tuple[Recorded, list[str]]:
    name = plan.names[trial]
    attributes = {**plan.attributes, **({"trial": trial + 1} if plan.trials > 1 else {})}
    described = {"output": header.output(store, plan.output), "recording": name, "attributes": attributes}
    wanted = {"duration_s": plan.duration_s, "keep": plan.keep_spool}
    spool = Spool(store.root, {**described, **wanted, "rig": recorder.rig.text}, list(recorder.stations))
    began_s = clock.now_s()
    how = COMPLETED

    def over() -> bool:
        nonlocal how
        if plan.duration_s is not None and clock.now_s() - began_s >= plan.duration_s:
            return True
        if ended() and (plan.requested or ended.number == signal.SIGHUP):
            how = INTERRUPTED
        return ended() or stops()

    kept = f"What was recorded is kept in {spool.folder}; `tacpipe acquire --recover` seals it"
    with (
        termination.reporting(f"tacpipe: interrupted. {kept}."),
        contextlib.closing(spool),
    ):  # nobody else may recover it
        with recorder.recording(spool, preroll=plan.start != "now"):
            recorder.run(over, lambda: view.show(f"recording {name}, {clock.now_s() - began_s:.0f} s"))
            spool.note(Note(clock.now_ns(), "", ENDED, how))
        lost = recorder.lost()  # now: while it is sealed nobody looks at what comes
        view.show(f"sealing {name}")
        try:
            return _sealed(store, plan.output, Spooled(spool.folder), recorder.rig), lost
        except TacpipeError as error:
            raise type(error)(f"{error} {kept} once that is fixed.") from error
        except Exception as error:
            error.add_note(f"{kept}.")
            raise


def _sealed(store: Store, output: Path, spooled: Spooled, rig: Rig) -> Recorded:
    sealed = sealing.seal(spooled, rig)
    with store.at_work():
        name = appending.append(store, output, spooled, rig, sealed)
    kept = str(spooled.keep()) if spooled.header.get("keep") is True else ""
    spooled.remove()
    rows = {stream: one.rows for stream, one in sealed.items()}
    spans_ns = [one.span_ns for one in sealed.values() if one.span_ns is not None]
    first, last = min(first for first, _ in spans_ns), max(last for _, last in spans_ns)
    lost = {stream: one.lost for stream, one in sealed.items()}
    return Recorded(name, (last - first) / 1e9, rows, lost, spooled.ended, kept)


def _triggers(
    recorder: Recorder, plan: Plan, pressed: triggers.Keys, tap: triggers.Tap | None
) -> tuple[triggers.Trigger, triggers.Trigger]:
    """Return what starts the next trial, and what stops it next to its duration."""
    contact = None
    if "contact" in (plan.start, plan.stop):
        contact = triggers.Contact(recorder.watches, plan.contact_count)
    starts: dict[str, triggers.Trigger] = {"now": lambda: True, "key": lambda: pressed(must=True)}
    stops: dict[str, triggers.Trigger] = {"duration": lambda: False, "key": pressed}
    if contact is not None:
        starts["contact"], stops["contact"] = contact.touched, contact.released
    if tap is not None:
        starts["tap"], stops["tap"] = (lambda: tap.received("start")), (lambda: tap.received("stop"))
        stops["duration"] = lambda: tap.received("start") and False  # one that comes meanwhile begins no other trial
    return starts[plan.start], stops[plan.stop]
