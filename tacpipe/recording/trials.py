"""Record one trial after another on an open rig: tare, start, stop, seal and append."""

from __future__ import annotations

import contextlib
import re
import signal
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tacpipe.datasets import labels as labels_of
from tacpipe.datasets.manifest import ACQUIRE
from tacpipe.datasets.paths import NAME_BYTES
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import termination
from tacpipe.io.files import user_name
from tacpipe.io.termination import EndRequest
from tacpipe.plugins.rows import StageRows
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import excerpt, plain
from tacpipe.recording import appending, clock, sealing, spool_folders, triggers
from tacpipe.recording import rig as rig_of
from tacpipe.recording.appending import NothingError
from tacpipe.recording.disk import DiskForecast
from tacpipe.recording.losses import StreamLosses
from tacpipe.recording.recorder import Recorder
from tacpipe.recording.rig import Rig
from tacpipe.recording.spool import ENDED, Spool, Spooled, StreamNote
from tacpipe.recording.spool_folders import COMPLETED, INTERRUPTED, RecordingHeader, own_user_ids
from tacpipe.recording.watch import RigView
from tacpipe.store.store import Store

NAME = re.compile(r"[\w-][\w.-]*")


@dataclass(frozen=True)
class RecordingPlan:
    """The planned recordings, and the events that start and stop them."""

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
    pictures: int | None = None  # port at which a browser sees the cameras
    realtime: bool = False  # true to run recordings before ordinary programs

    @property
    def has_end(self) -> bool:
        """True if an end is defined. Otherwise the recording lasts until it is interrupted, and counts as completed."""
        return self.duration_s is not None or self.stop != "duration"

    @property
    def names(self) -> list[str]:
        """The names of the recordings: ``name``, with a trial number if there are several trials."""
        return [self.name] if self.trials == 1 else [f"{self.name}-{trial + 1:03d}" for trial in range(self.trials)]


def recording_name(name: str | None) -> str:
    """Return the name of a recording, by default the current time. Raises `UsageError` for an invalid file name."""
    if not name:
        return time.strftime("%Y%m%d-%H%M%S", time.gmtime())
    if not NAME.fullmatch(name) or not spool_folders.is_name(name):
        raise UsageError(
            f"--name {name!r} is not a valid file name. Use letters, digits, _, - and dots, without a dot in front."
        )
    return name


def attributes(labels: Sequence[str], note: str | None) -> dict[str, Attribute]:
    """Return labels and a note as attributes of a recording. Raises `UsageError` for malformed labels."""
    parsed = labels_of.parse(labels, None, include=False) if labels else {}
    return {**parsed, **({"note": note} if note else {})}


@dataclass(frozen=True)
class Recorded:
    """A recording that was appended to a dataset."""

    name: str
    seconds: float
    rows: dict[str, int]  # number of samples by stream
    lost: dict[str, int]  # number of lost frames by stream, without estimated ones
    losses: dict[str, StreamLosses]  # lost frames by stream, and by what shows them
    ended: str = COMPLETED  # completed, interrupted or recovered
    spool: str = ""  # path of its retained spool; empty if the spool was removed
    unused: str = ""  # sentence on samples that were not stored

    def line(self) -> str:
        """Return the recording's name, duration, samples and losses as one line."""
        counts = ", ".join(
            f"{name} {rows} samples" + (f" ({self.losses[name]})" if self.losses[name] != StreamLosses() else "")
            for name, rows in self.rows.items()
        )
        retained = f"; its spool was moved to {self.spool}" if self.spool else ""
        unused = f"; {self.unused}" if self.unused else ""
        return f"{plain(self.name, NAME_BYTES)}: {self.seconds:.1f} s, {counts}{retained}{unused}"


