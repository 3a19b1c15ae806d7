"""Define the interface of codecs, and read stored ones back."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tacpipe.arrays import AnyFloats, Bools
from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError
from tacpipe.io import Json
from tacpipe.plugins import registry
from tacpipe.printable import excerpt, plain
from tacpipe.signals.runs import run_starts as run_starts

LEVELS, INCREMENTS = "levels", "increments"


def check_representation(representation: str) -> None:
    """Raise `TacpipeError` unless ``representation`` is levels or increments."""
    if representation not in (LEVELS, INCREMENTS):
        raise TacpipeError(f"representation is {representation!r}; a codec is fitted on {LEVELS} or {INCREMENTS}.")


def inputs(values: AnyFloats, begins: Bools | None, representation: str, frames: int) -> AnyFloats:
    """Return what a codec reads of each row of ``values`` (time, channel): (time, frames * channel), newest frame last.

    ``representation`` is levels, ``values`` as they are, or increments, what was added since the row before. ``begins``
    (time,) marks where a stretch begins; None: at the first row alone. Rows at the start of a stretch repeat its first
    frame, and the increment there is 0. Raises `TacpipeError` for another ``representation``.

    >>> inputs(np.array([[1.0], [4.0], [9.0]]), None, "increments", 2).tolist()
    [[0.0, 0.0], [0.0, 3.0], [3.0, 5.0]]
    """
    check_representation(representation)
    rows = np.arange(len(values))
    first = np.zeros_like(rows) if begins is None else np.maximum.accumulate(np.where(begins, rows, 0))
    if representation == INCREMENTS:
        with np.errstate(
            invalid="ignore"
        ):  # a row that is not finite has no increment, at the start of a stretch either
            values = values - values[np.maximum(rows - 1, first)]
    if frames == 1:
        return values
    return np.hstack([values[np.maximum(rows - lag, first)] for lag in reversed(range(frames))])


class Stacking:
    """Stack rows that come in pieces as `inputs` does; it keeps the last rows of a piece, which the next one reads.

    A stretch is a run of rows without a gap in time. Nothing here looks ahead, and nothing looks across the start of a
    stretch: its first row stands in for the rows before it.
    """

    def __init__(self, representation: str, frames: int = 1) -> None:
        check_representation(representation)
        self._representation, self._frames = representation, frames
        self._values: AnyFloats | None = None  # the last rows
        self._begins = np.zeros(0, dtype=bool)

    def next(self, values: AnyFloats, begins: Bools) -> AnyFloats:
        """Return what a codec reads of the next rows; ``values`` (time, channel) and ``begins`` (time,) as for `inputs`."""
        before = len(self._begins)
        if self._values is not None:
            values, begins = np.concatenate([self._values, values]), np.concatenate([self._begins, begins])
        self._values, self._begins = values[-self._frames :], begins[-self._frames :]
        return inputs(values, begins, self._representation, self._frames)[before:]


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

    def encode(self, values: AnyFloats, channels: Sequence[str], begins: Bools | None = None) -> AnyFloats:
        """Return the latents of counts above rest, (time, channel) to (time, latent), float32.

        ``begins`` (time,) marks where a stretch of rows that follow one another begins; None: at the first row alone.
        A row's latents depend on rows of its stretch up to it, never on later ones; where one of those that it reads is
        not finite they are NaN.
        """

    def decode(self, latents: AnyFloats) -> AnyFloats:
        """Return decoded counts, (…, latent) to (…, channel): levels or increments, whichever ``representation`` is."""


class FittedCodec(Codec, Protocol):
    """A codec that was fitted: a class that an entry point of the group ``tacpipe.codecs`` names by its kind.

    A stage fits it, stores what `tacpipe.codecs.codec.to_files` returns of it, and adds its latents to each recording
    (`tacpipe.codecs.tactile`). Models of the task ``forward`` keep a copy of its files and decode what they predict.
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

    def encode(self, values: AnyFloats, channels: Sequence[str], begins: Bools | None = None) -> AnyFloats:
        """Return ``values`` as float32, shape (time, channel)."""
        check_channels(self.channels, channels)
        return values.astype(np.float32)

    def decode(self, latents: AnyFloats) -> AnyFloats:
        """Return ``latents`` as they are, shape (…, channel)."""
        return latents


def decode_ahead(codec: Codec, latents: AnyFloats, last: AnyFloats) -> AnyFloats:
    """Return the counts above rest that latents of future rows decode to, shape (window, step, channel).

    ``latents`` is (window, step, latent), its first step the row after ``last``, which is (window, channel) in counts
    above rest. A codec of increments adds them up onto ``last``; one of levels does not look at it.
    """
    decoded = codec.decode(latents)
    return last[:, None] + np.cumsum(decoded, axis=1) if codec.representation == INCREMENTS else decoded


def encode_finite(project: Callable[[AnyFloats], AnyFloats], inputs: AnyFloats, width: int) -> AnyFloats:
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


def description(content: Json) -> bytes:
    """Return the bytes of ``codec.json``: keys sorted, so that one codec has one content."""
    return model_files.to_json(content)


NEEDED = {"of": str, "channels": list, "layout": list}
PLUGIN = "plugin"  # field of `codec.json`: the package and version of a codec that is not tacpipe's own


def load(files: Mapping[str, bytes]) -> FittedCodec:
    """Return the codec that `codec.json` and `codec.safetensors` among ``files`` hold.

    Its kind is an entry point of the group ``tacpipe.codecs``. Raises `TacpipeError` if a file is missing, where the
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

    Raises `TacpipeError` if its kind is not that of an entry point, or its parts do not fit one another.
    """
    files = dict(codec.to_files())
    read = load(files)
    if type(read) is not type(codec):
        raise TacpipeError(
            f"{type(codec).__name__} is of kind {codec.kind}, but the entry point of that name in {registry.CODECS} is "
            f"{type(read).__name__}."
        )
    package = registry.provider_of(registry.CODECS, codec.kind)
    if package is not None:
        content = {**model_files.tree(files, DESCRIPTION), PLUGIN: str(package)}
        files[DESCRIPTION] = description(content)
    return files


def check_latents(codec: Codec, latents: AnyFloats, rows: int) -> None:
    """Raise `TacpipeError` unless ``latents`` are as many as the codec names, of each of so many ``rows``."""
    expected = (rows, len(codec.latents))
    if latents.shape != expected:
        raise TacpipeError(
            f"The codec {codec.kind} returns latents {latents.shape}; they must be (time, latent), {expected}."
        )


def _tried(read: Callable[[], FittedCodec]) -> FittedCodec:
    """Return a codec whose parts fit one another, tried on a row. Raises `TacpipeError` if they do not."""
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
