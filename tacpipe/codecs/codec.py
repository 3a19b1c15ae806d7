"""Define the interface of codecs, and read stored ones back."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from tacpipe.codecs.frame_stacking import INCREMENTS, LEVELS
from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    Floats = np.ndarray[Any, np.dtype[np.floating[Any]]]
    Flags = np.ndarray[Any, np.dtype[np.bool_]]

DESCRIPTION, TENSORS = "codec.json", "codec.safetensors"


class Codec(Protocol):
    """Turns counts above rest into latents and back."""

    @property
    def kind(self) -> str:
        """The name of its entry point."""

    @property
    def representation(self) -> str:
        """The values that latents encode: ``levels``, counts above rest, or ``increments``, changes from row to row."""

    @property
    def channels(self) -> tuple[str, ...]:
        """The tactile channels, in the order that `encode` expects."""

    @property
    def latents(self) -> tuple[str, ...]:
        """The names of the latents, in order."""

    @property
    def layout(self) -> tuple[Mapping[str, str], ...]:
        """Stream, taxel and axis of each channel."""

    def encode(self, values: Floats, channels: Sequence[str], begins: Flags | None = None) -> Floats:
        """Return the latents of counts above rest, (time, channel) to (time, latent), float32.

        ``begins`` (time,) marks where a stretch of rows that follow one another begins; None: at the first row alone.
        A row's latents depend on rows of its stretch up to it, never on later ones; where one of those that it reads is
        not finite they are NaN.
        """

    def decode(self, latents: Floats) -> Floats:
        """Return decoded counts, (…, latent) to (…, channel): levels or increments, whichever ``representation`` is."""


class FittedCodec(Codec, Protocol):
    """A codec that was fitted: a class that an entry point of the group ``tacpipe.codecs`` names by its kind.

    A stage fits it, stores what `tacpipe.codecs.stored.to_files` returns of it, and adds its latents to each recording
    (`tacpipe.codecs.latents`). Models of the task ``forward`` keep a copy of its files and decode what they predict.
    """

    def to_files(self) -> Mapping[str, bytes]:
        """Return ``codec.json`` and ``codec.safetensors``: what `from_files` needs, and no pickle.

        `codec.json` is a mapping (`description`) with at least ``kind``, ``of`` (the representation), ``channels`` and
        ``layout`` (a mapping of texts each); the same codec gives the same bytes.
        """

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> FittedCodec:
        """Return the codec that `to_files` wrote; the files may be untrusted (`tacpipe.datasets.model_files` reads them)."""


@dataclass(frozen=True)
class Raw:
    """The codec of a dataset that has none: each latent is a channel in counts above rest."""

    channels: tuple[str, ...]
    layout: tuple[Mapping[str, str], ...]
    kind: str = "raw"
    representation: str = LEVELS

    @property
    def latents(self) -> tuple[str, ...]:
        """The names of the channels."""
        return self.channels

    def encode(self, values: Floats, channels: Sequence[str], begins: Flags | None = None) -> Floats:
        """Return ``values`` as float32, shape (time, channel)."""
        check_channels(self.channels, channels)
        return values.astype(np.float32)

    def decode(self, latents: Floats) -> Floats:
        """Return ``latents`` as they are, shape (…, channel)."""
        return latents


def decode_ahead(codec: Codec, latents: Floats, last: Floats) -> Floats:
    """Return the counts above rest that latents of future rows decode to, shape (window, step, channel).

    ``latents`` is (window, step, latent), its first step the row after ``last``, which is (window, channel) in counts
    above rest. A codec of increments adds them up onto ``last``; one of levels does not look at it.
    """
    decoded = codec.decode(latents)
    return last[:, None] + np.cumsum(decoded, axis=1) if codec.representation == INCREMENTS else decoded


def encode_finite(project: Callable[[Floats], Floats], inputs: Floats, width: int) -> Floats:
    """Return what ``project`` makes of the rows of ``inputs`` that are finite, (time, ``width``), float32; others NaN."""
    finite = np.isfinite(inputs).all(axis=1)
    latents = np.full((len(inputs), width), np.nan, dtype=np.float32)
    latents[finite] = project(inputs[finite])
    return latents


def check_channels(expected: Sequence[str], channels: Sequence[str]) -> None:
    """Raise `TacpipeError` unless ``channels`` names the channels a codec was fitted on, in their order."""
    if tuple(expected) == tuple(channels):
        return
    at = next((i for i, pair in enumerate(zip(expected, channels, strict=False)) if pair[0] != pair[1]), None)
    if at is None:
        differ = f"it was fitted on {len(expected)} channels and is given {len(channels)}"
    else:
        differ = f"channel {at + 1} is {channels[at]} where it was fitted on {expected[at]}"
    raise TacpipeError(f"The codec does not fit this table: {differ}. Fit one on recordings of this rig.")


def latent_names(count: int) -> tuple[str, ...]:
    """Return the column names of ``count`` latents.

    >>> latent_names(3)
    ('z00', 'z01', 'z02')
    """
    return tuple(f"z{index:02d}" for index in range(count))


def description(content: Mapping[str, Any]) -> bytes:
    """Return the bytes of ``codec.json``: keys sorted, so that one codec has one content."""
    return model_files.to_json(content)
