"""A project as an older version of tacpipe left it."""

import tarfile
from pathlib import Path

ARCHIVE = Path(__file__).parent / "project.tar.xz"


def unpack(folder: Path) -> None:
    """Unpack the project into a folder."""
    with tarfile.open(ARCHIVE) as archive:
        if hasattr(tarfile, "data_filter"):
            archive.extractall(folder, filter="data")
        else:  # Python before 3.11.4, as Debian 12 has it
            archive.extractall(folder)
