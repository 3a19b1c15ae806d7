"""Stages of a third-party plug-in that ignore requests to end."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.plugins.stage import stage

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Recording

ENTRY_POINTS = """
[tacpipe.stages]
stuck = stubborn:stuck
mistaken = stubborn:mistaken
"""


@dataclass(frozen=True)
class Nothing:
    pass


@stage(version=1)
def stuck(params: Nothing, recording: Recording) -> pa.Table:
    """Stay in one call of C for many minutes."""
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)
    return recording.table("left")


@stage(version=1)
def mistaken(params: Nothing, recording: Recording) -> pa.Table:
    """Raise what no stage should."""
    raise ZeroDivisionError(recording.name)
