"""What ``tacpipe show DATASET RECORDING --plot FILE`` does: a picture of one recording."""

from __future__ import annotations

from pathlib import Path

from tacpipe.errors import UsageError
from tacpipe.printable import listed

_NAMED = 5  # recordings that an error names


def write(dataset: Path, recording: str | None, picture: Path | None) -> Path:
    """Draw a recording, the only one where none is named, and return the picture's path.

    Raises `UsageError` for a name without a picture, and where several recordings are there and none is named.
    """
    if picture is None:
        raise UsageError(f"A recording is named to be drawn; give --plot FILE.png too, or leave {recording} out.")
    import tacpipe
    from tacpipe.viewer import contents, figure

    opened = tacpipe.open(dataset)
    if recording is None and len(opened) != 1:
        raise UsageError(
            f"{dataset} has {len(opened)} recordings, and --plot draws one; name it: {listed(opened.recordings, _NAMED)}."
        )
    name = next(iter(opened.recordings)) if recording is None else recording
    figure.draw(contents.of(opened[name]), picture)
    return picture
