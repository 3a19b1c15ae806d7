"""Measure how far the rest levels of evaluated recordings lie from those of the training recordings.

The rest level of a channel is what `tacpipe segment contacts` stored in its metadata: the median over rows without load. A
sensor's rest levels change with temperature, wear and mounting, so they show whether recordings are of another session.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.codecs import tactile
from tacpipe.tasks.forward.params import RestShift, TrainingRest

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from tacpipe.datasets.dataset import Dataset, Recording

SESSION = "session"  # attribute of a recording
FAR = 3.0  # standard deviations in the median channel above which a recording is noted


def training_levels(training: Dataset, channels: Sequence[str]) -> TrainingRest | None:
    """Return mean and standard deviation of each channel's rest level over recordings, in counts; None for fewer than two.

    Raises `TacpipeError` if a channel has no rest level.
    """
    levels = np.array([rest_level(recording, channels) for recording in training.recordings.values()])
    if len(levels) < 2:
        return None
    return {"mean": levels.mean(axis=0).tolist(), "deviation": levels.std(axis=0, ddof=1).tolist()}


def rest_level(recording: Recording, channels: Sequence[str]) -> list[float]:
    """Return a recording's rest levels (channel,) in counts. Raises `TacpipeError` if a channel has none."""
    levels: list[float] = tactile.rest_counts(recording.columns().schema, channels).tolist()
    return levels


def measure_shift(level: Sequence[float], training: TrainingRest) -> RestShift | None:
    """Return the distance of rest levels (channel,) from the training mean in standard deviations.

    Channels whose rest level is the same in all training recordings are left out; None if no channel remains.

    >>> measure_shift([10.0, 5.0, 0.0], {"mean": [4.0, 6.0, 0.0], "deviation": [2.0, 1.0, 0.0]})
    {'largest': 3.0, 'median': 2.0}
    """
    mean, deviation = np.array(training["mean"]), np.array(training["deviation"])
    varies = deviation > 0
    if not varies.any():
        return None
    distances = np.abs(np.array(level) - mean)[varies] / deviation[varies]
    return {"largest": float(f"{distances.max():.6g}"), "median": float(f"{np.median(distances):.6g}")}


def sessions(recordings: Iterable[Recording]) -> list[str]:
    """Return the known sessions of recordings, sorted."""
    return sorted({str(recording.attributes[SESSION]) for recording in recordings if recording.attributes.get(SESSION)})


def describe_shifts(shifts: Mapping[str, RestShift]) -> str:
    """Return a sentence on the rest levels of evaluated recordings, of which there is at least one."""
    farthest = max(shifts, key=lambda name: shifts[name]["largest"])
    median = float(np.median([shift["median"] for shift in shifts.values()]))
    return (
        f"Rest levels are {median:.2g} standard deviations from the mean of the training recordings, in the median "
        f"channel and recording, and at most {shifts[farthest]['largest']:.3g} ({farthest})."
    )


def shift_notes(
    shifts: Mapping[str, RestShift], recordings: Sequence[Recording], training_sessions: Sequence[str]
) -> list[str]:
    """Return notes on evaluated recordings whose rest levels are far from those of training, or of the same session."""
    notes = []
    far = sum(shift["median"] > FAR for shift in shifts.values())
    if far:
        notes.append(
            f"{far} of {len(shifts)} test recordings have rest levels that differ from training, by more than {FAR:g} "
            f"standard deviations in the median channel. Check whether a sensor was moved or warmed up."
        )
    shared = sum(str(recording.attributes.get(SESSION) or "") in training_sessions for recording in recordings)
    if shared:
        notes.append(
            f"{shared} of {len(recordings)} test recordings are of a session of the training recordings, so the errors in "
            f"another session may be larger. Use `tacpipe split --group {SESSION}` to test on other sessions only."
        )
    return notes
