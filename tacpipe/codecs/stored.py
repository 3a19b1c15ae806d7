"""A stored codec, read back."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from tacpipe.codecs.autoencoder import Autoencoder
from tacpipe.codecs.codec import DESCRIPTION, TENSORS, Codec
from tacpipe.codecs.frame_stacking import INCREMENTS, LEVELS
from tacpipe.codecs.pca import PCA
from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError
from tacpipe.printable import excerpt

KINDS = ("autoencoder", "pca")
NEEDED = {"of": str, "channels": list, "layout": list}


def load(files: Mapping[str, bytes]) -> Codec:
    """Return the codec that `codec.json` and `codec.safetensors` among ``files`` hold.

    Raises `TacpipeError` where a file is missing or the kind is unknown.
    """
    missing = [name for name in (DESCRIPTION, TENSORS) if name not in files]
    if missing:
        raise TacpipeError(f"There is no {' and no '.join(missing)} here. Give the output of `tacpipe compress`.")
    kind = model_files.tree(files, DESCRIPTION, {"kind": str})["kind"]
    if kind in KINDS:
        model_files.tree(files, DESCRIPTION, NEEDED)
    if kind == "pca":
        return _tried(lambda: PCA.from_files(files))
    if kind == "autoencoder":
        return _tried(lambda: Autoencoder.from_files(files))
    raise TacpipeError(
        f"A codec of kind {excerpt(kind)} is unknown here; {' and '.join(KINDS)} are known. "
        f"Install the plug-in that made it."
    )


def _tried(read: Callable[[], Codec]) -> Codec:
    """Return a codec whose parts fit one another, tried on a row. Raises `TacpipeError` where they do not."""
    with model_files.validated("the codec"), np.errstate(all="ignore"):
        codec = read()
        if codec.representation not in (LEVELS, INCREMENTS) or not all(
            isinstance(name, str) for name in codec.channels
        ):
            raise ValueError(f"it is of {codec.representation} and of {len(codec.channels)} channels")
        if len(codec.layout) != len(codec.channels) or not all(isinstance(one, Mapping) for one in codec.layout):
            raise ValueError(f"{len(codec.channels)} channels lie in {len(codec.layout)} places")
        row = np.zeros((1, len(codec.channels)))
        latents = codec.encode(row, codec.channels)
        if latents.shape != (1, len(codec.latents)) or codec.decode(latents).shape != row.shape:
            raise ValueError(f"{row.shape[1]} channels become {latents.shape[1]} latents and others")
        if not np.isfinite(latents).all():
            raise ValueError("its numbers are so large that latents are not finite")
    return codec
