"""Send stored models and results to trackers of experiments, as if they were trained now."""

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
    stored = [manifest.find(path) for path in paths]
    for path, entry in zip(paths, stored, strict=True):
        if not {CONFIG, HISTORY} & set(entry.manifest.files):
            raise UsageError(f"{path} was made by {entry.manifest.stage}; give a model or a result.")
    names, identities_of = [], functools.cache(identities.of_manifests)
    for path, entry in zip(paths, stored, strict=True):
        store = locate(entry.directory)
        identity, run_manifest = identities_of(store).get(entry.digest, {}), entry.manifest
        params = {**run_manifest.params, "stage": run_manifest.stage, "fold": identity.get("fold", 0)}
        name = tracking.name_of(path, digest(identity) if identity else entry.digest)
        Tracking(tracking.open_trackers(trackers), name, tracker.params(params)).finish(
            path, tracking.files(run_manifest, store)
        )
        names.append(name)
    return names
