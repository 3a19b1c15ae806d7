"""Find the images of a folder in the order of their names, and check that each file is complete."""

from __future__ import annotations

import re
from pathlib import Path

from tacpipe.errors import TacpipeError
from tacpipe.formats.container import natural_order
from tacpipe.io import files as file_system
from tacpipe.io import regular
from tacpipe.video.files import IMAGE_CODECS
from tacpipe.video.images import END, PNG, START

_PNG_END, _JPEG_SCAN = b"IEND\xaeB`\x82", b"\xff\xda"


def image_paths(folder: Path) -> list[Path]:
    """Return the images directly in a folder, sorted by name with numbers by value.

    Raises `TacpipeError` if there is none.
    """
    names = next((names for directory, _, names in file_system.walk(folder) if Path(directory) == folder), ())
    images = [path for path in (folder / name for name in names) if path.suffix.lower() in IMAGE_CODECS]
    if not images:
        raise TacpipeError(f"{folder} holds no image. Give a folder with JPEG, PNG or WebP files.")
    return sorted(images, key=lambda path: natural_order(path.name))


def last_number(path: Path) -> str | None:
    """Return the last number in the name of an image as text, or None if it has none.

    >>> last_number(Path("left_1744849152.25.jpg")), last_number(Path("a.png"))
    ('1744849152.25', None)
    """
    numbers = re.findall(r"[0-9]+(?:[.][0-9]+)?", path.stem)
    return numbers[-1] if numbers else None


def expect_complete(path: Path) -> None:
    """Raise `TacpipeError` if an image file lacks the header of its kind, or its end. Nothing is decoded."""
    content = regular.source(path)
    if not content:
        raise TacpipeError(f"{path} is empty. Copy it again from its source, or leave it out.")
    kind = IMAGE_CODECS[path.suffix.lower()]
    if kind == "png":
        has_header, has_end = content.startswith(PNG), _PNG_END in content
    elif kind == "mjpeg":  # a preview image within the header has an end of its own
        has_header, has_end = content.startswith(START), content.rfind(END) > content.rfind(_JPEG_SCAN)
    else:
        has_header = content.startswith(b"RIFF") and content[8:12] == b"WEBP"
        has_end = int.from_bytes(content[4:8], "little") + 8 <= len(content)
    if not has_header or not has_end:
        fault = "is cut off" if has_header else f"is no {path.suffix} image"
        raise TacpipeError(f"{path} {fault}. Copy it again from its source, or leave it out.")
