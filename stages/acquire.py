"""Record every stream of a rig.

A rig file names the streams. Each recording is appended to the dataset of ``-o``. ``--trials`` sets the number of
recordings, which a key, a contact or a tap can start and stop. Device bytes are written to disk immediately; recordings
that a crash interrupted are completed by the next ``acquire``, or with ``--recover``.

Example: tacpipe acquire rig.toml -o data/recordings --duration-s 30 --label material=cork
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.datasets import directory
from tacpipe.errors import UsageError
from tacpipe.io import terminal
from tacpipe.io.termination import EndRequest
from tacpipe.recording import clock

if TYPE_CHECKING:
    from tacpipe.recording.rig import Rig
    from tacpipe.recording.trials import Recorded, RecordingPlan
    from tacpipe.recording.watch import Figures
    from tacpipe.store.store import Store

DRY_RUN_S = 3.0


def record(rig: Rig, store: Store, plan: RecordingPlan, *, quiet: bool) -> tuple[list[Recorded], list[str]]:
    """Record the trials of a plan. Returns the recordings, and a message for each stream that was lost.

    Raises `UsageError` for invalid options, and `DeviceError` if streams do not open or send nothing.
    """
    from tacpipe.recording import appending, scheduling, trials, triggers
    from tacpipe.recording.pictures import serve_pictures
    from tacpipe.recording.recorder import Recorder, complete_rig
    from tacpipe.recording.watch import RigView

    for value, option, choices in ((plan.start, "--start", triggers.STARTS), (plan.stop, "--stop", triggers.STOPS)):
        if value not in choices:
            raise UsageError(f"There is no {option} {value}; it must be one of {', '.join(choices)}.")
    if plan.trials < 1 or (plan.duration_s is not None and plan.duration_s <= 0):
        raise UsageError("--trials and --duration-s must be above 0.")
    if plan.trials > 1 and plan.stop == "duration" and plan.duration_s is None:
        raise UsageError("--trials needs --duration-s or --stop, because otherwise the first trial never ends.")
    if plan.realtime:
        scheduling.check_realtime()
    store.prepare()
    directory.check_output(store, plan.output)
    appending.refuse_existing_names(plan.output, plan.names)
    recorder = Recorder(complete_rig(rig), realtime=plan.realtime)
    with (
        EndRequest() as is_over,
        recorder.open(),
        serve_pictures(recorder.watches, plan.pictures),
        RigView(recorder.watches, quiet=quiet).open() as view,
    ):
        recorder.await_first(is_over)
        recorded, lost = trials.run(recorder, store, plan, view, is_over)
    for recording in recorded if not quiet else ():
        terminal.note(recording.line())
    return recorded, lost


def recover(store: Store, output: Path | None, *, quiet: bool) -> tuple[list[Recorded], int]:
    """Complete the recordings from spools of earlier processes of this user, and report those that cannot be completed.

    Returns the recordings, and the number of spools that could not be completed.
    """
    from tacpipe.recording import trials

    sealed: list[Recorded] = []
    unsealed_count = 0
    for recovered in trials.recover_spools(store, output):
        if isinstance(recovered, trials.Unsealed):
            terminal.note(f"tacpipe: {recovered.line()}")
            unsealed_count += 1
            continue
        sealed.append(recovered)
        if not quiet:
            terminal.note(f"recovered {recovered.line()}")
    return sealed, unsealed_count


def report_spools_of_others(store: Store) -> None:
    """Print the owners of spools that other users left in a shared store."""
    from tacpipe.recording import trials

    for folder, owner in trials.spools_of_others(store).items():
        terminal.note(f"The spool {folder} belongs to {owner}. Only this user can seal it.")


def measure(rig: Rig) -> dict[str, Figures]:
    """Open every stream for `DRY_RUN_S` without recording; return the figures of each by its name.

    Raises `DeviceError` if streams do not open or send nothing.
    """
    from tacpipe.recording.recorder import Recorder

    recorder = Recorder(rig)
    with EndRequest() as is_over, recorder.open():
        recorder.await_first(is_over)
        until_s = clock.now_s() + DRY_RUN_S
        recorder.run(lambda: is_over() or clock.now_s() > until_s)
        return {name: watch.figures(clock.now_ns()) for name, watch in recorder.watches.items()}
