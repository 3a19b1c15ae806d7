"""Define the interface of codecs, and load stored ones."""

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
from tacpipe.printable import excerpt, listed, plain
from tacpipe.signals.runs import run_starts as run_starts

LEVELS, INCREMENTS = "levels", "increments"


def check_representation(representation: str) -> None:
    """Raise `TacpipeError` unless ``representation`` is levels or increments."""
    if representation not in (LEVELS, INCREMENTS):
        raise TacpipeError(f"representation is {representation!r}; a codec is fitted on {LEVELS} or {INCREMENTS}.")


def codec_inputs(values: AnyFloats, begins: Bools | None, representation: str, frames: int) -> AnyFloats:
    """Return the inputs of a codec for rows of ``values`` (time, channel): (time, frames * channel), newest frame last.

    ``representation`` is levels, the ``values`` themselves, or increments, the differences from the previous row.
    ``begins`` (time,) marks the first row of each run; None: only the first row. Rows at the start of a run repeat its
    first frame, and the increment there is 0. Raises `TacpipeError` for another ``representation``.

    >>> codec_inputs(np.array([[1.0], [4.0], [9.0]]), None, "increments", 2).tolist()
    [[0.0, 0.0], [0.0, 3.0], [3.0, 5.0]]
    """
    check_representation(representation)
    rows = np.arange(len(values))
    first = np.zeros_like(rows) if begins is None else np.maximum.accumulate(np.where(begins, rows, 0))
    frame_values = values
    if representation == INCREMENTS:
        with np.errstate(invalid="ignore"):  # a row that is not finite has no increment, not even at the start of a run
            frame_values = values - values[np.maximum(rows - 1, first)]
    if frames == 1:
        return frame_values
    return np.hstack([frame_values[np.maximum(rows - lag, first)] for lag in reversed(range(frames))])


class Stacking:
    """Compute `codec_inputs` of rows that arrive in chunks; the last rows of a chunk are kept for the next one.

    A run is a sequence of rows without a gap in time. Inputs depend neither on later rows nor on rows of an earlier
    run: the first row of a run replaces the rows before it.
    """

    def __init__(self, representation: str, frames: int = 1) -> None:
        check_representation(representation)
        self._representation, self._frames = representation, frames
        self._values: AnyFloats | None = None  # rows of the previous call that the next latents depend on
        self._begins = np.zeros(0, dtype=bool)

    def next(self, values: AnyFloats, begins: Bools) -> AnyFloats:
        """Return the inputs of the next rows, which continue the previous ones.

        ``values`` (time, channel) and ``begins`` (time,) are those of `codec_inputs`.
        """
        previous_count = len(self._begins)
        previous_values = values[:0] if self._values is None else self._values
        all_values, all_begins = np.concatenate([previous_values, values]), np.concatenate([self._begins, begins])
        self._values, self._begins = all_values[-self._frames :], all_begins[-self._frames :]
        return codec_inputs(all_values, all_begins, self._representation, self._frames)[previous_count:]


DESCRIPTION, TENSORS = "codec.json", "codec.safetensors"


class Codec(Protocol):
    """Encodes counts above rest as latents, and decodes them."""

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
        """Decode latents (…, latent) to counts (…, channel): levels or increments, according to ``representation``."""


class FittedCodec(Codec, Protocol):
    """A fitted codec. Its class is an entry point of the group ``tacpipe.codecs``, named by its kind.

    A stage fits it, stores the result of `tacpipe.codecs.codec.to_files`, and adds its latents to each recording
    (`tacpipe.codecs.tactile`). Models of the task ``forward`` contain a copy of its files and decode their predictions.
    """

    def to_files(self) -> Mapping[str, bytes]:
        """Return ``codec.json`` and ``codec.safetensors``, which `from_files` reads. Pickles are not allowed.

        `codec.json` is a mapping (`description`) with at least ``kind``, ``of`` (the representation), ``channels`` and
        ``layout`` (a list of mappings of strings); equal codecs have equal bytes.
        """

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> FittedCodec:
        """Return the codec that `to_files` stored. The files may be untrusted; `tacpipe.datasets.model_files` reads them."""


@dataclass(frozen=True)
class Raw:
    """The codec of a dataset without latents: each channel, in counts above rest, is a latent."""

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
        check_channels(self.channels, channels, is_fitted=False)
        return values.astype(np.float32)

    def decode(self, latents: AnyFloats) -> AnyFloats:
        """Return ``latents`` unchanged, shape (…, channel)."""
        return latents


def decode_ahead(codec: Codec, latents: AnyFloats, last: AnyFloats) -> AnyFloats:
    """Return counts above rest of future rows, shape (window, step, channel), decoded from their latents.

    ``latents`` is (window, step, latent), its first step the row after ``last`` (window, channel), which is in counts
    above rest. A codec of increments adds them to ``last``; a codec of levels ignores it.
    """
    decoded = codec.decode(latents)
    return last[:, None] + np.cumsum(decoded, axis=1) if codec.representation == INCREMENTS else decoded


