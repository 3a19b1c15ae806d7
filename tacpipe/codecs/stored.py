"""A stored codec, read back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.codecs.codec import DESCRIPTION, TENSORS, Codec, FittedCodec, description
from tacpipe.codecs.frame_stacking import INCREMENTS, LEVELS
from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError
from tacpipe.plugins import registry
from tacpipe.printable import excerpt, plain

if TYPE_CHECKING:
    from tacpipe.codecs.codec import Floats

NEEDED = {"of": str, "channels": list, "layout": list}
PLUGIN = "plugin"  # field of `codec.json`: the package and version of a codec that is not tacpipe's own


def load(files: Mapping[str, bytes]) -> FittedCodec:
    """Return the codec that `codec.json` and `codec.safetensors` among ``files`` hold.

    Its kind is an entry point of the group ``tacpipe.codecs``. Raises `TacpipeError` where a file is missing, where the
    kind is not installed, and where its parts do not fit one another.
    """
    missing = [name for name in (DESCRIPTION, TENSORS) if name not in files]
    if missing:
        raise TacpipeError(f"There is no {' and no '.join(missing)} here. Give the output of `tacpipe compress`.")
    content = model_files.tree(files, DESCRIPTION, {"kind": str})
    kind = content["kind"]
    if kind not in registry.codecs():
        installed = f"{', '.join(registry.codecs())} are installed"
        if PLUGIN in content:
            package = plain(str(content[PLUGIN]), 100)
            raise TacpipeError(
                f"The codec {excerpt(kind)} comes from the package {package}, which is not installed; "
                f"{installed}. Install it."
            )
        raise TacpipeError(f"A codec of kind {excerpt(kind)} is not installed here; {installed}.")
    model_files.tree(files, DESCRIPTION, NEEDED)
    codec_class = registry.load_codec(kind)
    return _tried(lambda: codec_class.from_files(files))


def to_files(codec: FittedCodec) -> dict[str, bytes]:
    """Return the files of a fitted codec, with the package that brings it, once they were read back.

    Raises `TacpipeError` where its kind is not that of an entry point, or its parts do not fit one another.
    """
    files = dict(codec.to_files())
    read = load(files)
    if type(read) is not type(codec):
        raise TacpipeError(
            f"{type(codec).__name__} is of kind {codec.kind}, and the entry point of that name in {registry.CODECS} is "
            f"{type(read).__name__}."
        )
    package = registry.brought_by(registry.CODECS, codec.kind)
    if package is not None:
        content = {**model_files.tree(files, DESCRIPTION), PLUGIN: str(package)}
        files[DESCRIPTION] = description(content)
    return files


def check_latents(codec: Codec, latents: Floats, rows: int) -> None:
    """Raise `TacpipeError` unless ``latents`` are as many as the codec names, of each of so many ``rows``."""
    expected = (rows, len(codec.latents))
    if latents.shape != expected:
        raise TacpipeError(
            f"The codec {codec.kind} returns latents {latents.shape}; they must be (time, latent), {expected}."
        )


def _tried(read: Callable[[], FittedCodec]) -> FittedCodec:
    """Return a codec whose parts fit one another, tried on a row. Raises `TacpipeError` where they do not."""
    with model_files.validated("the codec"), np.errstate(all="ignore"):
        codec = read()
        if codec.representation not in (LEVELS, INCREMENTS) or not all(
            isinstance(name, str) for name in codec.channels
        ):
            raise ValueError(f"it is of {codec.representation} and of {len(codec.channels)} channels")
        if len(codec.layout) != len(codec.channels) or not all(
            isinstance(channel, Mapping) for channel in codec.layout
        ):
            raise ValueError(f"{len(codec.channels)} channels lie in {len(codec.layout)} places")
        row = np.zeros((1, len(codec.channels)))
        latents = codec.encode(row, codec.channels)
        if latents.shape != (1, len(codec.latents)) or codec.decode(latents).shape != row.shape:
            raise ValueError(f"{row.shape[1]} channels become {latents.shape[1]} latents and others")
        if not np.isfinite(latents).all():
            raise ValueError("its numbers are so large that latents are not finite")
    return codec