def run(
    recorder: Recorder, store: Store, plan: RecordingPlan, view: RigView, stopping: EndRequest
) -> tuple[list[Recorded], list[str]]:
    """Record the trials of ``plan`` until ``stopping`` is true or a stream is lost.

    Returns the recordings, and a sentence for each lost stream. Raises the errors of `appending.append`.
    """
    recordings: list[Recorded] = []
    tap = triggers.MessageTrigger(recorder.watches) if "tap" in (plan.start, plan.stop) else None
    with _keys(plan) as pressed:
        for trial in range(plan.trials):
            if plan.tare:
                recorder.tare()
            starts, stops = _triggers(recorder, plan, pressed, tap)
            waiting = f"trial {trial + 1} of {plan.trials}: waiting for {plan.start}"
            recorder.run(lambda: stopping() or starts(), lambda: view.show(waiting))  # noqa: B023
            if stopping():
                break
            recording, lost = _record_trial(recorder, store, plan, trial, stops, view, stopping)
            recordings.append(recording)
            if lost or stopping():
                return recordings, lost
    return recordings, []


def _keys(plan: RecordingPlan) -> contextlib.AbstractContextManager[triggers.Keys]:
    """Return the keyboard's keys if a key starts or stops trials. Otherwise other programs can use the terminal."""
    return (
        triggers.watch_keys()
        if "key" in (plan.start, plan.stop)
        else contextlib.nullcontext(lambda *, must=False: False)
    )


def recover(store: Store, folder: Path, opened: Path | None) -> Recorded:
    """Seal an abandoned spool and append it to its dataset.

    ``opened`` is the output of this command, or None. Raises `TacpipeError`, and leaves the spool unchanged, if it belongs
    to another user, has an invalid header, or was recorded for a dataset elsewhere.
    """
    spooled = Spooled(folder, own_user_ids(folder.parent, [folder.lstat().st_uid]))
    rig_text = spooled.header.get("rig")
    if not isinstance(rig_text, str):
        raise TacpipeError(f"Its rig file is {excerpt(rig_text)}; it must be text.")
    rig = rig_of.parse(rig_text, f"The rig file in {folder}")
    spool_folders.check_header(spooled.header, rig.streams)
    return _seal(store, spool_folders.find_destination(spooled.header, store, opened), spooled, rig)


def _record_trial(
    recorder: Recorder,
    store: Store,
    plan: RecordingPlan,
    trial: int,
    stops: triggers.Trigger,
    view: RigView,
    stopping: EndRequest,
) -> tuple[Recorded, list[str]]:
    """Record one trial until its end, seal it, and return it with a sentence for each lost stream.

    ``stops`` returns whether the trial should end. An error of sealing names the spool and how to recover it.
    """
    name = plan.names[trial]
    attributes = {**plan.attributes, **({"trial": trial + 1} if plan.trials > 1 else {})}
    header: RecordingHeader = {
        "output": spool_folders.output_path(store, plan.output),
        "recording": name,
        "attributes": attributes,
        "duration_s": plan.duration_s,
        "keep": plan.keep_spool,
        "rig": recorder.rig.text,
    }
    spool = Spool(store.root, header, list(recorder.stations))
    start_s = clock.now_s()
    ending = COMPLETED

    def is_over() -> bool:
        nonlocal ending
        if plan.duration_s is not None and clock.now_s() - start_s >= plan.duration_s:
            return True
        if stopping() and (plan.has_end or stopping.number == signal.SIGHUP):
            ending = INTERRUPTED
        return stopping() or stops()

    advice = f"The recorded data is in {spool.folder}; `tacpipe acquire --recover` seals it"
    # The spool stays locked until it is sealed, so that no other process recovers it.
    with termination.reporting(f"tacpipe: interrupted. {advice}."), contextlib.closing(spool):
        disk = DiskForecast(spool.folder)

        def show() -> None:
            view.show(f"recording {name}, {clock.now_s() - start_s:.0f} s", disk.warning())

        with recorder.recording(spool, preroll=plan.start != "now"):
            recorder.run(is_over, show)
            spool.note(StreamNote(clock.now_ns(), "", ENDED, ending))
        lost = recorder.lost()  # before sealing, because nothing is read during it
        view.show(f"sealing {name}")
        try:
            return _seal(store, plan.output, Spooled(spool.folder), recorder.rig), lost
        except TacpipeError as error:
            raise type(error)(f"{error} {advice} once that is fixed.") from error
        except Exception as error:
            error.add_note(f"{advice}.")
            raise


