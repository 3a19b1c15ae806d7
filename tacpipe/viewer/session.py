"""Recordings written for Rerun's viewer, a file each, and the viewer opened on them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from tacpipe.viewer.contents import Contents

NAME = "tacpipe"
ENDING = ".rrd"
UNSAFE = r"[/\\:\x00]"  # in the name of a file


def write(
    recordings: Iterable[Contents], folder: Path, dataset: str, *, several: bool = True, all_rows: bool = False
) -> list[Path]:
    """Write a file of Rerun's for each recording and return the files; the viewer lists them by name below ``dataset``.

    Lines of more than 30,000 rows are written as their envelope, unless ``all_rows``; `several` recordings get their list.
    """
    import rerun as rr

    from tacpipe.viewer import layout, stream

    looks: dict[str, str] = {}
    written = []
    for contents in recordings:
        look = repr(layout.signature(contents))
        name = looks.setdefault(look, application(dataset, len(looks)))
        written.append(folder / f"{re.sub(UNSAFE, '-', contents.name)}{ENDING}")
        recording = rr.RecordingStream(name, recording_id=contents.name)
        recording.save(written[-1])
        recording.send_recording_name(contents.name)
        recording.send_blueprint(layout.blueprint(contents, several=several))
        stream.Stream(recording, contents.ends_ns[0], all_rows=all_rows).send(contents)
        recording.disconnect()  # writes what is left
    return written


def program() -> str:
    """Return the path of Rerun's viewer, a program of its own within the package. Raises `MissingModuleError` without it."""
    import rerun_cli

    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    bundled = Path(rerun_cli.__file__).parent / "Rerun.app" / "Contents" / "MacOS" / "Rerun"
    return str(bundled if bundled.exists() else Path(rerun_cli.__file__).parent / name)


def environment() -> dict[str, str]:
    """Return the environment of Rerun's programs: with ``CI`` set they neither collect nor send what they call analytics."""
    return {**os.environ, "CI": "true"}


def show(files: Sequence[Path]) -> int:
    """Open files in the viewer and return its exit code once it is closed."""
    return subprocess.run([program(), *files], env=environment(), stderr=subprocess.DEVNULL, check=False).returncode


def application(dataset: str, number: int) -> str:
    """Return the name under which the viewer groups recordings that share a layout; it allows few characters.

    >>> application("data/recordings", 0), application("data/recordings", 1)
    ('data-recordings', 'data-recordings-2')
    """
    name = re.sub(r"[^A-Za-z0-9]+", "-", dataset).strip("-") or NAME
    return name if not number else f"{name}-{number + 1}"
