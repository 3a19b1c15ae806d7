"""Stored models and results, given to trackers of experiments as if they were trained now."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path

from tacpipe.cli import identities
from tacpipe.datasets import manifest
from tacpipe.errors import UsageError
from tacpipe.io.hashing import digest
from tacpipe.store.location import locate
from tacpipe.trackers import tracker, tracking
from tacpipe.trackers.tracking import CONFIG, HISTORY, Tracking


def run(paths: Sequence[Path], trackers: Sequence[str]) -> list[str]:
    """Give each dataset's params, epochs and figures to ``trackers``; return the names of the runs.

    A run has the name that ``--track`` gives it, so that what was tracked as it was trained is the same run. Raises
    `UsageError` for a dataset without epochs and figures, and for an unknown tracker.
    """
    found = [manifest.find(path) for path in paths]
    for path, one in zip(paths, found, strict=True):
        if not {CONFIG, HISTORY} & set(one.manifest.files):
            raise UsageError(f"{path} was made by {one.manifest.stage}; give a model or a result.")
    names, known = [], functools.cache(identities.of_manifests)
    for path, one in zip(paths, found, strict=True):
        store = locate(one.directory)
        identity, made = known(store).get(one.digest, {}), one.manifest
        params = {**made.params, "stage": made.stage, "fold": identity.get("fold", 0)}
        name = tracking.name_of(path, digest(identity) if identity else one.digest)
        Tracking(tracking.open_trackers(trackers), name, tracker.params(params)).finish(
            path, tracking.files(made, store)
        )
        names.append(name)
    return names
