"""The roles of a split: which recordings train, validate and test in each of its folds."""

from __future__ import annotations

from collections.abc import Mapping

from tacpipe.datasets.manifest import Manifest
from tacpipe.errors import UsageError

FILE = "split.parquet"
_RECORDING = "split"  # the name of a split's only recording


def digest(manifest: Manifest, place: str) -> str:
    """Return the digest of the table of a split. Raises `UsageError`, which names ``place``, for any other dataset."""
    if set(manifest.recordings) != {_RECORDING}:
        raise UsageError(f"{place} is not a split; make one with `tacpipe split`.")
    shard_digest: str = manifest.recordings[_RECORDING]["shards"][""]["digest"]
    return shard_digest


def read(content: bytes) -> dict[tuple[str, int], str]:
    """Return (recording, fold) to role from the Parquet bytes of a split."""
    from tacpipe.io.parquet import from_parquet

    rows = from_parquet(content, ["recording", "fold", "role"]).to_pydict()
    return dict(zip(zip(rows["recording"], rows["fold"], strict=True), rows["role"], strict=True))


def in_fold(roles: Mapping[tuple[str, int], str], fold: int, place: str) -> dict[str, str]:
    """Return recording to role in a fold of the split ``place``. Raises `UsageError` where it has no such fold."""
    folds = sorted({number for _, number in roles})
    if fold not in folds:
        raise UsageError(f"The split {place} has the folds {folds}, not {fold}.")
    return {recording: role for (recording, number), role in roles.items() if number == fold}