def _seal(store: Store, output: Path, spooled: Spooled, rig: Rig) -> Recorded:
    """Seal a spool, append it to the dataset ``output``, and remove the spool or move it to the retained spools."""
    sealed = sealing.seal(spooled, rig)
    with store.at_work():
        name = appending.append(store, output, spooled, rig, sealed)
    retained = str(spooled.keep()) if spooled.header.get("keep") is True else ""
    spooled.remove()
    rows = {name: stream.rows for name, stream in sealed.items()}
    spans_ns = [stream.span_ns for stream in sealed.values() if stream.span_ns is not None]
    seconds = (max(last for _, last in spans_ns) - min(first for first, _ in spans_ns)) / 1e9
    losses = {name: stream.losses for name, stream in sealed.items()}
    lost = {name: count.certain for name, count in losses.items()}
    counts = StageRows(1, {name: stream.counts for name, stream in sealed.items()})
    return Recorded(name, seconds, rows, lost, losses, spooled.ended, retained, counts.describe_unused(ACQUIRE))


def _triggers(
    recorder: Recorder, plan: RecordingPlan, pressed: triggers.Keys, tap: triggers.MessageTrigger | None
) -> tuple[triggers.Trigger, triggers.Trigger]:
    """Return the triggers that start and stop the next trial. The duration of a trial is not a trigger."""
    contact = None
    if "contact" in (plan.start, plan.stop):
        contact = triggers.ContactTrigger(recorder.watches, plan.contact_count)
    starts: dict[str, triggers.Trigger] = {"now": lambda: True, "key": lambda: pressed(must=True)}
    stops: dict[str, triggers.Trigger] = {"duration": lambda: False, "key": pressed}
    if contact is not None:
        starts["contact"], stops["contact"] = contact.touched, contact.released
    if tap is not None:
        starts["tap"], stops["tap"] = (lambda: tap.received("start")), (lambda: tap.received("stop"))
        # discards start messages that arrive during a trial, so that they do not start the next trial
        stops["duration"] = lambda: tap.received("start") and False
    return starts[plan.start], stops[plan.stop]


MAX_ERROR_LENGTH = 300  # characters of an unexpected error


@dataclass(frozen=True)
class Unsealed:
    """A spool that could not be sealed."""

    folder: Path
    reason: str

    def line(self) -> str:
        """Return a sentence with the folder and the reason."""
        return f"The spool {self.folder} was not sealed. {self.reason}"


def recover_spools(store: Store, output: Path | None) -> Iterator[Recorded | Unsealed]:
    """Seal the spools that no process uses and yield the result of each. Spools without bytes are skipped.

    A spool that cannot be sealed is retained; the others are sealed. ``output`` is the dataset of the command.
    """
    for folder in spool_folders.find_abandoned(store.root):
        try:
            with spool_folders.locked(folder) as is_locked:
                if not is_locked:
                    continue
                recorded = recover(store, folder, output)
        except NothingError:
            continue  # the process ended before it received a byte
        except TacpipeError as error:
            yield Unsealed(folder, str(error))
        except Exception as error:  # a damaged spool or another version's driver may raise anything
            yield Unsealed(folder, plain(f"{type(error).__name__}: {error}", MAX_ERROR_LENGTH))
        else:
            yield recorded


def spools_of_others(store: Store) -> dict[Path, str]:
    """Return the owners' names of other users' spools in a shared store, by folder."""
    with contextlib.suppress(OSError):  # a failed disk has already been reported
        owners = spool_folders.find_owners(store.root)
        own_ids = spool_folders.own_user_ids(store.root / spool_folders.FOLDER, owners.values())
        return {folder: user_name(owner) for folder, owner in owners.items() if owner not in own_ids}
    return {}
