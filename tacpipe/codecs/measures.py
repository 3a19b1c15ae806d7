"""Measure a fitted codec, as ``codec.json`` holds it.

==================  ==============================================================================================
reconstruction      of ``train`` rows and of ``val``, training recordings that were held out: mean squared error of
                    encoding and decoding in units of each channel's scale, where 1 is what a codec without latents
                    gives, and mean absolute error in counts
latent_covariance   of the latents of the training rows, (latent, latent)
search              the networks that were tried; see `tacpipe.codecs.autoencoder_fit`
==================  ==============================================================================================

Errors are those of the newest frame and, of a codec of increments, those of the increments.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NotRequired, Protocol, TypedDict

import numpy as np

from tacpipe.arrays import AnyFloats, Bools
from tacpipe.codecs.codec import LEVELS
from tacpipe.errors import TacpipeError

DIGITS = 6  # stored digits; beyond them the order of additions matters, which the number of threads changes


class Reconstruction(TypedDict):
    """Errors of encoding and decoding rows."""

    rows: int
    mse_standardised: float
    mae_counts: float


class SearchedNetwork(TypedDict):
    """A network that was tried for a codec."""

    hidden: list[int]
    learning_rate: float
    weight_decay: float
    parameters: int
    epochs: int
    val_loss: float
    kept: bool


class CodecMeasures(TypedDict, total=False):
    """The measures of a fitted codec."""

    reconstruction: dict[str, Reconstruction]  # of ``train`` and ``val``
    latent_covariance: list[list[float]]
    search: list[SearchedNetwork]


class StoredCodec(CodecMeasures):
    """``codec.json`` of tacpipe's own codecs."""

    kind: str
    of: str  # levels or increments
    channels: list[str]
    layout: list[dict[str, str]]
    latents: int
    frames: NotRequired[int]
    explained_ratio: NotRequired[list[float]]
    layers: NotRequired[dict[str, int]]


class RowCodec(Protocol):
    """A codec that reads rows as `tacpipe.codecs.codec.inputs` makes them."""

    @property
    def scale_count(self) -> AnyFloats:
        """The spread of each channel on training rows, in counts."""

    def project(self, inputs: AnyFloats) -> AnyFloats:
        """Return the latents (row, latent) of finite rows (row, frames * channel)."""

    def decode(self, latents: AnyFloats) -> AnyFloats:
        """Return the counts that latents decode to."""


def reconstructions(codec: RowCodec, parts: Mapping[str, Iterable[AnyFloats]]) -> dict[str, Reconstruction]:
    """Return the errors on each part, of rows (row, frames * channel) in pieces; a part without rows is left out."""
    errors_by_part = {name: reconstruction(codec, pieces) for name, pieces in parts.items()}
    return {name: errors for name, errors in errors_by_part.items() if errors}


def reconstruction(codec: RowCodec, pieces: Iterable[AnyFloats]) -> Reconstruction | None:
    """Return the errors of encoding and decoding rows (row, frames * channel), and their number; None of no rows."""
    rows, squares, deviations, width = 0, 0.0, 0.0, len(codec.scale_count)
    for inputs in pieces:
        newest = inputs[:, -width:]
        error = codec.decode(codec.project(inputs).astype(np.float32)) - newest
        rows += len(inputs)
        squares += float(np.square(error / codec.scale_count).sum())
        deviations += float(np.abs(error).sum())
    if not rows:
        return None
    return {
        "rows": rows,
        "mse_standardised": rounded(squares / (rows * width)),
        "mae_counts": rounded(deviations / (rows * width)),
    }


def covariance(latents: AnyFloats) -> list[list[float]]:
    """Return the covariance of latents (row, latent), (latent, latent)."""
    return rounded_matrix(np.atleast_2d(np.cov(latents.astype(np.float64), rowvar=False)))


def rounded_matrix(matrix: AnyFloats) -> list[list[float]]:
    """Return a matrix rounded to the stored digits of its largest entry."""
    digits = DIGITS - 1 - int(np.floor(np.log10(max(float(np.abs(matrix).max()), 1e-30))))
    return (matrix.round(digits) + 0.0).tolist()  # type: ignore[no-any-return]  # + 0.0: no minus before a 0


def rounded(value: float) -> float:
    """Return ``value`` rounded to the stored digits.

    >>> rounded(0.123456789)
    0.123457
    """
    return float(f"{value:.{DIGITS}g}")


def stored(content: StoredCodec) -> CodecMeasures:
    """Return what ``codec.json`` holds of measures."""
    measures: CodecMeasures = {}
    if "reconstruction" in content:
        measures["reconstruction"] = content["reconstruction"]
    if "latent_covariance" in content:
        measures["latent_covariance"] = content["latent_covariance"]
    if "search" in content:
        measures["search"] = content["search"]
    return measures


