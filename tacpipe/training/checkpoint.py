"""Store the state that an interrupted training resumes from: one file, replaced as a whole after every epoch.

Its first line is the digest of the rest, a safetensors file with the state as JSON in its header: two files could be torn
apart by a crash between them, and training must not resume from a weight that a disk has changed.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from tacpipe.errors import TacpipeError
from tacpipe.io import regular
from tacpipe.io.files import readable_errors, sync_folder, write_whole
from tacpipe.io.hashing import bytes_digest

FILE = "checkpoint"
log = logging.getLogger(__name__)


def write(folder: Path, tensors: Mapping[str, Tensor], state: Mapping[str, Any]) -> None:
    """Replace the checkpoint in ``folder``; after return it is on disk, and before it the old one is whole."""
    content = save({name: tensor.cpu().contiguous() for name, tensor in tensors.items()}, {"state": json.dumps(state)})
    signed = bytes_digest(content).encode() + b"\n" + content
    with readable_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        draft = folder / f"{FILE}.draft"
        draft.unlink(missing_ok=True)  # left by a run that was killed
        write_whole(str(folder / FILE), signed, str(draft))
        sync_folder(str(folder))


def read(folder: Path) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
    """Return tensors and state of the checkpoint in ``folder``; None where there is none or it is damaged."""
    path = folder / FILE
    try:
        signed = regular.content(path, follow=False)
    except FileNotFoundError:
        return None
    except (OSError, TacpipeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        log.warning("The checkpoint %s cannot be read (%s); training starts over.", path, reason)
        return None
    stored, _, content = signed.partition(b"\n")
    try:
        if bytes_digest(content).encode() != stored:
            raise ValueError("its bytes do not give its digest")
        size = int.from_bytes(content[:8], "little")
        state = json.loads(json.loads(content[8 : 8 + size])["__metadata__"]["state"])
        return load(content), state
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        log.warning("The checkpoint %s cannot be read (%s); training starts over.", path, error)
        return None