def encode_finite(project: Callable[[AnyFloats], AnyFloats], inputs: AnyFloats, width: int) -> AnyFloats:
    """Return ``project`` of the finite rows of ``inputs``, (time, ``width``), float32; other rows are NaN."""
    finite = np.isfinite(inputs).all(axis=1)
    latents = np.full((len(inputs), width), np.nan, dtype=np.float32)
    latents[finite] = project(inputs[finite])
    return latents


def check_channels(expected: Sequence[str], channels: Sequence[str], *, is_fitted: bool = True) -> None:
    """Raise `TacpipeError` unless ``channels`` are the ``expected`` ones in the same order.

    Those are the channels that the codec was fitted on, or, if not ``is_fitted``, those of the first recording.
    """
    if tuple(expected) == tuple(channels):
        return
    if not is_fitted:
        missing = [name for name in expected if name not in channels]
        more = [name for name in channels if name not in expected]
        lacks = [f"it lacks {listed(missing, 4)}"] if missing else []
        has = [f"it also has {listed(more, 4)}"] if more else []
        raise TacpipeError(
            f"The tactile columns differ from those of the first training recording: "
            f"{' and '.join(lacks + has) or 'they come in another order'}. Exclude the "
            f"recording with `tacpipe label`, or leave the column out of all recordings."
        )
    position = next((i for i, pair in enumerate(zip(expected, channels, strict=False)) if pair[0] != pair[1]), None)
    if position is None:
        difference = f"it was fitted on {len(expected)} channels and is given {len(channels)}"
    else:
        difference = f"channel {position + 1} is {channels[position]} where it was fitted on {expected[position]}"
    raise TacpipeError(f"The codec does not fit this table: {difference}. Fit one on recordings of this rig.")


def latent_names(count: int) -> tuple[str, ...]:
    """Return the column names of ``count`` latents.

    >>> latent_names(3)
    ('z00', 'z01', 'z02')
    """
    return tuple(f"z{index:02d}" for index in range(count))


def description(content: Json) -> bytes:
    """Return the content of ``codec.json``, with sorted keys, so that equal codecs have equal bytes."""
    return model_files.to_json(content)


NEEDED = {"of": str, "channels": list, "layout": list}
PLUGIN = "plugin"  # field of `codec.json`: the package and version of a codec from another package


def load(files: Mapping[str, bytes]) -> FittedCodec:
    """Return the codec in `codec.json` and `codec.safetensors` of ``files``.

    Its kind is an entry point of the group ``tacpipe.codecs``. Raises `TacpipeError` if a file is missing, the kind is
    not installed, or the parts do not match.
    """
    missing = [name for name in (DESCRIPTION, TENSORS) if name not in files]
    if missing:
        raise TacpipeError(f"{missing[0]} does not exist here. Give the output of `tacpipe compress`.")
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
    return _load_checked(lambda: codec_class.from_files(files))


def to_files(codec: FittedCodec) -> dict[str, bytes]:
    """Return the files of a fitted codec, with the package that provides it, after checking that they can be loaded.

    Raises `TacpipeError` if its kind is not its entry point, or its parts do not match.
    """
    files = dict(codec.to_files())
    loaded = load(files)
    if type(loaded) is not type(codec):
        raise TacpipeError(
            f"{type(codec).__name__} is of kind {codec.kind}, but the entry point of that name in {registry.CODECS} is "
            f"{type(loaded).__name__}."
        )
    package = registry.provider_of(registry.CODECS, codec.kind)
    if package is not None:
        content = {**model_files.tree(files, DESCRIPTION), PLUGIN: str(package)}
        files[DESCRIPTION] = description(content)
    return files


def check_latents(codec: Codec, latents: AnyFloats, rows: int) -> None:
    """Raise `TacpipeError` unless ``latents`` has the shape (``rows``, number of latents)."""
    expected = (rows, len(codec.latents))
    if latents.shape != expected:
        raise TacpipeError(
            f"The codec {codec.kind} returns latents {latents.shape}; they must be (time, latent), {expected}."
        )


def _load_checked(read: Callable[[], FittedCodec]) -> FittedCodec:
    """Return the codec that ``read`` returns, after applying it to a row of zeros.

    Raises `TacpipeError` if its parts do not match.
    """
    with model_files.validated("the codec"), np.errstate(all="ignore"):
        codec = read()
        if codec.representation not in (LEVELS, INCREMENTS) or not all(
            isinstance(name, str) for name in codec.channels
        ):
            raise ValueError(f"its representation is {codec.representation} and it has {len(codec.channels)} channels")
        if len(codec.layout) != len(codec.channels) or not all(
            isinstance(channel, Mapping) for channel in codec.layout
        ):
            raise ValueError(f"{len(codec.channels)} channels have a layout of {len(codec.layout)}")
        row = np.zeros((1, len(codec.channels)))
        latents = codec.encode(row, codec.channels)
        if latents.shape != (1, len(codec.latents)) or codec.decode(latents).shape != row.shape:
            raise ValueError(f"the shapes of {row.shape[1]} channels and {latents.shape[1]} latents do not match")
        if not np.isfinite(latents).all():
            raise ValueError("its numbers are so large that latents are not finite")
    return codec
