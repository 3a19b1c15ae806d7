"""What every codec can do, and how a stored one is read back."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    Floats = np.ndarray[Any, np.dtype[np.floating[Any]]]

DESCRIPTION, TENSORS = "codec.json", "codec.safetensors"


class Codec(Protocol):
    """Turns counts above rest into latents and back."""

    @property
    def kind(self) -> str:
        """The word that `load` knows it by."""

    @property
    def channels(self) -> tuple[str, ...]:
        """The tactile channels, in the order that `encode` expects."""

    @property
    def latents(self) -> tuple[str, ...]:
        """The names of the latents, in order."""

    @property
    def layout(self) -> tuple[Mapping[str, str], ...]:
        """Stream, taxel and axis of each channel."""

    def encode(self, values: Floats, channels: Sequence[str]) -> Floats:
        """Return the latents of counts above rest, (time, channel) to (time, latent)."""

    def decode(self, latents: Floats) -> Floats:
        """Return the counts above rest that latents stand for, (…, latent) to (…, channel)."""


@dataclass(frozen=True)
class Raw:
    """The codec of a dataset that has none: each latent is a channel in counts above rest."""

    channels: tuple[str, ...]
    layout: tuple[Mapping[str, str], ...]
    kind: str = "raw"

    @property
    def latents(self) -> tuple[str, ...]:
        """The names of the channels."""
        return self.channels

    def encode(self, values: Floats, channels: Sequence[str]) -> Floats:
        """Return ``values`` as float32, shape (time, channel)."""
        check_channels(self.channels, channels)
        return values.astype(np.float32)

    def decode(self, latents: Floats) -> Floats:
        """Return ``latents`` as they are, shape (…, channel)."""
        return latents


def check_channels(expected: Sequence[str], given: Sequence[str]) -> None:
    """Raise `TacpipeError` unless ``given`` names the channels a codec was fitted on, in their order."""
    if tuple(expected) == tuple(given):
        return
    at = next((i for i, pair in enumerate(zip(expected, given, strict=False)) if pair[0] != pair[1]), None)
    if at is None:
        differ = f"it was fitted on {len(expected)} channels and is given {len(given)}"
    else:
        differ = f"channel {at + 1} is {given[at]} where it was fitted on {expected[at]}"
    raise TacpipeError(f"The codec does not fit this table: {differ}. Fit one on recordings of this rig.")


def latent_names(count: int) -> tuple[str, ...]:
    """Return the column names of ``count`` latents.

    >>> latent_names(3)
    ('z00', 'z01', 'z02')
    """
    return tuple(f"z{index:02d}" for index in range(count))


def load(files: Mapping[str, bytes]) -> Codec:
    """Return the codec that `codec.json` and `codec.safetensors` among ``files`` hold.

    Raises `TacpipeError` where a file is missing or the kind is unknown.
    """
    missing = [name for name in (DESCRIPTION, TENSORS) if name not in files]
    if missing:
        raise TacpipeError(f"There is no {' and no '.join(missing)} here. Give the output of `tacpipe compress`.")
    kind = json.loads(files[DESCRIPTION])["kind"]
    if kind == "pca":
        from tacpipe.codecs.pca import PCA

        return PCA.from_files(files)
    raise TacpipeError(f"A codec of kind {kind!r} is unknown here; pca is known. Install the plug-in that made it.")