def unmoving_channels(values: AnyFloats, channels: Sequence[str]) -> list[str]:
    """Return the names of the channels that have one value in all rows of ``values`` (time, channel)."""
    return [name for name, moves in zip(channels, _moves(values), strict=True) if not moves]


def standard(values: AnyFloats, representation: str) -> tuple[AnyFloats, AnyFloats]:
    """Return mean and scale of each channel in counts, (channel,) each, of training rows ``values`` (time, channel).

    The scale is the standard deviation, and 1 for a channel that never moves. Increments keep the mean 0, so that rows
    that do not move have latents 0. Raises `TacpipeError` if no channel moves.
    """
    moves = _moves(values)
    if not moves.any():
        raise none_moves(values.shape[1], len(values))
    mean = values.mean(axis=0) if representation == LEVELS else np.zeros(values.shape[1])
    return mean, np.where(moves, values.std(axis=0), 1.0)


def none_moves(channels: int, rows: int) -> TacpipeError:
    """Return the error of training rows in which no channel moves."""
    return TacpipeError(
        f"None of the {channels} tactile channels moves in {rows} training rows, so there is nothing to compress. Give "
        "training recordings with contact."
    )


def _moves(values: AnyFloats) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return whether a channel has more than one value: exact, where a standard deviation would leave rounding."""
    if not len(values):
        return np.zeros(values.shape[1], dtype=bool)
    moves: np.ndarray[Any, np.dtype[np.bool_]] = values.max(axis=0) > values.min(axis=0)
    return moves


class Moments:
    """Number, range and triangle of rows (row, channel).

    Covariances are kept as the triangle R of a QR decomposition of all rows, [1 | x] = Q R, which has as many rows as
    columns. The triangle of more rows is that of R and the new rows below it (Golub, Van Loan, Matrix Computations, 4th
    ed., 6.5), so no product of rows is ever summed, and no digits are lost to the means.
    """

    def __init__(self, width: int) -> None:
        self.count = 0  # rows
        self._low, self._high = np.full(width, np.inf), np.full(width, -np.inf)
        self._triangle: AnyFloats = np.zeros((width + 1, width + 1))

    @classmethod
    def from_pieces(cls, pieces: Iterable[AnyFloats], width: int) -> Moments:
        """Return the moments of rows that come in pieces."""
        moments = cls(width)
        for piece in pieces:
            moments.add(piece)
        return moments

    def add(self, rows: AnyFloats) -> None:
        """Add rows (row, channel)."""
        if len(rows):
            self.count += len(rows)
            self._low, self._high = np.minimum(self._low, rows.min(axis=0)), np.maximum(self._high, rows.max(axis=0))
            self._extend(np.column_stack([np.ones(len(rows)), rows]))

    def merged(self, further: Moments) -> Moments:
        """Return the moments of both sets of rows."""
        merged = Moments(len(self._low))
        merged.count = self.count + further.count
        merged._low, merged._high = np.minimum(self._low, further._low), np.maximum(self._high, further._high)
        merged._triangle = self._triangle
        merged._extend(further._triangle)
        return merged

    @property
    def moves(self) -> Bools:
        """Channels with more than one value: exact, where a standard deviation would leave rounding."""
        return self._high > self._low

    @property
    def centred(self) -> AnyFloats:
        """The triangle of the rows without their means (channel, channel)."""
        triangle: AnyFloats = self._triangle[1:, 1:] * self.moves
        return triangle

    def standard(self, representation: str) -> tuple[AnyFloats, AnyFloats]:
        """Return mean and scale of each channel, (channel,) each, as `tacpipe.codecs.measures.standard` does of the rows."""
        if not self.moves.any():
            raise none_moves(len(self._low), self.count)
        spread = np.sqrt(np.square(self.centred).sum(axis=0) / self.count)
        mean = self._triangle[0, 1:] / self._triangle[0, 0] if representation == LEVELS else np.zeros(len(spread))
        return mean, np.where(self.moves, spread, 1.0)

    def standardised(self, representation: str) -> AnyFloats:
        """Return the triangle of the rows (channel, channel) as `standard` makes channels alike."""
        _, scale = self.standard(representation)
        if representation == LEVELS:
            return self.centred / scale
        return _triangle(self._triangle[:, 1:] / scale)

    def _extend(self, rows: AnyFloats) -> None:
        self._triangle = _triangle(np.concatenate([self._triangle, rows]))


def _triangle(rows: AnyFloats) -> AnyFloats:
    """Return the R of a QR decomposition."""
    triangle: AnyFloats = np.asarray(np.linalg.qr(rows, mode="r"))
    return triangle
